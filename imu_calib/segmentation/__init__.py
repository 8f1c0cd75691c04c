"""Columns to segments: when the unit stood still and turned, and how well that is known."""
