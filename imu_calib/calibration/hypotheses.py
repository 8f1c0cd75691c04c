"""List hypotheses about what is wrong with a calibration, each with its corrected model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from ..common.stream import Floats
from ..common.units import ARCMIN, ARCSEC, DEG, DEG_H, MICRO_G, PPM, STANDARD_GRAVITY
from ..estimation.free_dwells import Sensors
from ..model.parameters import AXES, indices_of
from ..model.sensors import Triad, terms_of
from ..model.terms import G_SENSITIVITY
from ..session.imu import is_of_strapdown

_BIAS_UNITS = {
    True: {'deg/s': DEG, 'deg/h': DEG_H, 'rad/h': 1 / 3600},
    False: {'g': STANDARD_GRAVITY, 'mg': MICRO_G * 1e3, 'micro-g': MICRO_G},
}
"""Units that biases of gyros and accelerometers are written in by mistake, rad/s and m/s^2."""
_ANGLE_UNITS = {'degrees': DEG, 'arc minutes': ARCMIN, 'arc seconds': ARCSEC}
_RATIO_UNITS = {'ppm': PPM, 'per cent': 0.01}
"""The same for ratios."""
_ALIKE_HYPOTHESES = 0.01
"""Relative difference from a known factor below. A judgement: scale factors change by less, and the
factors differ by more."""
_SHARES = {
    True: {180 / np.pi: 'degrees taken for radians', np.pi / 180: 'radians taken for degrees'},
    False: {
        STANDARD_GRAVITY: 'm/s^2 taken for g',
        1 / STANDARD_GRAVITY: 'g taken for m/s^2',
        1e-3 * STANDARD_GRAVITY: 'milli-g taken for m/s^2',
    },
}


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A mistake, and the parameters corrected for it.

    Attributes:
        when: Ends the sentence 'the residuals vanish when'.
        why: What must then have happened, a sentence.
        values: (p,) of the triad's parameters without the mistake.
        reading: Factor on the outputs under this hypothesis.
        of_body_axes: Whether it only rotates or mirrors the body axes, which lengths cannot show.
    """

    when: str
    why: str
    values: Floats
    reading: float = 1.0
    of_body_axes: bool = False


def mistakes(sensors: Sensors, values: Floats) -> Iterator[Hypothesis]:
    """Yield common mistakes in a calibration file, the likely first.

    Args:
        sensors: Gyros or accelerometers.
        values: (p,) of their parameters in the file.
    """
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
            yield _of_unit('the biases', words, _but(values, bias=bias * by))
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
            yield _of_unit(what, words, _but(values, matrix))


def _both_ways(unit: str, si: str, size: float) -> tuple[tuple[tuple[str, str], float], ...]:
    return ((unit, si), size), ((si, unit), 1 / size)


def _of_unit(what: str, words: tuple[str, str], values: Floats) -> Hypothesis:
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
