"""Evaluation of many calibrations: of units, of populations, of stands (docs/history.md)."""
