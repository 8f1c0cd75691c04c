"""Many recordings: batches, catalogues, histories of units and stands, and their page."""
