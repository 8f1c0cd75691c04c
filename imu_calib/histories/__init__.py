"""What many calibrations say: of a unit's course, of a population, of a stand (docs/history.md)."""
