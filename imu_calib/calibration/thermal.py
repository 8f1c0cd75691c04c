"""Combine calibrations of one unit at several temperatures: parameters by temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from ..common.arguments import checked
from ..common.config import Section, dump, load
from ..common.errors import InputError
from ..common.files import user_path, write_whole
from ..common.stream import Floats
from ..common.units import counted
from ..session.imu import UNNAMED, ImuSpec, StampingClock
from .agreement import gravity_deviation, without_gravity
from .calibration import CHECKSUM, Calibration, calibration_section, with_checksum

_FORMAT = 1  #: Version of the format of combined calibrations; others are refused.
_APART = 0.5  #: K: closer ones count as one temperature: a slope between them would be noise.
_MARGIN = 5.0
"""K beyond the range of a calibration at one temperature in which it is valid; a choice."""
MOST = 4  #: Highest order of polynomials: higher ones oscillate between the points (Runge).
_WRITTEN = 1e-9
"""Relative tolerance for numbers that were written as text. A judgement, between the rounding of a
double and any difference that matters."""


@dataclass(frozen=True, eq=False)
class ThermalCalibration:
    """Calibrations of a unit at several temperatures.

    Every parameter is interpolated by itself: p(T) = sum of c_i(T) p_i, with c the weights of
    straight lines between neighbours, or of the best-fitting polynomial. The sessions are
    independent, so the covariance is the sum of c_i(T)^2 P_i; the error of gravity alone is common
    to all and does not average down. Where a neighbour shows curvature of the parameters,
    p'' (T - a) (b - T) / 2 is added as uncertainty of the straight lines (the remainder of linear
    interpolation, e.g. Abramowitz and Stegun, 25.2.1). Beyond the ends the nearest calibration is
    used. A single session with coefficients of temperature (`--terms thermal`) is one, too: its
    parameters and their covariance are those of p + c (T - T_0) within the temperatures of the
    session.
    """

    #: At least two of one unit, coldest first, or one with coefficients.
    calibrations: tuple[Calibration, ...]
    order: int | None = None  #: Of the polynomial; None for straight lines.

    def __repr__(self) -> str:
        points = ', '.join(f'{one:.1f}' for one in self.temperatures)
        return f'<ThermalCalibration of {self.calibrations[0].unit_name}: at {points} degC>'

    @property
    def temperatures(self) -> Floats:
        """(k,) mean temperatures of the sessions, degrees Celsius."""
        return np.array([c.provenance['temperature']['mean'] for c in self.calibrations])

    def weights(self, celsius: float) -> Floats:
        """Return the (k,) weights of the calibrations at a temperature."""
        points = self.temperatures
        held = float(np.clip(celsius, points[0], points[-1]))
        if self.order is None:
            lines = np.eye(len(points))
            return np.array([np.interp(held, points, line) for line in lines])
        middle, half = (points[0] + points[-1]) / 2, (points[-1] - points[0]) / 2
        design = np.vander((points - middle) / half, self.order + 1)
        at = np.vander([(held - middle) / half], self.order + 1)[0]
        return np.asarray(at @ np.linalg.pinv(design))

    def at(self, celsius: float) -> Calibration:
        """Return the calibration at a temperature; beyond the ends, that of the end."""
        if len(self.calibrations) == 1:
            return _by_coefficients(self.calibrations[0], celsius)
        weights = self.weights(celsius)
        values = np.array([c.values for c in self.calibrations])
        square = np.array([without_gravity(c) for c in self.calibrations])
        covariance = np.einsum('k,kij->ij', weights**2, square)
        common = weights @ np.array([gravity_deviation(c) for c in self.calibrations])
        covariance = covariance + np.outer(common, common)
        bend = self._bend(celsius, values)
        covariance = covariance + np.outer(bend, bend)
        walks = np.nan_to_num([c.sensor_walk for c in self.calibrations])
        walk = np.sqrt((walks**2).mean(axis=0)).tolist()
        rates = [c.provenance.get('highest_rate') for c in self.calibrations]
        first = self.calibrations[0]
        provenance = {
            **first.provenance,
            'random_walk': walk,
            'sensor_random_walk': walk,
            'highest_rate': min((r for r in rates if r is not None), default=None),
            'temperature': {'mean': celsius, 'lowest': celsius, 'highest': celsius},
        }
        return replace(
            first,
            model=first.model.with_values(first.parameters, weights @ values),
            covariance=covariance,
            budget=None,
            residuals=(),
            provenance=provenance,
            changes=None,
            clock=self._clock(weights),
        )

    def _clock(self, weights: Floats) -> StampingClock | None:
        """Return the stamping clock; a session without one refers to the stamps' own clock."""
        known = [(w, c.clock) for w, c in zip(weights, self.calibrations, strict=True) if c.clock]
        if not known:
            return None
        faster = sum(float(w) * clock.faster for w, clock in known)
        std = float(np.sqrt(sum((float(w) * clock.std) ** 2 for w, clock in known)))
        return replace(known[0][1], faster=faster, std=std)

    def _bend(self, celsius: float, values: Floats) -> Floats:
        """Return the possible error of straight lines for each parameter, (p,)."""
        points = self.temperatures
        place = int(np.searchsorted(points, celsius))
        if self.order is not None or len(points) < 3 or not 0 < place < len(points):
            return np.zeros(values.shape[1])
        rise = np.diff(values, axis=0) / np.diff(points)[:, None]
        # Second divided differences, one at each inner point; p'' is twice that.
        second = np.diff(rise, axis=0) / (points[2:] - points[:-2])[:, None]
        near = [k for k in (place - 2, place - 1) if 0 <= k < len(second)]
        largest = second[near][np.abs(second[near]).argmax(axis=0), np.arange(values.shape[1])]
        a, b = points[place - 1], points[place]
        return np.asarray(largest * (celsius - a) * (b - celsius))

    def to_yaml(self) -> str:
        """Return the file's text: the calibrations in sequence, each as in its own file."""
        documents = [load(c.to_yaml()) for c in self.calibrations]
        for document in documents:
            del document[CHECKSUM]
        first = self.calibrations[0]
        head: dict[str, Any] = {
            'format': _FORMAT,
            'imu': first.imu.id,
            'serial_number': first.serial_number,
        }
        head['order'] = 'lines' if self.order is None else self.order
        text = (
            '# Calibrations of one IMU at several temperatures, coldest first, SI units.\n'
            '# In between each parameter lies on straight lines, or on a polynomial.\n'
        )
        text += dump(head)
        text += dump({'calibrations': documents}, default_flow_style=None, width=200)
        return with_checksum(text)

    @checked
    def save(self, path: str | Path) -> None:
        """Write the file whole or not at all."""
        write_whole(user_path(path), self.to_yaml())


AnyCalibration: TypeAlias = Calibration | ThermalCalibration


def combine(
    calibrations: Sequence[Calibration],
    names: Sequence[str],
    order: int | None = None,
    where: str = '',
) -> ThermalCalibration:
    """Combine calibrations of one unit at several temperatures.

    Args:
        calibrations: At least two, in any order.
        names: Their files, for messages.
        order: Of a polynomial; None for straight lines between neighbours.
        where: Prefix of messages about all of them, if one file holds them.
    """
    if len(calibrations) < 2:
        raise InputError(
            f'{where}Found {counted(len(calibrations), "calibration")}, expected two or more to '
            'combine.'
        )
    for calibration, name in zip(calibrations, names, strict=True):
        _check_temperature(calibration, name)
        check_same_unit(calibration, name, calibrations[0], names[0])
        found, expected = _known(calibration), _known(calibrations[0])
        if found != expected:
            raise InputError(
                f'{name}: covariance: parameters: found {found}, expected {expected} as in '
                f'{names[0]}.'
            )
    if order is not None and not 1 <= order <= min(MOST, len(calibrations) - 1):
        raise InputError(
            f'{where}A polynomial of order {order}: found {len(calibrations)} temperatures, '
            f'expected an order from 1 to {min(MOST, len(calibrations) - 1)}.'
        )
    ordered = sorted(calibrations, key=lambda c: float(c.provenance['temperature']['mean']))
    result = ThermalCalibration(tuple(ordered), order)
    points = result.temperatures
    close = np.flatnonzero(np.diff(points) < _APART)
    if len(close):
        k = int(close[0])
        raise InputError(
            f'{where}Two calibrations at {points[k]:.2f} and {points[k + 1]:.2f} degC: expected at '
            f'least {_APART:g} K between them.'
        )
    return result


def temperature_range(calibration: AnyCalibration) -> tuple[float, float]:
    """Return the temperatures in which a calibration is valid, degrees Celsius.

    A single one is taken as valid 5 K beyond the range of its session, a combined one from the
    lowest to the highest temperature of its sessions, one without a temperature everywhere.
    """
    if isinstance(calibration, ThermalCalibration):
        seen = [c.provenance['temperature'] for c in calibration.calibrations]
        return min(float(s['lowest']) for s in seen), max(float(s['highest']) for s in seen)
    seen_once = calibration.provenance.get('temperature')
    if seen_once is None:
        return -np.inf, np.inf
    return float(seen_once['lowest']) - _MARGIN, float(seen_once['highest']) + _MARGIN


def unknown_temperature(calibration: AnyCalibration, *, recorded: bool) -> list[str]:
    """Return a note where either calibration or recording has a temperature, and not both."""
    made_at, text = first_of(calibration).provenance.get('temperature'), ''
    if recorded and not isinstance(made_at, dict):
        text = (
            'The recording has the temperature of the unit and the calibration none: whether it '
            'holds there is unknown. Record imu/temperature when you calibrate, too.'
        )
    elif isinstance(made_at, dict) and not recorded:
        text = (
            f'The calibration was made at {float(made_at["mean"]):.1f} degrees Celsius, and the '
            'recording has no temperature: whether it holds there is unknown. Record '
            'imu/temperature, too.'
        )
    return [text] if text else []


def load_calibration(path: str | Path) -> AnyCalibration:
    """Read a calibration file, single or combined."""
    return read_calibration(calibration_section(path))


def read_calibration(section: Section) -> AnyCalibration:
    """Read a calibration, single or combined, from its YAML mapping."""
    if not (section.has('calibrations') or section.alike('calibrations')):
        calibration = Calibration.read(section)
        return by_temperature(calibration, section.where)
    version = section.number('format')
    if version != _FORMAT:
        raise InputError(f'{section.key("format")}: found {version:g}, expected {_FORMAT}.')
    section.text('imu')
    section.text('serial_number', '')
    section.text(CHECKSUM, '')
    order = None
    if section.has('order') and section.raw('order') != 'lines':
        order = section.whole('order', 1, MOST)
    parts = section.sections('calibrations')
    section.refuse_unknown_keys()
    names = [part.where for part in parts]
    where = f'{section.key("calibrations")}: '
    return combine([Calibration.read(part) for part in parts], names, order, where)


def by_temperature(calibration: Calibration, name: str) -> AnyCalibration:
    """Return a calibration as it is to be applied: by temperature, if it has such coefficients."""
    if calibration.changes is None or not calibration.changes.follows_temperature:
        return calibration
    _check_temperature(calibration, name)
    return ThermalCalibration((calibration,))


def _by_coefficients(calibration: Calibration, celsius: float) -> Calibration:
    """Return a calibration at a temperature, by the coefficients of its session.

    Source: docs/mathematics.md, 'Terms of a session'.
    """
    assert calibration.changes is not None
    seen, changes = calibration.provenance['temperature'], calibration.changes
    held = float(np.clip(celsius, seen['lowest'], seen['highest']))
    slopes = changes.by_kelvin(calibration.parameters) * (held - float(seen['mean']))
    both = changes.cross @ slopes.T
    covariance = calibration.covariance + both + both.T + slopes @ changes.covariance @ slopes.T
    values = calibration.values + slopes @ changes.values
    at = {'mean': celsius, 'lowest': celsius, 'highest': celsius}
    return replace(
        calibration,
        model=calibration.model.with_values(calibration.parameters, values),
        covariance=covariance,
        budget=None,
        residuals=(),
        changes=None,
        provenance={**calibration.provenance, 'temperature': at},
    )


def _check_temperature(calibration: Calibration, name: str) -> None:
    found = calibration.provenance.get('temperature')
    keys = ('mean', 'lowest', 'highest')
    numbers = [found.get(key) for key in keys] if isinstance(found, dict) else []
    if not numbers or not all(isinstance(v, (int, float)) and np.isfinite(v) for v in numbers):
        raise InputError(
            f'{name}: provenance: temperature: found {found!r}, expected mean, lowest and highest '
            'in degC. They are recorded where the session has a topic imu/temperature.'
        )


def first_of(calibration: AnyCalibration) -> Calibration:
    """Return the calibration that identifies the unit."""
    if isinstance(calibration, ThermalCalibration):
        return calibration.calibrations[0]
    return calibration


def check_same_unit(
    calibration: AnyCalibration, name: str, other: AnyCalibration, other_name: str
) -> None:
    """Refuse calibrations that are not of one unit, or whose outputs differ in meaning."""
    unit = first_of(other)
    check_unit(calibration, name, unit.imu, other_name, unit.serial_number)


def check_unit(
    calibration: AnyCalibration, name: str, imu: ImuSpec, where: str, serial_number: str = ''
) -> None:
    """Refuse a calibration of a unit other than that of an IMU's description.

    Serial numbers are compared where both are stated.
    """
    check_identity(calibration, name, imu, where, serial_number)
    own = first_of(calibration).imu
    compared: dict[str, tuple[str | float, str | float]] = {
        'units': (own.units.value, imu.units.value),
        'gyro: scale_factor': (own.gyro.scale_factor, imu.gyro.scale_factor),
        'accelerometer: scale_factor': (own.accel.scale_factor, imu.accel.scale_factor),
    }
    _check_same(compared, name, where)


def check_identity(
    calibration: AnyCalibration, name: str, imu: ImuSpec, where: str, serial_number: str = ''
) -> None:
    """Refuse a calibration that states another unit."""
    own = first_of(calibration)
    compared: dict[str, tuple[str | float, str | float]] = {}
    # The supplied descriptions of rates name no unit: the calibration may be that of any.
    if own.imu.id not in UNNAMED or not (own.imu.units.physical and imu.units.physical):
        compared['imu'] = own.imu.id, imu.id
    if own.serial_number and serial_number:
        compared['serial_number'] = (own.serial_number, serial_number)
    _check_same(compared, name, where)


def _check_same(
    compared: Mapping[str, tuple[str | float, str | float]], name: str, where: str
) -> None:
    """Compare texts exactly, and numbers within the rounding of text."""
    for key, (found, expected) in compared.items():
        same = found == expected
        if isinstance(found, float) and isinstance(expected, float):
            same = math.isclose(found, expected, rel_tol=_WRITTEN)
        if not same:
            raise InputError(f'{name}: {key}: found {found}, expected {expected} as in {where}.')


def _known(calibration: Calibration) -> str:
    names = [p.name for p in calibration.parameters]
    known = np.isfinite(calibration.std)
    return ', '.join(name for name, yes in zip(names, known, strict=True) if yes)
