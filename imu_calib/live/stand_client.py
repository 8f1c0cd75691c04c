"""A live stand led from a script: start a run, watch it, pause or abort it, take its result."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..common.errors import ImuCalibError, InputError
from .rules import Phase

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from ..calibration.calibration import Calibration

_NODE = 'turntable_node'
_ACTION = f'{_NODE}/run_calibration'
_SPIN = 0.1
"""s that `is_done` waits for a message: a script that polls it in a loop leaves the processor to
others."""


@dataclass(frozen=True)
class RunFeedback:
    """How far a run is."""

    step: int  #: Number of the step, from 1.
    steps: int  #: Number of steps in the plan.
    position: str  #: Name of the position in the plan.
    phase: str  #: What the table does: MOVING, DWELLING, PAUSED and so on.
    text: str  #: The same in a sentence for a person.
    #: Standard deviations reached so far, by the names in `parameters()`, SI units (biases in rad/s
    #: and m/s^2); NaN where one is not determined.
    std: dict[str, float]
    #: s of the stand's time to the end of the plan; a simulated stand may be many times faster.
    seconds_left: float


class Stand:
    """A running stand, led from a script.

    Its nodes run by `imu-calib stand --processes`, or under ROS 2::

        with imu_calib.Stand() as stand:
            stand.start()
            while not stand.is_done():
                print(stand.feedback)
            stand.result().save('calibration.yaml')

    A run that the block leaves unfinished, by an error or Ctrl-C, is aborted: the table stops.

    Args:
        namespace: Of the stand's nodes.
        timeout: Longest wait for an answer of the stand, s.

    Raises:
        InputError: No stand answers.
    """

    def __init__(self, namespace: str = '', timeout: float = 10.0) -> None:
        self.feedback: RunFeedback | None = None
        """The newest of a run that a script started; None before the first, as of a run that the
        stand began by itself."""
        self._timeout = timeout
        self._asked: Any = None
        self._goal: Any = None
        self._present = self._former = b''
        self._end: Any = None
        self._gone_since = 0.0
        # Loaded by who has a stand: the package is imported where no runtime is, too.
        from . import middleware as ros

        self._ros = ros
        if ros.RUNTIME == 'embedded':
            raise InputError(
                'A script reaches a stand over the network, which needs ROS 2 or Cyclone DDS. '
                "Source ROS 2, or run pip install '.[web,dds]' in a clone of imu_calib."
            )
        self._initialised = not ros.ok()
        if self._initialised:
            ros.init(args=[])
        self._node: Any = ros.Node(f'stand_client_{os.getpid()}', namespace=namespace or None)
        kind = self._kind = ros.actions.RunCalibration
        self._client = ros.ActionClient(self._node, kind, _ACTION)
        self._node.create_subscription(
            kind.Impl.FeedbackMessage, f'{_ACTION}/_action/feedback', self._on_feedback, 10
        )
        self._services = {
            name: self._node.create_client(ros.Trigger, f'{_NODE}/{name}')
            for name in ('start', 'pause')
        }
        ready = [self._client.server_is_ready]
        ready += [client.service_is_ready for client in self._services.values()]
        try:
            self._wait(lambda: all(one() for one in ready), 'No stand answers')
        except ImuCalibError as error:
            self.close()
            raise InputError(
                f'{error} Check that it runs, with this ROS_DOMAIN_ID and namespace.'
            ) from None

    def __repr__(self) -> str:
        return f'<Stand: {"no run" if self.feedback is None else self.feedback.text}>'

    def __enter__(self) -> Stand:
        """Return the stand."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Abort what runs, and leave the stand."""
        self.close()

    def start(self, plan: str = '', *, resume: bool = False) -> None:
        """Begin a run; return when the stand has accepted it.

        Where the stand runs its plan already, `pause` comes first, whoever started the run:
        `start(resume=True)` then goes on with it, `start` begins it anew.

        Args:
            plan: Name of the stand's plan, to be sure of it; empty: whatever it is.
            resume: Whether to continue with the interrupted step.

        Raises:
            InputError: The stand refuses, with its reason: it runs its plan already, at a step that
                the text names, or runs another plan.
            ImuCalibError: A run of this script or of another client is in progress.
        """
        if self._in_progress and not self._is_paused:
            raise ImuCalibError(
                'The run that this script started has not ended: pause or abort it first.'
            )
        self._former = self._present
        self.feedback, self._end, self._gone_since = None, None, time.monotonic()
        self._asked = self._client.send_goal_async(self._kind.Goal(plan=plan, resume=resume))
        self._await_acceptance()
        # A refusal with a reason is the result of an accepted goal without any feedback.
        self._wait(lambda: self._end.done() or self.feedback is not None, 'The run does not begin')
        if self.feedback is None:
            refused, self._end = self._end.result().result.message, None
            raise InputError(refused)

    def _await_acceptance(self) -> None:
        goal = self._answer(self._asked, 'The goal')
        self._asked = None
        if not goal.accepted:
            raise ImuCalibError('The stand runs already, for someone else. Wait, or stop it there.')
        self._goal, self._end = goal, goal.get_result_async()

    def is_done(self) -> bool:
        """Tell whether the run has ended; waits a moment for messages.

        Raises:
            ImuCalibError: No run was started, or the stand has gone.
        """
        if self._end is None:
            raise ImuCalibError('No run was started.')
        self._spin()
        if self._end.done():
            return True
        now = time.monotonic()
        if self._client.server_is_ready():
            self._gone_since = now
        elif now > self._gone_since + self._timeout:
            raise ImuCalibError(f'{_NODE} has gone. Look at the stand: it holds the table.')
        return False

    def pause(self) -> str:
        """Stop the table, and keep the run; return the stand's sentence when `feedback` has it.

        Raises:
            ImuCalibError: The stand refuses, with its reason.
        """
        answer = self._call('pause')
        self._wait(lambda: self._is_paused or not self._in_progress, 'No feedback of the pause')
        return answer

    def resume(self) -> str:
        """Go on with the interrupted step after a pause; return the stand's sentence as it does.

        A fault ends the run: `start(resume=True)` goes on after it.

        Raises:
            ImuCalibError: The run has ended, or the stand refuses, with its reason.
        """
        if not self._in_progress:
            # Otherwise the plan would run without a client that stops it.
            raise ImuCalibError('No run is in progress: start(resume=True) continues one.')
        answer = self._call('start')
        self._wait(lambda: not (self._is_paused and self._in_progress), 'The run does not go on')
        return answer

    def abort(self) -> str:
        """Stop the table, and end the run; return the stand's sentence when the table stands.

        Raises:
            ImuCalibError: No run was started, or the stand does not answer.
        """
        if self._end is None:
            raise ImuCalibError('No run was started.')
        self._goal.cancel_goal_async()
        self._wait(self._end.done, 'The run does not end')
        return str(self._end.result().result.message)

    def result(self) -> Calibration | dict[str, Calibration]:
        """Return the calibration of a run that has ended; of several units by serial number.

        Raises:
            ImuCalibError: The run has not ended, or ended otherwise; the text says how.
        """
        from .nodes.convert import calibration_of

        if self._end is None or not self._end.done():
            raise ImuCalibError('The run has not ended.')
        answer = self._end.result()
        if answer.status != self._ros.GoalStatus.SUCCEEDED:
            raise ImuCalibError(answer.result.message)
        several = answer.result.calibrations
        if several:
            return {one.serial_number: calibration_of(one) for one in several}
        return calibration_of(answer.result.calibration)

    def close(self) -> None:
        """Abort a run that is in progress, and leave the stand."""
        if self._node is None:
            return
        try:
            if self._asked is not None:
                # Interrupted before the answer: what was asked for may run.
                with suppress(ImuCalibError):
                    self._await_acceptance()
            if self._in_progress:
                self.abort()
        finally:
            self._node.destroy_node()
            self._node = None
            if self._initialised:
                self._ros.try_shutdown()

    @property
    def _in_progress(self) -> bool:
        """Whether a run of this script has not ended."""
        return self._end is not None and not self._end.done()

    @property
    def _is_paused(self) -> bool:
        return self.feedback is not None and self.feedback.phase == Phase.PAUSED.name

    def _on_feedback(self, message: Any) -> None:
        identity = bytes(message.goal_id.uuid)
        if identity == self._former:
            # Still in flight as the next run begins.
            return
        self._present = identity
        one = message.feedback
        self.feedback = RunFeedback(
            one.step + 1,
            one.steps,
            one.position_id,
            Phase(one.phase).name,
            one.text,
            dict(zip(one.parameter_names, one.standard_deviations, strict=True)),
            one.seconds_left,
        )

    def _call(self, name: str) -> str:
        answer = self._answer(self._services[name].call_async(self._ros.Trigger.Request()), name)
        if not answer.success:
            raise ImuCalibError(answer.message)
        return str(answer.message)

    def _answer(self, future: Any, what: str) -> Any:
        self._wait(future.done, f'{what} is not answered')
        return future.result()

    def _wait(self, done: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + self._timeout
        while not done():
            if time.monotonic() > end:
                raise ImuCalibError(f'{otherwise} within {self._timeout:g} s.')
            self._spin()

    def _spin(self) -> None:
        if self._node is None:
            raise ImuCalibError('This Stand is closed: make another one.')
        self._ros.spin_once(self._node, timeout_sec=_SPIN)
