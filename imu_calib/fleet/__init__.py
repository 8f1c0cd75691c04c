"""Many recordings: found, calibrated side by side, and kept as rows of a catalogue."""
