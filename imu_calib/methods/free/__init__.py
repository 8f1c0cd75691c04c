"""Free positions: no table, attitudes that nobody knows, holds found by the data."""

from .fit import FreeFit, in_frame_of_accelerometers, refuse, solve
from .holds import Hold, Swing
from .system import ESTIMATES, FREE

NAME = 'free_positions'
"""The method's name in plans."""

__all__ = [
    'ESTIMATES',
    'FREE',
    'NAME',
    'FreeFit',
    'Hold',
    'Swing',
    'in_frame_of_accelerometers',
    'refuse',
    'solve',
]
