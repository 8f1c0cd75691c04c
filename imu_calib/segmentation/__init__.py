"""Columns to segments: when the unit stood still, when it turned, and the uncertainty of both."""
