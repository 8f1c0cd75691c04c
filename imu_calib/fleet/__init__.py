"""Many recordings: found, calibrated in parallel, and stored as rows of a catalogue."""
