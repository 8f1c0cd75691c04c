"""Leads a table through a plan, from joint states and commands alone: no clock, no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto

import numpy as np

from ..errors import InputError
from ..plan import Plan, Step
from ..stream import JointBlock, Mode, Setpoint
from ..turntable import Table
from .encoders import Encoders, Feedback, FeedbackError
from .idle_watch import IdleWatch
from .itinerary import Itinerary
from .obstacles import Obstacles, Reasons
from .rules import Phase, Rules, SequencerState
from .steps import check, end_of, held, setpoint_of, way_to
from .watch import Standing, Watch

_CALIBRATOR = 'the calibrator (calibration/progress)'


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
        self._obstacles = Obstacles()
        self._stage = self._waits_from = _Stage.IDLE
        self._why = Reasons()
        self._heard = not self.rules.supervised
        self._resumes = False
        self._done: frozenset[int] | None = None
        self._itinerary = Itinerary(plan, table, self.rules)
        self._command: Setpoint | None = None
        self._motion: Step | None = None
        self._sent = False
        self._watch: Watch | Standing = Standing(table, self.rules, None)
        self._unled = IdleWatch(table, self.rules, None)
        self._since = 0
        self._ended = 0
        self._place_is_known = False
        self._turns_done = 0.0

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
        found = self._obstacles
        if found.emergency:
            return found.emergency
        if self.running:
            return f'The plan is running, at step {self._itinerary.index}.'
        unled = self._unled.text if self._unled.moves else ''
        return found.forbidden or unled or found.feedback or found.calibrator

    @property
    def idle(self) -> IdleWatch:
        """What the table did while no plan was run."""
        return self._unled

    @property
    def fault(self) -> bool:
        """Whether something went wrong since the last start, and nobody asked for the stop."""
        return self._why.fault

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
            assert self._feedback is not None  # a start without joint states is refused
            self._itinerary.lay_out(self._feedback.angles)
        self._why.begin()
        if not self._heard:
            self._waits_from = _Stage.PAUSED if resumes else _Stage.IDLE
            self._enter(_Stage.WAITING)
            return f'Waits for {_CALIBRATOR}.'
        self._go()
        return (
            f'Resumes with step {self._itinerary.index}.' if resumes else f'Runs {self.plan.name}.'
        )

    def resume(self) -> None:
        """Have the first start run what the calibrator lacks alone: its session is gone on with.

        Raises:
            InputError: No calibrator is listened to.

        """
        if not self.rules.supervised:
            raise InputError('A session is gone on with by what the calibrator lacks: supervise.')
        self._resumes = True

    def skip_done(self, seen: int, repeat_steps: Sequence[int]) -> None:
        """Take what the calibrator has from before.

        Args:
            seen: How many steps it has seen at least the beginning of.
            repeat_steps: Indices of those among them that left too little.

        """
        if self._resumes:
            self._done = frozenset(range(seen)) - frozenset(repeat_steps)

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
        if on and not self._obstacles.emergency:
            if self._stage is _Stage.DONE:
                self._remark('emergency', 'Emergency stop.')
            else:
                self._halt(_Stage.ABORTED, 'Emergency stop.', fault=True)
        self._obstacles.emergency = obstacle if on else ''

    def forbid(self, what: str, why: str, *, awaited: bool = False) -> None:
        """Take whether something forbids to lead the table.

        Args:
            what: Who says so, for instance a topic.
            why: A sentence; empty where it forbids no longer, which alone moves nothing.
            awaited: Whether something is yet to come: no fault while the table is not led.

        """
        if not self._obstacles.forbid(what, why):
            return
        if self.running:
            self.fail(why)
        elif not awaited:
            self._remark(what, why)

    def fail(self, reason: str) -> None:
        """Stop and pause, if the table is led."""
        if self.running:
            self._halt(_Stage.PAUSED, reason, fault=True)

    def lose_feedback(self, reason: str) -> None:
        """Take it that joint states do not come any more, or say nothing of the table."""
        self._obstacles.feedback = reason
        self.fail(reason)

    def set_calibrator_fault(self, fault: str) -> None:
        """Take what keeps the calibrator from taking a session in; empty where nothing does.

        No plan is started while there is a fault; one that runs goes on.
        """
        if self.rules.supervised:
            self._obstacles.calibrator = fault

    @property
    def ignored(self) -> tuple[int, tuple[str, ...]]:
        """How many joint states lacked a joint of the table, and what the latest named."""
        return self._encoders.ignored, self._encoders.ignored_names

    def set_calibrator_present(self, heard: bool, reason: str = '') -> None:
        """Take whether the calibrator is there; while it is silent the table is not led."""
        if not self.rules.supervised:
            return
        heard = heard and not (self._resumes and self._done is None)
        self._heard = heard
        if not heard:
            self.fail(reason or 'The calibrator is silent.')
        elif self._stage is _Stage.WAITING and not self._obstacles.calibrator:
            if not self._obstacles.feedback:
                self._go()
            elif self._waits_from is _Stage.PAUSED:
                self._halt(_Stage.PAUSED, self._obstacles.feedback, fault=True)

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
        again = self._itinerary.repeat(repeat_steps)
        self._place_is_known = False
        if again:
            self._next()
        else:
            self._begin(self._itinerary.home)

    def take(self, block: JointBlock) -> bool:
        """Take joint states; return whether their stamps advance."""
        advanced = False
        try:
            for now in self._encoders.take(block):
                self._feedback, self._obstacles.feedback, advanced = now, '', True
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

    def state(self) -> SequencerState:
        """Return what is going on."""
        at = self._feedback
        if self._stage is _Stage.MOVING:
            turns = self._motion is not None and self._motion.mode is Mode.RATE
            phase = Phase.TURNING if turns else Phase.MOVING
        else:
            stage = self._waits_from if self._stage is _Stage.WAITING else self._stage
            phase = _PHASES[stage]
        waits = _CALIBRATOR if self._stage is _Stage.WAITING else ''
        reason, current = self._why.words, self._itinerary.current
        if waits and phase is Phase.PAUSED:
            reason = f'Waits for {waits}.'
        return SequencerState(
            plan=self.plan.name,
            step=self._itinerary.index,
            steps=len(self._itinerary),
            position='' if current is None else current.position,
            phase=phase,
            reason=reason,
            fault=self._why.fault,
            waits_for=waits,
            angles=() if at is None else at.angles,
            rates=() if at is None else at.rates,
            turns_done=self._turns_done,
            seconds_left=self._seconds_left(),
        )

    @property
    def feedback_fault(self) -> str:
        """What is wrong with the joint states; empty while they are sound."""
        return self._obstacles.feedback

    @property
    def summary(self) -> tuple[object, ...]:
        """What makes a state worth telling: it changes with everything but the measurements."""
        motion = None if self._motion is None else self._motion.mode
        current = self._itinerary.current
        return self._stage, self._waits_from, motion, current, self._why.words

    def _enter(self, stage: _Stage) -> None:
        self._stage = stage
        if self._feedback is not None:
            self._since = self._feedback.stamp

    def _send(self, command: Setpoint, motion: Step | None) -> None:
        """Make this the setpoint to send from now on."""
        self._command, self._motion, self._sent = command, motion, False
        self.revision += 1

    def _holding(self) -> Setpoint:
        at = None if self._feedback is None else self._feedback.angles
        return held(self._itinerary.current, at, self.plan.name, self.table)

    def _remark(self, what: str, text: str) -> None:
        """Hold a table that is not led, and say why; a start that waits is called off."""
        if self._stage is _Stage.WAITING:
            self._enter(self._waits_from)
        self._why.remark(what, text)
        if self._command is None or self._command.mode is not Mode.HOLD:
            self._send(self._holding(), None)

    def _halt(self, stage: _Stage, reason: str, *, fault: bool = False) -> None:
        """Hold, and do not go on by itself."""
        if self._stage in _WITHIN_A_STEP:
            self._itinerary.put_back()
        self._why.begin(reason, fault=fault)
        self._enter(stage)
        self._hold_table()

    def _hold_table(self) -> None:
        led = isinstance(self._watch, Watch) or self._watch.led
        self._unled = IdleWatch(self.table, self.rules, self._feedback, led=led)
        self._send(self._holding(), None)
        self._watch = Standing(self.table, self.rules, self._feedback, led=led)

    def _go(self) -> None:
        """Go on once the table stands."""
        if self._resumes and self._done is not None:
            self._resumes = False
            self._itinerary.leave_out(self._done)
        self._place_is_known = False
        self._enter(_Stage.STOPPING)
        self._hold_table()

    def _next(self) -> None:
        """Begin the next step; after the last one ask the calibrator, then go home."""
        step = self._itinerary.take()
        if step is None and self.rules.supervised and not self._itinerary.goes_home:
            self._enter(_Stage.REVIEWING)
            self._hold_table()
        else:
            self._begin(step or self._itinerary.home)

    def _begin(self, step: Step) -> None:
        """Command a step; a turn whose place is not certain is preceded by the way there."""
        self._itinerary.current = step
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
            self._why.reason = (
                f'The calibrator did not say within {self.rules.repeat_wait:g} s '
                'whether steps are to be repeated.'
            )
            self._begin(self._itinerary.home)

    def _see_it_stand(self, now: Feedback) -> None:
        """Hold a table that moves though nobody leads it, and say how far and how fast."""
        if self._unled.look(now):
            self._remark('unled', self._unled.text)

    def _arrive(self) -> None:
        motion, current = self._motion, self._itinerary.current
        assert motion is not None
        assert current is not None
        if motion.mode is not current.mode:
            self._move(current)
            return
        self._enter(_Stage.SETTLING)
        self._watch = Standing(self.table, self.rules, self._feedback)
        self._watch.keep(tuple(end_of(current).tolist()))

    def _dwell(self) -> float:
        current = self._itinerary.current
        return 0.0 if current is None else current.dwell

    def _finish(self, now: Feedback) -> None:
        if self._itinerary.goes_home:
            self._enter(_Stage.DONE)
            self._hold_table()
            return
        self._ended = now.stamp
        self._next()

    def _seconds_left(self) -> float:
        """Return the expected time to the end of the plan, s; 0 while nothing is started."""
        if self._stage in {_Stage.DONE, _Stage.ABORTED, _Stage.IDLE}:
            return 0.0
        left, at = self._itinerary.seconds_left(), self._feedback
        if self._stage not in _WITHIN_A_STEP or at is None:
            return left
        elapsed = (at.stamp - self._since) * 1e-9
        now = {
            _Stage.MOVING: self._itinerary.seconds_of_current(),
            _Stage.SETTLING: self.rules.settle + self._dwell(),
            _Stage.DWELLING: self._dwell(),
        }
        return left + max(now[self._stage] - elapsed, 0.0)
