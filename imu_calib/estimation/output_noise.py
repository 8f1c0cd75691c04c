"""Parts of the covariance of a session's outputs that do not depend on the prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from ..common.budget import ErrorSource
from ..common.stream import Floats
from .components import Blocks, Component, Diagonal
from .evidence import SMALLEST_VARIANCE, Evidence

ENCODER_FREEDOM = 14.0
"""Least degrees of freedom of an encoder's rate: sixteen blocks less a line's two unknowns
(`segmentation.plateaus`)."""
UNREST_FREEDOM = 3.0
"""Least degrees of freedom of the noise of a single dwell: four blocks less their mean
(`segmentation.statistics`)."""
_ANGLES, _VELOCITIES = np.repeat(np.eye(2), 3, axis=1)
"""(6,) masks, one or zero, of the angles and of the velocities among the outputs of a move."""


def own_parts(evidence: Evidence, inflation: Floats | None) -> tuple[Component, ...]:
    """Return the independent errors of each output: noise, quantisation, the encoders' noise.

    `inflation` are factors (m,) on these variances, or None. The first six parts are the random
    walk of the channels.
    """
    # Most equations of a session differ only in the other parts.
    if 'own' not in evidence.cache:
        evidence.cache['own'] = _without_inflation(evidence)
    parts = cast(tuple[Component, ...], evidence.cache['own'])
    if inflation is None:
        return parts
    total = np.sum([c.part.variances for c in parts if isinstance(c.part, Diagonal)], axis=0)
    more = total * (inflation - 1)
    inflated = []
    for c in range(6):
        own = np.where(evidence.layout.channels == c, more, 0.0)
        # Degrees of freedom of the scatter: less the two unknowns of a line.
        freedom = max(1.0, np.count_nonzero(own) - 2.0)
        inflated.append(Component(ErrorSource.SCATTER, Diagonal(own), freedom))
    return (*parts, *inflated)


def _without_inflation(evidence: Evidence) -> tuple[Component, ...]:
    """Return `own_parts` without factors on the variances."""
    segments, turns, walk = evidence.segments, evidence.turns, evidence.walk
    used = evidence.used_moves
    statistics = [s.statistics for s in segments]
    turned = [t.statistics for t in turns]
    site = evidence.site

    def joined(at_rest: Sequence[Floats], turned: Sequence[Floats], moved: Floats) -> Floats:
        rest, turn = (np.array(part).reshape(-1, 6) for part in (at_rest, turned))
        return evidence.layout.joined(rest, turn, moved)

    by_gyros, by_accels = used.noise(evidence.walk_of_moves)
    noise = joined(
        [walk**2 * s.walk_gain for s in statistics],
        [walk**2 * s.walk_gain for s in turned],
        by_gyros * _ANGLES + by_accels,
    )
    # Effect of the gyros' noise on velocities.
    none = np.zeros(6)
    by_rotation = joined([none for _ in segments], [none for _ in turns], by_gyros * _VELOCITIES)
    quantisation = joined(
        [s.quantisation_variance for s in statistics],
        [s.quantisation_variance for s in turned],
        used.quantisation(),
    )
    encoder = joined(
        [s.encoder_variance(site.gravity) for s in segments],
        [np.append(t.encoder_variance(), t.lean_variance(site.gravity)) for t in turns],
        used.encoders(),
    )
    total = noise + by_rotation + quantisation + encoder
    quantisation = quantisation + np.maximum(SMALLEST_VARIANCE - total, 0.0)
    channel = evidence.layout.channels
    parts = [
        Component(ErrorSource.NOISE, Diagonal(np.where(channel == c, noise, 0.0)), freedom)
        for c, freedom in enumerate(evidence.walk_freedom.tolist())
    ]
    parts += [
        Component(ErrorSource.NOISE, Diagonal(by_rotation), float(evidence.walk_freedom[:3].sum())),
        Component(ErrorSource.QUANTISATION, Diagonal(quantisation)),
        Component(ErrorSource.ENCODER_NOISE, Diagonal(encoder)),
    ]
    if held := used.with_accels:
        # The remainder of a level channel is an error along both level axes.
        across = used.by_remainders[list(held)] * (1 - np.eye(3))
        rows = np.array(evidence.layout.velocity)
        parts.append(Component(ErrorSource.QUANTISATION, Blocks(rows, across)))
    for k, segment in enumerate(segments):
        if segment.excess_covariance is not None:
            rows = evidence.layout.dwell[k : k + 1, 3:]
            blocks = Blocks(rows, segment.excess_covariance[None])
            parts.append(Component(ErrorSource.NOISE, blocks, UNREST_FREEDOM))
        if segment.sliding:
            rows = evidence.layout.dwell[k : k + 1, :3]
            blocks = Blocks(rows, segment.sliding**2 * np.eye(3)[None])
            parts.append(Component(ErrorSource.NOISE, blocks, UNREST_FREEDOM))
    return tuple(parts)


def level_gravity(evidence: Evidence, ups: Floats, levelled: float) -> Component:
    """Return the error in turns by cuts within samples and level gravity on a tilted table.

    `levelled` is the standard deviation of the table's tilt about either axis, rad.
    """
    which, rows = evidence.arms.turns, evidence.layout.turn_accels
    level_gravities = [
        evidence.turns[k].level_share * levelled * evidence.site.gravity for k in which
    ]
    variances = np.zeros(len(evidence.layout))
    variances[rows] = np.square(level_gravities).reshape(-1, 1) * (1 - ups[which] ** 2)
    return Component(ErrorSource.NORTH, Diagonal(variances))


def unknown_north(evidence: Evidence, ups: Floats, response: Floats) -> Component:
    """Return the level Earth rate as noise of its size where its direction is unknown.

    By hand every static dwell has an independent heading, and a turn from rest to rest does not
    average all of it out. Where attitudes are estimated it is in the state.
    """
    segments, turns = evidence.segments, evidence.turns
    by_hand = 1.0 if evidence.plan.by_hand and not evidence.free else 0.0
    shares = np.array([*(by_hand for _ in segments), *(t.level_share for t in turns)])
    across = np.eye(3) - ups[:, :, None] * ups[:, None, :]
    square = (shares * evidence.site.north_rate)[:, None, None] ** 2 / 2
    rows = np.vstack([evidence.layout.dwell[:, :3], evidence.layout.turn])
    some = shares > 0
    blocks = Blocks(rows[some], (response @ across @ response.T * square)[some])
    return Component(ErrorSource.NORTH, blocks)
