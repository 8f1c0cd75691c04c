"""Find which mistake explains a rejected calibration: fit and score each hypothesis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np

from ..common.errors import NotObservable
from ..common.gaussian import FIVE_SIGMA
from ..common.stream import Floats
from ..common.units import ARCMIN, ARCSEC, DEG, DEG_H, MICRO_G, PPM, STANDARD_GRAVITY
from ..estimation.free_dwells import Sensors
from ..estimation.score import log_bayes_factor, log_f
from ..estimation.system import Fit, Scatter, TriadSystem, least_square
from ..model.parameters import AXES, Parameter, ParameterKind, indices_of
from ..model.sensors import Triad, terms_of
from ..model.terms import G_SENSITIVITY, TERMS, Term
from .provenance import is_of_strapdown

_BIAS_UNITS = {
    True: {'deg/s': DEG, 'deg/h': DEG_H, 'rad/h': 1 / 3600},
    False: {'g': STANDARD_GRAVITY, 'mg': MICRO_G * 1e3, 'micro-g': MICRO_G},
}
"""Units that biases of gyros and accelerometers are written in by mistake, rad/s and m/s^2."""
_ANGLE_UNITS = {'degrees': DEG, 'arc minutes': ARCMIN, 'arc seconds': ARCSEC}
_RATIO_UNITS = {'ppm': PPM, 'per cent': 0.01}  #: The same for ratios.
_ALIKE_HYPOTHESES = 0.01
"""Relative difference from a known factor below. A judgement: scale factors change by less, and the
factors differ by more."""
_SHARES = {
    True: {180 / np.pi: 'radians taken for degrees', np.pi / 180: 'degrees taken for radians'},
    False: {
        STANDARD_GRAVITY: 'g taken for m/s^2',
        1 / STANDARD_GRAVITY: 'm/s^2 taken for g',
        1e-3 * STANDARD_GRAVITY: 'milli-g taken for m/s^2',
    },
}


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A mistake, and the parameters corrected for it; or parameters that have another value."""

    when: str  #: Ends the sentence 'the residuals vanish when'.
    why: str  #: What must then have happened, a sentence.
    values: Floats  #: (p,) of the triad's parameters without the mistake.
    reading: float = 1.0  #: Factor on the outputs under this hypothesis.
    #: Whether it only rotates or mirrors the body axes, which lengths cannot show.
    of_body_axes: bool = False
    freed: tuple[Parameter, ...] = ()  #: Terms that the calibration lacks; or some of its own.
    mount_free: bool = False  #: Whether the unit may be turned in its mount.

    def fit(self, system: TriadSystem, factor: Floats) -> Fit | None:
        """Fit the calibration with a factor (p, k) of its covariance; None if it diverges.

        With six lengths, nine parameters of a term are held by their prior alone and may diverge.
        """
        if self.freed or self.mount_free or self.reading != 1:
            # Otherwise the session's equations are reused.
            reading = system.reading * self.reading
            system = replace(system, reading=reading, mount_free=self.mount_free)
            system = _with_more(system, self.freed)
        more = (0, len(system.sensors.parameters) - len(self.values))
        if self.freed:
            columns = indices_of(self.freed, system.sensors.parameters)
            factor = np.hstack([np.pad(factor, (more, (0, 0))), _wide(system)[:, columns]])
        # A large rotation, and lengths with freed parameters, are nonlinear: their minimum is
        # always searched for.
        nonlinear = self.mount_free or (self.freed and system.up is not None)
        try:
            chance = 0.0 if nonlinear else _EXPLAINED
            return system.fit(np.pad(self.values, more), factor, chance)
        except (np.linalg.LinAlgError, NotObservable):
            return None

    def found(self, fit: Fit) -> Hypothesis:
        """Return it with what its fit shows."""
        if not self.mount_free:
            return self
        about = ', '.join(
            f'{v / ARCMIN:+.2f} arcmin about {axis}'
            for v, axis in zip(fit.unknown[-3:], 'XYZ', strict=True)
        )
        return replace(self, when=f'the unit is turned by {about}')

    def evidence(self, fit: Fit, without: float) -> float:
        """Return the logarithm of its odds against the calibration as it is, of chi-square."""
        gain, free = without - fit.chi_square, len(self.freed) + 3 * self.mount_free
        return log_bayes_factor(gain, free) - _ODDS if free else gain / 2


def mistakes(sensors: Sensors, values: Floats) -> Iterator[Hypothesis]:
    """Yield common mistakes in the parameters (p,) of one kind of sensors, the likely first."""
    for found in (_matrices, _terms, _biases, _units, _axes):
        yield from found(sensors, values)


def _but(values: Floats, matrix: Floats | None = None, bias: Floats | None = None) -> Floats:
    """Return the parameters with another error matrix or other biases."""
    triad = Triad.from_vector(values)
    matrix = triad.error_matrix if matrix is None else matrix
    changed = Triad(matrix, triad.bias if bias is None else bias).vector()
    return np.append(changed, values[len(changed) :])


def _parts(values: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the error matrix, its diagonal, its off-diagonal part, and the biases."""
    triad = Triad.from_vector(values)
    diagonal = np.diag(np.diag(triad.error_matrix))
    return triad.error_matrix, diagonal, triad.error_matrix - diagonal, triad.bias


def _matrices(sensors: Sensors, values: Floats) -> Iterator[Hypothesis]:
    name = f'{"gyro" if sensors.gyros else "accelerometer"} error matrix'
    matrix, diagonal, cross, _ = _parts(values)
    for when, why, changed in (
        (
            f'the {name} is transposed',
            'The matrix was written or applied the wrong way round: row is the channel, column '
            'the input axis.',
            matrix.T,
        ),
        (
            f'the {name} has the opposite sign',
            'The matrix of the correction stands for that of the error, or the inverse was left '
            'out.',
            -matrix,
        ),
        (
            'the misalignments have the opposite sign',
            'Their sign is that of another convention: here they are the response of a channel to '
            'another axis.',
            diagonal - cross,
        ),
        (
            'the scale-factor errors have the opposite sign',
            'They are deviations of the scale factor (rad per pulse), not of the response.',
            cross - diagonal,
        ),
        (
            f'the {name} has the opposite sign and is transposed',
            'The matrix of the correction was written the wrong way round.',
            -matrix.T,
        ),
    ):
        yield Hypothesis(when, why, _but(values, changed))


def _terms(sensors: Sensors, values: Floats) -> Iterator[Hypothesis]:
    for term in terms_of(sensors.parameters):
        mine = indices_of(term.parameters, sensors.parameters)
        own = values[mine]
        if not own.any():
            continue
        changes = [('has the opposite sign', -own), ('is left out', np.zeros_like(own))]
        if term is G_SENSITIVITY:
            changes.insert(0, ('is transposed', own.reshape(3, 3).T.ravel()))
        for when, changed in changes:
            without = values.copy()
            without[mine] = changed
            why = 'It was written or applied in another convention.'
            yield Hypothesis(f'the {term.kind.value.words} {when}', why, without)


def _biases(_: Sensors, values: Floats) -> Iterator[Hypothesis]:
    why = 'The bias is what the channel shows too much: it is subtracted, not added.'
    for signs in product((1.0, -1.0), repeat=3):
        turned = [AXES[i] for i in range(3) if signs[i] < 0]
        which = 'biases have' if len(turned) == 3 else f'bias of {" and ".join(turned)} has'
        if turned:
            changed = _but(values, bias=_parts(values)[3] * np.array(signs))
            yield Hypothesis(f'the {which} the opposite sign', why, changed)


def _units(sensors: Sensors, values: Floats) -> Iterator[Hypothesis]:
    _, diagonal, cross, bias = _parts(values)
    si = 'rad/s' if sensors.gyros else 'm/s^2'
    for unit, size in _BIAS_UNITS[sensors.gyros].items():
        for words, by in _both_ways(unit, si, size):
            yield _unit_hypothesis('the biases', words, _but(values, bias=bias * by))
    matrices = [
        *(
            ('the misalignments', words, diagonal + cross * by)
            for unit, size in _ANGLE_UNITS.items()
            for words, by in _both_ways(unit, 'radians', size)
        ),
        *(
            ('the scale-factor errors', words, diagonal * by + cross)
            for unit, size in _RATIO_UNITS.items()
            for words, by in _both_ways(unit, 'ratios', size)
        ),
    ]
    for what, words, matrix in matrices:
        # A response without limit explains any rate at rest.
        if is_of_strapdown(np.eye(3) + matrix):
            yield _unit_hypothesis(what, words, _but(values, matrix))


def _both_ways(unit: str, si: str, size: float) -> tuple[tuple[tuple[str, str], float], ...]:
    return ((unit, si), size), ((si, unit), 1 / size)


def _unit_hypothesis(what: str, words: tuple[str, str], values: Floats) -> Hypothesis:
    found, expected = words
    why = f'They are in {found} where {expected} are expected.'
    return Hypothesis(f'{what} are read as {found}', why, values)


def _axes(_: Sensors, values: Floats) -> Iterator[Hypothesis]:
    matrix, _diagonal, _cross, bias = _parts(values)
    response = np.eye(3) + matrix
    for order in permutations(range(3)):
        p = np.eye(3)[list(order)]
        exchanged = [i for i in range(3) if order[i] != i]
        if exchanged:
            which = ', '.join(f'{AXES[order[i]]} for {AXES[i]}' for i in exchanged)
            yield Hypothesis(
                f'the axes of the file change places ({which})',
                'Parameters stand under the names of other axes.',
                _but(values, p @ matrix @ p.T, p @ bias),
            )
            yield Hypothesis(
                f'the biases change places ({which})',
                'Biases stand under the names of other axes.',
                _but(values, bias=p @ bias),
            )
        for signs in product((1.0, -1.0), repeat=3):
            s = np.array(signs)[:, None] * p
            if np.array_equal(s, np.eye(3)):
                continue
            words = f'{"exchanged or " if exchanged else ""}reversed ({_channel_words(s)})'
            yield Hypothesis(
                f'channels are {words}',
                'The driver, or the file, has the channels in another order or sense.',
                _but(values, s @ response - np.eye(3), s @ bias),
            )
            yield Hypothesis(
                f'input axes are {words}',
                'The unit sits otherwise in its mount than when it was calibrated, or the columns '
                'of the matrix stand for other axes.'
                if np.linalg.det(s) > 0
                else 'A column of the matrix has the wrong sign, or the axes are mirrored.',
                _but(values, response @ s - np.eye(3)),
                of_body_axes=True,
            )


def _channel_words(signed: Floats) -> str:
    words = []
    for i in range(3):
        j = int(np.argmax(np.abs(signed[i])))
        if signed[i, j] != 1.0 or i != j:
            words.append(f'{AXES[i]} is {"-" if signed[i, j] < 0 else ""}{AXES[j]}')
    return ', '.join(words)


def share_in_words(share: float, *, gyros: bool) -> str:
    """Return what may cause a factor on the outputs."""
    for known, words in _SHARES[gyros].items():
        if abs(share / known - 1) < _ALIKE_HYPOTHESES:
            return words
    return 'the nominal scale factor or the units are not those of the recording'


_EXPLAINED = 1e-5
"""Chi-square probability above which a hypothesis explains the residuals; small, since hypotheses
are tried only after the session failed."""
_AS_GOOD = 3.0
"""Logarithm of odds, 20: strong evidence (Kass and Raftery 1995). Hypotheses nearer to the best are
named too."""
_ODDS = 6.0  #: Logarithm of prior odds of 400 to 1 for a plain mistake; a judgement.
_NOISE = 1e-3
"""Chi-square probability above which residuals are noise: one sound session of a thousand has
less."""
_ENOUGH = 8.0  #: Fewest degrees of freedom left by new parameters: with fewer, any fit succeeds.
_HALF = 0.5
"""Share of the determined parameters that must have changed to name another unit. A judgement."""
_FAR = 0.05
"""Relative scale change that indicates another unit of measurement; sensors drift far less."""
_DETERMINED = 0.3
"""Ratio of std to prior std below which the session determines a parameter: a tenth in variance."""
_LARGEST_ROTATION = 3 * DEG  #: rad: linear equations neglect half its square, a thousandth.
_NO_SENSE = 1.0 * DEG  #: Noise-to-signal ratio above which accelerometers determine no direction.
_WIDE = {ParameterKind.SCALE_FACTOR_ERROR: 0.2, ParameterKind.MISALIGNMENT: 0.2}
"""Prior standard deviations, ratios and rad, of an unknown unit: for kinds without a largest
plausible amount."""
_WIDE_BIAS = {'g': 0.05, 'a': 0.5}
"""The same of biases, rad/s and m/s^2: 3 deg/s and 50 mg. A choice."""
_WIDE_G = 1e-3  #: s/m: prior standard deviation of g-sensitivity of an unknown unit.
_OF_TERMS = {term.kind for term in TERMS}  #: Kinds that belong to terms.
_ALL_BUT_ZERO = 1e-9  #: Tolerance on a factor of one: far above rounding, far below any wrong unit.
_FREED = {
    ParameterKind.BIAS: ('the biases are others', ''),
    ParameterKind.SCALE_FACTOR_ERROR: ('the scale factors are others', ''),
    ParameterKind.MISALIGNMENT: (
        'the misalignments are others',
        "The unit or its axes have moved, or the table's positioning error is as large "
        '(positioning in its YAML).',
    ),
}
"""Condition and cause where freed parameters of a kind explain a session; without one, they have
moved with temperature or time."""
_SAME_TEMPERATURE = 0.1
"""K between two sessions below which it is one temperature: sensors in IMUs resolve no less. A
judgement."""
_ALIKE = '; or, if all are off alike, gravity or latitude are other than for the calibration.'


@dataclass(frozen=True, eq=False)
class ShiftedParameter:
    """A parameter with another value in the session: difference and its std, SI units."""

    parameter: Parameter
    difference: float
    std: float

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            'name': self.parameter.name,
            'difference': float(self.difference),
            'std': float(self.std),
            'unit': self.parameter.unit.si,
        }


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is wrong, in a sentence, and the parameters that have changed."""

    symptom: str
    moved: tuple[ShiftedParameter, ...] = ()
    by_biases: bool = False  #: Whether other biases explain everything, and nothing else does.


def refitted_parameters(system: TriadSystem) -> Fit:
    """Fit all parameters, starting from an error-free unit: residuals are those of any calibration.

    The outputs are read as the recording describes them.
    """
    return replace(system, reading=1.0).fit(np.zeros(len(system.sensors.parameters)), _wide(system))


def shows_scatter(system: TriadSystem) -> bool:
    """Return whether the residuals exceed the noise of the system for any parameters."""
    return refitted_parameters(system).chance <= _NOISE


def with_true_noise(system: TriadSystem) -> TriadSystem:
    """Widen the noise to the scatter that remains with all parameters fitted.

    Biases drift as the data sheet states, as far as the session shows it. Residuals explained by a
    term that the calibration lacks are not scatter.

    Raises:
        NotObservable: The scatter is too large to judge any calibration.
    """
    if system.spec.bias_instability:
        system = _with_shown_drift(system)
    if system.up is not None:
        return system
    fit, scatter = _explained(system)
    system = replace(system, scatter=scatter, seen=fit.unknown)
    spread = system.spread(np.zeros(len(system.sensors.parameters)))
    noise = np.sqrt(np.median(np.diagonal(spread, axis1=1, axis2=2))) / system.reading
    if not system.gyros and noise > _NO_SENSE * system.magnitude:
        raise NotObservable(
            'No parameters whatever explain the accelerometers of this recording: plan, table, '
            'mounting or the description of the IMU are not those of the recording.'
        )
    return system


def _with_shown_drift(system: TriadSystem) -> TriadSystem:
    """Let biases drift as stated, as far as the session shows it."""
    drifting = replace(system, drift=1.0)
    fit, calm = refitted_parameters(drifting), replace(system, reading=1.0)
    if not fit.converged:
        return drifting
    return replace(system, drift=calm.shown_drift(*_about(calm, fit)))


def _explained(system: TriadSystem) -> tuple[Fit, Scatter]:
    """Return the fit of all parameters, and of missing terms that it shows, and what scatters.

    The most significant term is added until none is, if the residuals are then noise.
    """
    fit, read = refitted_parameters(system), replace(system, reading=1.0)
    scatter = read.likely_scatter(*_about(read, fit))
    terms = _missing_terms(system)
    if fit.chance > _NOISE:
        return fit, Scatter(at_rest=scatter.at_rest)
    if not terms or scatter.at_rest < _ENOUGH:
        return fit, scatter
    larger = [_with_more(read, term.parameters) for term in terms]
    chances = [_log_chance(one, fit, scatter.freedom) for one in larger]
    best = int(np.argmin(chances))
    if chances[best] > np.log(_EXPLAINED):
        return fit, scatter
    better, remains = _explained(_with_more(system, terms[best].parameters))
    # Terms that leave more may stand for something else, such as a wrong latitude; with few
    # dwells, many terms fit any error.
    explained = better.chance > _NOISE and remains.at_rest >= _ENOUGH
    return (better, remains) if explained else (fit, scatter)


def _about(system: TriadSystem, fit: Fit) -> tuple[Floats, Floats, Floats]:
    """Return the whitened equations about a fit of the first parameters, and the state."""
    wide = _wide(system)
    values = np.pad(fit.delta, (0, len(wide) - len(fit.delta)))
    point, state = (np.append(v, fit.unknown) for v in (values / np.diag(wide), values))
    return *system.allowing(np.zeros(len(wide)), wide)(point), state


def _log_chance(system: TriadSystem, fit: Fit, freedom: float) -> float:
    """Return the logarithm of the chance that the parameters that a fit lacks explain as much.

    By one linear step from the fit, whose residuals have some degrees of freedom.
    """
    columns, residuals, _ = _about(system, fit)
    count = len(system.sensors.parameters) - len(fit.delta)
    if freedom <= count:
        return 0.0
    after = least_square(columns, residuals)
    ratio = max(fit.chi_square - after, 0.0) / count / (after / (freedom - count))
    return log_f(ratio, count, freedom - count)


def _with_more(system: TriadSystem, parameters: Sequence[Parameter]) -> TriadSystem:
    """Return a system with those of some parameters that it lacks, last."""
    every = tuple(dict.fromkeys((*system.sensors.parameters, *parameters)))
    return replace(system, sensors=replace(system.sensors, parameters=every))


def diagnose(system: TriadSystem, values: Floats, factor: Floats, without: float) -> Diagnosis:
    """Fit the candidate mistakes and return the one that explains the data.

    Args:
        system: The session's equations for one triad, with the estimated noise.
        values: (p,) of the triad's parameters in the calibration.
        factor: (p, k) of their covariance.
        without: Chi-square of the calibration as it is.
    """
    name, good = _name(system), []
    plain = mistakes(system.sensors, values)
    for one in (*plain, *_readings(system, values), *_freed(system, values)):
        if one.of_body_axes and system.up is not None:
            continue
        fit = one.fit(system, factor)
        if fit is None or fit.chance <= _EXPLAINED:
            continue
        if not (one.mount_free and np.linalg.norm(fit.unknown[-3:]) > _LARGEST_ROTATION):
            good.append((one.evidence(fit, without), one.found(fit), fit))
    if not good:
        return _another_unit(system, values, factor)
    best = max(evidence for evidence, _, _ in good)
    (first, fit), *others = [(h, f) for e, h, f in good if e >= best - _AS_GOOD]
    text = f'The residuals of the {name} vanish when {first.when}. {first.why}'
    if others:
        also = '; '.join(other.when for other, _ in others[:3])
        text = f'{text.removesuffix(".")} (as good: {also}).'
    parameters = tuple(dict.fromkeys((*system.sensors.parameters, *first.freed)))
    # What the calibration leaves open of its values is part of a difference from them.
    own = np.linalg.norm(factor, axis=1)
    differing = replace(fit, std=np.hypot(fit.std, np.pad(own, (0, len(parameters) - len(own)))))
    far = _shifted_parameters(parameters, differing, indices_of(first.freed, parameters))
    biases = bool(first.freed) and all(p.kind is ParameterKind.BIAS for p in first.freed)
    return Diagnosis(text, far, biases and not others)


def _name(system: TriadSystem) -> str:
    return 'gyros' if system.gyros else 'accelerometers'


def _readings(system: TriadSystem, values: Floats) -> Iterator[Hypothesis]:
    """Yield other scales of the outputs: the recording's own, and the best-fitting one."""
    if abs(system.reading - 1) > _ALL_BUT_ZERO:
        yield Hypothesis(
            f'the outputs are read as the recording describes them ({system.observed.imu.id})',
            'Units or nominal scale factor of the file are not those of the recording: '
            f'it reads {system.reading:.6g} times too much.',
            values,
            1 / system.reading,
        )
    share = system.share(values)
    if share > 0:
        yield Hypothesis(*_scale_cause(system, share), values, share)


def _scale_cause(system: TriadSystem, share: float) -> tuple[str, str]:
    """Return condition and cause of a scale change; a small one is common to all channels."""
    if abs(share - 1) > _FAR:
        words = share_in_words(share, gyros=system.gyros)
        return (
            f'the outputs are multiplied by {share:.5g}',
            f'They are of another scale than the file says: {words}.',
        )
    if system.gyros:
        ppm = (1 / share - 1) / PPM
        return (
            f'all gyros answer {abs(ppm):.1f} ppm {"more" if ppm > 0 else "less"}',
            f'Possible causes: {_of_temperature(system, ppm)}the clock of the IMU, or another '
            'nominal scale factor.',
        )
    return (
        f'gravity is {system.magnitude / share:.5f} m/s^2 instead of {system.magnitude:.5f}',
        'Latitude, height or gravity are not those of the recording, or not those of the '
        'calibration; or all accelerometers have changed alike.',
    )


def _of_temperature(system: TriadSystem, ppm: float) -> str:
    """Return temperature as a cause of a change of the scale factors, first of several.

    One session at one temperature does not tell it from the others.
    """
    warmer = system.observed.warmer
    if warmer is None:
        return 'another temperature, '
    if abs(warmer) < _SAME_TEMPERATURE:
        return ''
    return (
        f'the temperature (the recording is {_other_temperature(warmer)}; '
        f'{abs(ppm / warmer):.2g} ppm/K suffice), '
    )


def _other_temperature(warmer: float) -> str:
    return f'{abs(warmer):.1f} K {"warmer" if warmer > 0 else "colder"}'


def _moved_by(system: TriadSystem) -> str:
    """Return why parameters have moved, a sentence."""
    warmer = system.observed.warmer
    if warmer is None:
        return 'They have moved: another temperature, or time.'
    if abs(warmer) < _SAME_TEMPERATURE:
        return 'They have moved with time: the temperature is that of the calibration.'
    return (
        f'They have moved: the recording is {_other_temperature(warmer)} than the calibration, or '
        'with time.'
    )


def _freed(system: TriadSystem, values: Floats) -> Iterator[Hypothesis]:
    """Yield other parameters of the mount, of one kind, or of a missing term."""
    mine = system.sensors.parameters
    if system.up is None:
        # Before the misalignments, of which it is a special case.
        why = 'It sits otherwise in its mount than when it was calibrated.'
        yield Hypothesis('the unit is turned', why, values, mount_free=True)
    for kind in dict.fromkeys((*_FREED, *(p.kind for p in mine))):
        when, why = _words(kind)
        why = why or _moved_by(system)
        if kind is ParameterKind.SCALE_FACTOR_ERROR and not system.gyros:
            why = why.removesuffix('.') + _ALIKE
        freed = tuple(p for p in mine if p.kind is kind)
        yield Hypothesis(when, why, values, freed=freed)
    for term in _missing_terms(system):
        why = f'The calibration was made without it: calibrate with the term {term.name} (`terms`).'
        yield Hypothesis(f'{term.name} is in the model', why, values, freed=term.parameters)


def _shifted_parameters(
    parameters: Sequence[Parameter], fit: Fit, columns: Sequence[int]
) -> tuple[ShiftedParameter, ...]:
    """Return the parameters whose fitted values differ significantly."""
    moved = [
        ShiftedParameter(parameters[k], float(fit.delta[k]), float(fit.std[k])) for k in columns
    ]
    return tuple(m for m in moved if abs(m.difference) > FIVE_SIGMA * m.std)


def _missing_terms(system: TriadSystem) -> list[Term]:
    """Return the terms of the triad that the parameters lack."""
    known = {p.kind for p in system.sensors.parameters}
    return [t for t in TERMS if (t.triad == 'g') is system.gyros and t.kind not in known]


def _another_unit(system: TriadSystem, values: Floats, factor: Floats) -> Diagnosis:
    """Compare with refitted parameters, since no single mistake explains the data."""
    name, fit = _name(system), refitted_parameters(system)
    apart = fit.delta - values
    if not fit.converged:
        # Biases of degrees per second are nearer to the calibration than to an error-free unit.
        fit = replace(system, reading=1.0).fit(values, _wide(system))
        apart = fit.delta
    if not fit.converged:
        return Diagnosis(
            f'No single mistake explains the {name}, and no other parameters were found that do '
            '(the search did not converge). Calibrate this recording, and compare the two.'
        )
    determined = np.flatnonzero(fit.std < _DETERMINED * np.diag(_wide(system)))
    changed = replace(fit, delta=apart, std=np.hypot(fit.std, np.linalg.norm(factor, axis=1)))
    far = _shifted_parameters(system.sensors.parameters, changed, determined.tolist())
    only_biases = all(m.parameter.kind is ParameterKind.BIAS for m in far)
    # Not by the stated drift, which no data need show. Lengths hardly do.
    changing = shows_scatter(replace(system, drift=0.0)) or (system.up is not None and not far)
    if changing and only_biases:
        return Diagnosis(
            f'No constant parameters explain the {name}, and none but biases is off: these drifted '
            'or stepped within the recording, or the unit moved in its static dwells. Record anew '
            'once the unit is warm, in one run of it.',
            far,
            by_biases=True,
        )
    if len(far) >= _HALF * len(determined):
        return Diagnosis(
            f'No single mistake explains the {name}, other parameters do: {len(far)} of the '
            f'{len(determined)} that the session determines are off. The calibration is that of '
            'another unit, or the unit has changed.',
            far,
        )
    which = 'these have moved' if far else 'several moved, none by five standard deviations'
    return Diagnosis(f'No single mistake explains the {name}, other parameters do: {which}.', far)


def _wide(system: TriadSystem) -> Floats:
    """Return wide prior standard deviations of the parameters as a diagonal matrix (p, p)."""
    return np.diag([_width(p) for p in system.sensors.parameters])


def _width(parameter: Parameter) -> float:
    if parameter.kind is ParameterKind.BIAS:
        return _WIDE_BIAS[parameter.triad]
    if parameter.kind is ParameterKind.G_SENSITIVITY:
        return _WIDE_G
    limit = parameter.unit.limit
    return _WIDE[parameter.kind] if limit is None else limit


def _words(kind: ParameterKind) -> tuple[str, str]:
    """Return condition and cause for freed parameters of a kind."""
    if kind in _OF_TERMS:
        return f'the {kind.value.words} is another', 'It has moved, or is that of another unit.'
    return _FREED[kind]
