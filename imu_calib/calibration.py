"""A calibration as a value: computed once, saved as text, loaded by others, applied."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .config import Section
from .errors import InputError
from .imu import ImuSpec, TriadSpec
from .model import PARAMETER_NAMES, SensorModel, Triad
from .stream import Floats, Units

_FORMAT = 1


@dataclass(frozen=True, eq=False)
class ResidualRow:
    """What a stretch at rest shows beyond the model: (3,) rad/s and (3,) m/s^2."""

    position: str
    time: float
    gyro: Floats
    accel: Floats


@dataclass(frozen=True, eq=False)
class Calibration:
    """The 24 parameters of one unit, with everything that is needed to apply them.

    Attributes:
        imu: What the numbers of the unit's stream mean (nominal scale factors, units).
        model: The parameters.
        covariance: (24, 24) in the order of `model.PARAMETERS`, SI units.
        residuals: One per stretch at rest.
        findings: What a person should know, in sentences.
        provenance: Where it comes from: recording, hash, plan, method, site, versions.

    """

    imu: ImuSpec
    model: SensorModel
    covariance: Floats
    residuals: tuple[ResidualRow, ...] = ()
    findings: tuple[str, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def std(self) -> Floats:
        """Standard deviations of the 24 parameters, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def to_yaml(self) -> str:
        """Return the file's text: SI units, readable by a person and by yaml.safe_load."""
        std = SensorModel.from_vector(self.std)
        document = {
            'format': _FORMAT,
            'imu': self.imu.id,
            'units': self.imu.units.value,
            'gyro': _triad_document(self.imu.gyro, self.model.gyro, std.gyro),
            'accelerometer': _triad_document(self.imu.accel, self.model.accel, std.accel),
            'covariance': {
                'parameters': list(PARAMETER_NAMES),
                'matrix': _rows(self.covariance),
            },
            'residuals': [
                {
                    'position': r.position,
                    'time': float(r.time),
                    'gyro': _row(r.gyro),
                    'accelerometer': _row(r.accel),
                }
                for r in self.residuals
            ],
            'findings': list(self.findings),
            'provenance': self.provenance,
        }
        head = (
            '# Calibration of an IMU, SI units: rad, m, s.\n'
            '# Outputs times scale_factor = (I + error_matrix) input + bias.\n'
        )
        return head + yaml.dump(document, Dumper=_Dumper, sort_keys=False, width=200)

    @classmethod
    def from_yaml(cls, text: str, where: str) -> Calibration:
        """Read a calibration.

        Args:
            text: As `to_yaml` wrote it.
            where: The file, for messages.

        Raises:
            InputError: No calibration; names file, key, what was found and what was expected.

        """
        return cls._read(Section.parse(text, where))

    def save(self, path: Path) -> None:
        """Write the file whole or not at all.

        Raises:
            InputError: It cannot be written.

        """
        temporary = path.with_name(path.name + '.part')
        try:
            temporary.write_text(self.to_yaml(), encoding='utf-8')
            temporary.replace(path)
        except OSError as error:
            raise InputError(f'{path}: cannot be written ({error.strerror}).') from None

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """Read a calibration file.

        Raises:
            InputError: Unreadable, or no calibration.

        """
        return cls._read(Section.load(path))

    @classmethod
    def _read(cls, section: Section) -> Calibration:
        version = section.number('format')
        if version != _FORMAT:
            raise InputError(f'{section.key("format")}: found {version:g}, expected {_FORMAT}.')
        try:
            units = Units(section.text('units'))
        except ValueError:
            raise InputError(f'{section.key("units")}: found {section.text("units")!r}.') from None
        gyro_spec, gyro = _read_triad(section.section('gyro'))
        accel_spec, accel = _read_triad(section.section('accelerometer'))
        spec = ImuSpec(section.text('imu'), units, None, gyro_spec, accel_spec)
        covariance = _read_covariance(section)
        residuals = _read_residuals(section)
        findings = section.raw('findings') if section.has('findings') else []
        provenance = section.raw('provenance') if section.has('provenance') else {}
        if not isinstance(findings, list) or not isinstance(provenance, dict):
            raise InputError(f'{section.where}: findings must be a list, provenance a mapping.')
        return cls(
            spec, SensorModel(gyro, accel), covariance, residuals, tuple(findings), provenance
        )


class _Dumper(yaml.SafeDumper):
    """Keys on lines of their own, rows of numbers on one line, floats to the last bit."""


def _flow_list(dumper: yaml.SafeDumper, data: list[Any]) -> yaml.Node:
    numbers = all(isinstance(v, (int, float)) for v in data)
    names = all(isinstance(v, str) and ' ' not in v for v in data)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', data, flow_style=numbers or names)


_Dumper.add_representer(list, _flow_list)


def _row(values: Floats) -> list[float]:
    return [float(v) for v in values]


def _rows(matrix: Floats) -> list[list[float]]:
    return [_row(row) for row in matrix]


def _triad_document(spec: TriadSpec, triad: Triad, std: Triad) -> dict[str, Any]:
    return {
        'scale_factor': float(spec.scale_factor),
        'error_matrix': _rows(triad.error_matrix),
        'bias': _row(triad.bias),
        'std': {'error_matrix': _rows(std.error_matrix), 'bias': _row(std.bias)},
    }


def _read_covariance(section: Section) -> Floats:
    """Read the covariance; a truth that was written by hand has none, and is exact."""
    if not section.has('covariance'):
        return np.zeros((24, 24))
    block = section.section('covariance')
    if block.items('parameters') != list(PARAMETER_NAMES):
        raise InputError(f'{block.key("parameters")}: not the 24 parameters in their order.')
    return _matrix(block, 'matrix', (24, 24))


def _read_triad(section: Section) -> tuple[TriadSpec, Triad]:
    scale = section.number('scale_factor')
    triad = Triad(_matrix(section, 'error_matrix', (3, 3)), _matrix(section, 'bias', (3,)))
    section.has('std')
    section.finish()
    return TriadSpec(scale), triad


def _read_residuals(section: Section) -> tuple[ResidualRow, ...]:
    if not section.has('residuals') or not section.raw('residuals'):
        return ()
    return tuple(
        ResidualRow(
            row.text('position'),
            row.number('time'),
            _matrix(row, 'gyro', (3,)),
            _matrix(row, 'accelerometer', (3,)),
        )
        for row in section.sections('residuals')
    )


def _matrix(section: Section, key: str, shape: tuple[int, ...]) -> Floats:
    try:
        values = np.array(section.raw(key), dtype=float)
    except (TypeError, ValueError):
        raise InputError(f'{section.key(key)}: found no numbers.') from None
    if values.shape != shape or not np.isfinite(values).all():
        found = 'x'.join(str(n) for n in values.shape)
        expected = 'x'.join(str(n) for n in shape)
        raise InputError(f'{section.key(key)}: found {found} numbers, expected {expected}.')
    return values
