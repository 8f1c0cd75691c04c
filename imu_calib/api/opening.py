"""A recording, and what goes with it: all that a calibrator must know before its session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from ..bags import AnyPath, Recording, open_recording
from ..calibrator.setup import Setup
from ..errors import InputError
from ..plan import UNPLANNED
from ..stream import Block
from .assumed import SAID_BY_HAND, SAID_SI, plan_by_hand, taken_as_si
from .progress import Progress, silent
from .stated import (
    Stated,
    mounted_on,
    plan_of,
    serial_of,
    site_of,
    stated_imu,
    table_of,
)
from .streams import Streams, streams_of


@dataclass(frozen=True)
class Opened:
    """A recording with all that is needed to calibrate from it.

    Attributes:
        recording: Open for reading.
        setup: What a calibrator must know of it.
        streams: Its topics.
        assumed: What was not stated and is assumed, in sentences.

    """

    recording: Recording
    setup: Setup
    streams: Streams
    assumed: tuple[str, ...] = ()

    def blocks(self, progress: Progress = silent) -> Iterator[Block]:
        """Read the topics that count, in order."""
        with progress('reading') as show:
            for _, block in self.recording.read(self.streams.kinds(), show):
                yield block


def open_session(bag: str | AnyPath, stated: Stated, sha256: str | None = None) -> Opened:
    """Open a recording, and find what goes with it.

    Args:
        bag: As for `calibrate`, or what is located already.
        stated: What is known of the session.
        sha256: Of its storage files, where that is known already.

    Raises:
        InputError: Something is missing, ambiguous or unreadable.

    """
    return session_of(recording_at(bag, sha256), stated)


def recording_at(bag: str | AnyPath, sha256: str | None = None) -> Recording:
    """Open a recording.

    Args:
        bag: As for `calibrate`, or what is located already.
        sha256: Of its storage files, where that is known already.

    Raises:
        InputError: There is none, or it is unreadable.

    """
    if not isinstance(bag, str | AnyPath) or bag == '':
        raise InputError(f'found {bag!r}, expected the path of a recording.')
    return open_recording(bag, sha256)


def session_of(recording: Recording, stated: Stated) -> Opened:
    """Find what goes with the session of a recording.

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
        # Turned on the fixture it goes through other attitudes than those of the plan.
        plan = UNPLANNED
    steps = plan_by_hand() if plan is None else plan
    said = (*([] if known else [SAID_SI]), *([] if plan else [SAID_BY_HAND]))
    if streams.skew is None:
        # The calibrator must not wait for a gyro that the recording does not hold.
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
    return Opened(recording, setup, streams, said)
