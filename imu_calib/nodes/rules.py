"""The sequencer's rules as parameters of a node."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..sequencing import Rules
from ..units import DEG


def declare_rules(declare: Callable[..., Any]) -> Rules:
    """Declare tolerances and times, and return them.

    Args:
        declare: `parameters.declare` of the node.

    Raises:
        InputError: A value has another type or lies outside its range.

    """
    default = Rules()
    return Rules(
        settle=declare(
            'settle',
            default.settle,
            'From the stop of the joints to the start of the dwell, s of the joint states.',
            lower=0.0,
        ),
        arrival=DEG
        * declare(
            'arrival_tolerance',
            default.arrival / DEG,
            'A joint has arrived that stands so close to its goal, deg.',
            lower=1e-6,
            upper=1.0,
        ),
        overshoot=DEG
        * declare(
            'overshoot_tolerance',
            default.overshoot / DEG,
            'How far a joint may pass its goal or stray from its way, deg.',
            lower=1e-5,
            upper=10.0,
        ),
        feedback_timeout=declare(
            'feedback_timeout',
            default.feedback_timeout,
            'Longest gap between the stamps of joint states, s.',
            lower=0.001,
        ),
        supervised=declare(
            'supervised',
            default.supervised,
            'Whether a calibrator must be heard; it says what is to be repeated.',
        ),
        repeats=declare(
            'repeats',
            default.repeats,
            'How often a step is repeated at most if the calibrator asks for it.',
            lower=0,
        ),
        repeat_wait=declare(
            'repeat_wait',
            default.repeat_wait,
            'How long the end of the plan waits for the calibrator, s of the joint states.',
            lower=0.0,
        ),
    )
