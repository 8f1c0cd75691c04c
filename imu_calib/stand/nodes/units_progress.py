"""Reports of a calibrator on several units: the least advanced unit determines them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..middleware import messages
from .live import LiveSession, SessionPhase
from .session_reports import is_fed
from .sessions import Sessions

_ENDS = frozenset({SessionPhase.FINISHED, SessionPhase.FAILED})


def progress_of_all(
    sessions: Sessions, each: Sequence[Any], imu_timeout: float, folder: Path
) -> Any:
    """Return the common progress of the sessions; the node that runs the plan uses it.

    The standard deviation of a parameter is that of the unit with the largest. Steps are repeated
    if any unit whose session continues lacks their data. Excluded units do not count.

    Args:
        sessions: Of all units.
        each: imu_calib_msgs/CalibrationProgress of each, in their order.
        imu_timeout: Longest silence of a unit against the table, s.
        folder: Folder of the results.
    """
    open_ = [(s, m) for s, m in zip(sessions.all, each, strict=True) if s in sessions.open]
    running = [(s, m) for s, m in open_ if not s.is_over] or open_ or [(sessions.all[0], each[0])]
    std: dict[str, float] = {}
    for _, message in running:
        pairs = zip(message.parameter_names, message.standard_deviations, strict=True)
        for name, value in pairs:
            # A NaN is worse than any number, and is kept.
            least = std.get(name, 0.0)
            std[name] = math.nan if math.isnan(value + least) else max(least, float(value))
    state, text = _state(sessions, imu_timeout)
    first = each[0]
    common = messages.CalibrationProgress(
        plan=first.plan,
        step=max(int(message.step) for message in each),
        steps=first.steps,
        state=int(state),
        text=text,
        parameter_names=list(std),
        standard_deviations=list(std.values()),
        seconds_left=first.seconds_left,
        repeat_steps=sorted({int(k) for _, message in running for k in message.repeat_steps}),
        file=str(folder.absolute()),
        journal=first.journal,
        serial_numbers=[session.setup.serial_number for session in sessions.open],
    )
    stamps = [message.header.stamp for _, message in running]
    common.header.stamp = min(stamps, key=lambda stamp: (stamp.sec, stamp.nanosec))
    return common


def _state(sessions: Sessions, imu_timeout: float) -> tuple[SessionPhase, str]:
    """Return the common phase, and a sentence on it."""
    trouble = next((s.trouble for s in sessions.open if s.trouble), '')
    if trouble:
        # A full disk stops the table: further data could not be recorded.
        return SessionPhase.FAILED, trouble
    phase = sessions.phase
    failed = [s for s in sessions.open if s.phase is SessionPhase.FAILED]
    reasons = ' '.join(f'{_name(s)}: {s.failure}' for s in failed)
    if not sessions.open:
        return phase, 'All units are left out.'
    if phase in _ENDS:
        done = len(sessions.open) - len(failed)
        if sessions.is_over:
            return phase, f'{done} of {len(sessions.open)} units are calibrated. {reasons}'.strip()
        return phase, f'{reasons} Leave the unit out to go on with the others, or call ~/reset.'
    silent = [s for s in sessions.open if not is_fed(s, imu_timeout)]
    if silent and phase is not SessionPhase.FINISHED:
        names = ', '.join(_name(s) for s in silent)
        return SessionPhase.WAITING, f'No samples come from {names}.'
    running = [s for s in sessions.open if not s.is_over] or sessions.open
    known = [0 if s.review is None else int((s.review.std > 0).sum()) for s in running]
    least = running[known.index(min(known))]
    reached = f'{min(known)} of {len(least.parameters)} parameters'
    return (
        phase,
        f'{len(sessions.open)} units; {_name(least)} has the fewest determined: {reached}.',
    )


def _name(session: LiveSession) -> str:
    return session.setup.serial_number
