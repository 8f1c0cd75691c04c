"""A session in the time of its table: the seconds of stamps are corrected before solving.

The clock of the stamps is fast by r against the table's. Pulses over its seconds are 1 / (1 + r) of
those over the table's; counts and SI values are unchanged, and angles summed over its seconds are
(1 + r) times too large. The remaining error of the rate is an unknown of the equations
(`Nuisance.CLOCK`), and the ratio is stored with the calibration (`clock_ratio`).

Source: docs/mathematics.md, 'Clocks'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..segmentation.segment import Statistics, Turn
from ..segmentation.segmented import Move
from ..stream import Units
from .evidence import Evidence


def in_table_time(evidence: Evidence) -> Evidence:
    """Return a session whose seconds are the table's, as far as motions compare the clocks.

    Standard deviations are unchanged: they would change by parts in a million.
    """
    rate = evidence.clock_rate()[0]
    if not rate:
        return evidence
    faster = 1 + rate
    more, less = (faster, 1.0) if evidence.units is Units.PULSES else (1.0, 1 / faster)
    return replace(
        evidence,
        segments=tuple(
            replace(s, statistics=_statistics(s.statistics, faster, more))
            for s in evidence.segments
        ),
        turns=tuple(_turn(t, faster, more) for t in evidence.turns),
        moves=tuple(_move(m, faster, less) for m in evidence.moves),
        clock=replace(evidence.clock, rate=0.0),
    )


def _turn(turn: Turn, faster: float, more: float) -> Turn:
    skewed = turn.skewed
    return replace(
        turn,
        statistics=_statistics(turn.statistics, faster, more),
        skewed=None if skewed is None else _statistics(skewed, faster, more),
        each=None if turn.each is None else turn.each * more,
    )


def _statistics(statistics: Statistics, faster: float, more: float) -> Statistics:
    return replace(
        statistics,
        duration=statistics.duration / faster,
        mean=statistics.mean * more,
        end_points=statistics.end_points * more,
        blocks=tuple(b * np.array([more, 1.0, 1.0, 1 / faster]) for b in statistics.blocks),
        drift=statistics.drift * more * faster,
    )


def _move(move: Move, faster: float, less: float) -> Move:
    gained = move.velocity_steps
    if gained is not None:
        gained = replace(gained, velocity=gained.velocity * less, mean=gained.mean * less)
    turned, seconds = move.turned * less, move.seconds / faster
    return replace(move, turned=turned, seconds=seconds, velocity_steps=gained)
