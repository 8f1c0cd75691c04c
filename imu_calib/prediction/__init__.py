"""What a plan will give, before it is run: its evidence, its accuracy, its time."""

from .each_term import OfTerm, of_each_term
from .expected import expected
from .forecast import Forecast, check_session, forecast, listed
from .reach import Reached, reach
from .schedule import duration, schedule

__all__ = [
    'Forecast',
    'OfTerm',
    'Reached',
    'check_session',
    'duration',
    'expected',
    'forecast',
    'listed',
    'of_each_term',
    'reach',
    'schedule',
]
