"""Check a calibration file: each known key of its provenance, its budget, plausible parameters.

Numbers are returned as numbers and texts as texts, so that nothing needs to check them again.
Unknown keys of the provenance are kept: laboratories may add notes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite, isnan
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.budget import LEAST_FREEDOM, PROBABILITY, Budget, BudgetLine, ErrorSource
from ..common.config import Section, as_number, numbers_of
from ..common.errors import InputError
from ..common.gaussian import is_covariance
from ..common.keys import FieldKey
from ..common.stream import Floats, Units
from ..common.units import DEG, LARGEST
from ..model.earth import SITE_BOUNDS
from ..model.parameters import MOST_SKEWED, TRIADS, Parameter, ParameterKind
from ..model.sensors import SensorModel, parameters_of
from ..model.terms import TERMS, coefficients_of
from ..session.imu import COEFFICIENTS, CURVE, ImuSpec

_CHANNELS = 6  #: Channels of an IMU, gx to az.
LEAST = 1e-30
"""Smallest averaging time and sample rate in SI: none is near, and its square is not zero."""

Reader = Callable[..., Any]


def _entry(meaning: str, read: Reader, *arguments: Any, otherwise: str = '') -> FieldKey:
    """Return an entry that may be left out or empty; `read` gets the section and the name."""
    return FieldKey(meaning, read, arguments, {}, None, otherwise, '')


def read_origin(section: Section) -> dict[str, Any]:
    """Return the provenance in a file; empty without one."""
    if not section.has('provenance'):
        return {}
    return _read(section.section('provenance'), ENTRIES)


def _read(section: Section, known: Mapping[str, FieldKey]) -> dict[str, Any]:
    """Return the values of a mapping: those of known keys as read, others as they are."""
    found: dict[str, Any] = {}
    for name in section.names():
        one = known.get(name)
        read, arguments = (Section.raw, ()) if one is None else (one.read, one.arguments)
        found[name] = read(section, name, *arguments) if section.has(name) else None
    return found


def texts(section: Section, name: str) -> list[str]:
    """Return a list of texts."""
    return list(section.texts(name))


def number_within(section: Section, name: str, least: float, most: float | None = None) -> float:
    """Return a number of a range."""
    value = section.number(name)
    if value < least or (most is not None and value > most):
        bound = f'{least:g} or more' if most is None else f'{least:g} to {most:g}'
        raise InputError(f'{section.key(name)}: found {value:g}, expected {bound}.')
    return value


def possible(section: Section, name: str) -> float:
    """Return a number that may be infinite or unknown."""
    value = as_number(section.raw(name))
    if value is None or (isfinite(value) and abs(value) > LARGEST):
        raise InputError(f'{section.key(name)}: found {section.raw(name)!r}, expected a number.')
    return value


def numbers(
    section: Section, name: str, count: int | None = None, least: float = 0.0
) -> list[float | None]:
    """Return a list of numbers, some possibly unknown."""
    values = section.raw(name)
    found = [as_number(value) for value in values] if isinstance(values, list) else []
    known = isinstance(values, list) and all(
        value is None or (number is not None and (isnan(number) or least <= number <= LARGEST))
        for value, number in zip(values, found, strict=True)
    )
    if not known or (count is not None and len(found) != count):
        wanted = 'numbers' if count is None else f'{count} numbers'
        raise InputError(
            f'{section.key(name)}: found {values!r}, expected a list of {wanted}, '
            f'{least:g} or more.'
        )
    return found


_ROUNDING = 1e-6  #: K: means are of whole micro-kelvins, and files hold them as rounded.


def temperature(section: Section, name: str) -> dict[str, Any]:
    """Return the temperatures of a session."""
    mine = section.section(name)
    lowest, mean, highest = (mine.number(key) for key in ('lowest', 'mean', 'highest'))
    if not lowest - _ROUNDING <= mean <= highest + _ROUNDING:
        raise InputError(
            f'{mine.where}: found mean {mean:g}, expected one from lowest, {lowest:g}, to highest, '
            f'{highest:g}.'
        )
    return _read(mine, dict.fromkeys(('mean', 'lowest', 'highest'), _entry('', Section.number)))


def entries(section: Section, name: str, known: Mapping[str, FieldKey]) -> dict[str, Any]:
    """Return a mapping behind a key: those of known keys as read, others as they are."""
    return _read(section.section(name), known)


def each(section: Section, name: str, read: Reader) -> dict[str, Any]:
    """Return a mapping behind a key whose own keys are names, all read alike; none may be empty."""
    mine = section.section(name)
    return {one: read(mine, one) for one in mine.names()}


def test_of_term(tests: Section, name: str) -> dict[str, Any]:
    """Return the test of a term."""
    section = tests.section(name)
    try:
        known = {one.name for one in coefficients_of(name)}
    except InputError as error:
        raise InputError(f'{tests.key(name)}: {error}') from None
    section.raw('state')
    found = _read(
        section,
        {
            'state': _entry('', Section.text),
            # Of a number that is zero in double precision.
            'log10_p': _entry('', number_within, -LARGEST, 0.0),
            'probability': _entry('', number_within, 0.0, 1.0),
            'found_from': _entry('', numbers, len(known) or None),
            'would_move': _entry('', each, _moved),
        },
    )
    for one in found.get('would_move') or ():
        if known and one not in known:
            raise InputError(
                f'{section.key("would_move")}: found {one!r}, expected {", ".join(sorted(known))}.'
            )
    return found


def _moved(section: Section, name: str) -> dict[str, Any]:
    mine = section.section(name)
    moved = {'parameter': mine.text('parameter'), 'by': mine.number('by')}
    if moved['parameter'] not in _NAMES:
        raise InputError(
            f'{mine.key("parameter")}: found {moved["parameter"]!r}, expected the name of a '
            'parameter.'
        )
    mine.refuse_unknown_keys()
    return moved


_NAMES = {parameter.name for parameter in parameters_of(TERMS, skewed=MOST_SKEWED)}


def channel_noise(channels: Section, name: str) -> dict[str, Any]:
    """Return the noise of a channel."""
    section = channels.section(name)
    names = [f'{name}{end}' for name in COEFFICIENTS for end in ('', '_std', '_below')]
    section.raw('timed')
    found = {key: number_within(section, key, 0.0) for key in names if section.has(key)}
    curve = {key: numbers(section, key, least=LEAST if key == 'tau' else 0.0) for key in CURVE}
    timed = section.flag('timed', default=False)
    section.refuse_unknown_keys()
    if len({len(values) for values in curve.values()}) > 1:
        raise InputError(f'{section.where}: found {", ".join(CURVE)} of different lengths.')
    return {**found, **curve, 'timed': timed}


_CLOCK = {
    'offset_s': _entry('clock of the IMU against that of the table, s', possible),
    'offset_std_s': _entry('its standard deviation, s', possible),
    'rate_ppm': _entry('relative excess of its rate, ppm', possible),
    'rate_std_ppm': _entry('its standard deviation, ppm', possible),
    'motions': _entry('used for the comparison', Section.whole, 0),
}
"""Any numbers: the deviation of a clock that was not compared is infinite."""
_CLOSED_FORM = {
    'method': _entry('its name', Section.text),
    'refusal': _entry('why it has no result', Section.text),
    'joint_std_over_closed_form': _entry('ratio of the standard deviations', number_within, 0),
    'difference_in_std': _entry(
        'closed form less joint, in standard deviations', each, Section.number
    ),
}
ENTRIES = {
    'recording': _entry('name of the recording', Section.text),
    'sha256': _entry('of its files', Section.text),
    'simulated': _entry('whether the data were simulated', Section.flag, otherwise='measured'),
    'imu_sha256': _entry("of the IMU's file, as stated or as in the recording", Section.text),
    'table_sha256': _entry("of the table's file, likewise", Section.text),
    'segments_file': _entry('file of the holds and turns that were chosen by hand', Section.text),
    'topics': _entry('topics that were read', texts),
    'accel_interpolated_from_hz': _entry(
        "rate of the accelerometers before imu-calib convert read them at the gyros' stamps, Hz",
        number_within,
        LEAST,
    ),
    'recorded': _entry('when it began, `2026-01-31T12:00:00Z`', Section.text),
    'method': _entry('the estimator', Section.text),
    'terms': _entry('that were estimated', texts),
    'terms_looked_for': _entry(
        'whether terms were tested and significant ones estimated', Section.flag
    ),
    'plan': _entry('its name', Section.text),
    'by_hand': _entry('whether the unit was held by hand', Section.flag),
    'table': _entry('its name', Section.text),
    'table_simulated': _entry(
        'whether its file says that it is a simulated one', Section.flag, otherwise='a real one'
    ),
    'table_errors': _entry(
        'standard deviations of its errors, as stated or assumed, rad', each, Section.number
    ),
    'table_errors_assumed': _entry(
        'those that its file does not state, or states smaller than any known', texts
    ),
    'table_clock_std': _entry("of the table's clock, a ratio", number_within, 0),
    'latitude_deg': _entry('of the site, deg', number_within, *SITE_BOUNDS['latitude']),
    'latitude_std_deg': _entry('its standard deviation, deg', number_within, 0),
    'gravity': _entry('value used, m/s^2', number_within, *SITE_BOUNDS['gravity']),
    'gravity_source': _entry('its source', Section.text),
    'gravity_std': _entry('its standard deviation, m/s^2', number_within, 0),
    'height': _entry('of the site above the ellipsoid, m', Section.number),
    'height_assumed': _entry('whether it was not stated', Section.flag),
    'azimuth_seen_deg': _entry("heading of the table's zero by the session, deg", Section.number),
    'azimuth_seen_std_deg': _entry('its standard deviation, deg', number_within, 0),
    'segments': _entry('static dwells', Section.whole, 0),
    'turns': _entry('turns', Section.whole, 0),
    'samples': _entry('samples used', Section.whole, 0),
    'duration': _entry('from the first to the last sample, s', number_within, 0),
    'marks': _entry(
        'hashes of samples: verification knows a recording without dates by them, or a part of it',
        numbers,
    ),
    'random_walk': _entry('of the channels, rad/sqrt(s) and (m/s)/sqrt(s)', numbers, _CHANNELS),
    'sensor_random_walk': _entry(
        'of the sensors without the hand: by the data sheet, else by neighbouring samples',
        numbers,
        _CHANNELS,
        otherwise='unknown (sessions in the hand)',
    ),
    'residual_rms': _entry(
        'root mean square of the residuals, rad/s and m/s^2', numbers, _CHANNELS
    ),
    'gravity_off_before': _entry(
        'by how much the nominal accelerometers miss gravity at the worst static dwell, a ratio',
        number_within,
        0,
    ),
    'gravity_off_after': _entry('the same of the calibrated ones', number_within, 0),
    'bias_drift': _entry(
        'bias drift included in the standard deviations, rad/s and m/s^2', numbers, _CHANNELS
    ),
    'bias_instability': _entry(
        "as the IMU's description stated it, rad/s and m/s^2", numbers, _CHANNELS
    ),
    'condition_number': _entry('of the equations', Section.number),
    'highest_rate': _entry('of the turns, rad/s', number_within, 0),
    'temperature': _entry('of the unit', temperature, otherwise='not recorded'),
    'missing_positions': _entry('of the plan', texts),
    'shared_with': _entry('other units of its table', texts),
    'closed_form': _entry('the closed form of the plan beside it', entries, _CLOSED_FORM),
    'clock': _entry('comparison of the clocks', entries, _CLOCK),
    'versions': _entry('of the software: imu_calib, Python, NumPy, SciPy', each, Section.text),
    'frame': _entry('accelerometers: the axes are those of a session in the hand', Section.text),
    'tests_of_terms': _entry('terms, as tested', each, test_of_term),
    'noise': _entry('noise of the session', each, channel_noise),
}
"""What `provenance` may hold, by its keys; schema and page are made of it."""

# The uncertainty budget as `uncertainty_budget` of calibration.yaml: SI units, named.

_NOTHING = 1e-24
"""Variance in SI of what is held at its value: what rounding leaves of it is no contradiction."""
_ROUNDED = 1e-3
"""Ratio by which the sum of the sources may differ from a variance: certificates state two digits
of an uncertainty. Differences of nearly equal covariances lose some 1e-5 in exact sessions."""
_FOLLOWS = (
    'units',
    'standard_uncertainty',
    'effective_degrees_of_freedom',
    'coverage_probability',
    'coverage_factor',
    'expanded_uncertainty',
)
"""Keys of the file that are for the reader: they follow from the sources."""


def budget_document(
    budget: Budget, parameters: Sequence[Parameter], known: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the mapping of a budget in a file: of the `known` (n,) parameters alone."""

    def row(values: Floats) -> list[float]:
        return [float(v) for v in values[known]]

    estimated = [p for p, k in zip(parameters, known, strict=True) if k]
    return {
        'parameters': [p.name for p in estimated],
        'units': [p.unit.si for p in estimated],
        'standard_uncertainty': row(budget.std),
        'effective_degrees_of_freedom': row(budget.freedom),
        'coverage_probability': PROBABILITY,
        'coverage_factor': row(budget.coverage_factor),
        'expanded_uncertainty': row(budget.expanded),
        'sources': [
            {
                'source': line.source.value,
                'evaluation': line.source.evaluation,
                'description': line.source.words,
                'standard_uncertainty': row(line.std),
                'degrees_of_freedom': row(line.freedom),
            }
            for line in budget.lines
        ],
    }


def read_budget(section: Section, parameters: Sequence[Parameter], variances: Floats) -> Budget:
    """Read a budget from its mapping; quantities that follow from the sources are recomputed.

    Args:
        section: The mapping.
        parameters: Those of the calibration, n.
        variances: (n,) theirs, NaN for those that were not estimated.
    """
    known = np.isfinite(variances)
    names = [p.name for p, k in zip(parameters, known, strict=True) if k]
    if section.items('parameters') != names:
        raise InputError(
            f'{section.key("parameters")}: not the {len(names)} parameters of the covariance in '
            'their order.'
        )
    lines = []
    for entry in section.sections('sources'):
        source = entry.choice('source', {s.value: s for s in ErrorSource})
        std = _row(entry, 'standard_uncertainty', known)
        freedom = _row(entry, 'degrees_of_freedom', known)
        if not (std[known] <= LARGEST).all():
            raise InputError(f'{entry.key("standard_uncertainty")}: expected finite numbers.')
        if not (freedom[known] >= LEAST_FREEDOM).all():
            raise InputError(
                f'{entry.key("degrees_of_freedom")}: expected {LEAST_FREEDOM:g} or more each.'
            )
        for key in ('evaluation', 'description'):
            entry.text(key, '')
        entry.refuse_unknown_keys()
        lines.append(BudgetLine(source, std, freedom))
    for key in _FOLLOWS:
        section.has(key)
    section.refuse_unknown_keys()
    budget = Budget(tuple(lines))
    doubt = np.abs(budget.variances.sum(axis=0) - variances)[known]
    if not (doubt <= _ROUNDED * variances[known] + _NOTHING).all():
        raise InputError(
            f'{section.key("sources")}: their squares do not add up to the variances in covariance.'
        )
    return budget


def _row(entry: Section, key: str, known: NDArray[np.bool_]) -> Floats:
    """Return a row of non-negative numbers, NaN for parameters not estimated."""
    values = numbers_of(entry.items(key))
    if values is None:
        raise InputError(f'{entry.key(key)}: found no numbers.')
    count = int(known.sum())
    if values.shape != (count,) or not (values >= 0).all():
        raise InputError(f'{entry.key(key)}: expected {count} numbers, none of them negative.')
    row = np.full(len(known), np.nan)
    row[known] = values
    return row


_SCALE = (0.5, 2.0)
"""Limits of the response along the input axis. A nominal scale factor wrong by a factor of two is
that of another unit, another range or another unit of measure; the worst of the shipped truths,
Cao 2022's Table 1 read literally, is off by 25 %."""
_TILT = 30 * DEG
"""Largest angle between an input axis and its body axis. Beyond it a channel belongs to another
axis; data sheets of MEMS units state up to 2 deg of misalignment."""


class Estimated(Protocol):
    """What is checked of a calibration: its members of these names."""

    @property
    def imu(self) -> ImuSpec: ...  # noqa: D102
    @property
    def model(self) -> SensorModel: ...  # noqa: D102
    @property
    def covariance(self) -> Floats: ...  # noqa: D102
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...  # noqa: D102
    @property
    def values(self) -> Floats: ...  # noqa: D102
    @property
    def has_accelerometers(self) -> bool: ...  # noqa: D102


def is_of_strapdown(response: Floats) -> bool:
    """Return whether the response (3, 3) is plausible: row i the channel, column j the axis."""
    lengths = np.linalg.norm(response, axis=1)
    if not np.all((lengths > _SCALE[0]) & (lengths < _SCALE[1])):
        return False
    return bool(np.all(np.diag(response) / lengths >= np.cos(_TILT)))


def check_plausible(calibration: Estimated, name: str) -> None:
    """Refuse implausible parameters before they are applied.

    Biases of ADC codes are not limited: an ADC may count from any offset.
    """
    _check_scale_factors(calibration, name)
    for parameter, value in zip(calibration.parameters, calibration.values.tolist(), strict=True):
        if not np.isfinite(value):
            raise InputError(f'{name}: {parameter.name}: found {value}, expected a number.')
    model = calibration.model
    _check_response(model.gyro.response, 'gyro', name)
    _check_response(model.accel.response, 'accelerometer', name)
    if model.skewed is not None:
        _check_lengths(model.skewed.response, 'skewed gyro', name)
    _check_limits(calibration, name)
    _check_covariance(calibration, name)


def _check_scale_factors(calibration: Estimated, name: str) -> None:
    for what, spec in (('gyro', calibration.imu.gyro), ('accelerometer', calibration.imu.accel)):
        if not 0 < spec.scale_factor < np.inf:
            raise InputError(
                f'{name}: {what} scale_factor: found {spec.scale_factor}, expected above 0.'
            )


def _check_response(response: Floats, triad: str, name: str) -> None:
    _check_lengths(response, triad, name)
    along = np.diag(response) / np.linalg.norm(response, axis=1)
    for axis, cosine in zip('XYZ', along, strict=True):
        if cosine < np.cos(_TILT):
            angle = np.arccos(np.clip(cosine, -1, 1)) / DEG
            raise InputError(
                f'{name}: the input axis of {triad} {axis} lies {angle:.0f} deg off its body axis; '
                f'expected less than {_TILT / DEG:.0f} deg. Are channels swapped or mirrored?'
            )


def _check_lengths(response: Floats, what: str, name: str) -> None:
    low, high = _SCALE
    for k, length in enumerate(np.linalg.norm(response, axis=1)):
        if not low < length < high:
            raise InputError(
                f'{name}: {what} {"XYZ"[k]} answers {length:.4g} times its nominal scale factor; '
                f'expected {low:g} to {high:g} times. Is it a calibration of another unit?'
            )


def _check_limits(calibration: Estimated, name: str) -> None:
    """Refuse values beyond the limit of their kind, and biases beyond the range."""
    imu = calibration.imu
    ranges = {'g': imu.gyro.range, 'a': imu.accel.range}
    for parameter, value in zip(calibration.parameters, calibration.values.tolist(), strict=True):
        limit = parameter.unit.limit
        words = parameter.kind.value.words
        if parameter.kind is ParameterKind.BIAS:
            # An ADC may count from any offset.
            limit = (
                None if imu.units is Units.COUNTS else min(limit or np.inf, ranges[parameter.triad])
            )
            words = f'{TRIADS[parameter.triad]} bias'
        if limit is not None and abs(value) > limit:
            raise InputError(
                f'{name}: {words}: found {abs(value):.4g} {parameter.unit.si}, expected at most '
                f'{limit:.4g} {parameter.unit.si} ({parameter.name}).'
            )


def _check_covariance(calibration: Estimated, name: str) -> None:
    """Refuse an invalid covariance: not finite, asymmetric, or not positive semidefinite."""
    if (np.diag(calibration.covariance) < 0).any():
        raise InputError(f'{name}: covariance: found a negative variance.')
    # A triad that was not estimated is NaN, and only the accelerometers may be missing.
    estimated = np.array(
        [p.triad == 'g' or calibration.has_accelerometers for p in calibration.parameters]
    )
    covariance = calibration.covariance[np.ix_(estimated, estimated)]
    if not np.isfinite(covariance).all():
        raise InputError(f'{name}: covariance: found values that are not numbers.')
    if not is_covariance(covariance):
        raise InputError(
            f'{name}: covariance: not that of any errors (it must be symmetric and positive '
            'semidefinite).'
        )
