"""Estimate the unknowns from observations: fit of one system, excess scatter, missing terms."""
