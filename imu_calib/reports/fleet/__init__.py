"""The page on a catalogue: what needs a person, the types, and every unit."""
