"""The sensor model: parameters, their kinds, terms, and what the channels answer."""

from .kinds import TRIADS, Carried, Kind, ParameterKind, Unit
from .parameters import (
    AXES,
    MOST_SKEWED,
    PARAMETER_NAMES,
    PARAMETERS,
    Parameter,
    Product,
    positions,
    skewed_parameters,
)
from .sensors import (
    PRODUCTS,
    Regressors,
    SensorModel,
    Skewed,
    Triad,
    by_name,
    parameters_of,
    regressors,
    terms_of,
)
from .terms import G_SENSITIVITIES, G_SENSITIVITY, NO_TERMS, TERMS, Term, chosen, term

__all__ = [
    'AXES',
    'G_SENSITIVITIES',
    'G_SENSITIVITY',
    'MOST_SKEWED',
    'NO_TERMS',
    'PARAMETERS',
    'PARAMETER_NAMES',
    'PRODUCTS',
    'TERMS',
    'TRIADS',
    'Carried',
    'Kind',
    'Parameter',
    'ParameterKind',
    'Product',
    'Regressors',
    'SensorModel',
    'Skewed',
    'Term',
    'Triad',
    'Unit',
    'by_name',
    'chosen',
    'parameters_of',
    'positions',
    'regressors',
    'skewed_parameters',
    'term',
    'terms_of',
]
