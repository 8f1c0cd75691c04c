"""Observations of a session: outputs, the unknowns that predict them, and their uncertainties.

Used by the joint estimate, the verification of calibrations, the predictions of plans and free
positions. It does not depend on how an estimate is searched for.
"""
