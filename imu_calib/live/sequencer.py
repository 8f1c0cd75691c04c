"""Run a plan on a table by joint states and commands alone: no clock, no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto

from ..common.errors import InputError
from ..common.stream import NS, JointBlock, Setpoint
from ..session.plan import Plan
from ..session.table import Table
from .plan_run import Leg, Run
from .rules import Phase, Rules, SequencerState
from .table_watch import Encoders, Feedback, FeedbackError, IdleWatch

_NO_FEEDBACK = 'There are no joint states from the table.'


class Obstacles:
    """Obstacles to starting a plan."""

    def __init__(self) -> None:
        self.emergency = ''  #: Reply to a start during the emergency stop; else empty.
        self.feedback = _NO_FEEDBACK  #: Fault of the joint states; empty while they are valid.
        self.calibrator = ''  #: Fault of the calibrator; empty without.
        self._forbidden: dict[str, str] = {}

    def forbid(self, what: str, why: str) -> bool:
        """Set who forbids motion and why; empty: no longer. Return whether this is new."""
        if why == self._forbidden.get(what, ''):
            return False
        if not why:
            del self._forbidden[what]
            return False
        self._forbidden[what] = why
        return True

    @property
    def forbidden(self) -> str:
        """Why others forbid motion, in sentences; otherwise empty."""
        return ' '.join(self._forbidden.values())


class Reasons:
    """Reason for a stop, and events since."""

    def __init__(self) -> None:
        #: Why the table stopped, or goes home without the calibrator's reply; else empty.
        self.reason = ''
        self.fault = False  #: Whether there was a fault since the last start, not a requested stop.
        self._remarks: dict[str, str] = {}

    def begin(self, reason: str = '', *, fault: bool = False) -> None:
        """Reset, and set a new reason."""
        self.reason, self.fault = reason, fault
        self._remarks.clear()

    def remark(self, what: str, text: str) -> None:
        """Add a fault that occurred at rest, once by its name."""
        self.fault = True
        self._remarks[what] = text

    @property
    def words(self) -> str:
        """Return all of it in sentences."""
        remarks = [text for text in self._remarks.values() if text != self.reason]
        return ' '.join([*filter(None, [self.reason]), *remarks])


CALIBRATOR = 'the calibrator (calibration/progress)'


class Supervision:
    """Presence of a calibrator, if needed, and the steps that it has of a resumed session."""

    def __init__(self, *, needed: bool) -> None:
        self.needed = needed
        self.present = not needed  #: Whether the calibrator, if needed, is present.
        self._resumes = False
        self._done: frozenset[int] | None = None

    def resume(self) -> None:
        """Make the next start run only the steps that the calibrator lacks."""
        if not self.needed:
            raise InputError(
                'To resume a session set supervised to true: the calibrator tells which steps it '
                'lacks.'
            )
        self._resumes = True

    def skip_done(self, seen: int, repeat_steps: Sequence[int]) -> None:
        """Set the steps that the calibrator has already; arguments as `Sequencer.skip_done`."""
        if self._resumes:
            self._done = frozenset(range(seen)) - frozenset(repeat_steps)

    def set_present(self, present: bool) -> None:
        """Set whether the calibrator is present; to resume a session, its steps are needed too."""
        self.present = present and not (self._resumes and self._done is None)

    def pop_skipped(self) -> frozenset[int]:
        """Return the steps to skip, once: the next start runs all."""
        if not self._resumes or self._done is None:
            return frozenset()
        self._resumes = False
        return self._done


class _Stage(Enum):
    """Stage of a session."""

    IDLE = auto()
    WAITING = auto()
    """Waiting for the calibrator, to start or to resume."""
    RUNNING = auto()
    PAUSED = auto()
    DONE = auto()
    ABORTED = auto()


_PHASES = {
    _Stage.IDLE: Phase.IDLE,
    _Stage.PAUSED: Phase.PAUSED,
    _Stage.DONE: Phase.DONE,
    _Stage.ABORTED: Phase.ABORTED,
}


class Sequencer:
    """Runs a plan on a table, step by step, each confirmed by the joint states.

    A step counts as begun when its setpoint was sent: `setpoint` returns what to send, `revision`
    changes with it. Every fault ends in HOLD and PAUSED; `start` then repeats the interrupted step.
    After an abort or an emergency stop it restarts the plan: the unit may have been touched.
    """

    def __init__(self, plan: Plan, table: Table, rules: Rules | None = None) -> None:
        if plan.by_hand:
            raise InputError(f'Plan {plan.name} is for a unit in the hand, without a table.')
        table.check_limited('needs')
        self.plan = plan
        self.table = table
        self.rules = rules or Rules()
        self._encoders = Encoders(table, self.rules.arrival, self.rules.feedback_timeout)
        self._feedback: Feedback | None = None
        self._obstacles = Obstacles()
        self._stage = self._waits_from = _Stage.IDLE
        self._why = Reasons()
        self._supervision = Supervision(needed=self.rules.supervised)
        self._run = Run(plan, table, self.rules)

    @property
    def revision(self) -> int:
        """Number that changes with the setpoint to be sent."""
        return self._run.orders.revision

    @property
    def running(self) -> bool:
        """Whether a plan runs: from the start to DONE, except pauses."""
        return self._stage is _Stage.RUNNING

    @property
    def reviewing(self) -> bool:
        """Whether the plan has been run and the calibrator's reply on repetitions is awaited."""
        return self.running and self._run.leg is Leg.REVIEWING

    @property
    def feedback(self) -> Feedback | None:
        """The last joint state."""
        return self._feedback

    @property
    def obstacle(self) -> str:
        """Why a start would be refused now; otherwise empty."""
        found = self._obstacles
        if found.emergency:
            return found.emergency
        if self.running:
            return (
                f'The plan is running, at step {self._run.itinerary.index + 1}: pause or abort it '
                'first.'
            )
        uncommanded = self.idle.text if self.idle.is_moving else ''
        return found.forbidden or uncommanded or found.feedback or found.calibrator

    @property
    def idle(self) -> IdleWatch:
        """Motion of the table while no plan is run."""
        return self._run.orders.idle

    @property
    def fault(self) -> bool:
        """Whether there was a fault since the last start, not a requested stop."""
        return self._why.fault

    def start(self) -> str:
        """Start, resume after a pause, or restart; return a sentence on which.

        Raises:
            InputError: Refused, with the reason.
        """
        if self.obstacle:
            raise InputError(self.obstacle)
        stage = self._waits_from if self._stage is _Stage.WAITING else self._stage
        resumes = stage is _Stage.PAUSED
        if not resumes:
            assert self._feedback is not None  # a start without joint states is refused
            self._run.itinerary.plan_steps(self._feedback.angles)
        self._why.begin()
        if not self._supervision.present:
            self._waits_from = _Stage.PAUSED if resumes else _Stage.IDLE
            self._stage = _Stage.WAITING
            return f'Waits for {CALIBRATOR}.'
        self._go()
        index = self._run.itinerary.index
        return f'Resumes with step {index + 1}.' if resumes else f'Runs {self.plan.name}.'

    def resume(self) -> None:
        """Make the first start run only the steps that the calibrator lacks, in its old session."""
        self._supervision.resume()

    def skip_done(self, seen: int, repeat_steps: Sequence[int]) -> None:
        """Set the steps that the calibrator has from its old session.

        Args:
            seen: Number of steps of which it has at least the beginning.
            repeat_steps: Indices of those among them with too little data.
        """
        self._supervision.skip_done(seen, repeat_steps)

    def pause(self) -> None:
        """Stop, to continue later.

        Raises:
            InputError: Nothing is running.
        """
        if not self.running and self._stage is not _Stage.WAITING:
            raise InputError('Nothing is running.')
        self._halt(_Stage.PAUSED, 'Paused on request.')

    def abort(self, reason: str = 'Aborted on request.') -> None:
        """Stop finally.

        Raises:
            InputError: Nothing was started.
        """
        if self._stage in {_Stage.IDLE, _Stage.DONE, _Stage.ABORTED}:
            raise InputError('Nothing is running.')
        self._halt(_Stage.ABORTED, reason)

    def emergency(self, on: bool, obstacle: str = 'The emergency stop is on.') -> None:
        """Set the emergency stop, and the reply to a start; its release alone moves nothing."""
        if on and not self._obstacles.emergency:
            if self._stage is _Stage.DONE:
                self._remark('emergency', 'Emergency stop.')
            else:
                self._halt(_Stage.ABORTED, 'Emergency stop.', fault=True)
        self._obstacles.emergency = obstacle if on else ''

    def forbid(self, what: str, why: str, *, awaited: bool = False) -> None:
        """Set whether motion is forbidden.

        Args:
            what: The source, for instance a topic.
            why: A sentence; empty if no longer forbidden, which alone moves nothing.
            awaited: Whether it only awaits something: no fault while idle.
        """
        if not self._obstacles.forbid(what, why):
            return
        if self.running:
            self.fail(why)
        elif not awaited:
            self._remark(what, why)

    def fail(self, reason: str) -> None:
        """Stop and pause, if a plan runs."""
        if self.running:
            self._halt(_Stage.PAUSED, reason, fault=True)

    def lose_feedback(self, reason: str) -> None:
        """Note that joint states have ceased or are invalid."""
        self._obstacles.feedback = reason
        self.fail(reason)

    def set_calibrator_fault(self, fault: str) -> None:
        """Set the fault that prevents the calibrator from taking a session; empty without.

        With a fault no plan is started; a running one continues.
        """
        if self.rules.supervised:
            self._obstacles.calibrator = fault

    @property
    def ignored(self) -> tuple[int, tuple[str, ...]]:
        """Number of joint states that lacked a joint of the table, and the names of the latest."""
        return self._encoders.ignored, self._encoders.ignored_names

    def set_calibrator_present(self, present: bool, reason: str = '') -> None:
        """Set whether the calibrator is present; without it the table is not moved."""
        if not self.rules.supervised:
            return
        self._supervision.set_present(present)
        if not self._supervision.present:
            self.fail(reason or 'The calibrator is silent.')
        elif self._stage is _Stage.WAITING and not (
            self._obstacles.calibrator or self._obstacles.forbidden
        ):
            if not self._obstacles.feedback:
                self._go()
            elif self._waits_from is _Stage.PAUSED:
                self._halt(_Stage.PAUSED, self._obstacles.feedback, fault=True)

    def review(self, stamp: int, repeat_steps: Sequence[int]) -> None:
        """Process the calibrator's reply; ignore it while none is awaited.

        Args:
            stamp: Stamp of the last joint state that it has processed, ns.
            repeat_steps: Indices of steps with too little data.
        """
        if not self.reviewing or self._feedback is None:
            return
        if fault := self._run.review(stamp, repeat_steps, self._feedback):
            self.fail(fault)

    def add_joint_states(self, block: JointBlock) -> bool:
        """Process joint states; return whether their stamps increase."""
        advanced = False
        rest = self._run.rest if self.running else None
        if rest is not None:
            block = self._encoders.pass_over(block, rest)
        try:
            for now in self._encoders.read_feedback(block):
                self._feedback, self._obstacles.feedback, advanced = now, '', True
                self._follow(now)
        except FeedbackError as error:
            self.lose_feedback(str(error))
        return advanced

    def setpoint(self, stamp: int) -> Setpoint | None:
        """Return the setpoint to send at a stamp, ns; None before the first start."""
        return self._run.orders.to_send(stamp, self._feedback)

    def hold(self, stamp: int) -> Setpoint:
        """Return the setpoint that stops the table in any state."""
        hold = self._run.orders.hold_setpoint(self._run.itinerary.current, self._feedback)
        return replace(hold, stamp=stamp)

    def state(self) -> SequencerState:
        """Return the present state."""
        at, run = self._feedback, self._run
        stage = self._waits_from if self._stage is _Stage.WAITING else self._stage
        phase = run.phase if self.running else _PHASES[stage]
        waits = CALIBRATOR if self._stage is _Stage.WAITING else ''
        reason, current = self._why.words, run.itinerary.current
        if waits and phase is Phase.PAUSED:
            reason = f'Waits for {waits}.'
        over = self._stage in {_Stage.DONE, _Stage.ABORTED, _Stage.IDLE}
        return SequencerState(
            plan=self.plan.name,
            step=run.itinerary.index,
            steps=len(run.itinerary),
            position='' if current is None else current.position,
            phase=phase,
            reason=reason,
            fault=self._why.fault,
            waits_for=waits,
            angles=() if at is None else at.angles,
            rates=() if at is None else at.rates,
            turns_done=run.orders.turns_done,
            seconds_left=0.0 if over else run.seconds_left(at),
        )

    @property
    def feedback_fault(self) -> str:
        """Fault of the joint states; empty while they are valid."""
        return self._obstacles.feedback

    @property
    def summary(self) -> tuple[object, ...]:
        """Return a key of the state that changes with all except the measurements."""
        motion, current = self._run.orders.motion, self._run.itinerary.current
        mode = None if motion is None else motion.mode
        return self._stage, self._waits_from, self._run.leg, mode, current, self._why.words

    def _remark(self, what: str, text: str) -> None:
        """Hold an idle table, and note why; a waiting start is cancelled."""
        if self._stage is _Stage.WAITING:
            self._stage = self._waits_from
        self._why.remark(what, text)
        if not self._run.orders.holds:
            self._run.orders.hold(self._run.itinerary.current, self._feedback)

    def _halt(self, stage: _Stage, reason: str, *, fault: bool = False) -> None:
        """Hold, and do not continue automatically."""
        self._run.interrupt(self._feedback)
        self._why.begin(reason, fault=fault)
        self._stage = stage

    def _go(self) -> None:
        """Continue once the table is at rest."""
        self._stage = _Stage.RUNNING
        self._run.go(self._feedback, self._supervision.pop_skipped())

    def _follow(self, now: Feedback) -> None:
        """Process a joint state of a running plan."""
        if not self.running:
            self._hold_idle_table(now)
        elif now.gap > self.rules.feedback_timeout:
            self.fail(
                f'No joint state for {now.gap:.2f} s (allowed: {self.rules.feedback_timeout:g} s).'
            )
        elif fault := self._run.follow(now):
            self.fail(fault)
        else:
            self._why.reason = self._run.remark
            if self._run.leg is Leg.HOME:
                self._stage = _Stage.DONE

    def _hold_idle_table(self, now: Feedback) -> None:
        """Hold an idle table that moves, and report how far and how fast."""
        if self.idle.check(now):
            self._remark('uncommanded', self.idle.text)


class Pacing:
    """Keeps a rate by the stamps of joint states, and by the steady clock without them."""

    def __init__(self, rate: float) -> None:
        self._period = round(NS / rate)
        self.seconds = self._period * 1e-9  #: Between two setpoints.
        self._revision = -1
        self._due_stamp = 0
        self._due = -math.inf

    def is_due(self, table_time: int | None, now: float, revision: int) -> bool:
        """Return whether a setpoint is due, by table time in ns or by the steady clock in s.

        One of a new revision is due at once.
        """
        if table_time is not None and self._due_stamp > table_time + 2 * self._period:
            # The table's time restarted.
            self._due_stamp = table_time
        by_table = table_time is not None and table_time >= self._due_stamp
        return by_table or now >= self._due or revision != self._revision

    def sent(self, table_time: int | None, now: float, revision: int) -> None:
        """Record that a setpoint was sent; arguments as of `is_due`."""
        if table_time is not None and table_time >= self._due_stamp:
            # Count from the due time: a delay by one joint state each time would lower the mean
            # rate.
            late = table_time - self._due_stamp
            self._due_stamp = table_time + self._period - (late if late < self._period else 0)
        self._due = now + self.seconds
        self._revision = revision
