"""What may be wrong with a calibration, each as the model that would then be the right one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from ..model import AXES, G_SENSITIVITY, Triad, terms_of
from ..stream import Floats
from ..units import ARCMIN, ARCSEC, DEG, DEG_H, MICRO_G, PPM, STANDARD_GRAVITY
from .equations import Sensors

_BIAS_UNITS = {
    True: {'deg/s': DEG, 'deg/h': DEG_H, 'rad/h': 1 / 3600},
    False: {'g': STANDARD_GRAVITY, 'mg': MICRO_G * 1e3, 'micro-g': MICRO_G},
}
_ANGLE_UNITS = {'degrees': DEG, 'arc minutes': ARCMIN, 'arc seconds': ARCSEC}
_RATIO_UNITS = {'ppm': PPM, 'per cent': 0.01}
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
    """A mistake, and the model as it would be without it.

    Attributes:
        when: Ends the sentence 'the residuals vanish when'.
        why: What must then have happened, a sentence.
        sensors: The model without the mistake.
        reading: Factor on the outputs that goes with it.

    """

    when: str
    why: str
    sensors: Sensors
    reading: float = 1.0


def mistakes(sensors: Sensors, *, gyros: bool) -> Iterator[Hypothesis]:
    """List what people do to a calibration file, the likely first.

    Args:
        sensors: The triad as the file has it.
        gyros: Gyros or accelerometers.

    """
    yield from _matrices(sensors, gyros=gyros)
    yield from _terms(sensors)
    yield from _biases(sensors)
    yield from _units(sensors, gyros=gyros)
    yield from _axes(sensors)


def _with(sensors: Sensors, matrix: Floats | None = None, bias: Floats | None = None) -> Sensors:
    triad = sensors.triad
    return sensors.with_triad(
        Triad(
            triad.error_matrix if matrix is None else matrix,
            triad.bias if bias is None else bias,
        )
    )


def _matrices(sensors: Sensors, *, gyros: bool) -> Iterator[Hypothesis]:
    name = f'{"gyro" if gyros else "accelerometer"} error matrix'
    matrix = sensors.triad.error_matrix
    diagonal = np.diag(np.diag(matrix))
    cross = matrix - diagonal
    yield Hypothesis(
        f'the {name} is transposed',
        'The matrix was written or applied the wrong way round: row is the channel, column the '
        'input axis.',
        _with(sensors, matrix.T),
    )
    yield Hypothesis(
        f'the {name} has the opposite sign',
        'The matrix of the correction stands for that of the error, or the inverse was left out.',
        _with(sensors, -matrix),
    )
    yield Hypothesis(
        'the misalignments have the opposite sign',
        'Their sign is that of another convention: here they are the response of a channel to '
        'another axis.',
        _with(sensors, diagonal - cross),
    )
    yield Hypothesis(
        'the scale-factor errors have the opposite sign',
        'They are deviations of the scale factor (rad per pulse), not of the response.',
        _with(sensors, cross - diagonal),
    )
    yield Hypothesis(
        f'the {name} has the opposite sign and is transposed',
        'The matrix of the correction was written the wrong way round.',
        _with(sensors, -matrix.T),
    )


def _terms(sensors: Sensors) -> Iterator[Hypothesis]:
    for term in terms_of(sensors.parameters):
        values = sensors.model.values(term.parameters)
        if not values.any():
            continue
        changes = [('has the opposite sign', -values), ('is left out', np.zeros_like(values))]
        if term is G_SENSITIVITY:
            changes.insert(0, ('is transposed', values.reshape(3, 3).T.ravel()))
        for when, changed in changes:
            yield Hypothesis(
                f'the {term.kind.value.words} {when}',
                'It was written or applied in another convention.',
                sensors.with_values(term.parameters, changed),
            )


def _biases(sensors: Sensors) -> Iterator[Hypothesis]:
    bias = sensors.triad.bias
    for signs in product((1.0, -1.0), repeat=3):
        turned = [AXES[i] for i in range(3) if signs[i] < 0]
        if not turned:
            continue
        which = 'biases have' if len(turned) == 3 else f'bias of {" and ".join(turned)} has'
        yield Hypothesis(
            f'the {which} the opposite sign',
            'The bias is what the channel shows too much: it is subtracted, not added.',
            _with(sensors, bias=bias * np.array(signs)),
        )


def _units(sensors: Sensors, *, gyros: bool) -> Iterator[Hypothesis]:
    triad = sensors.triad
    diagonal = np.diag(np.diag(triad.error_matrix))
    cross = triad.error_matrix - diagonal
    si = 'rad/s' if gyros else 'm/s^2'
    for unit, size in _BIAS_UNITS[gyros].items():
        yield _of_unit('the biases', unit, si, _with(sensors, bias=triad.bias * size))
        yield _of_unit('the biases', si, unit, _with(sensors, bias=triad.bias / size))
    for unit, size in _ANGLE_UNITS.items():
        for factor, words in ((size, (unit, 'radians')), (1 / size, ('radians', unit))):
            yield _of_unit('the misalignments', *words, _with(sensors, diagonal + cross * factor))
    for unit, size in _RATIO_UNITS.items():
        for factor, words in ((size, (unit, 'ratios')), (1 / size, ('ratios', unit))):
            changed = _with(sensors, diagonal * factor + cross)
            yield _of_unit('the scale-factor errors', *words, changed)


def _of_unit(what: str, found: str, expected: str, sensors: Sensors) -> Hypothesis:
    return Hypothesis(
        f'{what} are read as {found}',
        f'They are in {found} where {expected} are expected.',
        sensors,
    )


def _axes(sensors: Sensors) -> Iterator[Hypothesis]:
    triad = sensors.triad
    for order in permutations(range(3)):
        p = np.eye(3)[list(order)]
        if order != (0, 1, 2):
            moved = [i for i in range(3) if order[i] != i]
            which = ', '.join(f'{AXES[order[i]]} for {AXES[i]}' for i in moved)
            yield Hypothesis(
                f'the axes of the file change places ({which})',
                'Parameters stand under the names of other axes.',
                _with(sensors, p @ triad.error_matrix @ p.T, p @ triad.bias),
            )
            yield Hypothesis(
                f'the biases change places ({which})',
                'Biases stand under the names of other axes.',
                _with(sensors, bias=p @ triad.bias),
            )
        for signs in product((1.0, -1.0), repeat=3):
            s = np.array(signs)[:, None] * p
            if np.array_equal(s, np.eye(3)):
                continue
            words = _channel_words(s)
            reversed_ = all(order[i] == i for i in range(3))
            what = 'reversed' if reversed_ else 'exchanged or reversed'
            yield Hypothesis(
                f'channels are {what} ({words})',
                'The driver, or the file, has the channels in another order or sense.',
                _with(sensors, s @ triad.response - np.eye(3), s @ triad.bias),
            )
            yield Hypothesis(
                f'input axes are {what} ({words})',
                'The unit sits otherwise in its mount than when it was calibrated, or the columns '
                'of the matrix stand for other axes.'
                if np.linalg.det(s) > 0
                else 'A column of the matrix has the wrong sign, or the axes are mirrored.',
                _with(sensors, triad.response @ s - np.eye(3)),
            )


def _channel_words(signed: Floats) -> str:
    words = []
    for i in range(3):
        j = int(np.argmax(np.abs(signed[i])))
        if signed[i, j] != 1.0 or i != j:
            words.append(f'{AXES[i]} is {"-" if signed[i, j] < 0 else ""}{AXES[j]}')
    return ', '.join(words)


def share_in_words(share: float, *, gyros: bool) -> str:
    """Say what a factor on the outputs may come from."""
    for known, words in _SHARES[gyros].items():
        if abs(share / known - 1) < 0.01:
            return words
    return 'the nominal scale factor or the units are not those of the recording'
