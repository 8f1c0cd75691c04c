"""Steps between two sessions of a unit that no trend explains.

Source: partial t test of a step in addition to line and steps, at every place and in every
parameter, the probability multiplied by their number (Bonferroni); docs/history.md, 'Steps'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..calibration.agreement import FEWEST_FOR_A_STEP
from ..common.stream import Floats
from .blocks import SIZE, Block
from .lines import Fit, fit, line_design
from .scatter import Prior

_MOST = 5
"""Most steps of one parameter: more are not steps but another course."""
_DISTINCT = 1e-6
"""Share of a step that is independent of line and steps, below which it is one of them."""


@dataclass(frozen=True, eq=False)
class Places:
    """Steps of the units of a block: for each parameter, the first sessions after them.

    Attributes:
        of: Sessions by (unit, parameter), indices in the block; without steps there is no entry.
    """

    of: dict[tuple[int, int], tuple[int, ...]]

    def of_unit(self, unit: int) -> dict[int, list[int]]:
        """Return the parameters that step, by the first session after the step."""
        found: dict[int, list[int]] = {}
        for (u, p), places in self.of.items():
            if u == unit:
                for k in places:
                    found.setdefault(k, []).append(p)
        return dict(sorted(found.items()))


def find_steps(block: Block, weights: Floats, prior: Prior, false_alarm: float) -> Places:
    """Return the steps of units, with a false step in at most one unit of 1 / false_alarm.

    Args:
        block: u units.
        weights: (u, 24, n) of the sessions.
        prior: Of their type.
        false_alarm: For all places and parameters of a unit together.
    """
    count = block.months.shape[1]
    if count < FEWEST_FOR_A_STEP:
        return Places({})
    level = false_alarm / (SIZE * (count - 1))
    design = line_design(block.months)[:, None]
    at = fit(design, weights, block.values)
    t, freedom = (np.zeros((*weights.shape[:2], count)) for _ in range(2))
    for k in range(1, count):
        t[..., k], freedom[..., k] = _t_at(k, design, weights, at, prior)
    found = {}
    for u, p in np.argwhere(np.min(chance_of(t, freedom), axis=-1) < level):
        places: tuple[int, ...] = (int(np.argmax(t[u, p])),)
        own = (block.months[u], weights[u, p], block.values[u, p])
        one = Prior(prior.between[p], prior.scale[p], prior.freedom[p])
        while len(places) < _MOST and (more := _next(places, *own, one, level)) is not None:
            places = tuple(sorted((*places, more)))
        found[int(u), int(p)] = places
    return Places(found)


def step_design(months: Floats, places: tuple[int, ...]) -> Floats:
    """Return the columns of a line with steps, (n, 2 + s): its level is that after the last step.

    Args:
        months: (n,).
        places: First sessions after each step.
    """
    before = np.arange(len(months))[:, None] < np.array(places, dtype=int)
    return np.column_stack([line_design(months), -before.astype(float)])


def _next(
    places: tuple[int, ...],
    months: Floats,
    weights: Floats,
    values: Floats,
    prior: Prior,
    level: float,
) -> int | None:
    """Return the place of a further step of one parameter, None if none is significant."""
    design = step_design(months, places)
    at = fit(design, weights, values)
    t, freedom = np.zeros(len(months)), np.zeros(len(months))
    for k in set(range(1, len(months))) - set(places):
        t[k], freedom[k] = _t_at(k, design, weights, at, prior)
    # By t: the probabilities of large values are all zero.
    best = int(np.argmax(t))
    return best if chance_of(t, freedom)[best] < level else None


def _t_at(
    place: int, design: Floats, weights: Floats, at: Fit, prior: Prior
) -> tuple[Floats, Floats]:
    """Return absolute t (...) of a step at a session in addition to the fit, and its freedom.

    Both are zero without information.
    """
    after = slice(place, None)
    along = np.sum((weights * at.residuals)[..., after], axis=-1)
    crossed = np.sum(weights[..., after, None] * design[..., after, :], axis=-2)
    explained = np.einsum('...i,...ij,...j->...', crossed, at.inverse, crossed)
    own = np.sum(weights[..., after], axis=-1)
    unexplained = own - explained
    determined = unexplained > _DISTINCT * own
    gain = np.divide(along**2, unexplained, out=np.zeros_like(along), where=determined)
    rest = np.maximum(at.square - gain, 0.0)
    scale, freedom = prior.moderated(rest, np.maximum(at.freedom - 1.0, 0.0))
    determined = (
        determined
        & (freedom > 0)
        & (np.sum(weights > 0, axis=-1) >= FEWEST_FOR_A_STEP)
        & (scale > 0)
    )
    t = np.sqrt(np.divide(gain, scale, out=np.zeros_like(gain), where=determined))
    return t, np.where(determined, freedom, 0.0)


def chance_of(t: Floats, freedom: Floats) -> Floats:
    """Return the two-sided p-value of Student's t; 1 without freedom."""
    some = freedom > 0
    return np.where(some, 2 * scipy.special.stdtr(np.where(some, freedom, 1.0), -np.abs(t)), 1.0)
