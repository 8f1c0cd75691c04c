"""Leads a table through a plan, from joint states and commands alone: no clock, no ROS."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from ..errors import InputError
from ..plan import Plan, Step
from ..stream import JointBlock, Mode, Setpoint
from ..turntable import Table
from .encoders import Encoders, Feedback, FeedbackError
from .rules import Phase, Rules, State
from .steps import check, end_of, laid_out, motion_time, setpoint_of, way_to
from .unled import Unled
from .watch import Standing, Watch

_CALIBRATOR = 'the calibrator (calibration/progress)'
_NO_FEEDBACK = 'There are no joint states from the table.'


class _Stage(Enum):
    """Where the sequencer is within a session."""

    IDLE = auto()
    WAITING = auto()
    """For the calibrator, to start or to resume."""
    STOPPING = auto()
    """Until the table stands, to go on from there."""
    MOVING = auto()
    SETTLING = auto()
    DWELLING = auto()
    REVIEWING = auto()
    """For the calibrator's word on what is to be repeated."""
    PAUSED = auto()
    DONE = auto()
    ABORTED = auto()


_RUNNING = frozenset(
    {_Stage.STOPPING, _Stage.MOVING, _Stage.SETTLING, _Stage.DWELLING, _Stage.REVIEWING}
)
_WITHIN_A_STEP = frozenset({_Stage.MOVING, _Stage.SETTLING, _Stage.DWELLING})
_PHASES = {
    _Stage.IDLE: Phase.IDLE,
    _Stage.STOPPING: Phase.MOVING,
    _Stage.SETTLING: Phase.SETTLING,
    _Stage.DWELLING: Phase.DWELLING,
    _Stage.REVIEWING: Phase.DWELLING,
    _Stage.PAUSED: Phase.PAUSED,
    _Stage.DONE: Phase.DONE,
    _Stage.ABORTED: Phase.ABORTED,
}


class Sequencer:
    """Runs a plan on a table, step by step, each confirmed by the joint states.

    A step counts as begun when its setpoint was sent: `setpoint` says what to send, `revision`
    changes with it. Whatever goes wrong ends in HOLD and PAUSED; `start` then repeats the step
    that was interrupted. After an abort or an emergency stop it starts the plan anew: somebody
    may have touched the unit.

    Args:
        plan: What is run.
        table: On what.
        rules: Tolerances and times.

    Raises:
        InputError: The plan is turned by hand, or a joint has no limits.

    """

    def __init__(self, plan: Plan, table: Table, rules: Rules | None = None) -> None:
        if plan.by_hand:
            raise InputError(f'Plan {plan.name} is turned by hand, there is no table in it.')
        for joint in table.joints:
            if not (math.isfinite(joint.max_rate) and math.isfinite(joint.max_acceleration)):
                raise InputError(
                    f'Table {table.name}, joint {joint.name}: needs max_rate and max_acceleration.'
                )
        self.plan = plan
        self.table = table
        self.rules = rules or Rules()
        self.revision = 0
        self._encoders = Encoders(table, self.rules.arrival, self.rules.feedback_timeout)
        self._feedback: Feedback | None = None
        self._feedback_fault = _NO_FEEDBACK
        self._calibrator_fault = ''
        self._stage = self._waits_from = _Stage.IDLE
        self._reason, self._fault = '', False
        self._remarks: dict[str, str] = {}
        self._forbidden: dict[str, str] = {}
        self._emergency = ''
        self._heard = not self.rules.supervised
        self._steps: tuple[Step, ...] = ()
        self._home: Step | None = None
        self._queue: deque[Step] = deque()
        self._current: Step | None = None
        self._command: Setpoint | None = None
        self._motion: Step | None = None
        self._sent = False
        self._watch: Watch | Standing = Standing(table, self.rules, None)
        self._unled = Unled(table, self.rules, None)
        self._since = 0
        self._ended = 0
        self._place_is_known = False
        self._repeated: Counter[int] = Counter()
        self._turns_done = 0.0
        self._times: dict[str | int, float] = {}

    @property
    def running(self) -> bool:
        """Whether the table is led: from the start to DONE, but for pauses."""
        return self._stage in _RUNNING

    @property
    def reviewing(self) -> bool:
        """Whether the plan has been run and the calibrator is to say what is to be repeated."""
        return self._stage is _Stage.REVIEWING

    @property
    def feedback(self) -> Feedback | None:
        """The last joint state."""
        return self._feedback

    @property
    def obstacle(self) -> str:
        """Why a start would be refused now; empty if it would not."""
        if self._emergency:
            return self._emergency
        if self.running:
            return f'The plan is running, at step {self._index()}.'
        if self._forbidden:
            return ' '.join(self._forbidden.values())
        return (
            (self._unled.text if self._unled.moves else '')
            or self._feedback_fault
            or self._calibrator_fault
        )

    @property
    def unled(self) -> Unled:
        """What the table did while no plan was run."""
        return self._unled

    @property
    def fault(self) -> bool:
        """Whether something went wrong since the last start, and nobody asked for the stop."""
        return self._fault

    def start(self) -> str:
        """Start, resume after a pause, or start anew; return what is done, in words.

        Raises:
            InputError: Refused, and why.

        """
        if self.obstacle:
            raise InputError(self.obstacle)
        stage = self._waits_from if self._stage is _Stage.WAITING else self._stage
        resumes = stage is _Stage.PAUSED
        if not resumes:
            self._lay_out()
        self._reason, self._fault = '', False
        self._remarks.clear()
        if not self._heard:
            self._waits_from = _Stage.PAUSED if resumes else _Stage.IDLE
            self._enter(_Stage.WAITING)
            return f'Waits for {_CALIBRATOR}.'
        self._go()
        return f'Resumes with step {self._index()}.' if resumes else f'Runs {self.plan.name}.'

    def pause(self) -> None:
        """Stop, to go on later.

        Raises:
            InputError: Nothing is running.

        """
        if not self.running and self._stage is not _Stage.WAITING:
            raise InputError('Nothing is running that could be paused.')
        self._halt(_Stage.PAUSED, 'Paused on request.')

    def abort(self, reason: str = 'Aborted on request.') -> None:
        """Stop for good.

        Raises:
            InputError: Nothing was started.

        """
        if self._stage in {_Stage.IDLE, _Stage.DONE, _Stage.ABORTED}:
            raise InputError('Nothing is running that could be aborted.')
        self._halt(_Stage.ABORTED, reason)

    def emergency(self, on: bool, obstacle: str = 'The emergency stop is on.') -> None:
        """Take the emergency stop's state; its release alone moves nothing.

        Args:
            on: Whether it is on.
            obstacle: What a start is answered while it is on.

        """
        if on and not self._emergency:
            if self._stage is _Stage.DONE:
                self._remark('emergency', 'Emergency stop.')
            else:
                self._halt(_Stage.ABORTED, 'Emergency stop.', fault=True)
        self._emergency = obstacle if on else ''

    def forbid(self, what: str, why: str) -> None:
        """Take whether something forbids to lead the table.

        Args:
            what: Who says so, for instance a topic.
            why: A sentence; empty where it forbids no longer, which alone moves nothing.

        """
        if why == self._forbidden.get(what, ''):
            return
        if not why:
            del self._forbidden[what]
            return
        self._forbidden[what] = why
        if self.running:
            self.fail(why)
        else:
            self._remark(what, why)

    def fail(self, reason: str) -> None:
        """Stop and pause, if the table is led."""
        if self.running:
            self._halt(_Stage.PAUSED, reason, fault=True)

    def lose_feedback(self, reason: str) -> None:
        """Take it that joint states do not come any more, or say nothing of the table."""
        self._feedback_fault = reason
        self.fail(reason)

    def hear(self, fault: str, *, fatal: bool) -> None:
        """Take what keeps the calibrator from taking a session in; empty where nothing does.

        Args:
            fault: In a sentence; no plan is started while there is one.
            fatal: Whether a plan that runs is to stop for it.

        """
        if not self.rules.supervised:
            return
        self._calibrator_fault = fault
        if fault and fatal and self.running:
            self.fail(fault)

    @property
    def ignored(self) -> tuple[int, tuple[str, ...]]:
        """How many joint states lacked a joint of the table, and what the latest named."""
        return self._encoders.ignored, self._encoders.ignored_names

    def attend(self, heard: bool, reason: str = '') -> None:
        """Take whether the calibrator is there; while it is silent the table is not led."""
        if not self.rules.supervised:
            return
        self._heard = heard
        if not heard:
            self.fail(reason or 'The calibrator is silent.')
        elif self._stage is _Stage.WAITING and not self._calibrator_fault:
            if not self._feedback_fault:
                self._go()
            elif self._waits_from is _Stage.PAUSED:
                self._halt(_Stage.PAUSED, self._feedback_fault, fault=True)

    def review(self, stamp: int, repeat_steps: Sequence[int]) -> None:
        """Take the calibrator's word.

        Args:
            stamp: Up to when it has worked through the joint states, ns.
            repeat_steps: Indices of steps that left too little.

        """
        at = self._feedback
        if self._stage is not _Stage.REVIEWING or stamp < self._ended or at is None:
            return
        if stamp > at.stamp + self.rules.feedback_timeout * 1e9:
            # Nobody has worked through joint states that are yet to come.
            return
        again = [
            step
            for step in self._steps
            if step.index in set(repeat_steps) and self._repeated[step.index] < self.rules.repeats
        ]
        self._repeated.update(step.index for step in again)
        self._queue.extend(again)
        self._place_is_known = False
        if again:
            self._next()
        else:
            self._go_home()

    def take(self, block: JointBlock) -> bool:
        """Take joint states; return whether their stamps advance."""
        advanced = False
        try:
            for now in self._encoders.take(block):
                self._feedback, self._feedback_fault, advanced = now, '', True
                self._follow(now)
        except FeedbackError as error:
            self.lose_feedback(str(error))
        return advanced

    def setpoint(self, stamp: int) -> Setpoint | None:
        """Return the setpoint to send now, None before the first start.

        Args:
            stamp: When it is sent, ns.

        """
        if self._command is None:
            return None
        if not self._sent:
            self._sent = True
            at = self._feedback
            if self._motion is not None and at is not None:
                self._watch = Watch(self.table, self.rules, self._motion, at)
        return replace(self._command, stamp=stamp)

    def hold(self, stamp: int) -> Setpoint:
        """Return the setpoint that stops the table, whatever else is going on."""
        return replace(self._holding(), stamp=stamp)

    def state(self) -> State:
        """Return what is going on."""
        at = self._feedback
        if self._stage is _Stage.MOVING:
            turns = self._motion is not None and self._motion.mode is Mode.RATE
            phase = Phase.TURNING if turns else Phase.MOVING
        else:
            stage = self._waits_from if self._stage is _Stage.WAITING else self._stage
            phase = _PHASES[stage]
        waits = _CALIBRATOR if self._stage is _Stage.WAITING else ''
        reason = self._words()
        if waits and phase is Phase.PAUSED:
            reason = f'Waits for {waits}.'
        return State(
            plan=self.plan.name,
            step=self._index(),
            steps=len(self._steps),
            position='' if self._current is None else self._current.position,
            phase=phase,
            reason=reason,
            fault=self._fault,
            waits_for=waits,
            angles=() if at is None else at.angles,
            rates=() if at is None else at.rates,
            turns_done=self._turns_done,
            seconds_left=self._seconds_left(),
        )

    @property
    def feedback_fault(self) -> str:
        """What is wrong with the joint states; empty while they are sound."""
        return self._feedback_fault

    @property
    def summary(self) -> tuple[object, ...]:
        """What makes a state worth telling: it changes with everything but the measurements."""
        motion = None if self._motion is None else self._motion.mode
        return self._stage, self._waits_from, motion, self._current, self._words()

    def _lay_out(self) -> None:
        """Make the steps from where the table stands; refuse what it cannot do."""
        at = self._feedback
        assert at is not None  # a start without joint states is refused
        before = np.array(at.angles)
        self._steps, self._home = laid_out(self.plan, self.table, before)
        self._queue = deque(self._steps)
        self._current = self._steps[0]
        self._repeated.clear()
        for step in (*self._steps, self._home):
            time = motion_time(step, before, self.table) + self.rules.settle + step.dwell
            self._times['home' if step is self._home else step.index] = time
            before = end_of(step)

    def _index(self) -> int:
        return 0 if self._current is None else self._current.index

    def _enter(self, stage: _Stage) -> None:
        self._stage = stage
        if self._feedback is not None:
            self._since = self._feedback.stamp

    def _send(self, command: Setpoint, motion: Step | None) -> None:
        """Make this the setpoint to send from now on."""
        self._command, self._motion, self._sent = command, motion, False
        self.revision += 1

    def _holding(self) -> Setpoint:
        """Return HOLD where the table is; the angles are for the record."""
        joints = self.table.joints
        at = self._feedback.angles if self._feedback is not None else (0.0,) * len(joints)
        angles = tuple(
            min(max(a, joint.lower), joint.upper) for a, joint in zip(at, joints, strict=True)
        )
        position = '' if self._current is None else self._current.position
        return Setpoint(
            stamp=0,
            plan=self.plan.name,
            step=self._index(),
            position=position,
            mode=Mode.HOLD,
            joints=self.table.names,
            angles=angles,
            rates=(0.0,) * len(joints),
            turns=0.0,
            dwell=0.0,
        )

    def _words(self) -> str:
        """Return why it stands, and what happened to it since."""
        remarks = [text for text in self._remarks.values() if text != self._reason]
        return ' '.join([*filter(None, [self._reason]), *remarks])

    def _remark(self, what: str, text: str) -> None:
        """Hold a table that is not led, and say why; a start that waits is called off."""
        if self._stage is _Stage.WAITING:
            self._enter(self._waits_from)
        self._fault = True
        self._remarks[what] = text
        if self._command is None or self._command.mode is not Mode.HOLD:
            self._send(self._holding(), None)

    def _halt(self, stage: _Stage, reason: str, *, fault: bool = False) -> None:
        """Hold, and do not go on by itself."""
        if self._stage in _WITHIN_A_STEP and self._current is not None:
            self._queue.appendleft(self._current)
        self._reason, self._fault = reason, fault
        self._remarks.clear()
        self._enter(stage)
        self._hold_table()

    def _hold_table(self) -> None:
        self._unled = Unled(self.table, self.rules, self._feedback)
        self._send(self._holding(), None)
        self._watch = Standing(self.table, self.rules, self._feedback)

    def _go(self) -> None:
        """Go on once the table stands."""
        self._place_is_known = False
        self._enter(_Stage.STOPPING)
        self._hold_table()

    def _next(self) -> None:
        """Begin the next step; after the last one ask the calibrator, then go home."""
        if self._queue:
            self._begin(self._queue.popleft())
        elif self.rules.supervised and self._current is not self._home:
            self._enter(_Stage.REVIEWING)
            self._hold_table()
        else:
            self._go_home()

    def _go_home(self) -> None:
        assert self._home is not None
        self._begin(self._home)

    def _begin(self, step: Step) -> None:
        """Command a step; a turn whose place is not certain is preceded by the way there."""
        self._current = step
        at = self._feedback
        assert at is not None
        off = np.abs(step.angles - np.array(at.angles)).max()
        if step.mode is Mode.RATE and not (self._place_is_known and off <= self.rules.arrival):
            self._move(way_to(step))
        else:
            self._move(step)

    def _move(self, motion: Step) -> None:
        try:
            check(motion, self.table)
        except InputError as error:
            self._enter(_Stage.MOVING)
            self.fail(str(error))
            return
        self._place_is_known = True
        self._turns_done = 0.0
        self._enter(_Stage.MOVING)
        self._send(setpoint_of(motion, self.plan.name, self.table.names), motion)

    def _follow(self, now: Feedback) -> None:
        """Go on by one joint state."""
        if not self.running:
            self._see_it_stand(now)
            return
        if now.gap > self.rules.feedback_timeout:
            self.fail(
                f'No joint state for {now.gap:.2f} s, accepted is up to '
                f'{self.rules.feedback_timeout:g} s.'
            )
            return
        if not self._sent:
            # What was measured before the setpoint left says nothing of what it does.
            return
        there, fault = self._watch.look(now)
        if isinstance(self._watch, Watch):
            self._turns_done = self._watch.turns_done
        if fault:
            self.fail(fault)
            return
        elapsed = (now.stamp - self._since) * 1e-9
        if self._stage is _Stage.STOPPING and there:
            self._next()
        elif self._stage is _Stage.MOVING and there:
            self._arrive()
        elif self._stage is _Stage.SETTLING and elapsed >= self.rules.settle:
            self._enter(_Stage.DWELLING)
            if not self._dwell():
                self._finish(now)
        elif self._stage is _Stage.DWELLING and elapsed >= self._dwell():
            self._finish(now)
        elif self._stage is _Stage.REVIEWING and elapsed > self.rules.repeat_wait:
            self._reason = (
                f'The calibrator did not say within {self.rules.repeat_wait:g} s '
                'whether steps are to be repeated.'
            )
            self._go_home()

    def _see_it_stand(self, now: Feedback) -> None:
        """Hold a table that moves though nobody leads it, and say how far and how fast."""
        if self._unled.look(now):
            self._remark('unled', self._unled.text)

    def _arrive(self) -> None:
        motion, current = self._motion, self._current
        assert motion is not None
        assert current is not None
        if motion.mode is not current.mode:
            self._move(current)
            return
        self._enter(_Stage.SETTLING)
        self._watch = Standing(self.table, self.rules, self._feedback)
        self._watch.keep(tuple(end_of(current).tolist()))

    def _dwell(self) -> float:
        return 0.0 if self._current is None else self._current.dwell

    def _finish(self, now: Feedback) -> None:
        if self._current is self._home:
            self._enter(_Stage.DONE)
            self._hold_table()
            return
        self._ended = now.stamp
        self._next()

    def _seconds_left(self) -> float:
        """Return the expected time to the end of the plan, s; 0 while nothing is started."""
        if self._stage in {_Stage.DONE, _Stage.ABORTED, _Stage.IDLE}:
            return 0.0
        left = sum(self._time_of(step) for step in self._queue)
        if self._current is not self._home and self._home not in self._queue:
            left += self._times['home']
        at = self._feedback
        if self._stage not in _WITHIN_A_STEP or at is None or self._current is None:
            return left
        elapsed = (at.stamp - self._since) * 1e-9
        now = {
            _Stage.MOVING: self._time_of(self._current),
            _Stage.SETTLING: self.rules.settle + self._current.dwell,
            _Stage.DWELLING: self._current.dwell,
        }
        return left + max(now[self._stage] - elapsed, 0.0)

    def _time_of(self, step: Step) -> float:
        return self._times['home' if step is self._home else step.index]
