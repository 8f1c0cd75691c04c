"""Segments to a solution: equations of a session, the joint estimate, and predictions."""
