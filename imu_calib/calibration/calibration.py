"""A calibration as a value: computed once, saved as text, loaded and applied by others."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from ..common.arguments import checked
from ..common.budget import Budget, ErrorSource, Share
from ..common.config import SafeDumper, Section, dump
from ..common.errors import InputError
from ..common.files import read_text, user_path, write_whole
from ..common.finding import by_effect, how_many
from ..common.stream import Floats, Units
from ..model.alignment import Angles, free_of_frame
from ..model.parameters import (
    AXES,
    MOST_SKEWED,
    PARAMETERS,
    TRIADS,
    Parameter,
    indices_of,
    skewed_parameters,
)
from ..model.sensors import SensorModel, Skewed, Triad, parameters_of, terms_of
from ..model.session_terms import KEY as CHANGES
from ..model.session_terms import Changes, read_changes
from ..model.terms import TERMS, Term
from ..session.imu import (
    GENERIC,
    ChannelNoise,
    ImuSpec,
    StampingClock,
    TriadSpec,
    read_clock,
    read_noise,
)
from ..session.imu import KEY as CLOCK
from .provenance import budget_document, check_plausible, read_budget, read_origin

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

    from .views import LabelledValues

_FORMAT = 1  #: Version of calibration.yaml; others are refused.
CHECKSUM = 'checksum'  #: Key of the last line of a file.

BY_ACCELEROMETERS = 'accelerometers'
"""Value of `frame` in the provenance: the axes of a session in the hand."""

_ROUNDED = 1e-6
"""Ratio by which a stated standard deviation may differ from that of the covariance: seven digits
in a text, single precision in other software."""
_EXPECTED = 'a calibration file, which imu-calib calibrate makes of a recording'
_RECORDINGS = {'.mcap', '.db3'}
_OF_A_STAND = 'calibration.yaml'  #: In the folder of its session.


@dataclass(frozen=True, eq=False)
class ResidualRow:
    """Residuals of a static dwell: (3,) rad/s and (3,) m/s^2.

    NaN for a triad that was not estimated.
    """

    position: str
    time: float
    gyro: Floats
    accel: Floats


@dataclass(frozen=True, eq=False)
class Calibration:
    """The parameters of one unit, with all that is needed to apply them."""

    imu: ImuSpec  #: Description of the unit's stream (nominal scale factors, units).
    model: SensorModel  #: The parameters.
    #: (n, n) in the order of `parameters`, SI units. Rows and columns of a triad that was not
    #: estimated are NaN, those of angles that define the axes of a session in the hand zero.
    covariance: Floats
    residuals: tuple[ResidualRow, ...] = ()  #: One per static dwell.
    #: Sentences for the user: warnings, on which a number depends, then notes, the most important
    #: first (`finding.by_effect`).
    findings: tuple[str, ...] = ()
    #: Origin: recording, hash, plan, method, site, versions.
    provenance: dict[str, Any] = field(default_factory=dict)
    serial_number: str = ''  #: Unit of the type `ImuSpec.id`; empty if not stated.
    #: Of the rows of the covariance: the 24, those of terms, those of skewed gyros, in the order of
    #: `sensors.parameters_of`.
    parameters: tuple[Parameter, ...] = PARAMETERS
    budget: Budget | None = None  #: The variances by source; None if the method does not give them.
    #: Changes of parameters during the session; None if not asked for. Those with the temperature
    #: are applied (`calibration/thermal`), others are not.
    changes: Changes | None = None
    #: The stamping clock, if the session compared it with the table's: pulses are then per second
    #: of the table's clock, else of the stamps'.
    clock: StampingClock | None = None

    def __post_init__(self) -> None:
        """Refuse a covariance that does not fit the model's parameters; order the findings."""
        assert self.covariance.shape == (len(self.parameters),) * 2
        assert set(self.model.parameters) <= set(self.parameters)
        object.__setattr__(self, 'findings', by_effect(self.findings, self.budget))

    @property
    def std(self) -> Floats:
        """Standard deviations of `parameters`, SI units; NaN if not estimated."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def __repr__(self) -> str:
        """Return one line; `to_dataframe` has the parameters."""
        count = int((np.isfinite(self.std) & self._not_chosen).sum())
        told = how_many(self.findings)
        return f'<Calibration of {self.unit_name}: {count} parameters, {told}>'

    @property
    def _not_chosen(self) -> NDArray[np.bool_]:
        """(n,) mask of all but the zeros that are a choice of the axes."""
        return np.asarray((self.values != 0) | (self.std != 0))

    @property
    def unit_name(self) -> str:
        """Type and serial number of the unit, for people; of a unit without either, its recording.

        Units of one topic of SI units have a common description, and no type. A unit that does not
        exist is said to be simulated.
        """
        name = ' '.join([self.imu.id, self.serial_number]).strip()
        if self.imu.id == GENERIC and not self.serial_number:
            name = str(self.provenance.get('recording') or self.imu.id)
        return f'{name} (simulated)' if self.simulated else name

    @property
    def simulated(self) -> bool:
        """Whether its data were simulated, so that it is of no real unit."""
        return bool(self.provenance.get('simulated'))

    @property
    def values(self) -> Floats:
        """Values of `parameters`, SI units."""
        return self.model.values(self.parameters)

    @property
    def free_of_frame(self) -> tuple[Angles, ...]:
        """The angles between input axes, which do not depend on the table's frame."""
        return free_of_frame(self.model, self.covariance, self.parameters)

    @property
    def noise(self) -> dict[str, ChannelNoise]:
        """The noise of the session, by channel ('gx'); empty if unknown."""
        return read_noise(self.provenance.get('noise') or {})

    @property
    def sensor_walk(self) -> Floats:
        """Random walk (6,) of the sensors, rad/sqrt(s) and (m/s)/sqrt(s); NaN if unknown.

        That of a session in the hand is mostly the hand's.
        """
        walk = self.provenance.get('sensor_random_walk' if self.in_the_hand else 'random_walk')
        return np.array([np.nan] * 6 if walk is None else walk, dtype=float)

    @property
    def in_the_hand(self) -> bool:
        """Whether the unit was held by hand, in unknown attitudes."""
        return self.provenance.get('frame') == BY_ACCELEROMETERS

    @property
    def by_hand(self) -> bool:
        """Whether the unit was held and turned by hand."""
        return bool(self.provenance.get('by_hand', self.in_the_hand))

    @property
    def unknown_noise(self) -> list[str]:
        """A sentence if the session does not show the noise of the sensors; else empty."""
        unknown = np.isnan(self.sensor_walk)
        names = ['gyros'] * bool(unknown[:3].any())
        names += ['accelerometers'] * bool(unknown[3:].any() and self.has_accelerometers)
        if not (names and 'random_walk' in self.provenance):
            return []
        return [
            f'The noise of the {" and ".join(names)} is unknown, since that of the session is the '
            "hand's: covariances of compensated samples do not contain it. State the random walk "
            "of the data sheet in the IMU's file."
        ]

    def with_data_sheet(self, sheet: ImuSpec) -> Calibration:
        """Return the calibration with the noise of a data sheet, if it was made in the hand."""
        if not self.in_the_hand:
            return self
        stated = np.repeat([sheet.gyro.random_walk, sheet.accel.random_walk], 3)
        walk = np.where(stated > 0, stated, self.sensor_walk).tolist()
        return replace(self, provenance={**self.provenance, 'sensor_random_walk': walk})

    def with_share(self, source: ErrorSource, share: Share) -> Calibration:
        """Return the calibration with the contribution of another source to its covariance."""
        budget = None if self.budget is None else self.budget.with_share(source, share)
        return replace(self, covariance=self.covariance + share.covariance, budget=budget)

    @property
    def has_accelerometers(self) -> bool:
        """Whether the accelerometers were estimated; else their model is that of ideal ones."""
        of_accels = np.array([p.triad == 'a' for p in self.parameters])
        return bool(np.isfinite(self.std[of_accels]).all())

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file, by its keys (docs/files/calibration.md): plain values,
        SI.

        A triad that was not estimated has no numbers: zeros could be taken for a result.
        """
        known = np.isfinite(self.std)
        # Of the accelerometers all are estimated, or none.
        of_accels = np.array([p.triad == 'a' for p in self.parameters])
        needed = ~of_accels | known[of_accels].any()
        lost = needed & ~np.isfinite(self.values + self.std)
        if lost.any():
            names = [p.name for p, gone in zip(self.parameters, lost, strict=True) if gone]
            raise InputError(
                f'The calibration cannot be written: {", ".join(names)} is not a number.'
            )
        free = self.free_of_frame
        return {
            'format': _FORMAT,
            'imu': self.imu.id,
            'serial_number': self.serial_number,
            'units': self.imu.units.value,
            'gyro': self._triad_document('g', self.imu.gyro, self.model.gyro),
            'accelerometer': (
                self._triad_document('a', self.imu.accel, self.model.accel)
                if self.has_accelerometers
                else _spec_document(self.imu.accel)
            ),
            **self._skewed_document(),
            # For people: `read` recomputes these angles.
            'free_of_frame': {
                **{angles.group.key: angles.values.tolist() for angles in free},
                'std': {angles.group.key: angles.std.tolist() for angles in free},
            },
            'covariance': {
                'parameters': [p.name for p, k in zip(self.parameters, known, strict=True) if k],
                'matrix': self.covariance[np.ix_(known, known)].tolist(),
            },
            **(
                {}
                if self.budget is None
                else {'uncertainty_budget': budget_document(self.budget, self.parameters, known)}
            ),
            **({} if self.changes is None else {CHANGES: self.changes.document()}),
            **({} if self.clock is None else {CLOCK: self.clock.document()}),
            'residuals': [_residual_document(r) for r in self.residuals],
            'findings': [str(text) for text in self.findings],
            'provenance': self.provenance,
        }

    def to_yaml(self) -> str:
        """Return the file's text: SI units, for people and for yaml.safe_load."""
        head = (
            '# Calibration of an IMU, SI units: rad, m, s.\n'
            '# Outputs times scale_factor = (I + error_matrix) input + bias.\n'
        )
        for term in terms_of(self.parameters):
            head += f'# To channel i of the {TRIADS[term.triad]} add {term.formula}.\n'
        if not self.has_accelerometers:
            head += '# The accelerometers were not calibrated.\n'
        return with_checksum(head + dump(self.to_dict(), _Dumper, width=200))

    def _triad_document(self, letter: str, spec: TriadSpec, triad: Triad) -> dict[str, Any]:
        """Return a triad's section: the linear part, and its terms."""
        return {
            **_spec_document(spec),
            'error_matrix': triad.error_matrix.tolist(),
            'bias': triad.bias.tolist(),
            **self._term_documents(letter, self.values),
            'std': self._std_document(letter),
        }

    def _term_documents(self, letter: str, values: Floats) -> dict[str, Any]:
        """Return values of the parameters that belong to the terms of a triad."""
        return {
            term.name: _shaped(values[indices_of(term.parameters, self.parameters)])
            for term in terms_of(self.parameters)
            if term.triad == letter
        }

    def _std_document(self, letter: str) -> dict[str, Any]:
        """Return the standard deviations in the section of a triad."""
        std = SensorModel.from_vector(self.std[indices_of(PARAMETERS, self.parameters)])
        triad = std.gyro if letter == 'g' else std.accel
        return {
            'error_matrix': triad.error_matrix.tolist(),
            'bias': triad.bias.tolist(),
            **self._term_documents(letter, self.std),
        }

    def _skewed_document(self) -> dict[str, Any]:
        skewed = self.model.skewed
        if skewed is None:
            return {}
        return {
            'skewed_gyro': {
                **_spec_document(self.imu.skewed or self.imu.gyro),
                'response': skewed.response.tolist(),
                'bias': skewed.bias.tolist(),
                'std': self._skewed_std_document(len(skewed.bias)),
            }
        }

    def _skewed_std_document(self, channels: int) -> dict[str, Any]:
        """Return the standard deviations in the section of the skewed gyros."""
        mine = indices_of(skewed_parameters(channels), self.parameters)
        std = self.std[mine].reshape(-1, 4)
        return {'response': std[:, :3].tolist(), 'bias': std[:, 3].tolist()}

    def _check_stated_std(self, section: Section) -> None:
        """Refuse standard deviations in a file that are not those of its covariance."""
        expected = {'gyro': self._std_document('g')}
        if self.has_accelerometers:
            expected['accelerometer'] = self._std_document('a')
        if self.model.skewed is not None:
            expected['skewed_gyro'] = self._skewed_std_document(len(self.model.skewed.bias))
        for key, std in expected.items():
            if section.section(key).has('std'):
                _check_std(section.section(key).section('std'), std)

    @classmethod
    @checked
    def from_yaml(cls, text: str, where: str) -> Calibration:
        """Read a calibration."""
        return cls.read(Section.parse(text, where))

    def to_dataframe(self) -> pandas.DataFrame:
        """Return value, std and unit of each parameter as a pandas.DataFrame, by its name.

        Those that are zero by the choice of the axes have no row.
        """
        from .views import compared_frame

        rows = np.flatnonzero(self._not_chosen)
        shown = {'value': self.values[rows], 'std': self.std[rows]}
        parameters = [self.parameters[k] for k in rows]
        return compared_frame(parameters, shown, {}, by_hand=self.by_hand)

    @property
    def labelled(self) -> LabelledValues:
        """`values`, `std`, `covariance` and `noise` with their names, as pandas holds them: SI."""
        from .views import labelled

        return labelled(self.parameters, self.values, self.std, self.covariance, self.noise)

    def apply(
        self,
        *samples: ArrayLike | pandas.DataFrame,
        gyro: ArrayLike | None = None,
        accel: ArrayLike | None = None,
        rate: float | None = None,
    ) -> tuple[Floats, Floats]:
        """Return rates, rad/s, and specific forces, m/s^2, for samples in memory.

        Samples beyond the range are not marked, and terms of motion (places and delay of the
        accelerometers) are not subtracted: `imu_calib.compensate` does both, for recordings.

        Args:
            *samples: Of gyro and accelerometer, (n, 3) each, as the sensor delivers them, in the
                units of `imu`; or a data frame of both.
            gyro: The columns of the data frame, 'gx,gy,gz:deg/s', as for `imu_calib.calibrate`; by
                default `angular_velocity.x` to `.z`.
            accel: Likewise; by default `linear_acceleration.x` to `.z`.
            rate: Samples per second; needed for what is counted over the sample interval.

        Samples of a calibration in SI that are evidently in g, mg or deg/s are a UserWarning.

        Raises:
            InputError: The arrays do not have three columns each and as many rows, a data frame has
                columns of other names, or `rate` is missing or no number above 0.
            NotObservable: The model cannot be inverted.
        """
        raw = self._outputs(*samples, gyro=gyro, accel=accel)
        if raw[0].shape != raw[1].shape or raw[0].shape[-1:] != (len(AXES),):
            raise InputError(
                f'`gyro`, `accel`: found the shapes {raw[0].shape} and {raw[1].shape}, expected '
                '(n, 3) of both.'
            )
        if rate is not None and not _is_positive(rate):
            raise InputError(f'`rate`: found {rate!r}, expected samples per second, above 0.')
        per_second = 1.0
        if self.imu.units.per_interval:
            if rate is None:
                raise InputError(
                    '`rate`: found None, expected samples per second: outputs of '
                    f'{self.imu.id} are {self.imu.units.value} counted over the sample interval.'
                )
            per_second = rate if self.clock is None else rate * (1 + self.clock.faster)
        if self.imu.units is Units.SI and (doubt := _other_units(*np.atleast_2d(*raw))):
            warnings.warn(
                f'{doubt}: the calibration of {self.unit_name} takes rad/s and m/s^2.', stacklevel=2
            )
        scales = self.imu.gyro.scale_factor, self.imu.accel.scale_factor
        outputs = (values * scale * per_second for values, scale in zip(raw, scales, strict=True))
        return self.model.compensate(*outputs)

    def _outputs(self, *samples: Any, gyro: Any, accel: Any) -> tuple[Floats, Floats]:
        """Return samples, as `apply` takes them, as arrays (n, 3)."""
        if isinstance(gyro, str) and isinstance(accel, str) and len(samples) == 1:
            from ..recordings.text import outputs_of_frame

            return outputs_of_frame(samples[0], gyro, accel, self.imu)
        both = [*samples, *(one for one in (gyro, accel) if one is not None)]
        if len(both) == 1 and hasattr(both[0], 'columns'):
            both *= 2
        if len(both) != 2 or any(isinstance(one, str) for one in both):
            raise InputError(
                'Expected samples of gyro and accelerometer, (n, 3) each, or one data frame, with '
                "the names of its columns in `gyro` and `accel`: gyro='gx,gy,gz:deg/s'."
            )
        return _by_axis(both[0], 'angular_velocity'), _by_axis(both[1], 'linear_acceleration')

    def _repr_html_(self) -> str:
        """Return the parameters as a small table, for a notebook."""
        from .views import parameter_page

        title = f'{self.unit_name}: {how_many(self.findings)}'
        return parameter_page(title, self.parameters, self.values, self.std, by_hand=self.by_hand)

    def plot(self) -> Figure:
        """Draw the parameters with bars of two standard deviations, as a matplotlib Figure."""
        from .views import draw_parameters

        rows = np.flatnonzero(self._not_chosen)
        parameters = tuple(self.parameters[k] for k in rows)
        return draw_parameters(
            self.unit_name, parameters, self.values[rows], self.std[rows], by_hand=self.by_hand
        )

    def plot_residuals(self) -> Figure:
        """Draw the residuals of the static dwells by position; return the matplotlib Figure.

        Raises:
            InputError: matplotlib is not installed, or the calibration contains no residuals.
        """
        from .views import draw_residuals

        rows = self.residuals
        if not rows:
            raise InputError(
                f'The calibration of {self.unit_name} carries no residuals: it was not made of a '
                'recording.'
            )
        columns = [np.array([r.gyro for r in rows]), np.array([r.accel for r in rows])]
        positions = [r.position for r in rows]
        return draw_residuals(self.unit_name, positions, columns, by_hand=self.by_hand)

    def plot_noise(self) -> Figure:
        """Draw the Allan deviation of the session; return the matplotlib Figure.

        Raises:
            InputError: matplotlib is not installed, or the calibration contains no noise.
        """
        from .views import draw_noise

        return draw_noise(self.unit_name, self.noise)

    @checked
    def save(self, path: str | Path) -> None:
        """Write the file whole or not at all."""
        write_whole(user_path(path), self.to_yaml())

    @classmethod
    @checked
    def load(cls, path: str | Path) -> Calibration:
        """Read a calibration file."""
        return cls.read(calibration_section(path))

    @classmethod
    def read(cls, section: Section) -> Calibration:
        """Read a calibration from its YAML mapping."""
        version = section.number('format')
        if version != _FORMAT:
            raise InputError(f'{section.key("format")}: found {version:g}, expected {_FORMAT}.')
        units = section.choice('units', {u.value: u for u in Units})
        gyros, accels = section.section('gyro'), section.section('accelerometer')
        terms = {**_read_terms(gyros, 'g'), **_read_terms(accels, 'a')}
        gyro_spec, gyro = _read_triad(gyros)
        accel_spec, accel = _read_triad(accels)
        skewed_spec, skewed = _read_skewed(section)
        if gyro is None:
            raise InputError(f'{gyros.where}: the keys error_matrix and bias are missing.')
        of_accels = [term.name for term in terms if term.triad == 'a']
        if accel is None and of_accels:
            raise InputError(
                f'{accels.where}: found {", ".join(of_accels)}, but the keys error_matrix and bias '
                'are missing.'
            )
        spec = ImuSpec(section.text('imu'), units, None, gyro_spec, accel_spec, skewed_spec)
        channels = 0 if skewed is None else len(skewed.bias)
        parameters = parameters_of(tuple(terms), skewed=channels)
        covariance = _read_covariance(section, parameters, accelerometers=accel is not None)
        model = SensorModel(gyro, accel or Triad(), skewed=skewed)
        for term, values in terms.items():
            model = model.with_values(term.parameters, values)
        residuals: tuple[ResidualRow, ...] = ()
        if section.has('residuals') and section.raw('residuals') != []:
            residuals = tuple(_read_residual(row) for row in section.sections('residuals'))
        findings = section.texts('findings')
        section.skip('free_of_frame')
        section.text(CHECKSUM, '')
        provenance = read_origin(section)
        serial_number = section.text('serial_number', '')
        budget = None
        budgeted = section.has('uncertainty_budget')
        changing, stamped = section.has(CHANGES), section.has(CLOCK)
        # First: without a misspelt `covariance` no budget adds up to the variances.
        section.refuse_unknown_keys()
        if budgeted:
            variances = np.diag(covariance)
            budget = read_budget(section.section('uncertainty_budget'), parameters, variances)
        calibration = cls(
            spec,
            model,
            covariance,
            residuals,
            findings,
            provenance,
            serial_number,
            parameters,
            budget,
            read_changes(section.section(CHANGES), parameters, covariance) if changing else None,
            read_clock(section.section(CLOCK)) if stamped else None,
        )
        check_plausible(calibration, section.where)
        calibration._check_stated_std(section)
        return calibration


def with_checksum(text: str) -> str:
    """Return the text of a file with its SHA-256 in a last line, which shows later changes."""
    import hashlib  # Only what is written needs it.

    return f'{text}{CHECKSUM}: {hashlib.sha256(text.encode()).hexdigest()}\n'


def is_as_saved(path: Path) -> bool | None:
    """Return whether a file has the text that was saved; None if it has no checksum."""
    # Line ends are those of the system that copied it.
    text, _, stated = read_text(path).replace('\r\n', '\n').rpartition(f'{CHECKSUM}: ')
    return f'{CHECKSUM}: {stated}' == with_checksum(text)[len(text) :] if text else None


class _Dumper(SafeDumper):
    """Write each key on a line, rows of numbers on one line, floats in full precision."""


def _flow_list(dumper: SafeDumper, data: list[Any]) -> yaml.Node:
    numbers = all(isinstance(v, (int, float)) for v in data)
    names = all(isinstance(v, str) and ' ' not in v for v in data)
    return dumper.represent_sequence('tag:yaml.org,2002:seq', data, flow_style=numbers or names)


_Dumper.add_representer(list, _flow_list)


def _spec_document(spec: TriadSpec) -> dict[str, Any]:
    """Return the description of a triad; a range that is not stated is left out."""
    document = {'scale_factor': float(spec.scale_factor)}
    if np.isfinite(spec.range):
        document['range'] = float(spec.range)
    return document


def _shape(term: Term) -> tuple[int, ...]:
    """Return the shape of a term's coefficients in a file: one, one for each channel, or rows."""
    count = len(term.parameters) // len(AXES)
    if not count:
        return ()
    return (len(AXES),) if count == 1 else (len(AXES), count)


def _shaped(values: Floats) -> list[Any] | float:
    """Return coefficients in the shape of a file."""
    if len(values) == 1:
        return float(values[0])
    shape = (-1,) if len(values) == len(AXES) else (len(AXES), -1)
    shaped: list[Any] = values.reshape(shape).tolist()
    return shaped


def _residual_document(row: ResidualRow) -> dict[str, Any]:
    document: dict[str, Any] = {'position': row.position, 'time': float(row.time)}
    for name, values in (('gyro', row.gyro), ('accelerometer', row.accel)):
        if np.isfinite(values).all():
            document[name] = values.tolist()
    return document


def _read_covariance(
    section: Section, parameters: tuple[Parameter, ...], *, accelerometers: bool
) -> Floats:
    """Read the covariance; a truth written by hand has none, and is exact."""
    known = [accelerometers or p.triad != 'a' for p in parameters]
    covariance = np.full((len(parameters), len(parameters)), np.nan)
    count = sum(known)
    if section.has('covariance'):
        block = section.section('covariance')
        names = [p.name for p, k in zip(parameters, known, strict=True) if k]
        if block.items('parameters') != names:
            raise InputError(
                f'{block.key("parameters")}: not the {count} parameters in their order.'
            )
        covariance[np.ix_(known, known)] = block.array('matrix', (count, count))
        block.refuse_unknown_keys()
    else:
        covariance[np.ix_(known, known)] = 0.0
    return covariance


def calibration_section(path: str | Path) -> Section:
    """Read the mapping of a calibration file."""
    file = user_path(path)
    inside = file.iterdir() if file.is_dir() else (file,)
    if any(one.suffix in _RECORDINGS for one in inside):
        raise InputError(f'{file} is a recording, expected {_EXPECTED}.')
    if (file / _OF_A_STAND).is_file():
        raise InputError(f'{file} is a folder: did you mean {file / _OF_A_STAND}?')
    section = Section.load(file, _EXPECTED)
    if not section.has('format'):
        raise InputError(f"{file} is not a calibration file (the key 'format' is missing).")
    return section


def _read_terms(section: Section, letter: str) -> dict[Term, Floats]:
    """Read the coefficients of the terms in a triad's section."""
    mine = [term for term in TERMS if term.triad == letter and section.has(term.name)]
    return {term: section.array(term.name, _shape(term)).ravel() for term in mine}


def _read_triad(section: Section) -> tuple[TriadSpec, Triad | None]:
    """Read a triad; None for one with a scale factor alone: it was not estimated."""
    scale = section.number('scale_factor')
    triad = None
    if section.has('error_matrix') or section.has('bias'):
        triad = Triad(section.array('error_matrix', (3, 3)), section.array('bias', (3,)))
        section.skip('std')
    return _finish_spec(section, scale), triad


def _finish_spec(section: Section, scale: float) -> TriadSpec:
    limit = section.number('range', np.inf)
    if not (scale > 0 and limit > 0):
        key, found = ('range', limit) if scale > 0 else ('scale_factor', scale)
        raise InputError(f'{section.key(key)}: found {found:g}, expected above 0.')
    section.refuse_unknown_keys()
    return TriadSpec(scale, range=limit)


def _read_skewed(section: Section) -> tuple[TriadSpec | None, Skewed | None]:
    if not section.has('skewed_gyro'):
        return None, None
    block = section.section('skewed_gyro')
    scale, channels = block.number('scale_factor'), len(block.items('bias'))
    if channels > MOST_SKEWED:
        raise InputError(f'{block.key("bias")}: found {channels}, expected at most {MOST_SKEWED}.')
    skewed = Skewed(block.array('response', (channels, 3)), block.array('bias', (channels,)))
    block.skip('std')
    return _finish_spec(block, scale), skewed


def _check_std(section: Section, expected: Mapping[str, Any]) -> None:
    """Refuse standard deviations that contradict expected ones, each by its key."""
    for key, values in expected.items():
        if section.has(key):
            found, wanted = section.array(key, np.shape(values)), np.array(values)
            if not (np.abs(found - wanted) <= _ROUNDED * wanted).all():
                raise InputError(
                    f'{section.key(key)}: not the square roots of the variances in covariance.'
                )
    section.refuse_unknown_keys()


_NEAR = 0.25
"""Relative: scale factor error and bias of the cheapest accelerometers. No motion of a vehicle has
a median of 1 m/s^2 within that, nor of 1000."""
_TOO_FAST = 75.0
"""rad/s: 4300 deg/s, above the widest range of MEMS gyros (4000 deg/s, ICM-20649)."""
_OFTEN = 0.01  #: Share of samples: spikes and failed reads are fewer. A judgement.


def _other_units(gyro: Floats, accel: Floats) -> str:
    """Return which samples, (n, 3) and stated to be in SI, evidently are not; else empty."""
    known = np.isfinite(np.hstack([gyro, accel])).all(axis=-1)
    gyro, accel = gyro[known], accel[known]
    if not len(accel):
        return ''
    length = float(np.median(np.linalg.norm(accel, axis=1)))
    for unit, one in (('g', 1.0), ('mg', 1000.0)):
        if abs(length / one - 1) < _NEAR:
            return f'The median length of the accelerations is {length:.4g}, as in {unit}'
    fast = np.abs(gyro).max(axis=1)
    if np.mean(fast > _TOO_FAST) > _OFTEN:
        return f'The gyros read up to {fast.max():.4g}, as in deg/s'
    return ''


def _by_axis(samples: Any, field: str) -> Floats:
    """Return samples (n, 3) as numbers: the columns of a data frame by their names, if any."""
    names = [name for name in getattr(samples, 'columns', ()) if isinstance(name, str)]
    if names:
        wanted = [f'{field}.{axis}' for axis in 'xyz']
        if any(names.count(name) != 1 for name in wanted):
            raise InputError(
                f'The data frame has the columns {", ".join(names)}, expected {", ".join(wanted)}, '
                "or their names: apply(frame, gyro='gx,gy,gz:deg/s', accel='ax,ay,az:g')."
            )
        samples = samples[wanted]
    return np.asarray(samples, dtype=np.float64)


def _is_positive(value: object) -> bool:
    return isinstance(value, Real) and float(value) > 0


def _read_residual(row: Section) -> ResidualRow:
    gyro, accel = (
        row.array(key, (3,)) if row.has(key) else np.full(3, np.nan)
        for key in ('gyro', 'accelerometer')
    )
    residual = ResidualRow(row.text('position'), row.number('time'), gyro, accel)
    row.refuse_unknown_keys()
    return residual
