"""Convert values of the core to messages and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...calibration.calibration import Calibration
from ...calibration.provenance import check_plausible
from ...common.errors import InputError
from ...common.stream import Units
from ...model.parameters import PARAMETER_NAMES, Parameter
from ...model.sensors import SensorModel, Skewed, Triad, by_name, parameters_of, terms_of
from ...model.session_terms import Changes, Course, change
from ...model.terms import G_SENSITIVITIES, G_SENSITIVITY
from ...session.imu import ImuSpec, StampingClock, TriadSpec, check_clock
from ..middleware import Time, messages
from ..rules import SequencerState

_UNITS = {
    Units.PULSES: messages.ImuCalibration.UNIT_PULSES,
    Units.COUNTS: messages.ImuCalibration.UNIT_COUNTS,
    Units.SI: messages.ImuCalibration.UNIT_SI,
    Units.INCREMENTS: messages.ImuCalibration.UNIT_INCREMENTS,
    Units.RATES: messages.ImuCalibration.UNIT_RATES,
}


def calibration_message(calibration: Calibration, status: int, frame_id: str, stamp: Any) -> Any:
    """Return imu_calib_msgs/ImuCalibration: VALID, INCOMPLETE or PROVISIONAL.

    Its text has a finding in each line.
    """
    findings = list(calibration.findings)
    if status == messages.ImuCalibration.INCOMPLETE:
        missing = ', '.join(_missing(calibration))
        findings.insert(0, f'Positions of the plan are missing: {missing}.')
    text = '\n'.join(findings)
    message = _empty(calibration.imu, status, text, frame_id, stamp)
    message.serial_number = calibration.serial_number
    where = calibration.provenance
    message.plan = str(where['plan'] or '')
    message.method = str(where['method'])
    message.gravity = float(where['gravity'])
    message.latitude = math.radians(float(where['latitude_deg']))
    # Parameters that were not estimated are NaN.
    known = np.isfinite(calibration.std[: len(PARAMETER_NAMES)])
    vector = np.where(known, calibration.model.vector(), math.nan)
    for name, value in zip(PARAMETER_NAMES, vector.tolist(), strict=True):
        setattr(message, name.lower(), value)
    message.parameter_names = [parameter.name for parameter in calibration.parameters]
    message.standard_deviations = calibration.std.tolist()
    message.covariance = calibration.covariance.ravel().tolist()
    sensitivity = calibration.model.g_sensitivity
    message.has_g_sensitivity = set(G_SENSITIVITIES) <= set(calibration.parameters)
    message.g_sensitivity = sensitivity.ravel().tolist()
    further = _in_no_field(calibration.parameters)
    message.term_parameters = [parameter.name for parameter in further]
    message.term_values = calibration.model.values(further).tolist()
    message.term_units = [parameter.unit.si for parameter in further]
    skewed = calibration.model.skewed
    if skewed is not None:
        message.has_skew = True
        message.skew_response = skewed.response[0].tolist()
        message.skew_bias = float(skewed.bias[0])
    message.segments = int(where['segments']) + int(where['turns'])
    message.samples = int(where['samples'])
    residuals = np.array(where['residual_rms'], dtype=float)
    message.residual_rms_gyro, message.residual_rms_accel = (
        float(np.sqrt(np.mean(part**2))) for part in (residuals[:3], residuals[3:])
    )
    message.condition_number = float(where['condition_number'])
    message.random_walk = [float(walk) for walk in calibration.sensor_walk]
    if where['highest_rate'] is not None:
        message.highest_rate = float(where['highest_rate'])
    if where['temperature'] is not None:
        message.reference_temperature = float(where['temperature']['mean'])
        message.lowest_temperature = float(where['temperature']['lowest'])
        message.highest_temperature = float(where['temperature']['highest'])
    _add_changes(message, calibration.changes)
    if calibration.clock is not None:
        message.clock, message.clock_against = calibration.clock.name, calibration.clock.against
        message.clock_faster = float(calibration.clock.faster)
        message.clock_faster_std = float(calibration.clock.std)
    return message


def calibration_of(message: Any) -> Calibration:
    """Return the content of imu_calib_msgs/ImuCalibration that compensation needs.

    Raises:
        InputError: The message is REFUSED, inconsistent, or impossible for a strapdown IMU.
    """
    if message.status == messages.ImuCalibration.REFUSED:
        raise InputError(f'The calibration is refused: {message.status_text}')
    units = {value: unit for unit, value in _UNITS.items()}.get(message.units)
    skewed = None
    if message.has_skew:
        response = np.array([message.skew_response], dtype=float)
        skewed = Skewed(response, np.array([message.skew_bias]))
    parameters = _parameters(message)
    names, size = [p.name for p in parameters], len(parameters)
    covariance = np.array(message.covariance, dtype=float)
    if units is None or list(message.parameter_names) != names or covariance.size != size**2:
        raise InputError(
            f'{_name(message)} cannot be used: its units ({message.units}), parameters '
            f'({len(message.parameter_names)}) and covariance ({covariance.size} numbers) do not '
            f'match a model with {size} parameters.'
        )
    vector = np.array([getattr(message, name.lower()) for name in PARAMETER_NAMES])
    if not np.isfinite(vector[:12]).all():
        raise InputError(f'{_name(message)} cannot be used: no gyro parameters.')
    accel = Triad.from_vector(vector[12:]) if np.isfinite(vector[12:]).all() else Triad()
    sensitivity = np.array(message.g_sensitivity, dtype=float).reshape(3, 3)
    spec = ImuSpec(
        message.imu_id,
        units,
        None,
        TriadSpec(float(message.gyro_scale_factor), range=_limit(message.gyro_range)),
        TriadSpec(float(message.accel_scale_factor), range=_limit(message.accel_range)),
    )
    model = SensorModel(Triad.from_vector(vector[:12]), accel, sensitivity, skewed)
    calibration = Calibration(
        spec,
        model.with_values(_in_no_field(parameters), np.array(message.term_values, dtype=float)),
        covariance.reshape(size, size),
        provenance=_provenance(message),
        serial_number=message.serial_number,
        parameters=parameters,
        changes=_changes(message),
        clock=_clock(message),
    )
    check_plausible(calibration, _name(message))
    return calibration


def _name(message: Any) -> str:
    return f'The calibration of {message.imu_id or "no name"}'


def _in_no_field(parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    """Return the parameters for which the message has no named fields."""
    terms = [term for term in terms_of(parameters) if term is not G_SENSITIVITY]
    return tuple(p for term in terms for p in term.parameters)


def _parameters(message: Any) -> tuple[Parameter, ...]:
    """Return the parameters of a calibration that the message lists."""
    try:
        further = by_name(message.term_parameters)
    except KeyError as error:
        raise InputError(
            f'{_name(message)} cannot be used: this version does not know its parameter '
            f'{error.args[0]!r}.'
        ) from None
    terms = (*terms_of(further), *([G_SENSITIVITY] if message.has_g_sensitivity else []))
    parameters = parameters_of(terms, skewed=1 if message.has_skew else 0)
    units = [parameter.unit.si for parameter in further]
    if (
        further != _in_no_field(parameters)
        or list(message.term_units) != units
        or len(message.term_values) != len(further)
    ):
        raise InputError(
            f'{_name(message)} cannot be used: found the terms '
            f'{", ".join(message.term_parameters)} in {", ".join(message.term_units)} with '
            f'{len(message.term_values)} values, expected '
            f'{", ".join(p.name for p in _in_no_field(parameters))} in {", ".join(units)}.'
        )
    return parameters


def final_status(calibration: Calibration) -> int:
    """Return the status of a final result: INCOMPLETE if positions are missing."""
    kinds = messages.ImuCalibration
    return int(kinds.INCOMPLETE if _missing(calibration) else kinds.VALID)


def _missing(calibration: Calibration) -> list[str]:
    return [str(name) for name in calibration.provenance.get('missing_positions', ())]


def _provenance(message: Any) -> dict[str, Any]:
    """Return the entries that compensation uses, named as in the file."""
    temperature = {
        'mean': float(message.reference_temperature),
        'lowest': float(message.lowest_temperature),
        'highest': float(message.highest_temperature),
    }
    known = all(math.isfinite(value) for value in temperature.values())
    return {
        'method': message.method,
        'plan': message.plan or None,
        'random_walk': [float(value) for value in message.random_walk],
        'highest_rate': _known(message.highest_rate),
        'temperature': temperature if known else None,
    }


def _add_changes(message: Any, changes: Changes | None) -> None:
    """Write how parameters changed during the session."""
    if changes is None:
        return
    message.change_terms = [one.course.value for one in changes.changes]
    message.change_of = [one.name for one in changes.changes]
    message.change_values = changes.values.tolist()
    message.change_units = [one.si for one in changes.changes]
    message.change_covariance = changes.covariance.ravel().tolist()
    message.change_cross_covariance = changes.cross.ravel().tolist()
    message.change_time_constant = float(changes.time_constant)
    message.change_instant = float(changes.instant)


def _changes(message: Any) -> Changes | None:
    """Return how parameters changed during the session; None if the message does not state it."""
    if not message.change_terms:
        return None
    name = _name(message)
    courses = {course.value: course for course in Course}
    found = []
    for term, of in zip(message.change_terms, message.change_of, strict=False):
        if term not in courses:
            raise InputError(
                f'{name}: change_terms: found {term!r}, expected {", ".join(courses)}.'
            )
        found.append(change(courses[term], of))
    count, size = len(message.change_terms), len(message.parameter_names)
    units = [one.si for one in found]
    sizes = [
        len(numbers)
        for numbers in (
            message.change_of,
            message.change_values,
            message.change_covariance,
            message.change_cross_covariance,
        )
    ]
    if list(message.change_units) != units or sizes != [count, count, count**2, size * count]:
        raise InputError(
            f'{name}: changes: found {sizes} numbers in {", ".join(message.change_units)}, '
            f'expected {[count, count, count**2, size * count]} in {", ".join(units)}.'
        )
    return Changes(
        tuple(found),
        np.array(message.change_values, dtype=float),
        np.array(message.change_covariance, dtype=float).reshape(count, count),
        np.array(message.change_cross_covariance, dtype=float).reshape(size, count),
        float(message.change_time_constant),
        float(message.change_instant),
    )


def _clock(message: Any) -> StampingClock | None:
    """Return the stamping clock that a message states; None without."""
    if not message.clock_against:
        return None
    clock = StampingClock(
        message.clock,
        message.clock_against,
        float(message.clock_faster),
        float(message.clock_faster_std),
    )
    check_clock(clock, f'{_name(message)}: clock')
    return clock


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _limit(value: float) -> float:
    """Return a range; a publisher without one may leave zero."""
    return float(value) if value > 0 else math.inf


def refusal_message(imu: ImuSpec, plan: str, text: str, frame_id: str, stamp: Any) -> Any:
    """Return imu_calib_msgs/ImuCalibration with the reason and without numbers."""
    message = _empty(imu, messages.ImuCalibration.REFUSED, text, frame_id, stamp)
    message.plan = plan
    for name in PARAMETER_NAMES:
        setattr(message, name.lower(), math.nan)
    return message


def _empty(imu: ImuSpec, status: int, text: str, frame_id: str, stamp: Any) -> Any:
    """Return a message with a status, and NaN for all that it does not know."""
    message = messages.ImuCalibration()
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    message.imu_id = imu.id
    message.status = status
    message.status_text = text
    message.units = _UNITS[imu.units]
    message.gyro_scale_factor = float(imu.gyro.scale_factor)
    message.accel_scale_factor = float(imu.accel.scale_factor)
    message.gyro_range = float(imu.gyro.range)
    message.accel_range = float(imu.accel.range)
    message.random_walk = [math.nan] * 6
    for name in ('reference', 'lowest', 'highest'):
        setattr(message, f'{name}_temperature', math.nan)
    message.highest_rate = message.change_time_constant = message.change_instant = math.nan
    return message


def state_message(state: SequencerState, joints: tuple[str, ...], stamp: int) -> Any:
    """Return imu_calib_msgs/TurntableState; the stamp is in ns."""
    message = messages.TurntableState(
        plan=state.plan,
        step=state.step,
        steps=state.steps,
        position_id=state.position,
        phase=int(state.phase),
        reason=state.reason,
        joint_names=list(joints),
        positions=list(state.angles),
        rates=list(state.rates),
        turns_done=float(state.turns_done),
        seconds_left=float(state.seconds_left),
    )
    message.header.stamp = Time(nanoseconds=stamp).to_msg()
    return message
