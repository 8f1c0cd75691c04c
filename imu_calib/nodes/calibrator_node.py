"""calibrator_node: listens, journals, and publishes the 24 parameters as they become known."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from .. import middleware as ros
from ..bags import Journal
from ..calibration import Calibration
from ..calibrator import Review, Setup
from ..cdr import Kind
from ..earth import Site
from ..errors import InputError
from ..imu import load_imu
from ..metadata import describe
from ..middleware import messages
from ..model import AUTO_TERMS, Parameter, chosen, looked_for
from ..model.session_terms import parted
from ..plan import load_plan
from ..reports.parameter_table import engineering
from ..turntable import load_table
from ..units import DEG
from . import qos
from .convert import calibration_message, final_status, refusal_message
from .declared import declare
from .diagnostics import Diagnostics, Level
from .done import DoneWord
from .entry import entry_point
from .live import LiveSession, Phase
from .publishers import OnePublisher

_TICK = 0.005
_SECOND = 1.0
_GLANCE = 0.25
_MOST = 4096
_GHOST = 15.0
_STATE_TYPE = 'imu_calib_msgs/msg/TurntableState'
_TOPICS = {
    Kind.SETPOINTS: ('turntable/setpoint', messages.TurntableSetpoint),
    Kind.JOINTS: ('turntable/joint_states', messages.JointState),
    Kind.TEMPERATURES: ('imu/temperature', messages.Temperature),
    Kind.IMU: ('imu/pulses', messages.Imu),
    Kind.SKEW: ('imu/skew', messages.Imu),
}
_OF_THE_TABLE = (Kind.SETPOINTS, Kind.JOINTS)
_SILENCE_BY_HAND = 2.0


class CalibratorNode(ros.Node):
    """Feeds the `Calibrator` that `imu-calib calibrate` feeds, and says what it finds."""

    def __init__(self) -> None:
        super().__init__('calibrator_node')
        self._setup = self._read_setup()
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
        self._drains = {kind: self._open_drain(kind, reliable=True) for kind in self._kinds()}
        self._unreliable: set[Kind] = set()
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

    def _read_setup(self) -> Setup:
        plan = declare(self, 'plan', 'twelve_position', 'name or file of the plan that is run')
        imu = declare(self, 'imu', 'fog_medium', "name or file: what the IMU's numbers mean")
        table = declare(self, 'table', 'three_axis', 'name or file of the turntable')
        latitude = declare(self, 'latitude', math.nan, 'deg, negative in the south; required')
        latitude_std = declare(self, 'latitude_std', math.nan, 'deg; nan: 0.01')
        height = declare(self, 'height', math.nan, 'm above the ellipsoid; nan: not known')
        height_std = declare(self, 'height_std', math.nan, 'm; nan: 0 where a height is stated')
        gravity = declare(
            self, 'gravity', math.nan, 'local gravity as measured, m/s^2; nan: normal gravity'
        )
        gravity_std = declare(
            self, 'gravity_std', math.nan, 'm/s^2; nan: 0 if measured, 30e-5 if normal'
        )
        azimuth = declare(
            self, 'azimuth', math.nan, "heading of the table's zero, deg; nan: as the table says"
        )
        method = declare(self, 'method', '', 'the estimator; empty: joint where it applies')
        wanted = declare(
            self, 'terms', AUTO_TERMS, 'that the joint estimate adds; auto: those that show'
        )
        named, changes = parted(wanted)
        terms, look = chosen(named), looked_for(wanted)
        serial = declare(self, 'serial_number', '', 'of the unit; empty: not stated')
        if math.isnan(latitude):
            raise InputError('Parameter latitude: give the latitude of the stand, in degrees.')
        site = Site.at(
            latitude * DEG,
            _stated(height),
            _stated(gravity),
            height_std=_stated(height_std),
            gravity_std=_stated(gravity_std),
            latitude_std=None if math.isnan(latitude_std) else latitude_std * DEG,
        )
        laid_out = load_plan(plan)
        if laid_out.by_hand:
            self._description = describe(plan, imu, None, site, serial)
            return Setup(
                load_imu(imu), laid_out, None, site, method or None, serial, terms, changes, look
            )
        described = load_table(table)
        if not math.isnan(azimuth):
            described = replace(described, azimuth=azimuth * DEG)
        self._description = describe(plan, imu, table, site, serial)
        return Setup(
            load_imu(imu), laid_out, described, site, method or None, serial, terms, changes, look
        )

    def _kinds(self) -> list[Kind]:
        """List what there is to listen to: no table, no joint states; no skewed gyro, no topic."""
        setup = self._setup
        left_out: set[Kind] = set()
        if setup.table is None:
            left_out |= set(_OF_THE_TABLE)
        if setup.imu.skewed is None:
            left_out.add(Kind.SKEW)
        return [kind for kind in _TOPICS if kind not in left_out]

    def _open_drain(self, kind: Kind, *, reliable: bool) -> Any:
        topic, message = _TOPICS[kind]

        def incompatible(_: Any) -> None:
            self._unreliable.add(kind)

        return ros.open_drain(
            self,
            message,
            topic,
            qos.stream(reliable=reliable),
            event_callbacks=ros.SubscriptionEventCallbacks(incompatible_qos=incompatible),
            # The second subscription of a topic is not to be made reliable by what the first took.
            qos_overriding_options=qos.overridable() if reliable else None,
        )

    def _new_session(self) -> LiveSession:
        """Begin a session, or go on with the one that the journal holds."""
        path = self._journal_path
        if self._sessions:
            path = path.with_name(f'{path.name}_{self._sessions + 1}')
        self._sessions += 1
        topics = {kind: self.resolve_topic_name(_TOPICS[kind][0]) for kind in self._drains}
        journal = Journal(path, self._description, {t: kind for kind, t in topics.items()})
        if self._setup.table is not None:
            journal.add_latched_topic(self._state_topic, _STATE_TYPE)
        self._two_since: float | None = None
        self._shown: Calibration | None = None
        session = LiveSession(self._setup, journal, topics)
        held = sum(intake.count for intake in session.intakes.values())
        resumed = f'The session goes on from {path}, which holds {held} messages.'
        if held:
            self._diagnostics.report('journal', Level.WARN, resumed)
        else:
            self._diagnostics.report('journal', Level.OK, _written(path))
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
        for kind, subscription in self._drains.items():
            payloads = ros.drain(subscription, _MOST)
            if not payloads or self._session.over:
                continue
            if kind is Kind.IMU and self._mixed(payloads):
                self._two_publishers()
            else:
                self._session.take(kind, payloads, now)

    def _on_glance(self) -> None:
        self._session.solve()

    def _on_second(self) -> None:
        self._subscribe_anew()
        self._count_publishers()
        self._states.look(time.monotonic())
        self._session.flush()
        if self._session.rested:
            self._session.solve()
        self._report()
        self._publish_progress()

    def _mixed(self, payloads: list[bytes]) -> bool:
        """Say whether a second device publishes: its samples cannot be told from the first's."""
        if self.count_publishers(self._session.intakes[Kind.IMU].topic) < 2:
            return False
        return self._session.backwards(Kind.IMU, payloads)

    def _count_publishers(self) -> None:
        """Refuse two publishers that stay; one that was killed is seen for ten seconds more."""
        if self.count_publishers(self._session.intakes[Kind.IMU].topic) < 2:
            self._two_since = None
        elif self._two_since is None:
            self._two_since = time.monotonic()
        elif time.monotonic() - self._two_since > _GHOST and not self._session.over:
            self._two_publishers()

    def _two_publishers(self) -> None:
        topic = self._session.intakes[Kind.IMU].topic
        self._session.fail(f'Two publishers on {topic}: stop one of them, then call ~/reset.')
        self._publish()

    def _subscribe_anew(self) -> None:
        """Take what a publisher offers that does not send again what is lost, and say so."""
        for kind in self._unreliable:
            self.destroy_subscription(self._drains[kind])
            self._drains[kind] = self._open_drain(kind, reliable=False)
            topic = self._session.intakes[kind].topic
            self._diagnostics.report(
                'quality of service',
                Level.WARN,
                f'{topic} is published best effort: messages can be lost on the way.',
            )
        self._unreliable.clear()

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
        if session.phase is Phase.FAILED:
            self._result_publisher.publish(
                refusal_message(
                    self._setup.imu, self._setup.plan.name, session.failure, session.frame_id, now
                )
            )
        elif session.calibration is not None and self._is_news(session.calibration):
            self._shown = session.calibration
            final = session.phase is Phase.FINISHED
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
            or self._session.phase is Phase.FINISHED
            or calibration.provenance['samples'] != self._shown.provenance['samples']
        )

    def _publish_progress(self) -> None:
        session = self._session
        review = session.review
        stamp = messages.TimeMsg(
            sec=session.worked_until // 1_000_000_000, nanosec=session.worked_until % 1_000_000_000
        )
        names = [parameter.name for parameter in session.parameters]
        guidance = session.guidance
        message = messages.CalibrationProgress(
            plan=self._setup.plan.name,
            step=session.steps_seen if guidance is None else guidance.holds,
            steps=self._steps,
            # A full disk stops the table: what it would do now could not be kept.
            state=int(Phase.FAILED if session.trouble else session.phase),
            text=self._sentence(),
            parameter_names=names,
            standard_deviations=(
                [math.nan] * len(names) if review is None else review.std.tolist()
            ),
            seconds_left=self._seconds_left,
            repeat_steps=[] if review is None else list(review.unsupported),
            next_attitudes=[] if guidance is None else [c.words for c in guidance.candidates],
            next_gains=[] if guidance is None else [float(c.gain) for c in guidance.candidates],
        )
        message.header.stamp = stamp
        self._progress_publisher.publish(message)

    def _sentence(self) -> str:
        session = self._session
        if session.failure or session.trouble:
            return session.failure or session.trouble
        known = 0 if session.review is None else int((session.review.std > 0).sum())
        imu = session.intakes[Kind.IMU]
        if session.guidance is not None and not session.over:
            return session.guidance.text
        words = {
            Phase.WAITING: f'Waiting for {imu.topic}.',
            Phase.COLLECTING: f'{known} of {len(session.parameters)} parameters are determined.',
            Phase.DETERMINED: f'{known} parameters are determined, and still improve.',
            Phase.FINISHED: f'{known} parameters are determined.',
            Phase.FAILED: session.failure,
        }
        return words[session.phase]

    def _report(self) -> None:
        """Say on /diagnostics how the streams and the calibration are."""
        session = self._session
        self._report_imu()
        level = Level.OK
        if session.phase is Phase.FAILED:
            level = Level.ERROR
        elif session.phase is Phase.FINISHED and session.calibration is not None:
            level = Level.WARN if session.calibration.findings else Level.OK
        figures = {} if session.review is None else _worst(session.review)
        text = self._sentence()
        if session.guidance is not None and not session.over:
            known = int((session.review.std > 0).sum()) if session.review is not None else 0
            total = len(session.parameters)
            text = f'{session.guidance.holds} holds, {known} of {total} parameters are determined.'
        self._diagnostics.report('calibration', level, text, **figures)
        if session.trouble:
            self._diagnostics.report('journal', Level.ERROR, session.trouble)
        elif not session.over:
            self._diagnostics.report('journal', Level.OK, _written(session.journal.path))

    def _report_imu(self) -> None:
        imu, joints = self._session.intakes[Kind.IMU], self._session.intakes.get(Kind.JOINTS)
        figures = {'samples': str(imu.count), 'malformed': str(imu.malformed.count)}
        level, text = Level.OK, f'{imu.topic} comes in.'
        if imu.newest is None:
            level, text = Level.WARN, f'Nothing has come in on {imu.topic} yet.'
        elif joints is None and not self._session.over:
            if time.monotonic() - imu.heard > max(_SILENCE_BY_HAND, self._imu_timeout):
                level, text = Level.ERROR, f'{imu.topic} is silent.'
        elif joints is not None and joints.newest is not None and not self._session.over:
            behind = (joints.newest - imu.newest) * 1e-9
            figures['behind the table'] = f'{behind:.3f} s'
            silent = time.monotonic() - imu.heard
            if behind > self._imu_timeout and silent > self._imu_timeout:
                level, text = Level.ERROR, f'{imu.topic} is silent while the table is not.'
        if imu.malformed.count:
            level, text = Level.ERROR, f'{imu.topic}: {imu.malformed.reason}'
        self._diagnostics.report('stream', level, text, **figures)
        self._report_joint_states()
        self._report_skew()

    def _report_joint_states(self) -> None:
        """Say whether the table, where there is one, is heard."""
        joints = self._session.intakes.get(Kind.JOINTS)
        if joints is None:
            return
        level, text = Level.OK, f'{joints.topic} comes in.'
        if not joints.count:
            level, text = Level.WARN, f'Nothing has come in on {joints.topic} yet.'
        if joints.malformed.count:
            level, text = Level.ERROR, f'{joints.topic}: {joints.malformed.reason}'
        figures = {
            'samples': str(joints.count),
            'of other joints': str(joints.ignored),
            'malformed': str(joints.malformed.count),
        }
        if joints.ignored and not joints.count and self._setup.table is not None:
            names = ', '.join(self._setup.table.names)
            text = f'{joints.topic} names no message with all joints of the table ({names}) yet.'
        self._diagnostics.report('joint states', level, text, **figures)

    def _report_skew(self) -> None:
        """Say whether a skewed gyro, where the IMU's file names one, is heard."""
        skew = self._session.intakes.get(Kind.SKEW)
        if skew is None:
            return
        level, text = Level.OK, f'{skew.topic} comes in.'
        if self._session.without_skew:
            level = Level.WARN
            text = (
                f"Nothing has come on {skew.topic}, though the IMU's file has a skewed_gyro: the "
                'session goes on without it.'
            )
        elif not skew.count:
            level, text = Level.WARN, f'Nothing has come in on {skew.topic} yet.'
        if skew.malformed.count:
            level, text = Level.ERROR, f'{skew.topic}: {skew.malformed.reason}'
        self._diagnostics.report('skewed gyro', level, text, samples=str(skew.count))

    def _save(self) -> str:
        """Write the result; return why not, or nothing."""
        calibration = self._session.calibration
        if calibration is None:
            return self._sentence()
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
        response.message = self._sentence()
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
        self._session.close()
        try:
            self._session = self._new_session()
        except InputError as error:
            response.success, response.message = False, str(error)
        else:
            response.success = True
            response.message = f'A new session is written to {self._session.journal.path}.'
        self._publish_progress()
        return response

    def _on_save(self, _: Any, response: Any) -> Any:
        """Write what is determined so far."""
        problem = self._save()
        response.success, response.message = not problem, problem or f'{self._output} is written.'
        return response


def _stated(value: float) -> float | None:
    """Return a parameter, or None where nobody has stated it."""
    return None if math.isnan(value) else value


def _written(path: Path) -> str:
    return f'The journal is written to {path}.'


def _worst(review: Review) -> dict[str, str]:
    return {
        f'std of {parameter.name}': _deviation(parameter, value)
        for parameter, value in zip(review.parameters, review.std.tolist(), strict=True)
    }


def _deviation(parameter: Parameter, value: float) -> str:
    if math.isnan(value):
        return 'not determined'
    shown = engineering(parameter)
    return f'{value / shown.scale:.3g} {shown.unit}'.strip()


def main() -> int:
    """Run the node; return the exit code."""
    return entry_point(CalibratorNode)


if __name__ == '__main__':
    raise SystemExit(main())
