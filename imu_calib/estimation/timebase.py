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

from ..segmentation.segments import Statistics, Turn
from ..segmentation.stream_facts import Move
from .evidence import Evidence


def in_table_time(evidence: Evidence) -> Evidence:
    """Return a session whose seconds are the table's, as far as motions compare the clocks.

    Standard deviations are unchanged: they would change by parts in a million.
    """
    rate = evidence.clock_rate()[0]
    if not rate:
        return evidence
    faster = 1 + rate
    # Pulses are sums, divided by seconds to give rates; counts and SI values are rates.
    on_rates, on_increments = (faster, 1.0) if evidence.units.per_interval else (1.0, 1 / faster)
    return replace(
        evidence,
        segments=tuple(
            replace(s, statistics=_retimed_statistics(s.statistics, faster, on_rates))
            for s in evidence.segments
        ),
        turns=tuple(_retimed_turn(t, faster, on_rates) for t in evidence.turns),
        moves=tuple(_retimed_move(m, faster, on_increments) for m in evidence.moves),
        clock=replace(evidence.clock, rate=0.0),
    )


def _retimed_turn(turn: Turn, faster: float, on_rates: float) -> Turn:
    """Return a turn by a clock that is slower by a factor, with a factor on its outputs."""
    skewed = turn.skewed
    return replace(
        turn,
        statistics=_retimed_statistics(turn.statistics, faster, on_rates),
        skewed=None if skewed is None else _retimed_statistics(skewed, faster, on_rates),
        each=None if turn.each is None else turn.each * on_rates,
    )


def _retimed_statistics(statistics: Statistics, faster: float, on_rates: float) -> Statistics:
    """Return statistics by a clock that is slower by a factor, with a factor on their outputs."""
    return replace(
        statistics,
        duration=statistics.duration / faster,
        mean=statistics.mean * on_rates,
        end_points=statistics.end_points * on_rates,
        blocks=tuple(b * np.array([on_rates, 1.0, 1.0, 1 / faster]) for b in statistics.blocks),
        drift=statistics.drift * on_rates * faster,
    )


def _retimed_move(move: Move, faster: float, on_increments: float) -> Move:
    """Return a move by a clock that is slower by a factor, with a factor on its increments."""
    gained = move.velocity_steps
    if gained is not None:
        gained = replace(
            gained, velocity=gained.velocity * on_increments, mean=gained.mean * on_increments
        )
    turned, seconds = move.turned * on_increments, move.seconds / faster
    return replace(move, turned=turned, seconds=seconds, velocity_steps=gained)
