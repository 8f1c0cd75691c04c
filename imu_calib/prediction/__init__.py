"""Predict the evidence, the accuracy and the duration of a plan before it is run."""

from .each_term import ChangeForecast, TermForecast, forecast_changes, forecast_terms
from .expected import expected
from .forecast import Forecast, check_session, forecast, listed, resting_on_the_table
from .reach import Reached, reach
from .schedule import duration, schedule

__all__ = [
    'ChangeForecast',
    'Forecast',
    'Reached',
    'TermForecast',
    'check_session',
    'duration',
    'expected',
    'forecast',
    'forecast_changes',
    'forecast_terms',
    'listed',
    'reach',
    'resting_on_the_table',
    'schedule',
]
