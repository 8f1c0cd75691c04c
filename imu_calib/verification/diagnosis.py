"""Which mistake a calibration suffers from: the candidates are tried, and the data decides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..errors import NotObservable
from ..model import TERMS, Parameter, ParameterKind, SensorModel, Term
from ..stream import Floats
from ..units import ARCMIN, DEG, PPM
from .equations import Fit, Sensors, System
from .hypotheses import Hypothesis, mistakes, share_in_words

_EXPLAINED = 1e-5
_AS_GOOD = 6.0
_ODDS = 12.0
_EXCESS = 1e-3
_ENOUGH = 8.0
_MOVED = 5.0
_HALF = 0.5
_FAR = 0.05
_DETERMINED = 0.3
_LARGEST_ROTATION = 3 * DEG
_NO_SENSE = 1.0 * DEG
_WIDE = 0.2
_WIDE_BIAS = {'g': 0.05, 'a': 0.5}
_WIDE_G = 1e-3
_ALL_BUT_ZERO = 1e-9
_FREED = {
    ParameterKind.BIAS: (
        'the biases are others',
        'They have moved: another temperature, or time.',
    ),
    ParameterKind.SCALE_FACTOR_ERROR: (
        'the scale factors are others',
        'They have moved: temperature, or time.',
    ),
    ParameterKind.MISALIGNMENT: (
        'the misalignments are others',
        "The unit or its axes have moved, or the table's arrivals are off by as much "
        '(positioning in its YAML).',
    ),
}
"""What is said where parameters of a kind, let go of, explain a session; of terms their words."""


@dataclass(frozen=True, eq=False)
class Moved:
    """A parameter that the session sees elsewhere: by how much, and its deviation, SI units."""

    parameter: Parameter
    difference: float
    std: float


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is wrong, in a sentence, and the parameters that are elsewhere."""

    symptom: str
    moved: tuple[Moved, ...] = ()


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
        return self.fit.square + price + (_ODDS if self.freed else 0.0)


def new_parameters(system: System) -> Fit:
    """Fit all parameters anew, from a unit without errors: what no calibration explains is left.

    The outputs are taken as the recording describes them.
    """
    own = replace(system, reading=1.0)
    ideal = Sensors.of(SensorModel(), system.parameters, gyros=system.gyros)
    return own.fit(ideal, _wide(system))


def with_true_noise(system: System) -> System:
    """Widen the noise to what the session scatters by, whatever the parameters.

    A session of few rests, or of lengths alone, cannot tell: the data sheet's bias instability
    then counts. What a term explains that the calibration does not have is no scatter.

    Raises:
        NotObservable: It scatters so much that no calibration can be judged by it.

    """
    lengths_alone = not system.observed.with_attitudes
    if lengths_alone or new_parameters(system).spare < _ENOUGH:
        imu = system.observed.imu
        system = replace(system, wander=(imu.gyro if system.gyros else imu.accel).bias_instability)
    if lengths_alone:
        return system
    for _ in range(2):
        fit = _with_missing_terms(system)
        if not _scatters(fit):
            break
        system = system.inflated(fit.ratios)
    if system.gyros:
        return system
    sigma = float(np.sqrt(np.median(system.variances))) / system.reading
    if sigma > _NO_SENSE * system.magnitude:
        raise NotObservable(
            'No parameters whatever explain the accelerometers of this recording: plan, table, '
            'mounting or the description of the IMU are not those of the recording.'
        )
    return system


def _with_missing_terms(system: System) -> Fit:
    """Fit all parameters anew, with terms where they leave nothing but noise: they are no scatter.

    The next term is the one that explains most, and counts where chi-square falls by what scatter
    of the size that it leaves makes of nothing once in a hundred thousand sessions (F test).
    """
    without = fit = new_parameters(system)
    while _scatters(fit):
        tried = [
            (new_parameters(larger), larger)
            for term in TERMS
            if _lacks(system, term)
            for larger in [replace(system, parameters=(*system.parameters, *term.parameters))]
        ]
        if not tried:
            return without
        best, larger = min(tried, key=lambda one: one[0].square)
        count = len(larger.parameters) - len(system.parameters)
        left = best.freedom - len(larger.parameters)
        # A few rests fit many a term, whatever is wrong with them.
        if left < 1 or best.spare < _ENOUGH:
            return without
        ratio = (fit.square - best.square) / count / (best.square / left)
        if scipy.special.fdtrc(count, left, ratio) > _EXPLAINED:
            return without
        fit, system = best, larger
    return fit


def _scatters(fit: Fit) -> bool:
    return bool(scipy.special.chdtrc(max(fit.freedom, 1), fit.square) < _EXCESS)


def diagnose(system: System, sensors: Sensors, factor: Floats) -> Diagnosis:
    """Try the candidate mistakes and name the one that explains the data.

    Args:
        system: The session as one triad sees it, with its true noise.
        sensors: The triad as the calibration has it.
        factor: (p, k) of the covariance of its parameters.

    """
    name = 'gyros' if system.gyros else 'accelerometers'
    candidates = [*mistakes(sensors, gyros=system.gyros), *_readings(system, sensors)]
    tried = [
        _Tried(Diagnosis(h.why), h.when, fit)
        for h in candidates
        if (fit := _under(system, h, factor)) is not None
    ]
    tried += _freed(system, sensors, factor)
    good = [t for t in tried if t.fit.chance > _EXPLAINED]
    if not good:
        return _another_unit(system, sensors, factor, name)
    best = min(t.score() for t in good)
    first, *others = [t for t in good if t.score() < best + _AS_GOOD]
    text = f'The residuals of the {name} vanish when {first.when}. {first.diagnosis.symptom}'
    if others:
        text += f' As good: {"; ".join(t.when for t in others[:3])}.'
    return replace(first.diagnosis, symptom=text)


def _under(system: System, hypothesis: Hypothesis, factor: Floats) -> Fit | None:
    reading = system.reading * hypothesis.reading
    return _fit(replace(system, reading=reading), hypothesis.sensors, factor)


def _fit(system: System, sensors: Sensors, factor: Floats) -> Fit | None:
    """Fit a hypothesis; None where it comes to a model without an inverse, which is no unit's.

    Six lengths hold nine parameters of a term by their prior alone: they go where they may.
    """
    try:
        return system.fit(sensors, factor)
    except (np.linalg.LinAlgError, NotObservable):
        return None


def _readings(system: System, sensors: Sensors) -> list[Hypothesis]:
    """Take the outputs for those of another scale: the recording's own, or any that fits."""
    found = []
    if abs(system.reading - 1) > _ALL_BUT_ZERO:
        found.append(
            Hypothesis(
                f'the outputs are read as the recording describes them ({system.observed.imu.id})',
                'Units or nominal scale factor of the file are not those of the recording: '
                f'it reads {system.reading:.6g} times too much.',
                sensors,
                1 / system.reading,
            )
        )
    if system.observed.with_attitudes:
        rows = system.rows(
            sensors, system.world, np.zeros((len(system.parameters), 1)), level_known=True
        )
        seen, expected = rows.outputs / rows.sigma, (rows.outputs - rows.residual) / rows.sigma
        share = float(seen @ expected) / float(seen @ seen)
    else:
        length = np.linalg.norm(system.outputs - sensors.triad.bias, axis=1)
        share = system.magnitude / float(np.median(length))
    if not share > 0:
        return found
    if abs(share - 1) <= _FAR:
        found.append(_all_alike(system, sensors, share))
    else:
        found.append(
            Hypothesis(
                f'the outputs are multiplied by {share:.5g}',
                f'They are of another scale than the file says: '
                f'{share_in_words(share, gyros=system.gyros)}.',
                sensors,
                share,
            )
        )
    return found


def _all_alike(system: System, sensors: Sensors, share: float) -> Hypothesis:
    """Take all three channels for wrong by one and the same small factor."""
    if system.gyros:
        return Hypothesis(
            f'all gyros answer {(1 / share - 1) / PPM:+.1f} ppm more',
            'The clock of the IMU, or the nominal scale factor, is not what it was.',
            sensors,
            share,
        )
    return Hypothesis(
        f'gravity is {system.magnitude / share:.5f} m/s^2 instead of {system.magnitude:.5f}',
        'Site, latitude, height or --gravity are not those of the recording, or not those of the '
        'calibration; or all accelerometers have changed alike.',
        sensors,
        share,
    )


def _freed(system: System, sensors: Sensors, factor: Floats) -> list[_Tried]:
    """Let go of some parameters, or of the mount: what has moved since the calibration."""
    wide = _wide(system)
    tried = []
    mine = system.parameters
    for kind in dict.fromkeys((*_FREED, *(p.kind for p in mine))):
        when, why = _FREED.get(kind) or _freed_term(kind)
        columns = [k for k, p in enumerate(mine) if p.kind is kind]
        fit = _fit(system, sensors, np.hstack([factor, wide[:, columns]]))
        if fit is None:
            continue
        moved = [Moved(mine[k], float(fit.delta[k]), float(fit.std[k])) for k in columns]
        far = tuple(m for m in moved if abs(m.difference) > _MOVED * m.std)
        tried.append(_Tried(Diagnosis(why, far), when, fit, len(columns)))
    added = [_added(system, sensors, factor, term) for term in TERMS if _lacks(system, term)]
    tried += [one for one in added if one is not None]
    if system.observed.with_attitudes:
        fit = system.fit(sensors, factor, mount_free=True)
        angle = float(np.linalg.norm(fit.mounted))
        if angle < _LARGEST_ROTATION:
            about = ', '.join(
                f'{v / ARCMIN:+.2f} arcmin about {axis}'
                for v, axis in zip(fit.mounted, 'XYZ', strict=True)
            )
            why = 'It sits otherwise in its mount than when it was calibrated.'
            tried.append(_Tried(Diagnosis(why), f'the unit is turned by {about}', fit, 3))
    return tried


def _lacks(system: System, term: Term) -> bool:
    of_gyros = term.triad == 'g'
    return of_gyros is system.gyros and term.kind not in {p.kind for p in system.parameters}


def _added(system: System, sensors: Sensors, factor: Floats, term: Term) -> _Tried | None:
    """Add a term that the calibration was made without."""
    parameters = (*system.parameters, *term.parameters)
    larger = replace(system, parameters=parameters)
    known, count = len(system.parameters), len(term.parameters)
    wide = scipy.linalg.block_diag(factor, _wide(larger)[known:, known:])
    fit = _fit(larger, replace(sensors, parameters=parameters), wide)
    if fit is None:
        return None
    moved = [
        Moved(p, float(d), float(s))
        for p, d, s in zip(term.parameters, fit.delta[known:], fit.std[known:], strict=True)
    ]
    far = tuple(m for m in moved if abs(m.difference) > _MOVED * m.std)
    why = f'The calibration was made without it: calibrate with --terms {term.name}.'
    return _Tried(Diagnosis(why, far), f'{term.name} is in the model', fit, count)


def _another_unit(system: System, sensors: Sensors, factor: Floats, name: str) -> Diagnosis:
    """Compare with parameters fitted anew, since no single mistake explains the data."""
    fit = new_parameters(system)
    file, mine = sensors.values, system.parameters
    wide = np.diag(_wide(system))
    determined = np.flatnonzero(fit.std < _DETERMINED * wide)
    moved = []
    for k in determined:
        std = float(np.hypot(fit.std[k], np.linalg.norm(factor[k])))
        moved.append(Moved(mine[k], float(fit.delta[k] - file[k]), std))
    far = tuple(m for m in moved if abs(m.difference) > _MOVED * m.std)
    if len(far) >= _HALF * len(moved):
        return Diagnosis(
            f'No single mistake explains the {name}, other parameters do: {len(far)} of the '
            f"{len(moved)} that the session tells are off. The calibration is another unit's, or "
            'the unit is not what it was.',
            far,
        )
    return Diagnosis(
        f'No single mistake explains the {name}, other parameters do: these have moved.', far
    )


def _wide(system: System) -> Floats:
    """Return a prior that says little, (p, p): standard deviations of any unit's parameters."""
    return np.diag([_width(p) for p in system.parameters])


def _width(parameter: Parameter) -> float:
    if parameter.kind is ParameterKind.BIAS:
        return _WIDE_BIAS[parameter.triad]
    if parameter.kind is ParameterKind.G_SENSITIVITY:
        return _WIDE_G
    return parameter.unit.limit or _WIDE


def _freed_term(kind: ParameterKind) -> tuple[str, str]:
    words = kind.value.words
    return f'the {words} is another', 'It has moved, or is that of another unit.'
