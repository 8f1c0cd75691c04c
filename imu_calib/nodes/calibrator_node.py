"""calibrator_node: listens, journals, and publishes the 24 parameters as they become known."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from .. import middleware as ros
from ..bags import Journal
from ..calibration import Calibration
from ..cdr import Kind
from ..errors import InputError
from ..middleware import messages
from . import qos
from .convert import calibration_message, final_status, refusal_message
from .declared import declare
from .diagnostics import Diagnostics, Level
from .done import DoneWord
from .entry import entry_point
from .hearing import Hearing
from .live import LiveSession, SessionPhase
from .publishers import OnePublisher
from .session_parameters import declared_setup
from .session_words import journal_words, progress_message, report, session_sentence

_TICK = 0.005
"""s: five samples at 1 kHz; a queue of the middleware holds many times that."""
_SECOND = 1.0
"""s between two looks at what changes slowly: publishers, the disk, the words said."""
_GLANCE = 0.25
"""s between two reviews of a session in the hand: a person who holds still waits for the answer."""
_STATE_TYPE = 'imu_calib_msgs/msg/TurntableState'


class CalibratorNode(ros.Node):
    """Feeds the `Calibrator` that `imu-calib calibrate` feeds, and says what it finds."""

    def __init__(self) -> None:
        super().__init__('calibrator_node')
        self._setup, self._description = declared_setup(self)
        table, plan = self._setup.table, self._setup.plan
        self._steps = len(plan.positions if table is None else plan.steps(table))
        self._output = Path(
            declare(self, 'output', 'calibration.yaml', 'file that takes the result')
        ).expanduser()
        self._journal_path = Path(
            declare(self, 'journal', 'journal', 'folder of the recording; resumed if unfinished')
        ).expanduser()
        self._imu_timeout = declare(
            self, 'imu_timeout', 0.5, 'longest silence of the IMU against the table, s', lower=0.01
        )
        steady = ros.Clock(clock_type=ros.ClockType.STEADY_TIME)
        self._diagnostics = Diagnostics(self, self._setup.imu.id)
        self._result_publisher = self.create_publisher(
            messages.ImuCalibration, 'calibration', qos.latched()
        )
        self._progress_publisher = self.create_publisher(
            messages.CalibrationProgress, 'calibration/progress', qos.latched()
        )
        self._hearing = Hearing(self, self._setup)
        self._state_topic = self.resolve_topic_name('turntable/state')
        self._early_states: list[bytes] = []
        self._latest = 0
        self._states = OnePublisher(self, self._state_topic)
        self._done = DoneWord(plan.name, self._steps)
        self._seconds_left = math.nan
        if self._setup.table is not None:
            self.create_subscription(
                messages.TurntableState, 'turntable/state', self._on_state, qos.latched(), raw=True
            )
        self.create_service(ros.Trigger, '~/solve', self._on_solve)
        self.create_service(ros.Trigger, '~/reset', self._on_reset)
        self.create_service(ros.Trigger, '~/save', self._on_save)
        self._sessions = 0
        self._session = self._new_session()
        self.create_timer(_TICK, self._on_tick, clock=steady)
        self.create_timer(_SECOND, self._on_second, clock=steady)
        if self._setup.table is None:
            # A person looks at what it says while holding still.
            self.create_timer(_GLANCE, self._on_glance, clock=steady)

    def stop(self) -> list[Any]:
        """Leave the journal such that the next start goes on with it."""
        self._take_all()
        self._session.close()
        self._publish_progress()
        return [self._progress_publisher, self._result_publisher]

    def _new_session(self) -> LiveSession:
        """Begin a session, or go on with the one that the journal holds."""
        path = self._journal_path
        if self._sessions:
            path = path.with_name(f'{path.name}_{self._sessions + 1}')
        self._sessions += 1
        topics = self._hearing.topics
        journal = Journal(path, self._description, {t: kind for kind, t in topics.items()})
        if self._setup.table is not None:
            journal.add_latched_topic(self._state_topic, _STATE_TYPE)
        session = LiveSession(self._setup, journal, topics)
        self._hearing.begin()
        self._shown: Calibration | None = None
        held = sum(intake.count for intake in session.intakes.values())
        resumed = f'The session goes on from {path}, which holds {held} messages.'
        if held:
            self._diagnostics.report('journal', Level.WARN, resumed)
        else:
            self._diagnostics.report('journal', Level.OK, journal_words(path))
        return session

    def _on_tick(self) -> None:
        self._take_all()
        if self._session.poll():
            self._publish()

    def _read_clock(self) -> int:
        """Return the time of the recording, ns; 0 before the first /clock of a simulated time."""
        now = int(self.get_clock().now().nanoseconds)
        if now < self._latest:
            back = (self._latest - now) * 1e-9
            self._diagnostics.report(
                'time',
                Level.WARN,
                f'The clock jumped back by {back:.3g} s: the recording goes on with its last time.',
            )
        elif now == 0:
            self._diagnostics.report(
                'time', Level.WARN, 'Nothing has come on /clock yet: nothing is taken in.'
            )
        else:
            self._diagnostics.report('time', Level.OK, 'The clock runs.')
        self._latest = max(now, self._latest)
        return self._latest

    def _take_all(self) -> None:
        now = self._read_clock()
        if now == 0:
            # A log time before the clock began would make a recording of decades.
            return
        for payload in self._early_states:
            self._session.record(self._state_topic, _STATE_TYPE, payload, now)
        self._early_states.clear()
        for kind, payloads in self._hearing.take():
            session = self._session
            # Samples of a second device cannot be told from those of the first.
            two = kind is Kind.IMU and not session.over and self._hearing.two_devices
            if two and session.backwards(kind, payloads):
                self._two_publishers()
            elif not session.over:
                session.take(kind, payloads, now)

    def _on_glance(self) -> None:
        self._session.solve()

    def _on_second(self) -> None:
        for topic in self._hearing.subscribe_anew():
            self._diagnostics.report(
                'quality of service',
                Level.WARN,
                f'{topic} is published best effort: messages can be lost on the way.',
            )
        if self._hearing.two_devices_stay() and not self._session.over:
            self._two_publishers()
        self._states.look(time.monotonic())
        self._session.flush()
        if self._session.rested:
            self._session.solve()
        self._report()
        self._publish_progress()

    def _two_publishers(self) -> None:
        topic = self._session.intakes[Kind.IMU].topic
        self._session.fail(f'Two publishers on {topic}: stop one of them, then call ~/reset.')
        self._publish()

    def _on_state(self, payload: bytes) -> None:
        state = ros.deserialize_message(payload, messages.TurntableState)
        self._early_states.append(payload)
        self._take_all()
        if state.plan and state.plan != self._setup.plan.name:
            self._session.fail(
                f'The table runs plan {state.plan}, this calibrator expects '
                f'{self._setup.plan.name}.'
            )
            self._publish()
            return
        self._seconds_left = float(state.seconds_left)
        if state.phase != messages.TurntableState.DONE:
            self._done.deny()
            self._session.table_running()
            return
        doubt = self._done.doubt(
            state.plan,
            state.steps,
            self._session.steps_seen,
            alone=self._states.is_alone(time.monotonic()),
        )
        if not doubt and self._done.is_repeated:
            stamp = state.header.stamp
            self._session.table_done(stamp.sec * 1_000_000_000 + stamp.nanosec)
        self._report_done(doubt)

    def _report_done(self, doubt: str) -> None:
        """Say why DONE does not end the session, where it does not."""
        text = f'{self._state_topic} says DONE, which ends nothing: {doubt}.'
        self._diagnostics.report(
            'turntable state',
            Level.WARN if doubt else Level.OK,
            text if doubt else f'{self._state_topic} says DONE.',
        )

    def _publish(self) -> None:
        """Publish the calibration where there is news of it, and the progress."""
        session = self._session
        now = self.get_clock().now().to_msg()
        if session.phase is SessionPhase.FAILED:
            self._result_publisher.publish(
                refusal_message(
                    self._setup.imu, self._setup.plan.name, session.failure, session.frame_id, now
                )
            )
        elif session.calibration is not None and self._is_news(session.calibration):
            self._shown = session.calibration
            final = session.phase is SessionPhase.FINISHED
            status = messages.ImuCalibration.PROVISIONAL
            if final:
                status = final_status(session.calibration)
            self._result_publisher.publish(
                calibration_message(session.calibration, status, session.frame_id, now)
            )
            if final:
                self._save()
        self._report()
        self._publish_progress()

    def _is_news(self, calibration: Calibration) -> bool:
        return (
            self._shown is None
            or self._session.phase is SessionPhase.FINISHED
            or calibration.provenance['samples'] != self._shown.provenance['samples']
        )

    def _publish_progress(self) -> None:
        message = progress_message(self._session, self._steps, self._seconds_left, self._output)
        self._progress_publisher.publish(message)

    def _report(self) -> None:
        report(self._session, self._diagnostics, self._imu_timeout)

    def _save(self) -> str:
        """Write the result; return why not, or nothing."""
        calibration = self._session.calibration
        if calibration is None:
            return session_sentence(self._session)
        try:
            calibration.save(self._output)
        except InputError as error:
            self._diagnostics.report('file', Level.ERROR, str(error))
            return str(error)
        self._diagnostics.report('file', Level.OK, f'{self._output} is written.')
        return ''

    def _on_solve(self, _: Any, response: Any) -> Any:
        """End the session with what is here."""
        session = self._session
        response.success = not session.over
        response.message = session_sentence(self._session)
        review = session.review
        if self._setup.table is None and review is not None and review.result is None:
            # In the hand there is always another hold to be made.
            response.success, response.message = False, review.refusal
        if response.success:
            self._session.end()
            topic = self.resolve_topic_name('calibration')
            response.message = f'The session is being solved; the result comes on {topic}.'
        return response

    def _on_reset(self, _: Any, response: Any) -> Any:
        """Begin a new session, with a journal of its own."""
        before = self._session
        try:
            self._session = self._new_session()
        except InputError as error:
            # The one that runs goes on.
            response.success, response.message = False, str(error)
        else:
            before.close()
            response.success = True
            response.message = f'A new session is written to {self._session.journal.path}.'
        self._publish_progress()
        return response

    def _on_save(self, _: Any, response: Any) -> Any:
        """Write what is determined so far."""
        problem = self._save()
        response.success, response.message = not problem, problem or f'{self._output} is written.'
        return response


def main() -> int:
    """Run the node; return the exit code."""
    return entry_point(CalibratorNode)


if __name__ == '__main__':
    raise SystemExit(main())
