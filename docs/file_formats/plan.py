"""The keys of a plan's file."""

from __future__ import annotations

from itertools import product

import numpy as np

from imu_calib.common.units import Dimension
from imu_calib.estimation.methods import METHODS
from imu_calib.session.plan import COMPASS

from .keys import (
    REQUIRED,
    Key,
    Tables,
    Value,
    array,
    choice,
    flag,
    given,
    has,
    mapping,
    quantity,
    text,
    when,
    whole,
)

D = Dimension
_FRAMES = [
    list(axes)
    for axes in product(COMPASS, repeat=3)
    if np.linalg.det(np.array([COMPASS[letter] for letter in axes])) > 0.5
]

_RATE_TEST = [
    Key(
        'rates',
        array(quantity(D.RATE, 'not 0')),
        'signed rates about up, in order; not with `by_hand`',
        REQUIRED,
    ),
    Key(
        'turns',
        whole(1),
        'whole turns at each rate; the table adds one for starting and stopping',
        1,
    ),
]
_BY_HAND = mapping([_RATE_TEST[1]])
_TURNED = [
    Key('about', choice(['X', 'Y', 'Z']), 'body axis', REQUIRED),
    Key('by', quantity(D.ANGLE), 'angle', REQUIRED),
]
_POSITION = [
    Key('id', text(), 'name; no two alike', REQUIRED),
    Key(
        'axes',
        Value({'enum': _FRAMES}, 'list of three of `E`, `N`, `U`, `W`, `S`, `D`'),
        "where X, Y and Z point, in this order, when the table's zero points north; a "
        'right-handed frame',
        REQUIRED,
    ),
    Key('turned', mapping(_TURNED, words='keys, below'), 'a further turn about a body axis'),
    Key(
        'dwell',
        quantity(D.TIME, '0 or more'),
        'at this position; 0 only with turns',
        None,
        '`dwell` of the plan',
    ),
    Key('rate_test', flag(), 'whether turns are made here, before the dwell', default=False),
]
_STANDS = when(
    has('rate_test', True),
    {},
    {
        'properties': {
            'dwell': {**quantity(D.TIME, 'above 0').schema, 'type': ['string', 'null']},
        }
    },
)
_ASKS = {'properties': {'positions': {'contains': has('rate_test', True)}}}

KEYS = [
    Key('name', text(), 'of the plan', REQUIRED),
    Key('title', text(), 'one line for a person', REQUIRED),
    Key('source', text(), 'document and section', REQUIRED),
    Key(
        'method',
        choice(list(METHODS)),
        'the solver of the plan ([methods](../methods.md))',
        REQUIRED,
    ),
    Key(
        'dwell',
        quantity(D.TIME, 'above 0'),
        'time to stand still at a position; 30 days in all at most',
        REQUIRED,
    ),
    Key('by_hand', flag(), 'turned by hand: the angle is known, the rate is not', default=False),
    Key(
        'rate_test',
        Value({'type': 'object'}, 'keys, below'),
        'turns about the vertical',
        None,
        'none; must be given if a position has one',
    ),
    Key(
        'positions',
        array(mapping(_POSITION, _STANDS), words='list of positions, below'),
        'in the order of the run',
        REQUIRED,
    ),
]

TABLES: Tables = {
    'plan': KEYS,
    'rate_test': _RATE_TEST,
    'positions': _POSITION,
    'turned': _TURNED,
}
VALUE = mapping(
    KEYS,
    when(
        has('by_hand', True),
        {'properties': {'rate_test': {**_BY_HAND.schema, 'type': ['object', 'null']}}},
        {'properties': {'rate_test': {**mapping(_RATE_TEST).schema, 'type': ['object', 'null']}}},
    ),
    when(_ASKS, given('rate_test')),
)
TITLE = 'A plan: the positions, rates and dwells of a session'
