"""Calibrate from a recording."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..calibration.calibrator import Calibrator, calibrator_of
from ..calibration.hand import HandCalibrator
from ..calibration.results import Result
from ..common.errors import InputError, NotObservable, NotStated
from ..common.files import printable
from ..common.parallel import Progress, by_one_thread, silent
from ..recordings.remote import AnyPath
from ..recordings.text import InOrder
from ..segmentation.stream_facts import Segmented
from ..session.imu import HOTTEST
from ..session.metadata import compensated_already, interpolated_from
from ..session.plan import load_plan
from .assumed import ASSUMED_BY_HAND, ask_for_plan, is_hand_held
from .conforming import specification_of
from .keywords import Session, with_keywords
from .named import Named
from .opening import Opened, open_session
from .session import Stated
from .stamp_clock import clock_findings, refused_by_stamps

_HOLDS_AND_TURNS = 'six_position_by_hand'
_FEWEST_HOLDS, _MOST_HOLDS = 6, 18
"""Of a session that may be of that plan: one for each position, up to three beside each turn. A
judgement."""

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_keywords(Session)
def calibrate(
    bag: Named,
    *,
    progress: Progress = silent,
    **stated: Unpack[Session],
) -> Result:
    """Calibrate from a recording.

    Values that are not stated are taken from the recording if it has them. Names are those of
    supplied files (`imu-calib plans` lists plans), paths those of your own.

    Args:
        bag: Folder of rosbag2, one .mcap or .db3 file, or a URL of one that fsspec reads.
        plan: The plan that was run; 'none' without one.
        imu: Units and noise of the IMU's samples.
        table: The turntable.
        azimuth: Heading of the table's zero against north, counter-clockwise, deg.
        latitude: Of the site, deg, negative in the south.
        latitude_std: Its standard deviation, deg.
        height: Above the ellipsoid, m; determines gravity if that is not stated.
        height_std: Its standard deviation, m.
        gravity: Measured gravity, m/s^2.
        gravity_std: Its standard deviation, m/s^2.
        method: The estimator; None for the joint estimate if it applies, else the plan's own.
        terms: Terms that the joint estimate adds to the 24 parameters, names separated by commas:
            'auto' (those that the session shows, as None), 'none', or terms by name.
        serial: Serial number of the unit.
        imu_topic: Of sensor_msgs/Imu, if there are several.
        joint_topic: Of sensor_msgs/JointState, likewise.
        setpoint_topic: Of imu_calib_msgs/TurntableSetpoint, likewise.
        imu_only: Use only the IMU and the order of the plan.
        progress: Shows the progress; nothing by default.
        **stated: The keywords from `plan` on, all optional.

    Returns:
        The calibration with its session.

    Raises:
        InputError: Something is missing, ambiguous, unreadable, or differs from what is stated.
        NotObservable: The data does not determine all parameters; the text states which and why.
    """
    return calibrated(bag, Stated(**stated), progress)


@by_one_thread
def calibrated(
    bag: str | AnyPath,
    stated: Stated,
    progress: Progress = silent,
    *,
    to_be_judged: bool = False,
) -> Result:
    """Calibrate from a recording, with the statements as one value; as `calibrate`.

    Args:
        bag: As for `calibrate`.
        stated: Known facts of the session.
        progress: Shows the progress.
        to_be_judged: Refuse a unit without a specification before the computation.
    """
    opened = open_session(bag, stated)
    with opened.recording:
        if to_be_judged:
            specification_of(opened.setup.imu)
        return solve(opened, progress)


def solve(opened: Opened, progress: Progress = silent) -> Result:
    """Process an opened recording with the calibrator.

    Raises:
        InputError: Unreadable, or different from what is stated.
        NotObservable: The data does not determine all parameters.
    """
    calibrator = calibrator_of(opened.setup)
    with refused_by_stamps(opened.recording, opened.streams):
        for block in opened.blocks(progress):
            calibrator.feed(block)
    return documented(opened, finished(opened, calibrator))


def finished(opened: Opened, calibrator: Calibrator | HandCalibrator) -> Result:
    """End a session whose recording was fed to a calibrator.

    Raises:
        InputError: It differs from what is stated.
        NotObservable: The data does not determine all parameters.
    """
    lost = opened.losses
    by_hand = ASSUMED_BY_HAND in opened.assumed
    before = calibrator.snapshot()
    with refused_by_stamps(opened.recording, opened.streams):
        try:
            result = calibrator.finish()
        except NotObservable as error:
            if by_hand and isinstance(before, HandCalibrator):
                session = before.segmented()
                _check_that_it_was(opened, session)
                if _fits_holds_and_turns(opened, session):
                    raise NotStated(
                        f'{opened.recording.path} fits plan {_HOLDS_AND_TURNS} (each axis up and '
                        'down, and a turn about each), not free positions: give `plan` '
                        f'{_HOLDS_AND_TURNS}.'
                    ) from None
            raise NotObservable(' '.join([str(error), *lost, *opened.assumed])) from None
        if by_hand:
            _check_that_it_was(opened, result.session)
    return result


def documented(opened: Opened, result: Result) -> Result:
    """Return a result with a reference to its recording."""
    calibration = result.calibration
    rate = interpolated_from(opened.recording.custom_data, opened.streams.imu)
    interpolated = {} if rate is None else {'accel_interpolated_from_hz': rate}
    provenance = {
        'recording': printable(opened.recording.path.name),
        'sha256': opened.recording.sha256(),
        'topics': sorted(opened.streams.kinds()),
        **interpolated,
        **calibration.provenance,
    }
    already = compensated_already(opened.recording.custom_data, opened.streams.imu)
    assumed = (*opened.assumed, *already, *([] if rate is None else [_interpolated(rate)]))
    assumed += tuple(clock_findings(opened.recording, opened.streams, opened.setup.imu.units))
    assumed += tuple(_kelvin(calibration.provenance.get('temperature')))
    findings = (*assumed, *calibration.findings, *opened.losses)
    findings = tuple(map(printable, findings))
    calibration = replace(calibration, provenance=provenance, findings=findings)
    return replace(result, calibration=calibration)


def _kelvin(temperature: object) -> list[str]:
    """Return a sentence on a temperature that no unit has, but that in kelvin is a usual one."""
    if not isinstance(temperature, dict) or not temperature['mean'] > HOTTEST:
        return []
    mean = float(temperature['mean'])
    kelvin = mean - 273.15
    other = f': {kelvin:.1f} if it is in kelvin' if kelvin <= HOTTEST else ''
    return [
        f'The temperature is {mean:.1f} degrees Celsius, hotter than any unit{other}. '
        'sensor_msgs/Temperature is in degrees Celsius; correct the driver before calibrations are '
        'combined by it.'
    ]


def _interpolated(rate: float) -> str:
    return (
        f'The accelerometers were recorded at {rate:.4g} Hz and interpolated at the stamps of the '
        f'gyros: over less than {2 / rate:.2g} s their noise seems smaller than it is. Parameters '
        'and standard deviations use longer times, and are not affected.'
    )


def _fits_holds_and_turns(opened: Opened, session: Segmented) -> bool:
    """Return whether a session without a plan can be solved as the holds and turns of imucal."""
    if not _FEWEST_HOLDS <= len(session.segments) <= _MOST_HOLDS:
        return False
    setup = replace(opened.setup, plan=load_plan(_HOLDS_AND_TURNS))
    calibrator = calibrator_of(setup)
    for block in replace(opened, order=InOrder()).blocks():
        calibrator.feed(block)
    try:
        calibrator.finish()
    except (InputError, NotObservable):
        return False
    return True


def _check_that_it_was(opened: Opened, session: Segmented) -> None:
    """Refuse a session that was assumed to be in the hand and was not."""
    if not is_hand_held(session):
        raise NotStated(ask_for_plan(opened.recording.path))
