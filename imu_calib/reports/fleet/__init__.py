"""The page on a catalogue: matters for attention, the types, and every unit."""
