"""Whole turns at equally spaced headings: a mean over a turn is the mean over these."""

from __future__ import annotations

import numpy as np

from ..common.rotations import across
from ..common.stream import Floats

_TURN_HEADINGS = 8
"""Means over so many equal steps of a whole turn are exact for products of up to seven inputs."""


def headings(ups: Floats) -> Floats:
    """Return the attitudes of whole turns at equal steps, (t, 8, 3, 3): to body axes.

    Those of the second half are the first half's with the level axes exactly reversed: terms that
    cancel over a whole turn are then exactly zero, not rounding that seems observed.

    Args:
        ups: (t, 3) up in body axes.
    """
    angles = np.arange(_TURN_HEADINGS // 2) * (2 * np.pi / _TURN_HEADINGS)
    cosine, sine = np.cos(angles)[:, None], np.sin(angles)[:, None]
    first, second = (axes[:, None] for axes in across(ups))
    half = np.stack([cosine * first + sine * second, cosine * second - sine * first], axis=-1)
    level = np.concatenate([half, -half], axis=1)
    up = np.broadcast_to(ups[:, None, :, None], (*level.shape[:3], 1))
    return np.concatenate([level, up], axis=-1)


def mean_over_turn(values: Floats) -> Floats:
    """Return the mean (t, ...) over the `headings` of whole turns, (t, 8, ...)."""
    half = _TURN_HEADINGS // 2
    return np.asarray((values[:, :half] + values[:, half:]).sum(axis=1) / _TURN_HEADINGS)
