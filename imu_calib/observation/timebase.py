"""A session in the time of its table: what stamps count as a second is put right before solving.

The clock that stamps the samples runs fast by r against the table's. Pulses over its seconds are
1 / (1 + r) of those over the table's; counts and SI values are what they are, and angles that are
summed up over its seconds (1 + r) times too large. What is left of the rate's error goes into the
equations (`Nuisance.CLOCK`), and the ratio with the calibration (`clock_ratio`).

Source: docs/mathematics.md, 'Clocks'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..segmentation.segment import Segment, Statistics, Turn
from ..segmentation.segmented import Move
from ..stream import Units
from .evidence import Evidence


def in_table_time(evidence: Evidence) -> Evidence:
    """Return a session whose seconds are the table's, as far as motions compare the clocks.

    Standard deviations are left as they are: they change by parts in a million of themselves.
    """
    rate = evidence.clock_rate()[0]
    if not rate:
        return evidence
    faster, pulses = 1 + rate, evidence.units is Units.PULSES
    return replace(
        evidence,
        segments=tuple(_segment(s, faster, pulses) for s in evidence.segments),
        turns=tuple(_turn(t, faster, pulses) for t in evidence.turns),
        moves=tuple(_move(m, faster, pulses) for m in evidence.moves),
        clock=replace(evidence.clock, rate=0.0),
    )


def _segment(segment: Segment, faster: float, pulses: bool) -> Segment:
    return replace(segment, statistics=_statistics(segment.statistics, faster, pulses))


def _turn(turn: Turn, faster: float, pulses: bool) -> Turn:
    more = faster if pulses else 1.0
    skewed = turn.skewed
    return replace(
        turn,
        statistics=_statistics(turn.statistics, faster, pulses),
        skewed=None if skewed is None else _statistics(skewed, faster, pulses),
        each=None if turn.each is None else turn.each * more,
    )


def _statistics(statistics: Statistics, faster: float, pulses: bool) -> Statistics:
    more = faster if pulses else 1.0
    return replace(
        statistics,
        duration=statistics.duration / faster,
        mean=statistics.mean * more,
        end_points=statistics.end_points * more,
        blocks=tuple(b * np.array([more, 1.0, 1.0, 1 / faster]) for b in statistics.blocks),
        drift=statistics.drift * more * faster,
    )


def _move(move: Move, faster: float, pulses: bool) -> Move:
    less = 1.0 if pulses else 1 / faster
    gained = move.velocity_steps
    if gained is not None:
        gained = replace(gained, velocity=gained.velocity * less, mean=gained.mean * less)
    turned, seconds = move.turned * less, move.seconds / faster
    return replace(move, turned=turned, seconds=seconds, velocity_steps=gained)
