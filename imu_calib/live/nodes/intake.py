"""What sessions take in: topics with the offered quality of service, and their blocks.

The table has its topics; each of several units has its own in its namespace.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ...calibration.calibrator import Calibrator, calibrator_of
from ...calibration.hand import HandCalibrator
from ...common.stream import Block, ImuBlock, JointBlock, SetpointBlock, at
from ...estimation.setup import Setup
from ...model.parameters import skewed_parameters
from ...recordings.cdr import Malformed
from ...recordings.cdr_codec import Kind
from ...segmentation.stamp_faults import INTERRUPTION, interruption
from .. import middleware as ros
from ..middleware import messages
from ..web.board import Board, UnitsBoard
from .qos import latched, overridable, stream

_MOST = 4096
"""Messages taken per call: one second at 4 kHz, so that other callbacks can run."""
_TOPICS = {
    Kind.SETPOINTS: ('turntable/setpoint', messages.TurntableSetpoint),
    Kind.JOINTS: ('turntable/joint_states', messages.JointState),
    Kind.TEMPERATURES: ('imu/temperature', messages.Temperature),
    Kind.IMU: ('imu/pulses', messages.Imu),
    Kind.SKEW: ('imu/skew', messages.Imu),
}
_OF_THE_TABLE = (Kind.SETPOINTS, Kind.JOINTS)


def topics_of_table(setup: Setup) -> dict[Kind, str]:
    """Return the names of the table's topics by content; empty without a table."""
    kinds = _OF_THE_TABLE if setup.table is not None else ()
    return {kind: _TOPICS[kind][0] for kind in kinds}


def topics_of_unit(setup: Setup, namespace: str = '', imu_topic: str = '') -> dict[Kind, str]:
    """Return the names of a unit's topics by content; `imu_topic` if it is not imu/pulses."""
    kinds = [kind for kind in _TOPICS if kind not in _OF_THE_TABLE]
    if setup.imu.skewed is None:
        kinds.remove(Kind.SKEW)
    names = {kind: '/'.join(filter(None, [namespace, _TOPICS[kind][0]])) for kind in kinds}
    return {**names, Kind.IMU: imu_topic or names[Kind.IMU]}


class Subscriptions:
    """Subscriptions that are drained."""

    def __init__(self, node: ros.Node, topics: Mapping[Kind, str]) -> None:
        self._node = node
        self._names = dict(topics)
        #: Their full names.
        self.topics = {kind: node.resolve_topic_name(name) for kind, name in topics.items()}
        self._unreliable: set[Kind] = set()
        self._drains = {kind: self._open(kind, reliable=True) for kind in topics}
        self._two_since: float | None = None

    def received(self) -> Iterator[tuple[Kind, list[bytes]]]:
        """Yield the new serialised messages, grouped by kind."""
        for kind, subscription in self._drains.items():
            payloads = ros.drain(subscription, _MOST)
            if payloads:
                yield kind, payloads

    def begin(self) -> None:
        """Begin a session: earlier publishers do not count."""
        self._two_since = None

    @property
    def two_devices(self) -> bool:
        """Whether the IMU's topic has more than one publisher."""
        return bool(self._node.count_publishers(self.topics[Kind.IMU]) > 1)

    def two_devices_persist(self) -> bool:
        """Return whether there are two for long: a killed one stays listed until its lease ends."""
        if not self.two_devices:
            self._two_since = None
            return False
        now = time.monotonic()
        if self._two_since is None:
            self._two_since = now
        return now - self._two_since > ros.LEASE

    def subscribe_anew(self) -> list[str]:
        """Subscribe best effort to best-effort publishers; return their topics."""
        found = list(self._unreliable)
        for kind in found:
            self._node.destroy_subscription(self._drains[kind])
            self._drains[kind] = self._open(kind, reliable=False)
        self._unreliable.clear()
        return [self.topics[kind] for kind in found]

    def _open(self, kind: Kind, *, reliable: bool) -> Any:
        """Subscribe to a topic; note a publisher that offers best effort alone."""
        topic, message = self._names[kind], _TOPICS[kind][1]

        def incompatible(_: Any) -> None:
            self._unreliable.add(kind)

        return ros.open_drain(
            self._node,
            message,
            topic,
            stream(reliable=reliable),
            event_callbacks=ros.SubscriptionEventCallbacks(incompatible_qos=incompatible),
            # Messages of the first subscription must not make the second one reliable.
            qos_overriding_options=overridable() if reliable else None,
        )


@dataclass(eq=False)
class TopicIntake:
    """One topic of the session."""

    kind: Kind  #: Content of the topic.
    topic: str  #: Full name.
    malformed: Malformed  #: Number of messages that could not be read.
    received_at: float  #: When the newest came, s of the steady clock.
    count: int = 0  #: Number of samples, those of the journal included.
    #: Number of joint states that lack a joint of the table, or setpoints of another plan.
    ignored: int = 0
    oldest: int | None = None  #: Stamp of the first, ns; None before it.
    newest: int | None = None  #: Stamp of the newest, ns; None before the first.

    def note(self, block: Block, *, strange: bool) -> None:
        """Count a block; a foreign one, for instance of other joints, is ignored."""
        if strange:
            self.ignored += len(block)
            return
        self.count += len(block)
        if isinstance(block, SetpointBlock):
            self.newest = block.setpoints[-1].stamp if block.setpoints else self.newest
        elif len(block):
            self.oldest = int(block.stamp[0]) if self.oldest is None else self.oldest
            self.newest = int(block.stamp[-1])


def listen_to_each(node: ros.Node, board: UnitsBoard) -> None:
    """Subscribe to calibration and calibration/progress of every unit."""
    for name, own in board.each.items():
        node.create_subscription(
            messages.CalibrationProgress,
            f'{name}/calibration/progress',
            partial(_on_progress, own),
            latched(),
        )
        node.create_subscription(
            messages.ImuCalibration, f'{name}/calibration', own.on_calibration, latched()
        )


def _on_progress(board: Board, message: Any) -> None:
    board.on_progress(message, time.monotonic())


_SKEW_AWAITED = 10.0
"""Longest time for which IMU samples come without the skewed gyro: s, by stamps and by the
clock."""


class CalibratorFeed:
    """Holds blocks back until the calibrator can be created, then feeds it.

    A skewed gyro is expected if its topic is among the topics.
    """

    def __init__(self, setup: Setup, topics: Mapping[Kind, str]) -> None:
        self._setup = setup
        self._topics = topics
        self._began = time.monotonic()
        self._held: list[Block] = []
        self.without_skew = False  #: Whether the session continues without a skewed gyro.
        # Refuse a plan that the method cannot solve now, before the calibrator is created.
        calibrator_of(setup)
        #: None while the presence of a skewed gyro is unknown.
        self.calibrator: Calibrator | HandCalibrator | None = None
        if setup.imu.skewed is None or Kind.SKEW not in topics:
            self.begin(with_skew=False)

    def add_block(self, block: Block, intakes: Mapping[Kind, TopicIntake]) -> str:
        """Add a block, or hold it back; return as `begin`.

        The received samples decide on the skewed gyro, as in reprocessing.
        """
        if self.calibrator is not None:
            self.calibrator.add_block(block)
            return ''
        self._held.append(block)
        imu = intakes[Kind.IMU]
        if intakes[Kind.SKEW].count:
            return self.begin(with_skew=True)
        if imu.oldest is not None and imu.newest is not None:
            spanned = (imu.newest - imu.oldest) * 1e-9
            if min(spanned, time.monotonic() - self._began) > _SKEW_AWAITED:
                return self.begin(with_skew=False)
        return ''

    def begin(self, *, with_skew: bool) -> str:
        """Create the calibrator, and feed it with the blocks received before.

        Returns:
            Why the session cannot succeed, in sentences; else empty.
        """
        self.without_skew = not with_skew
        imu = self._setup.imu if with_skew else replace(self._setup.imu, skewed=None)
        self.calibrator = calibrator_of(replace(self._setup, imu=imu))
        held, self._held = self._held, []
        for block in held:
            self.calibrator.add_block(block)
        if with_skew or not held or self._setup.method_name != 'skewed':
            return ''
        lost = ', '.join(p.name for p in skewed_parameters(1))
        return (
            f'{self._topics[Kind.IMU]} is received, {self._topics[Kind.SKEW]} is not: {lost} '
            'cannot be determined. Let the driver publish it (imu_node: a device file with the '
            'field skew), and call ~/reset.'
        )


_SET_BACK = 10_000_000_000
"""ns that stamps may begin before a journal's last: less than the shortest step of the plans."""


class FormerSession:
    """The last stamps of a journal, compared with the first ones after it."""

    def __init__(self, journal: Path, intakes: Mapping[Kind, TopicIntake]) -> None:
        self._journal = journal
        self._imu_end = intakes[Kind.IMU].newest
        timed = {k: intakes[k].newest for k in (Kind.IMU, Kind.JOINTS) if k in intakes}
        self._ends = {k: newest for k, newest in timed.items() if newest is not None}

    def adjust_to_journal(self, intake: TopicIntake, blocks: Sequence[Block]) -> str:
        """Return a warning if stamps begin so far before the journal's last that steps are lost.

        Samples older than the preceding ones are dropped until the old time is reached: after a
        restart of a simulation that may be the whole session.
        """
        timed = [b for b in blocks if isinstance(b, ImuBlock | JointBlock) and len(b)]
        last = self._ends.pop(intake.kind, None) if timed else None
        if last is None or (first := int(timed[0].stamp[0])) > last - _SET_BACK:
            return ''
        return (
            f'Stamps on {intake.topic} begin at {at(first)}, {(last - first) * 1e-9:.0f} s before '
            f'the end of the journal {self._journal}: the clock was set back, or a simulation '
            'began anew, and these samples are ignored. Set the clock right or give another '
            'journal, and start again.'
        )

    def gap(self, first: int) -> str:
        """Return how long the session was interrupted, where the stream alone does not show it.

        Args:
            first: Stamp of the first IMU sample after it, ns; later ones are ignored.
        """
        last, self._imu_end = self._imu_end, None
        if last is None or first - last > INTERRUPTION:
            return ''
        return f'{interruption(last, first)}.'
