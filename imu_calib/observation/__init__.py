"""What a session tells of: its observations, the unknowns they are predicted by, and the doubts.

The joint estimate, the judge of calibrations, the predictions of plans and free positions rest on
it. It knows nothing of how an estimate is searched for.
"""
