"""Free positions: no table, attitudes that nobody knows, holds found by the data."""

from .fit import ESTIMATES, FREE, FreeFit, in_frame_of_accelerometers, refuse, solve

NAME = 'free_positions'
"""The method's name in plans."""

__all__ = [
    'ESTIMATES',
    'FREE',
    'NAME',
    'FreeFit',
    'in_frame_of_accelerometers',
    'refuse',
    'solve',
]
