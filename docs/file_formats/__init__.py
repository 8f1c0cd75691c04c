"""Descriptions of the files that people write: the source of their schemas and tables of keys."""
