"""Find which mistake explains a rejected calibration: fit and score each hypothesis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ..common.errors import NotObservable
from ..common.rotations import FIVE_SIGMA
from ..common.stream import Floats
from ..common.units import ARCMIN, DEG, PPM
from ..estimation.system import Fit, TriadSystem
from ..model.parameters import Parameter, ParameterKind
from ..model.terms import TERMS, Term
from .hypotheses import Hypothesis, mistakes, share_in_words

_EXPLAINED = 1e-5
"""Chi-square probability above which a hypothesis explains the residuals; small, since hypotheses
are tried only after the session failed."""
_AS_GOOD = 6.0
"""Difference in Schwarz's criterion: strong evidence (Kass and Raftery 1995). Hypotheses nearer to
the best are named too."""
_ODDS = 12.0
"""In Schwarz's criterion: prior odds of 400 to 1 for a plain mistake; a judgement."""
_EXCESS = 1e-3
"""Chi-square probability below which residuals show excess scatter. A choice: in one sound session
of a thousand."""
_ENOUGH = 8.0
"""Fewest degrees of freedom left by new parameters: with fewer, any fit succeeds."""
_HALF = 0.5
"""Share of the determined parameters that must have changed to name another unit. A judgement."""
_FAR = 0.05
"""Relative scale change that indicates another unit of measurement; sensors drift far less."""
_DETERMINED = 0.3
"""Ratio of std to prior std below which the session determines a parameter: a tenth in variance."""
_LARGEST_ROTATION = 3 * DEG
"""rad: linear equations neglect half its square, a thousandth."""
_NO_SENSE = 1.0 * DEG
"""Noise-to-signal ratio above which accelerometers determine no direction."""
_WIDE = {ParameterKind.SCALE_FACTOR_ERROR: 0.2, ParameterKind.MISALIGNMENT: 0.2}
"""Prior standard deviations, ratios and rad, of an unknown unit: for kinds without a largest
plausible amount."""
_WIDE_BIAS = {'g': 0.05, 'a': 0.5}
"""The same of biases, rad/s and m/s^2: 3 deg/s and 50 mg. A choice."""
_WIDE_G = 1e-3
"""s/m: prior standard deviation of g-sensitivity of an unknown unit."""
_OF_TERMS = {term.kind for term in TERMS}
"""Kinds that belong to terms."""
_ALL_BUT_ZERO = 1e-9
"""Tolerance on a factor of one: far above rounding, far below any wrong unit."""
_FREED = {
    ParameterKind.BIAS: ('the biases are others', 'They have moved: another temperature, or time.'),
    ParameterKind.SCALE_FACTOR_ERROR: (
        'the scale factors are others',
        'They have moved: temperature, or time.',
    ),
    ParameterKind.MISALIGNMENT: (
        'the misalignments are others',
        "The unit or its axes have moved, or the table's positioning error is as large "
        '(positioning in its YAML).',
    ),
}
"""Condition and cause where freed parameters of a kind explain a session."""
_ALIKE = ' Where all are off alike, gravity or latitude are other than for the calibration.'


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


@dataclass(frozen=True, eq=False)
class _Tried:
    """A fitted hypothesis; the number of freed parameters counts against it."""

    diagnosis: Diagnosis
    when: str
    fit: Fit
    freed: int = 0

    def score(self) -> float:
        """Return Schwarz's criterion, with odds in favour of a plain mistake."""
        price = self.freed * float(np.log(max(self.fit.freedom, 2)))
        return self.fit.chi_square + price + (_ODDS if self.freed else 0.0)


def refitted_parameters(system: TriadSystem) -> Fit:
    """Fit all parameters, starting from an error-free unit: residuals are those of any calibration.

    The outputs are read as the recording describes them.
    """
    return replace(system, reading=1.0).fit(np.zeros(len(system.sensors.parameters)), _wide(system))


def _refitted_from(nested: Fit, system: TriadSystem) -> tuple[float, Callable[[], Fit]]:
    """Start `refitted_parameters` at a fit of its first parameters; see `TriadSystem.begun`."""
    count, wide = len(system.sensors.parameters), _wide(system)
    delta = np.pad(nested.delta, (0, count - len(nested.delta)))
    begin = np.append(delta / np.diag(wide), nested.unknown)
    return replace(system, reading=1.0).begun(np.zeros(count), wide, begin)


def with_true_noise(system: TriadSystem) -> TriadSystem:
    """Widen the noise to the scatter that remains with all parameters fitted.

    With few dwells, or lengths alone, scatter cannot be estimated: the bias instability of the data
    sheet is used. Residuals explained by a term that the calibration lacks are not scatter.

    Raises:
        NotObservable: The scatter is too large to judge any calibration.
    """
    with_drift = replace(system, bias_drift=system.spec.bias_instability)
    if system.up is not None:
        return with_drift
    without = refitted_parameters(system)
    if without.spare < _ENOUGH:
        system, without = with_drift, _refitted_from(without, with_drift)[1]()
    fit = _with_missing_terms(system, without)
    if _scatters(fit):
        system = system.inflated(fit.ratios)
        fit = _with_missing_terms(system, _refitted_from(without, system)[1]())
    if _scatters(fit):
        system = system.inflated(fit.ratios)
    spread = system.spread(np.zeros(len(system.sensors.parameters)))
    noise = np.sqrt(np.median(np.diagonal(spread, axis1=1, axis2=2))) / system.reading
    if not system.gyros and noise > _NO_SENSE * system.magnitude:
        raise NotObservable(
            'No parameters whatever explain the accelerometers of this recording: plan, table, '
            'mounting or the description of the IMU are not those of the recording.'
        )
    return replace(system, seen=fit.unknown)


def _with_missing_terms(system: TriadSystem, without: Fit) -> Fit:
    """Return the fit of all parameters, extended by terms if these remove all excess scatter.

    Terms are added one at a time, the one that explains most first. A term counts if the F test
    gives its reduction of chi-square a probability below `_EXPLAINED`.
    """
    fit = without
    while _scatters(fit):
        begun = [(*_refitted_from(fit, larger), larger) for _, larger in _with_another(system)]
        if not begun:
            return without
        best, larger = _best(begun, fit.chi_square)
        count = len(larger.sensors.parameters) - len(system.sensors.parameters)
        freedom = best.freedom - len(larger.sensors.parameters)
        # With few dwells, many terms fit any error.
        if freedom < 1 or best.spare < _ENOUGH:
            return without
        ratio = (fit.chi_square - best.chi_square) / count / (best.chi_square / freedom)
        if scipy.special.fdtrc(count, freedom, ratio) > _EXPLAINED:
            return without
        fit, system = best, larger
    return fit


def _best(
    begun: list[tuple[float, Callable[[], Fit], TriadSystem]], before: float
) -> tuple[Fit, TriadSystem]:
    """Return the fit of least chi-square among candidates, and its system.

    Each candidate comes with its chi-square by the linear equations, and `before` is chi-square at
    the start. A candidate is fitted only if its linear reduction is at least half of the best
    reduction so far: the factor of two allows for nonlinearity.
    """
    (_, fitted, best), *others = sorted(begun, key=lambda one: one[0])
    found = fitted()
    for square, fitted, system in others:
        if 2 * (before - square) < before - found.chi_square:
            break
        fit = fitted()
        if fit.chi_square < found.chi_square:
            found, best = fit, system
    return found, best


def _scatters(fit: Fit) -> bool:
    return bool(scipy.special.chdtrc(max(fit.freedom, 1), fit.chi_square) < _EXCESS)


def diagnose(system: TriadSystem, values: Floats, factor: Floats) -> Diagnosis:
    """Fit the candidate mistakes and return the one that explains the data.

    Args:
        system: The session's equations for one triad, with the estimated noise.
        values: (p,) of the triad's parameters in the calibration.
        factor: (p, k) of their covariance.
    """
    name = 'gyros' if system.gyros else 'accelerometers'
    tried = [*_mistaken(system, values, factor), *_freed(system, values, factor)]
    good = [t for t in tried if t.fit.chance > _EXPLAINED]
    if not good:
        return _another_unit(system, values, factor, name)
    best = min(t.score() for t in good)
    first, *others = [t for t in good if t.score() < best + _AS_GOOD]
    text = f'The residuals of the {name} vanish when {first.when}. {first.diagnosis.symptom}'
    if others:
        text += f' As good: {"; ".join(t.when for t in others[:3])}.'
    return replace(first.diagnosis, symptom=text)


def _fit(
    system: TriadSystem, values: Floats, factor: Floats, chance: float = _EXPLAINED
) -> Fit | None:
    """Fit a hypothesis; None if it fails or the model has no inverse.

    With six lengths, nine parameters of a term are held by their prior alone and may diverge.
    """
    try:
        return system.fit_likely(values, factor, chance)
    except (np.linalg.LinAlgError, NotObservable):
        return None


def _mistaken(system: TriadSystem, values: Floats, factor: Floats) -> Iterator[_Tried]:
    """Fit mistakes in the calibration file and in the reading of the outputs."""
    likely = system.likely(values, factor, _EXPLAINED)
    for mistake in (*mistakes(system.sensors, values), *_readings(system, values)):
        if mistake.of_body_axes and system.up is not None:
            continue
        # Without a factor on the outputs, the session's equations are reused.
        read = system
        if mistake.reading != 1:
            read = replace(system, reading=system.reading * mistake.reading)
        elif not likely(mistake.values):
            continue
        if fit := _fit(read, mistake.values, factor):
            yield _Tried(Diagnosis(mistake.why), mistake.when, fit)


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
        yield Hypothesis(*_of_scale(system, share), values, share)


def _of_scale(system: TriadSystem, share: float) -> tuple[str, str]:
    """Return condition and cause of a scale change; a small one is common to all channels."""
    if abs(share - 1) > _FAR:
        words = share_in_words(share, gyros=system.gyros)
        return (
            f'the outputs are multiplied by {share:.5g}',
            f'They are of another scale than the file says: {words}.',
        )
    if system.gyros:
        return (
            f'all gyros answer {(1 / share - 1) / PPM:+.1f} ppm more',
            'The clock of the IMU, or the nominal scale factor, is not what it was.',
        )
    return (
        f'gravity is {system.magnitude / share:.5f} m/s^2 instead of {system.magnitude:.5f}',
        'Latitude, height or gravity are not those of the recording, or not those of the '
        'calibration; or all accelerometers have changed alike.',
    )


def _freed(system: TriadSystem, values: Floats, factor: Floats) -> Iterator[_Tried]:
    """Free parameters of one kind, of a missing term, or of the mount, and fit."""
    mine = system.sensors.parameters
    for kind in dict.fromkeys((*_FREED, *(p.kind for p in mine))):
        columns = [k for k, p in enumerate(mine) if p.kind is kind]
        when, why = _words(kind)
        if kind is ParameterKind.SCALE_FACTOR_ERROR and not system.gyros:
            why += _ALIKE
        yield from _without(system, values, factor, columns, when, why)
    for term, larger in _with_another(system):
        columns = list(range(len(mine), len(larger.sensors.parameters)))
        when = f'{term.name} is in the model'
        why = f'The calibration was made without it: calibrate with the term {term.name} (`terms`).'
        yield from _without(larger, values, factor, columns, when, why)
    if system.up is None:
        # A large rotation is nonlinear: its minimum is always searched for.
        fit = replace(system, mount_free=True).fit(values, factor)
        mounted = fit.unknown[-3:]
        about = ', '.join(
            f'{v / ARCMIN:+.2f} arcmin about {axis}' for v, axis in zip(mounted, 'XYZ', strict=True)
        )
        why = 'It sits otherwise in its mount than when it was calibrated.'
        if np.linalg.norm(mounted) < _LARGEST_ROTATION:
            yield _Tried(Diagnosis(why), f'the unit is turned by {about}', fit, 3)


def _without(
    system: TriadSystem, values: Floats, factor: Floats, columns: list[int], when: str, why: str
) -> Iterator[_Tried]:
    """Free the parameters of some columns; those that the calibration lacks come last."""
    more = len(system.sensors.parameters) - len(values)
    freed = np.hstack([np.pad(factor, ((0, more), (0, 0))), _wide(system)[:, columns]])
    # Lengths are nonlinear in freed parameters: their minimum is always searched for.
    if fit := _fit(system, np.pad(values, (0, more)), freed, 0.0 if system.up else _EXPLAINED):
        far = _shifted_parameters(system.sensors.parameters, fit, columns)
        yield _Tried(Diagnosis(why, far), when, fit, len(columns))


def _shifted_parameters(
    parameters: Sequence[Parameter], fit: Fit, columns: Sequence[int]
) -> tuple[ShiftedParameter, ...]:
    """Return the parameters whose fitted values differ significantly."""
    moved = [
        ShiftedParameter(parameters[k], float(fit.delta[k]), float(fit.std[k])) for k in columns
    ]
    return tuple(m for m in moved if abs(m.difference) > FIVE_SIGMA * m.std)


def _with_another(system: TriadSystem) -> Iterator[tuple[Term, TriadSystem]]:
    """Yield each term of the triad that the parameters lack, and the system with it."""
    mine = system.sensors.parameters
    for term in TERMS:
        if (term.triad == 'g') is system.gyros and term.kind not in {p.kind for p in mine}:
            larger = replace(system.sensors, parameters=(*mine, *term.parameters))
            yield term, replace(system, sensors=larger)


def _another_unit(system: TriadSystem, values: Floats, factor: Floats, name: str) -> Diagnosis:
    """Compare with refitted parameters, since no single mistake explains the data."""
    fit = refitted_parameters(system)
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
    if len(far) >= _HALF * len(determined):
        return Diagnosis(
            f'No single mistake explains the {name}, other parameters do: {len(far)} of the '
            f'{len(determined)} that the session determines are off. The calibration is that of '
            'another unit, or the unit has changed.',
            far,
        )
    return Diagnosis(
        f'No single mistake explains the {name}, other parameters do: these have moved.', far
    )


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
