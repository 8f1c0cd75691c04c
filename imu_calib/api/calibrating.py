"""A recording in, a calibration out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from ..bags import Recording, open_recording
from ..calibrator import HandCalibrator, Result, Setup, calibrator_of
from ..errors import InputError, NotObservable, NotStated
from ..imu import ImuSpec
from ..plan import Plan
from ..segmentation.segmented import Segmented
from ..stream import Block
from ..turntable import Table
from .assumed import (
    SAID_BY_HAND,
    SAID_SI,
    ask_for_plan,
    plan_by_hand,
    taken_as_si,
    was_in_the_hand,
)
from .conforming import specification_of
from .named import Named
from .progress import Progress, silent
from .stated import (
    Stated,
    Streams,
    plan_of,
    serial_of,
    site_of,
    stated_imu,
    streams_of,
    table_of,
)


@dataclass(frozen=True)
class Opened:
    """A recording with all that is needed to calibrate from it.

    Attributes:
        recording: Open for reading.
        setup: What a calibrator must know of it.
        streams: Its topics.
        assumed: What nobody said and is taken for granted, in sentences.

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


def calibrate(
    bag: Named,
    *,
    plan: Plan | Named | None = None,
    imu: ImuSpec | Named | None = None,
    table: Table | Named | None = None,
    azimuth: float | None = None,
    latitude: float | None = None,
    latitude_std: float | None = None,
    height: float | None = None,
    height_std: float | None = None,
    gravity: float | None = None,
    gravity_std: float | None = None,
    method: str | None = None,
    terms: str | None = None,
    serial: str | None = None,
    imu_topic: str | None = None,
    joint_topic: str | None = None,
    setpoint_topic: str | None = None,
    imu_only: bool = False,
    progress: Progress = silent,
) -> Result:
    """Calibrate from a recording.

    What is not stated is taken from the recording, as far as it says; names are those of files that
    ship (`imu-calib plans` lists plans), paths those of your own.

    Args:
        bag: Folder of rosbag2, or one .mcap or .db3 file.
        plan: That was run; 'none' where none was.
        imu: What the IMU's numbers mean.
        table: The turntable.
        azimuth: Heading of the table's zero against north, counter-clockwise, deg.
        latitude: Of the site, deg, negative in the south.
        latitude_std: Its standard deviation, deg.
        height: Above the ellipsoid, m; says what gravity is where none is stated.
        height_std: Its standard deviation, m.
        gravity: As measured, m/s^2.
        gravity_std: Its standard deviation, m/s^2.
        method: The estimator; None for the joint estimate where it applies, else the plan's own.
        terms: What the joint estimate adds to the 24 parameters, names with commas between: 'auto'
            (those that the session shows, as None), 'none', or terms by name.
        serial: Serial number of the unit.
        imu_topic: Of sensor_msgs/Imu, where there are several.
        joint_topic: Of sensor_msgs/JointState, likewise.
        setpoint_topic: Of imu_calib_msgs/TurntableSetpoint, likewise.
        imu_only: Use the IMU and the order of the plan alone.
        progress: Shows how far it is; nothing by default.

    Returns:
        The calibration with all that led to it.

    Raises:
        InputError: Something is missing, ambiguous, unreadable, or not what it is said to be.
        NotObservable: The data cannot give all parameters; says which and why.

    """
    stated = Stated(
        plan=plan,
        imu=imu,
        table=table,
        azimuth=azimuth,
        imu_topic=imu_topic,
        joint_topic=joint_topic,
        setpoint_topic=setpoint_topic,
        imu_only=imu_only,
        latitude=latitude,
        latitude_std=latitude_std,
        height=height,
        height_std=height_std,
        gravity=gravity,
        gravity_std=gravity_std,
        method=method,
        terms=terms,
        serial=serial,
    )
    return calibrated(bag, stated, progress)


def calibrated(
    bag: Named, stated: Stated, progress: Progress = silent, *, to_be_judged: bool = False
) -> Result:
    """Calibrate from a recording, with what is stated of it as one value; as `calibrate`.

    Args:
        bag: As for `calibrate`.
        stated: What is known of the session.
        progress: Shows how far it is.
        to_be_judged: Refuse a unit without a specification before anything is computed.

    """
    opened = open_session(bag, stated)
    with opened.recording:
        if to_be_judged:
            specification_of(opened.setup.imu)
        return solve(opened, progress)


def open_session(bag: Named, stated: Stated) -> Opened:
    """Open a recording, and find what goes with it.

    Raises:
        InputError: Something is missing, ambiguous or unreadable.

    """
    if not isinstance(bag, str | Path) or bag == '':
        raise InputError(f'found {bag!r}, expected the path of a recording.')
    recording = open_recording(Path(bag))
    streams = streams_of(stated, recording)
    table = table_of(stated, recording)
    known = stated_imu(stated, recording, streams.imu)
    imu = taken_as_si(recording, streams.imu) if known is None else known[0]
    plan = plan_of(stated, recording, streams)
    steps = plan_by_hand() if plan is None else plan
    said = (*([] if known else [SAID_SI]), *([] if plan else [SAID_BY_HAND]))
    if streams.skew is None:
        # Nobody is to wait for a gyro that the recording does not hold.
        imu = replace(imu, skewed=None)
    setup = Setup(
        imu,
        steps,
        table if streams.joints is not None else None,
        site_of(stated, recording, by_hand=steps.by_hand),
        stated.method,
        serial_of(stated, recording),
        stated.sensor_terms,
        stated.changes,
        stated.search_terms,
    )
    return Opened(recording, setup, streams, said)


def solve(opened: Opened, progress: Progress = silent) -> Result:
    """Run an opened recording through the calibrator.

    Raises:
        InputError: Unreadable, or not what it is said to be.
        NotObservable: The data cannot give all parameters.

    """
    calibrator = calibrator_of(opened.setup)
    for block in opened.blocks(progress):
        calibrator.feed(block)
    lost = tuple(opened.recording.losses)
    by_hand = SAID_BY_HAND in opened.assumed
    before = calibrator.snapshot()
    try:
        result = calibrator.finish()
    except NotObservable as error:
        if by_hand and isinstance(before, HandCalibrator):
            _check_that_it_was(opened, before.segmented())
        raise NotObservable(' '.join([str(error), *lost, *opened.assumed])) from None
    if by_hand:
        _check_that_it_was(opened, result.session)
    calibration = result.calibration
    provenance = {
        'recording': opened.recording.path.name,
        'sha256': opened.recording.sha256(),
        'topics': sorted(opened.streams.kinds()),
        **calibration.provenance,
    }
    findings = (*opened.assumed, *calibration.findings, *lost)
    calibration = replace(calibration, provenance=provenance, findings=findings)
    return replace(result, calibration=calibration)


def _check_that_it_was(opened: Opened, session: Segmented) -> None:
    """Refuse to take a session for one in the hand that was none.

    Raises:
        NotStated: Nobody holds a unit still for so long.

    """
    if not was_in_the_hand(session):
        raise NotStated(ask_for_plan(opened.recording.path))
