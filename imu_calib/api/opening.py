"""A recording with everything that a calibrator needs before its session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from ..common.errors import InputError
from ..common.parallel import Progress, silent
from ..common.stream import Block
from ..estimation.methods import Setup
from ..recordings.remote import AnyPath, located
from ..recordings.rosbag2 import Recording, open_recording
from ..recordings.text import InOrder
from ..session.plan import UNPLANNED
from .assumed import ASSUMED_BY_HAND, ASSUMED_SI, plan_by_hand, taken_as_si
from .session import Stated, mounted_on, plan_of, serial_of, site_of, stated_imu, table_of
from .streams import Streams, streams_of


@dataclass(frozen=True)
class Opened:
    """A recording with everything that is needed to calibrate from it.

    Attributes:
        recording: Open for reading.
        setup: Set-up for the calibrator.
        streams: Its topics.
        assumed: Assumptions about what is not stated, in sentences.
        order: Sorts the samples of the IMU.
    """

    recording: Recording
    setup: Setup
    streams: Streams
    assumed: tuple[str, ...] = ()
    order: InOrder = field(default_factory=InOrder)

    def blocks(self, progress: Progress = silent) -> Iterator[Block]:
        """Read the needed topics, in order, the samples of the IMU in that of their stamps."""
        with progress('reading') as show:
            blocks = self.recording.read(self.streams.kinds(), show)
            yield from self.order.passed(blocks, self.streams.imu)

    @property
    def losses(self) -> tuple[str, ...]:
        """Sentences on what was unreadable or out of order, so far."""
        return (*self.recording.losses, *self.order.sentences)


def recording_path(bag: str | AnyPath) -> AnyPath:
    """Return the path of a recording: a remote one is fetched once for all that take it.

    Raises:
        InputError: It is a URL that cannot be read.
    """
    return located(bag)


def open_session(bag: str | AnyPath, stated: Stated) -> Opened:
    """Open a recording, and find its set-up.

    Args:
        bag: As for `calibrate`, or already located.
        stated: Known facts of the session.

    Raises:
        InputError: Something is missing, ambiguous or unreadable.
    """
    return session_of(recording_at(bag), stated)


def recording_at(bag: str | AnyPath, sha256: str | None = None) -> Recording:
    """Open a recording.

    Args:
        bag: As for `calibrate`, or already located.
        sha256: Of its storage files, if known already.

    Raises:
        InputError: There is none, or it is unreadable.
    """
    if bag == '':
        raise InputError("found '', expected the path of a recording.")
    return open_recording(bag, sha256)


def session_of(recording: Recording, stated: Stated) -> Opened:
    """Find the set-up of a recording's session.

    Raises:
        InputError: Something is missing or ambiguous.
    """
    streams = streams_of(stated, recording)
    described = table_of(stated, recording)
    table = mounted_on(described, stated, recording, streams.imu)
    known = stated_imu(stated, recording, streams.imu)
    imu = taken_as_si(recording, streams.imu) if known is None else known[0]
    plan = plan_of(stated, recording, streams)
    if plan is not None and table is not described:
        # A unit rotated on the fixture passes other attitudes than those of the plan.
        plan = UNPLANNED
    steps = plan_by_hand() if plan is None else plan
    statements = (*([] if known else [ASSUMED_SI]), *([] if plan else [ASSUMED_BY_HAND]))
    if streams.skew is None:
        # The calibrator must not wait for a gyro that the recording lacks.
        imu = replace(imu, skewed=None)
    setup = Setup(
        imu,
        steps,
        table if streams.joints is not None else None,
        site_of(stated, recording, by_hand=steps.by_hand),
        stated.method,
        serial_of(stated, recording, streams.imu),
        stated.sensor_terms,
        stated.changes,
        stated.search_terms,
    )
    return Opened(recording, setup, streams, statements)
