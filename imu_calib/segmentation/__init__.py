"""Columns to segments: where the unit stood still, where it turned, and how well that is known."""
