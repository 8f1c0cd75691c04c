"""The sessions of all units on one table: they begin, receive data, and end together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...calibration.calibrator import estimate_together
from ...calibration.results import Result, Review
from ...common.errors import ImuCalibError
from ...recordings.cdr_codec import Kind
from ...recordings.writer import Journal
from ...session.metadata import LEFT_OUT, mount_description, unit_description
from ...session.units_file import namespace
from .live_session import (
    AnyCalibrator,
    LiveSession,
    SessionPhase,
    SharedJournal,
    SharedSolver,
    SolverPart,
)
from .session_parameters import StatedUnit

_LEFT_OUT = 'The unit was left out of the session.'


class Sessions:
    """A `LiveSession` for each unit, with a common journal.

    Data in the journal from before a crash is read first, in one pass.
    """

    def __init__(
        self,
        units: Sequence[StatedUnit],
        topics: Sequence[Mapping[Kind, str]],
        journal: Journal,
        common: Mapping[Kind, str],
        absent: Iterable[str] = (),
    ) -> None:
        self.left_out: set[int] = set()  #: Places of the units that the user has excluded.
        self._absent = set(absent)  # Names of those that are not among the units at all.
        self.journal = journal
        self._names = [unit.name for unit in units]
        self._solver = SharedSolver(concluded)
        self._parts = [SolverPart(self._solver, unit.setup.serial_number) for unit in units]
        shared = SharedJournal(journal, frozenset(common.values()))
        #: One for each unit, in their order.
        self.all = tuple(
            LiveSession(unit.setup, shared.part(), {**common, **own}, part, unit.solved)
            for unit, own, part in zip(units, topics, self._parts, strict=True)
        )
        if journal.resumed:
            self._replay_journal()
        else:
            for session in self.all:
                session.notes += journal.losses
        if self._absent:
            self._note_left_out()

    def _replay_journal(self) -> None:
        """Feed the sessions with the journal's data from before a crash."""
        fed: dict[str, list[tuple[LiveSession, Kind]]] = {}
        for session in self.all:
            for kind, intake in session.intakes.items():
                fed.setdefault(intake.topic, []).append((session, kind))
        for topic, block in self.journal.replay():
            for session, kind in fed[topic]:
                session.feed_former(kind, block)
        for session in self.all:
            session.end_of_journal(self.journal.losses)
        for name in filter(None, self.journal.former.get(LEFT_OUT, '').split(',')):
            if name in self._names:
                self.leave_out(self._names.index(name))
            else:
                self._absent.add(name)

    @property
    def is_over(self) -> bool:
        """Whether no more messages are accepted."""
        return all(session.is_over for session in self.all)

    @property
    def open(self) -> list[LiveSession]:
        """The sessions of the units that were not excluded."""
        return [s for k, s in enumerate(self.all) if k not in self.left_out]

    @property
    def may_review(self) -> bool:
        """Whether the pause since the last round of reviews is as long as that round."""
        return self._solver.may_review

    def add_common_messages(self, kind: Kind, payloads: Sequence[bytes], now: int) -> None:
        """Add messages of the table; see `LiveSession.add_messages`."""
        for session in self.all:
            if not session.is_over:
                session.add_messages(kind, payloads, now)

    def record(self, topic: str, type_name: str, payload: bytes, now: int) -> None:
        """Record a message that calibration does not use."""
        for session in self.all:
            if not session.is_over:
                session.record(topic, type_name, payload, now)
                return

    def leave_out(self, place: int) -> None:
        """Continue without a unit: its session ends without a result, its topic is not recorded.

        The recording states this, so that reprocessing excludes it too.
        """
        self.left_out.add(place)
        self._note_left_out()
        self.all[place].fail(_LEFT_OUT)

    def _note_left_out(self) -> None:
        names = self._absent | {self._names[k] for k in self.left_out}
        self.journal.note({LEFT_OUT: ','.join(sorted(names))})

    def poll(self) -> list[int]:
        """Check for results of the solver and for the end; return the units with news."""
        news = [place for place, session in enumerate(self.all) if session.poll()]
        if news and self.journal.sha256:
            for session in self.all:
                session.cite_journal()
        parts = [p for p, s in zip(self._parts, self.all, strict=True) if not s.is_over]
        if parts and all(part.ready for part in parts):
            self._solver.conclude(parts)
        return news

    def solve(self) -> None:
        """Begin a round of reviews, one of each session, if the last one is long enough ago."""
        if self.may_review:
            for session in self.all:
                session.solve()

    def end(self) -> None:
        """Solve the received data for the final results."""
        for session in self.all:
            session.end()

    def flush(self) -> None:
        """Secure the received data, and retry what a full disk refused."""
        for session in self.all:
            session.flush()

    def close(self) -> None:
        """Close the journal so that it can be resumed."""
        self._solver.threads.shutdown(wait=False, cancel_futures=True)
        for session in self.all:
            session.close()

    @property
    def held(self) -> int:
        """Number of messages taken, those of the journal included."""
        counts = {i.topic: i.count for session in self.all for i in session.intakes.values()}
        return sum(counts.values())

    @property
    def phase(self) -> SessionPhase:
        """The least advanced phase of the open sessions; the worst once one failed.

        With several units it is FINISHED as soon as one of them has a result.
        """
        phases = [session.phase for session in self.open]
        if phases and all(session.is_over for session in self.open):
            return SessionPhase.FINISHED if SessionPhase.FINISHED in phases else phases[0]
        if SessionPhase.FAILED in phases or not phases:
            return SessionPhase.FAILED
        return min(phases)


def concluded(
    calibrators: Sequence[AnyCalibrator], serials: Sequence[str]
) -> list[Review | ImuCalibError]:
    """Conclude sessions: each by itself, then their common table errors from all of them.

    Returns:
        A review of each, or the error that prevented it.
    """
    each = [_reviewed(calibrator) for calibrator in calibrators]
    if len(each) == 1:
        return each
    # In the order of names: floating-point sums depend on the order.
    order = sorted(range(len(each)), key=lambda k: namespace(serials[k]))
    results = [one.result if isinstance(one, Review) else None for one in each]
    shared = estimate_together([results[k] for k in order], [serials[k] for k in order]).results
    for k, result in zip(order, shared, strict=True):
        one = each[k]
        if isinstance(one, Review):
            each[k] = _with(one, result)
    return each


def _with(review: Review, result: Result | None) -> Review:
    """Return a review with another result of its session."""
    if result is None or result is review.result:
        return review
    std = dict(zip(result.calibration.parameters, result.calibration.std, strict=True))
    return replace(
        review, result=result, std=np.array([std.get(p, np.nan) for p in review.parameters])
    )


def _reviewed(calibrator: AnyCalibrator) -> Review | ImuCalibError:
    try:
        return calibrator.conclude()
    except ImuCalibError as error:
        return error


class SessionFactory:
    """Opens journals, one after the other, and the sessions of all units with each.

    Args:
        units: What is calibrated.
        description: Set-up that every journal contains.
        journal: Folder of the first; later ones have a number at the end of their names.
        state: Full name of turntable/state; None without a table.
        progress: Called now and then with the read share of a journal that is resumed, 0 to 1.
        absent: Names of the units that are excluded from the start.
    """

    def __init__(
        self,
        units: Sequence[StatedUnit],
        description: Mapping[str, str],
        journal: Path,
        state: str | None,
        progress: Callable[[float], None] = lambda _: None,
        absent: Iterable[str] = (),
    ) -> None:
        self._units = units
        self._absent = tuple(absent)
        self._description = description
        self._journal = journal
        self._state = state
        self._progress = progress
        self._count = 0

    def begin(self, common: Mapping[Kind, str], of_units: Sequence[Mapping[Kind, str]]) -> Sessions:
        """Begin sessions, or resume those in the journal."""
        path = self._journal
        if self._count:
            path = path.with_name(f'{path.name}_{self._count + 1}')
        self._count += 1
        kinds = {topic: kind for names in (common, *of_units) for kind, topic in names.items()}
        journal = Journal(path, self._described(of_units), kinds, self._progress)
        if self._state is not None:
            journal.add_latched_topic(self._state, STATE_TYPE)
        return Sessions(self._units, of_units, journal, common, self._absent)

    def _described(self, of_units: Sequence[Mapping[Kind, str]]) -> dict[str, str]:
        """Return the set-up, with that of each of several units."""
        description = dict(self._description)
        for unit, topics in zip(self._units, of_units, strict=True):
            if unit.name:
                topic = topics[Kind.IMU]
                description |= unit_description(topic, unit.imu, unit.setup.serial_number)
                if unit.mount is not None:
                    description |= mount_description(topic, unit.mount)
        return description


STATE_TYPE = 'imu_calib_msgs/msg/TurntableState'
