"""The sequencer's rules as parameters of a node."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...common.units import DEG
from ..rules import Rules


def declare_rules(declare: Callable[..., Any]) -> Rules:
    """Declare tolerances and times, and return them.

    Args:
        declare: `declared.declare` of the node.

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
            'Largest distance from its goal at which a joint has arrived, deg.',
            lower=1e-6,
            upper=1.0,
        ),
        overshoot=DEG
        * declare(
            'overshoot_tolerance',
            default.overshoot / DEG,
            'Largest overshoot of a goal, and deviation from the path, of a joint, deg.',
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
            'Whether a calibrator is required; it asks for steps to be repeated.',
        ),
        repeats=declare(
            'repeats',
            default.repeats,
            'Largest number of times that a step is repeated when the calibrator asks for it.',
            lower=0,
        ),
        repeat_wait=declare(
            'repeat_wait',
            default.repeat_wait,
            'Longest wait for the calibrator at the end of the plan, s of the joint states.',
            lower=0.0,
        ),
    )
