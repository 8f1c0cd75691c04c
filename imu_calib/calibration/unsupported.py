"""Find steps of a plan that were run but have too little usable data."""

from __future__ import annotations

from ..common.stream import Mode
from ..segmentation.labelling import Labelled
from ..segmentation.segments import Turn
from ..segmentation.stream_facts import Segmented
from ..session.plan import Plan, Step

_ENOUGH = 0.5
"""Share of a dwell that must be usable: less increases its noise by more than a factor 1.4."""

_SAME_RATE = 0.2
"""Relative tolerance on the commanded rate. A judgement: scale factors are percents off, and the
rates of a supplied plan differ by a quarter or more."""


def unsupported_steps(
    session: Segmented, labelled: Labelled, plan: Plan, steps: tuple[Step, ...]
) -> tuple[int, ...]:
    """Return the steps whose setpoints were seen without sufficient data.

    Args:
        session: Contents of the streams.
        labelled: Its segments by name.
        plan: The plan that is run.
        steps: Its steps on the table; none without one, since nothing can be repeated.

    Returns:
        Indices of steps, ascending; the current step is among them until it is done.
    """
    seen = [s.step for s in session.setpoints if s.plan == plan.name and s.mode is not Mode.HOLD]
    # Steps are run in order: one whose setpoints were lost with all else was run as well.
    last = max(seen, default=-1)
    rates = _rates_about_up(plan, steps)
    lost = [
        step.index
        for step in steps
        if step.index <= last and not _is_supported(step, labelled, rates.get(step.index))
    ]
    return tuple(lost)


def _is_supported(step: Step, labelled: Labelled, rate: float | None) -> bool:
    if step.mode is Mode.RATE:
        return any(_is_turn_of(turn, step.position, rate) for turn in labelled.turns)
    if not step.dwell:
        return True
    quiet = sum(
        segment.statistics.duration
        for segment in labelled.segments
        if segment.position == step.position
    )
    return quiet >= _ENOUGH * step.dwell


def _is_turn_of(turn: Turn, position: str, rate: float | None) -> bool:
    if turn.position != position or rate is None:
        return False
    return abs(turn.rate() - rate) < _SAME_RATE * abs(rate)


def _rates_about_up(plan: Plan, steps: tuple[Step, ...]) -> dict[int, float]:
    """Return the signed rate about up of every RATE step: those of its position, in order."""
    rates = {p.id: list(p.rate_test.rates) for p in plan.positions if p.rate_test is not None}
    return {step.index: rates[step.position].pop(0) for step in steps if step.mode is Mode.RATE}
