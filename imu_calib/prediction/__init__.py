"""What a plan will give, before it is run: its evidence, its accuracy, its time."""

from .each_term import TermForecast, forecast_terms
from .expected import expected
from .forecast import Forecast, check_session, forecast, listed
from .reach import Reached, reach
from .schedule import duration, schedule

__all__ = [
    'Forecast',
    'Reached',
    'TermForecast',
    'check_session',
    'duration',
    'expected',
    'forecast',
    'forecast_terms',
    'listed',
    'reach',
    'schedule',
]
