"""calibrator_node: records a journal and publishes the 24 parameters as they are determined."""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

from ...common.errors import InputError
from ...common.stream import NS
from ...recordings.cdr_codec import Kind
from ...recordings.rosbag2 import SIMULATED_CLOCK
from ...reports.convergence import reading_sentence
from ...session.metadata import SIMULATED
from ...session.plan import Plan
from .. import middleware as ros
from ..middleware import Node, messages
from ..rules import Phase, Severity
from . import qos
from .diagnostics import Diagnostics
from .intake import Subscriptions, topics_of_table, topics_of_unit
from .live_session import SessionPhase
from .parameters import declare, declare_path
from .programs import entry_point
from .qos import OnePublisher
from .session_parameters import StatedUnit, absent_units, declared_units
from .session_reports import (
    IMU_TIMEOUT,
    UnitResults,
    journal_sentence,
    progress_of_all,
    session_sentence,
)
from .sessions import STATE_TYPE, SessionFactory, Sessions


class DoneCheck:
    """Receives turntable/state, and accepts DONE only with independent evidence.

    Any publisher on the topic could end a session. Therefore the calibrator must have received
    setpoints of every step, no other node may publish the state, and DONE must come twice in
    succession: the node that runs the plan repeats its state twice a second and would contradict.
    """

    def __init__(self, plan: str, steps: int) -> None:
        self._plan = plan
        self._steps = steps
        self._in_succession = 0

    def deny(self) -> None:
        """Record a state other than DONE."""
        self._in_succession = 0

    def refusal(self, plan: str, steps: int, commanded: int, *, alone: bool) -> str:
        """Record DONE of a plan, and the steps that setpoints commanded; return why it is not
        accepted.
        """
        self._in_succession += 1
        if plan != self._plan:
            return f'it names the plan {plan or "(none)"}, not {self._plan}'
        if steps != self._steps:
            return f'it has {steps} steps, plan {self._plan} has {self._steps}'
        if commanded < self._steps:
            first = f'{commanded + 1} to ' if commanded + 1 < self._steps else ''
            return f'step {first}{self._steps} of {self._plan} was never commanded'
        if not alone:
            return 'more than one node publishes the state'
        return ''

    @property
    def is_repeated(self) -> bool:
        """Whether DONE was received more than once in succession."""
        return self._in_succession > 1


_RUNS = frozenset(phase for phase in Phase if phase.at_a_step)


class TurntableStateIntake:
    """Passes to sessions whether the table runs, is done, or runs another plan; records it."""

    def __init__(self, node: Node, plan: Plan, steps: int, diagnostics: Diagnostics) -> None:
        self.topic = node.resolve_topic_name('turntable/state')  #: Full name.
        #: Remaining time of the plan as the table states, s; else NaN.
        self.seconds_left = math.nan
        #: Of the table, a constant of TurntableState; None before the first message.
        self.phase: int | None = None
        self._plan = plan
        self._diagnostics = diagnostics
        self._publisher = OnePublisher(node, self.topic)
        self._done = DoneCheck(plan.name, steps)
        self._unrecorded: list[bytes] = []

    def keep(self, payload: bytes) -> None:
        """Keep a serialised message for recording."""
        self._unrecorded.append(payload)

    def record(self, sessions: Sessions, now: int) -> None:
        """Record the messages received since the last call, at `now`, host time in ns."""
        for payload in self._unrecorded:
            sessions.record(self.topic, STATE_TYPE, payload, now)
        self._unrecorded.clear()

    def check_publishers(self, now: float) -> None:
        """Check its publishers at a time of the steady clock, s."""
        self._publisher.fault(now)

    def follow(self, state: Any, sessions: Sessions, now: float) -> bool:
        """Process a message after all earlier data; return whether it ended the sessions."""
        if state.plan and state.plan != self._plan.name:
            for session in sessions.all:
                session.fail(
                    f'The table runs plan {state.plan}, this calibrator expects {self._plan.name}.'
                )
            return True
        self.seconds_left, self.phase = float(state.seconds_left), state.phase
        if state.phase != messages.TurntableState.DONE:
            self._done.deny()
            for session in sessions.all:
                session.table_running()
            return False
        refusal = self._done.refusal(
            state.plan,
            state.steps,
            max(session.steps_seen for session in sessions.all),
            alone=self._publisher.is_alone(now),
        )
        if not refusal and self._done.is_repeated:
            stamp = state.header.stamp
            for session in sessions.all:
                session.table_done(stamp.sec * NS + stamp.nanosec)
        text = f'{self.topic} reports that the plan is done, which is ignored: {refusal}.'
        self._diagnostics.report(
            'turntable state',
            Severity.WARN if refusal else Severity.OK,
            text if refusal else f'{self.topic} reports that the plan is done.',
        )
        return False

    @property
    def runs(self) -> bool:
        """Whether the table is at a step of the plan."""
        return self.phase in _RUNS

    @property
    def paused(self) -> bool:
        """Whether the plan is interrupted, and may be resumed."""
        return self.phase == Phase.PAUSED


_TICK = 0.02
"""s: twenty samples at 1 kHz; a queue of the middleware holds many times that. The fixed cost of a
round is paid for every unit: for eight units at 1 kHz 14 % of a core, and 43 % with rounds of
5 ms."""
_SECOND = 1.0
"""s between checks of what changes slowly: publishers, disk, report texts."""
_LAST_TAKE = 1.0
"""s to process pending data when the node is stopped. A judgement: a person waits no longer after
Ctrl-C, and a launcher kills the process five seconds later, before which the journal must close."""
_GROWTH = 1.5
"""Growth of the data between two reviews in step with a simulation. A choice: ten reviews of a
session, each of which the person sees."""
_NEAR_THE_END = 20.0
"""s left of a plan below which its table may wait for a review. A choice: it is on its way home."""
_GLANCE = 0.25
"""s between two reviews of a session in the hand: a person who holds still waits for the result."""
_TWO_CLOCKS = (
    'Samples are stamped by both: give each simulated stand a domain of its own (ROS_DOMAIN_ID).'
)


class CalibratorNode(ros.Node):
    """Feeds the same `Calibrator` as `imu-calib calibrate`, and publishes its results.

    Each of several units on one table has a session and a namespace; topics without a namespace
    concern all units.
    """

    def __init__(self) -> None:
        super().__init__('calibrator_node')
        self._units, description = declared_units(self)
        # Plan, table and site are common to all units.
        self._setup = self._units[0].setup
        self._several = bool(self._units[0].name)
        table, plan = self._setup.table, self._setup.plan
        self._steps = len(plan.positions if table is None else plan.steps(table))
        words = 'File that takes the result; of several units the folder that gets SERIAL.yaml.'
        self._output = declare_path(self, 'output', 'calibration.yaml', words)
        words = 'Folder of the recording; an unfinished one is continued.'
        journal = declare_path(self, 'journal', 'journal', words)
        words = 'Longest silence of the IMU against the table, s.'
        self._imu_timeout = declare(self, 'imu_timeout', IMU_TIMEOUT, words, lower=0.01)
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        stand = f'{len(self._units)} units' if self._several else self._setup.imu.id
        self._diagnostics = Diagnostics(self, stand)
        self._results = [
            UnitResults(self, unit.setup, unit.name, self._file_of(unit), self._diagnostics)
            for unit in self._units
        ]
        self._common = self._open_common_topics() if self._several else None
        self._of_table = Subscriptions(self, topics_of_table(self._setup))
        self._of_units = [
            Subscriptions(self, topics_of_unit(unit.setup, unit.name, unit.topic))
            for unit in self._units
        ]
        self._latest = 0
        self._clocks = OnePublisher(self, '/clock', _TWO_CLOCKS)
        self._simulated = bool(self.get_parameter('use_sim_time').value)
        self._two_clocks = ''
        self._turntable = TurntableStateIntake(self, plan, self._steps, self._diagnostics)
        if self._setup.table is not None:
            self.create_subscription(
                messages.TurntableState, 'turntable/state', self._on_state, qos.latched(), raw=True
            )
        self.create_service(ros.Trigger, '~/solve', self._on_solve)
        self.create_service(ros.Trigger, '~/reset', self._on_reset)
        self.create_service(ros.Trigger, '~/save', self._on_save)
        state = None if table is None else self._turntable.topic
        self._told_at = -math.inf
        if self._simulated:
            description |= {SIMULATED: 'true', SIMULATED_CLOCK: 'true'}
        absent = absent_units(self) if self._several else ()
        self._factory = SessionFactory(
            self._units, description, journal, state, self._tell_read, absent
        )
        self._sessions = self._new_sessions()
        self.create_timer(_TICK, self._on_tick, clock=steady)
        self.create_timer(_SECOND, self._on_second, clock=steady)
        if self._setup.table is None:
            # A person reads the advice while holding still.
            self.create_timer(_GLANCE, self._on_glance, clock=steady)

    def stop(self) -> list[Any]:
        """Close the journal so that the next start can resume it."""
        end = time.monotonic() + _LAST_TAKE
        while self._receive_all() and time.monotonic() < end:
            # A round takes a limited number of messages from each topic.
            pass
        self._sessions.close()
        self._publish_progress()
        publishers = [p for results in self._results for p in (results.progress, results.result)]
        return publishers if self._common is None else [*publishers, *self._common]

    def _file_of(self, unit: StatedUnit) -> Path:
        """Return the file of a unit's result."""
        if not self._several:
            return self._output
        # As bringup.launch.py expects it.
        return self._output / f'{unit.setup.serial_number}.yaml'

    def _open_common_topics(self) -> tuple[Any, Any]:
        """Open the topics without a namespace, and the services that exclude a unit."""
        try:
            self._output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f'Parameter output: {self._output}: {error.strerror}.') from None
        for place, unit in enumerate(self._units):
            self.create_service(
                ros.Trigger, f'~/leave_out/{unit.name}', partial(self._on_leave_out, place)
            )
        latched = qos.latched(len(self._units))
        return (
            self.create_publisher(
                messages.CalibrationProgress, 'calibration/progress', qos.latched()
            ),
            self.create_publisher(messages.ImuCalibration, 'calibration', latched),
        )

    def _new_sessions(self) -> Sessions:
        """Begin a session, or resume the one in the journal."""
        of_units = [subscriptions.topics for subscriptions in self._of_units]
        sessions = self._factory.begin(self._of_table.topics, of_units)
        self._reviewed = 0
        for subscriptions, results in zip(self._of_units, self._results, strict=True):
            subscriptions.begin()
            results.begin()
        held = sessions.held
        path = sessions.journal.path
        resumed = f'The session is resumed from {path}, which holds {held} messages.'
        if held:
            self._diagnostics.report('journal', Severity.WARN, resumed)
        elif sessions.journal.losses:
            self._diagnostics.report('journal', Severity.WARN, ' '.join(sessions.journal.losses))
        else:
            self._diagnostics.report('journal', Severity.OK, journal_sentence(path))
        return sessions

    def _tell_read(self, share: float) -> None:
        """Tell now and then how much of a journal is read: until then the node does not answer."""
        now = time.monotonic()
        if now - self._told_at > _SECOND:
            self._told_at = now
            self._diagnostics.report('journal', Severity.OK, reading_sentence(share))
            self._diagnostics.publish()

    def _on_tick(self) -> None:
        self._receive_all()
        for place in self._sessions.poll():
            self._publish(place)

    def _read_clock(self) -> int:
        """Return the time of the recording, ns; 0 before the first /clock of a simulated time."""
        now = int(self.get_clock().now().nanoseconds)
        if self._two_clocks:
            self._diagnostics.report('time', Severity.ERROR, self._two_clocks)
        elif now < self._latest:
            back = (self._latest - now) * 1e-9
            self._diagnostics.report(
                'time',
                Severity.WARN,
                f'The clock jumped back by {back:.3g} s. Messages are recorded with the time '
                'before the jump until the clock reaches it again.',
            )
        elif now == 0:
            self._diagnostics.report(
                'time',
                Severity.WARN,
                f'{qos.none_yet("/clock")} Until there is one, all data are ignored.',
            )
        else:
            self._diagnostics.report('time', Severity.OK, 'The clock runs.')
        self._latest = max(now, self._latest)
        return self._latest

    def _receive_all(self) -> bool:
        """Process a limited number of new messages per topic; return whether there were any."""
        now = self._read_clock()
        if now == 0:
            # A log time before the clock starts would make the recording decades long.
            return False
        self._turntable.record(self._sessions, now)
        came = False
        for kind, payloads in self._of_table.received():
            self._sessions.add_common_messages(kind, payloads, now)
            came = True
        for place, subscriptions in enumerate(self._of_units):
            came = self._receive_unit(place, subscriptions, now) or came
        return came

    def _receive_unit(self, place: int, subscriptions: Subscriptions, now: int) -> bool:
        """Process new messages of a unit; return whether there were any."""
        session, came = self._sessions.all[place], False
        for kind, payloads in subscriptions.received():
            came = True
            # Samples of a second device cannot be distinguished from those of the first.
            two = kind is Kind.IMU and not session.is_over and subscriptions.two_devices
            if two and session.backwards(kind, payloads):
                self._two_publishers(place)
            elif not session.is_over:
                session.add_messages(kind, payloads, now)
        return came

    def _on_glance(self) -> None:
        for session in self._sessions.all:
            session.solve()

    def _on_second(self) -> None:
        """Check publishers and journal, and begin a round of reviews."""
        for subscriptions in (self._of_table, *self._of_units):
            for topic in subscriptions.subscribe_anew():
                self._diagnostics.report(
                    'quality of service',
                    Severity.WARN,
                    qos.best_effort(topic),
                )
        for place, subscriptions in enumerate(self._of_units):
            if subscriptions.two_devices_persist() and not self._sessions.all[place].is_over:
                self._two_publishers(place)
        self._turntable.check_publishers(time.monotonic())
        if self._simulated:
            self._two_clocks = self._clocks.fault(time.monotonic())
        self._sessions.flush()
        if self._review_is_due():
            self._sessions.solve()
        self._report()
        self._publish_progress()

    def _review_is_due(self) -> bool:
        """Return whether it is time for a review; the solver itself pauses between two.

        In step with a simulation a review holds everything up. There is one whenever the data has
        grown by half, and whenever the table may wait for one: at the end of its plan.
        """
        if not ros.in_step() or not self._turntable.seconds_left > _NEAR_THE_END:
            return True
        held = self._sessions.held
        due = held > _GROWTH * self._reviewed
        if due:
            self._reviewed = held
        return due

    def _two_publishers(self, place: int) -> None:
        session = self._sessions.all[place]
        topic = session.intakes[Kind.IMU].topic
        session.fail(f'{qos.two_publishers(topic)} Then call ~/reset.')
        self._publish(place)

    def _on_state(self, payload: bytes) -> None:
        state = ros.deserialize_message(payload, messages.TurntableState)
        self._turntable.keep(payload)
        self._receive_all()
        if self._turntable.follow(state, self._sessions, time.monotonic()):
            for place in range(len(self._units)):
                self._publish(place)

    def _publish(self, place: int) -> None:
        """Publish a unit's calibration if it changed, and its progress."""
        last = self._results[place].publish(self._sessions.all[place])
        if last is not None and self._common is not None:
            _, results = self._common
            results.publish(last)
        self._report()
        self._publish_progress()

    def _publish_progress(self) -> None:
        sessions = self._sessions
        each = [
            results.publish_progress(session, self._steps, self._turntable.seconds_left)
            for results, session in zip(self._results, sessions.all, strict=True)
        ]
        if self._common is not None:
            progress, _ = self._common
            progress.publish(progress_of_all(sessions, each, self._imu_timeout, self._output))

    def _report(self) -> None:
        for place, results in enumerate(self._results):
            if place in self._sessions.left_out:
                results.report_part(
                    'calibration', Severity.WARN, 'The unit is left out of this session.'
                )
            else:
                results.report(self._sessions.all[place], self._imu_timeout)

    def _on_solve(self, _: Any, response: Any) -> Any:
        """End the session with the data received so far."""
        sessions = self._sessions
        first = sessions.all[0]
        response.success = not sessions.is_over
        response.message = self._sentence()
        review = first.review
        if self._setup.table is None and review is not None and review.result is None:
            # In the hand another hold is always possible.
            response.success, response.message = False, review.refusal
        if response.success:
            sessions.end()
            topic = self.resolve_topic_name('calibration')
            response.message = (
                f'The calibration is being computed; it will be published on {topic}.'
            )
        return response

    def _sentence(self) -> str:
        """Return a sentence on the progress of the session or its fault."""
        sentences = [session_sentence(session) for session in self._sessions.all]
        if not self._several:
            return sentences[0]
        names = [unit.setup.serial_number for unit in self._units]
        return ' '.join(f'{name}: {words}' for name, words in zip(names, sentences, strict=True))

    def _on_leave_out(self, place: int, _: Any, response: Any) -> Any:
        """Continue without a unit, for instance a silent one that delays the others."""
        sessions, serial = self._sessions, self._units[place].setup.serial_number
        alone = sessions.open == [sessions.all[place]]
        if place in sessions.left_out:
            response.success, response.message = False, f'{serial} is left out already.'
        elif sessions.is_over:
            # Its recording is closed.
            response.success = False
            response.message = f'The session is over: {serial} cannot be left out.'
        elif alone or sessions.all[place].phase is SessionPhase.FINISHED:
            what = 'is the last unit' if alone else 'has its result'
            response.success, response.message = False, f'{serial} {what}: it cannot be left out.'
        else:
            sessions.leave_out(place)
            response.success = True
            response.message = f'{serial} is left out; the session goes on with the others.'
            self._publish(place)
        return response

    def _on_reset(self, _: Any, response: Any) -> Any:
        """Begin a new session with a new journal, unless the table is in the middle of one."""
        before, turntable = self._sessions, self._turntable
        if turntable.runs and not before.is_over and self.count_publishers(turntable.topic):
            response.success = False
            response.message = (
                'The plan is running, and a new session would lack its first steps. Abort the '
                'plan at turntable_node, call ~/reset, and start the plan again.'
            )
            return response
        try:
            self._sessions = self._new_sessions()
        except InputError as error:
            # The running session continues.
            response.success, response.message = False, str(error)
        else:
            before.close()
            response.success = True
            response.message = f'A new session is written to {self._sessions.journal.path}.'
            if turntable.paused:
                response.message += (
                    ' The plan is paused: abort it to run all steps, resume it to run the rest.'
                )
        self._publish_progress()
        return response

    def _on_save(self, _: Any, response: Any) -> Any:
        """Write the parameters determined so far."""
        problems = [
            f'{unit.setup.serial_number}: {problem}' if self._several else problem
            for unit, results, session in zip(
                self._units, self._results, self._sessions.all, strict=True
            )
            if (problem := results.save(session))
        ]
        response.success = not problems
        response.message = ' '.join(problems) or f'{self._output} is written.'
        return response


if __name__ == '__main__':
    raise SystemExit(entry_point(CalibratorNode))
