"""The keys of a plan's file."""

from __future__ import annotations

from itertools import product

import numpy as np

from imu_calib.common.units import Dimension
from imu_calib.session.plan import (
    BY_HAND,
    COMPASS,
    RateTest,
    StatedPlan,
    StatedPosition,
    Turned,
    read_axes,
    read_rate_test,
    read_rates,
)

from .keys import (
    CONDITIONS,
    VALUES,
    Schema,
    Tables,
    Value,
    array,
    given,
    has,
    keys_of,
    mapping_of,
    quantity,
    when,
)

_FRAMES = [
    list(axes)
    for axes in product(COMPASS, repeat=3)
    if np.linalg.det(np.array([COMPASS[letter] for letter in axes])) > 0.5
]
VALUES.update(
    {
        read_rates: lambda: array(quantity(Dimension.RATE, 'not 0')),
        read_axes: lambda: Value(
            {'enum': _FRAMES}, 'list of three of `E`, `N`, `U`, `W`, `S`, `D`'
        ),
        read_rate_test: lambda: Value({'type': 'object'}, 'keys, below'),
    }
)
CONDITIONS[StatedPosition] = [
    when(
        has('rate_test', True),
        {},
        {
            'properties': {
                'dwell': {**quantity(Dimension.TIME, 'above 0').schema, 'type': ['string', 'null']},
            }
        },
    )
]
_ASKS = {'properties': {'positions': {'contains': has('rate_test', True)}}}


def _turns(variant: str) -> Schema:
    turns = mapping_of(RateTest, variant).schema
    return {'properties': {'rate_test': {**turns, 'type': ['object', 'null']}}}


CONDITIONS[StatedPlan] = [
    when(has('by_hand', True), _turns(BY_HAND), _turns('key')),
    when(_ASKS, given('rate_test')),
]
TABLES: Tables = {
    'plan': keys_of(StatedPlan),
    'rate_test': keys_of(RateTest),
    'positions': keys_of(StatedPosition),
    'turned': keys_of(Turned),
}
VALUE = mapping_of(StatedPlan)
TITLE = 'A plan: the positions, rates and dwells of a session'
