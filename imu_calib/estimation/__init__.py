"""Observations to unknowns: the fit of one system, its scatter, and the terms that it lacks."""
