"""Which mistake a calibration suffers from: the candidates are tried, and the data decides."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from ..errors import NotObservable
from ..model import TERMS, Parameter, ParameterKind, Term
from ..stream import Floats
from ..units import ARCMIN, DEG, PPM
from .hypotheses import Hypothesis, mistakes, share_in_words
from .system import Fit, TriadSystem

_EXPLAINED = 1e-5
"""Probability of a chi-square from which on a change explains what is left; small, since the
changes are looked at only after the session failed."""
_AS_GOOD = 6.0
"""Of Schwarz's criterion: strong evidence (Kass and Raftery 1995); what is nearer is named too."""
_ODDS = 12.0
"""Of Schwarz's criterion: odds of 400 to 1 for a plain mistake beforehand; a judgement."""
_EXCESS = 1e-3
"""Probability of chance below which residuals scatter."""
_ENOUGH = 8.0
"""Degrees of freedom that new parameters must leave: fewer fit whatever is wrong."""
_MOVED = 5.0
"""Standard deviations: false in 1e-5 of 24 parameters."""
_HALF = 0.5
"""Of the parameters that the session determines: so many have moved in another unit."""
_FAR = 0.05
"""Share by which a scale is another unit of measurement; sensors drift by far less."""
_DETERMINED = 0.3
"""Of what was known beforehand: the session determines it, ten times in variance."""
_LARGEST_ROTATION = 3 * DEG
"""rad: the equations are linear, and leave out half the square of it, a thousandth."""
_NO_SENSE = 1.0 * DEG
"""Noise over signal from which on accelerometers tell no direction."""
_WIDE = {ParameterKind.SCALE_FACTOR_ERROR: 0.2, ParameterKind.MISALIGNMENT: 0.2}
"""Ratios, and rad, before anything is known of a unit: of what has no largest amount that any may
have."""
_WIDE_BIAS = {'g': 0.05, 'a': 0.5}
_WIDE_G = 1e-3
"""s/m: g-sensitivity before anything is known of a unit."""
_OF_TERMS = {term.kind for term in TERMS}
"""Kinds of which nothing is known but their words."""
_ALL_BUT_ZERO = 1e-9
"""By how much a factor that is one may differ from it: what rounding leaves is far below, any wrong
unit far above."""
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
"""What is said where parameters of a kind, let go of, explain a session; of terms their words."""
_ALIKE = ' Where all are off alike, gravity or latitude are other than for the calibration.'


@dataclass(frozen=True, eq=False)
class ShiftedParameter:
    """A parameter that the session sees elsewhere: by how much, and its deviation, SI units."""

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
    """What is wrong, in a sentence, and the parameters that are elsewhere."""

    symptom: str
    moved: tuple[ShiftedParameter, ...] = ()


@dataclass(frozen=True, eq=False)
class _Tried:
    """A hypothesis as the data judges it: what it frees counts against it."""

    diagnosis: Diagnosis
    when: str
    fit: Fit
    freed: int = 0

    def score(self) -> float:
        """Schwarz's criterion, with odds in favour of a plain mistake."""
        price = self.freed * float(np.log(max(self.fit.freedom, 2)))
        return self.fit.chi_square + price + (_ODDS if self.freed else 0.0)


def refitted_parameters(system: TriadSystem) -> Fit:
    """Fit all parameters anew, from a unit without errors: what no calibration explains is left.

    The outputs are taken as the recording describes them.
    """
    return replace(system, reading=1.0).fit(np.zeros(len(system.sensors.parameters)), _wide(system))


def _refitted_from(nested: Fit, system: TriadSystem) -> tuple[float, Callable[[], Fit]]:
    """Begin `refitted_parameters` at a fit of its first parameters, as `TriadSystem.begun` does."""
    count, wide = len(system.sensors.parameters), _wide(system)
    delta = np.pad(nested.delta, (0, count - len(nested.delta)))
    begin = np.append(delta / np.diag(wide), nested.unknown)
    return replace(system, reading=1.0).begun(np.zeros(count), wide, begin)


def with_true_noise(system: TriadSystem) -> TriadSystem:
    """Widen the noise to what the session scatters by, whatever the parameters.

    A session of few dwells, or of lengths alone, cannot tell: the data sheet's bias instability
    then counts. What a term explains that the calibration does not have is no scatter.

    Raises:
        NotObservable: It scatters so much that no calibration can be judged by it.
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
    """Return a fit of all parameters, or one with terms where they leave nothing but noise.

    Terms are no scatter. The next is the one that explains most, and counts where chi-square falls
    by what scatter of the size that it leaves makes of nothing once in a hundred thousand sessions
    (F test).
    """
    fit = without
    while _scatters(fit):
        begun = [(*_refitted_from(fit, larger), larger) for _, larger in _with_another(system)]
        if not begun:
            return without
        best, larger = _best(begun, fit.chi_square)
        count = len(larger.sensors.parameters) - len(system.sensors.parameters)
        left = best.freedom - len(larger.sensors.parameters)
        # A few dwells fit many a term, whatever is wrong with them.
        if left < 1 or best.spare < _ENOUGH:
            return without
        ratio = (fit.chi_square - best.chi_square) / count / (best.chi_square / left)
        if scipy.special.fdtrc(count, left, ratio) > _EXPLAINED:
            return without
        fit, system = best, larger
    return fit


def _best(
    begun: list[tuple[float, Callable[[], Fit], TriadSystem]], before: float
) -> tuple[Fit, TriadSystem]:
    """Return the fit of least chi-square among those that promise one, and its system.

    What promises less than half of what the best has brought is not fitted: twice is left for what
    is not linear. Each comes with what chi-square would be if all were linear, and `before` is it
    where they begin.
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
    """Try the candidate mistakes and name the one that explains the data.

    Args:
        system: The session as one triad sees it, with its true noise.
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
    """Fit a hypothesis; None where nothing comes of it, or a model without an inverse.

    Six lengths hold nine parameters of a term by their prior alone: they go where they may.
    """
    try:
        return system.fit_likely(values, factor, chance)
    except (np.linalg.LinAlgError, NotObservable):
        return None


def _mistaken(system: TriadSystem, values: Floats, factor: Floats) -> Iterator[_Tried]:
    """Take the file, or the outputs, for what they are not."""
    for mistake in (*mistakes(system.sensors, values), *_readings(system, values)):
        if mistake.of_body_axes and system.up is not None:
            continue
        # Read as it is, the session's equations are not made anew.
        read = system
        if mistake.reading != 1:
            read = replace(system, reading=system.reading * mistake.reading)
        if fit := _fit(read, mistake.values, factor):
            yield _Tried(Diagnosis(mistake.why), mistake.when, fit)


def _readings(system: TriadSystem, values: Floats) -> Iterator[Hypothesis]:
    """Take the outputs for those of another scale: the recording's own, or any that fits."""
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
    """Say when outputs are multiplied by a share, and why: a small one is of all channels alike."""
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
    """Let go of some parameters, of a term, or of the mount: what has moved since."""
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
        # A large rotation is not linear: its minimum is always sought.
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
    """Let go of the parameters of some columns; those that the calibration lacks come last."""
    more = len(system.sensors.parameters) - len(values)
    freed = np.hstack([np.pad(factor, ((0, more), (0, 0))), _wide(system)[:, columns]])
    # Lengths are not linear in what may be anything: their minimum is always sought.
    if fit := _fit(system, np.pad(values, (0, more)), freed, 0.0 if system.up else _EXPLAINED):
        far = _far(system.sensors.parameters, fit, columns)
        yield _Tried(Diagnosis(why, far), when, fit, len(columns))


def _far(
    parameters: Sequence[Parameter], fit: Fit, columns: Sequence[int]
) -> tuple[ShiftedParameter, ...]:
    """Return which of some parameters a fit sees elsewhere."""
    moved = [
        ShiftedParameter(parameters[k], float(fit.delta[k]), float(fit.std[k])) for k in columns
    ]
    return tuple(m for m in moved if abs(m.difference) > _MOVED * m.std)


def _with_another(system: TriadSystem) -> Iterator[tuple[Term, TriadSystem]]:
    """Return terms of the triad that the parameters lack, and the system with each."""
    mine = system.sensors.parameters
    for term in TERMS:
        if (term.triad == 'g') is system.gyros and term.kind not in {p.kind for p in mine}:
            larger = replace(system.sensors, parameters=(*mine, *term.parameters))
            yield term, replace(system, sensors=larger)


def _another_unit(system: TriadSystem, values: Floats, factor: Floats, name: str) -> Diagnosis:
    """Compare with parameters fitted anew, since no single mistake explains the data."""
    fit = refitted_parameters(system)
    apart = fit.delta - values
    if not fit.converged:
        # Biases of degrees a second are far from a unit without errors: nearer to the calibration.
        fit = replace(system, reading=1.0).fit(values, _wide(system))
        apart = fit.delta
    if not fit.converged:
        return Diagnosis(
            f'No single mistake explains the {name}, and no other parameters were found that do '
            '(the search did not converge). Calibrate this recording, and compare the two.'
        )
    determined = np.flatnonzero(fit.std < _DETERMINED * np.diag(_wide(system)))
    beside = replace(fit, delta=apart, std=np.hypot(fit.std, np.linalg.norm(factor, axis=1)))
    far = _far(system.sensors.parameters, beside, determined.tolist())
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
    """Return a prior that says little, (p, p): standard deviations of any unit's parameters."""
    return np.diag([_width(p) for p in system.sensors.parameters])


def _width(parameter: Parameter) -> float:
    if parameter.kind is ParameterKind.BIAS:
        return _WIDE_BIAS[parameter.triad]
    if parameter.kind is ParameterKind.G_SENSITIVITY:
        return _WIDE_G
    limit = parameter.unit.limit
    return _WIDE[parameter.kind] if limit is None else limit


def _words(kind: ParameterKind) -> tuple[str, str]:
    """Say when parameters of a kind are let go of, and why."""
    if kind in _OF_TERMS:
        return f'the {kind.value.words} is another', 'It has moved, or is that of another unit.'
    return _FREED[kind]
