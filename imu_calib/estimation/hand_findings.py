"""Contradictions in a session in the hand: units, exchanged axes, a latitude of another site.

Free positions have no plan to compare with, but three facts remain: gravity has a known length, the
gyros must turn gravity from hold to hold as seen by the accelerometers, and the Earth turns at the
rate of the site.

Source: docs/mathematics.md, 'Free positions'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import permutations, product

import numpy as np

from ..common.errors import Contradiction, InputError
from ..common.finding import warning
from ..common.stream import Floats
from ..common.units import DEG, HOUR, STANDARD_GRAVITY, significant
from ..model.parameters import AXES
from ..model.sensors import SensorModel, Triad, wrong_turns_sentences
from ..model.session_terms import session_term
from ..session.imu import SCALE_LIMIT
from .checks import measured_latitude, vertical_earth_rate
from .evidence import Evidence
from .term_tests import chance_in_words

_ASTRAY = 10 * DEG
"""rad, root mean square over the turns: gravity turned by the gyros misses the next hold by more
only with wrong channels or units. Scale factors and misalignments of percents cause a few degrees
in half a turn."""
_BETTER = 3.0
"""Factor by which exchanged axes or other units must fit better to be named. A judgement: the right
one leaves the few degrees of `_ASTRAY`, the wrong one some ninety."""
_UNITS = (1.0, 1 / DEG, DEG, 2.0, 0.5, 1e-3, 1e3, 1 / HOUR, HOUR)
"""Responses of gyros in rad/s where deg/s are stated as rad/s or rad/s as deg/s, where half or
twice the rate of the samples, or the next range of a converter, is stated, and where units of
1/1000 (mdps) or of an hour are confused."""

_AROUND = np.geomspace(0.8, 1.25, 41).tolist()
"""Of a named response, by 1.1 %: from those in `_UNITS` to those that are solved and reported."""


def check_turns(evidence: Evidence, model: SensorModel) -> None:
    """Raise if gravity turned by the gyros disagrees with the accelerometers of the next hold.

    The attitudes have the ups of the accelerometers; only the gyro biases of the model are used.

    All exchanges and signs of axes, in rad/s and in other units, are tried; the one with the fewest
    changes of those that fit is named. If none fits, this function does not raise.

    Raises:
        InputError: Units or scale factor of the gyros differ from those of the recording.
        Contradiction: Axes are exchanged or mirrored; names them.
    """
    if not len(evidence.used_moves):
        return
    astray = _turned_gravity_error(evidence, model, np.eye(3))
    if astray < _ASTRAY:
        return
    responses = [scale * axes for scale in _UNITS for axes in _signed_axes()]
    misses = np.array([_turned_gravity_error(evidence, model, response) for response in responses])
    if misses.min() * _BETTER > astray:
        return
    response = responses[int(np.argmax(misses <= misses.min() * _BETTER))]
    scale = float(np.abs(response).max())
    if scale != 1.0:
        scale *= min(
            _AROUND, key=lambda factor: _turned_gravity_error(evidence, model, factor * response)
        )
        if 1 / SCALE_LIMIT < scale < SCALE_LIMIT:
            return
        raise InputError(
            wrong_turns_sentences(
                scale,
                "units or scale factor of the IMU's description are not those of the recording",
            )
        )
    raise Contradiction(
        f'The gyros contradict the accelerometers: from hold to hold {_in_words(response)}. '
        'Channels are exchanged or have a wrong sign: correct the driver or the columns of the '
        'recording.'
    )


def other_latitudes(evidence: Evidence) -> tuple[float, ...]:
    """Return latitudes, rad, that may be meant: the opposite one, and that seen by the gyros."""
    seen = vertical_earth_rate(evidence.segments)
    found = None if seen is None else measured_latitude(*seen)
    stated = evidence.site.latitude
    return (-stated,) if found is None else (-stated, found[0])


def wrong_latitude(evidence: Evidence, latitude: float) -> Contradiction:
    """Return a sentence on a latitude (rad) that fits in place of the stated one.

    Accelerometers with the other sign see down where up is: north of the equator turns like south.
    """
    remedy = 'State the latitude of the site.'
    if latitude * evidence.site.latitude < 0:
        remedy = (
            'Either the latitude has the wrong sign (it is negative in the south), or all '
            'accelerometers have: at rest the one that points up has to read +1 g.'
        )
    return Contradiction(
        f'The data contradicts the latitude {evidence.site.latitude / DEG:.2f} deg: the gyros fit '
        f'a latitude of {latitude / DEG:.2f} deg, with odds of more than a thousand to one. '
        f'{remedy}'
    )


def _signed_axes() -> list[Floats]:
    """Return the 48 ways in which three channels can be exchanged or mirrored, few changes first.

    (3, 3) each: row i the channel, column j its input axis.
    """
    found = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3))
    ]
    return sorted(found, key=lambda axes: int(np.count_nonzero(axes != np.eye(3))))


def _turned_gravity_error(evidence: Evidence, model: SensorModel, response: Floats) -> float:
    """Return the error of gravity turned by gyros of a response (3, 3), rad, root mean square."""
    tried = SensorModel(Triad(response - np.eye(3), model.gyro.bias), model.accel)
    used, ups = evidence.used_moves, evidence.dwell_attitudes[:, 2]
    propagated_ups = np.array(
        [
            path.rotation @ ups[link.first]
            for path, link in zip(used.paths(tried), used.linked, strict=True)
        ]
    )
    cosines = np.einsum('ij,ij->i', propagated_ups, ups[[link.second for link in used.linked]])
    missed = np.arccos(np.clip(cosines, -1.0, 1.0))
    return float(np.sqrt(np.mean(missed**2)))


def _in_words(response: Floats) -> str:
    """Return the input axis of each channel that is not its own."""
    words = []
    for channel, row in zip(AXES, response, strict=True):
        axis = int(np.argmax(np.abs(row)))
        sign = '-' if row[axis] < 0 else ''
        if sign or AXES[axis] != channel:
            words.append(f'gyro {channel} answers to {sign}{AXES[axis].upper()}')
    text = ', '.join(words)
    alone = np.flatnonzero(np.diag(response) > 0)
    if np.linalg.det(response) > 0 and len(words) == 2 and len(alone) == 1:
        text += f' (accelerometer {AXES[alone[0]]} with a wrong sign looks the same)'
    return text


TRENDS = {name: session_term(name) for name in ('trend:D_g', 'trend:D_a')}
"""Drifts that are tested: biases of either triad that change evenly."""
DRIFT_SHOWN = {'trend:D_g': 1e-3, 'trend:D_a': 1e-6}
"""Probability of chance below which an even drift is in the model, where the other triad has none.

Gyros at rest show theirs at each hold. That of accelerometers is told from their parameters by what
further holds and the turns leave. In halves of a published recording, of 11 to 13 holds whose
accelerometers scatter by up to 16 times their noise (docs/real_recordings.md, position), drifts of
1e-4 to 1e-6 were none: with them the other half fitted worse."""
LARGEST_DRIFT = {'trend:D_g': 1 * DEG, 'trend:D_a': 0.1 * STANDARD_GRAVITY}
"""Largest drift of a bias during a session, rad/s and m/s^2: chips that were just switched on."""


class DriftKind(Enum):
    """How biases drift."""

    EVEN = 'even'  #: Along a line: estimated.
    WANDER = 'wander'  #: A random walk: in the covariance.
    STEP = 'step'  #: A walk that is one step: in the covariance as that.
    UNEVEN = 'uneven'  #: Otherwise: seen in the residuals.


@dataclass(frozen=True)
class Drift:
    """A drift of the biases of a triad that a session shows."""

    name: str  #: Of the term: `trend:D_g` or `trend:D_a`.
    log_p: float  #: Natural logarithm of the probability by chance, or of the odds for a wander.
    largest: float  #: By how much a bias changes during the session, rad/s or m/s^2.
    kind: DriftKind = DriftKind.EVEN  #: How.
    std: float = np.inf  #: Largest stated standard deviation of the biases, rad/s or m/s^2.
    instant: float = np.nan  #: Of a step, s since the first hold began.

    @property
    def is_large(self) -> bool:
        """Whether biases at the end of the session are off the stated ones, beyond their noise.

        They are off by half of the drift: by more than three standard deviations.
        """
        return self.largest > 6 * self.std


def drift_words(drifts: Sequence[Drift]) -> list[str]:
    """Report drifts of biases, those of one kind in a sentence."""
    words: list[str] = []
    steps = [one for one in drifts if one.kind is DriftKind.STEP]
    if steps:
        each = ' and '.join(_one_drift(one) for one in steps)
        words.append(
            warning(
                f'Biases stepped {steps[0].instant:.0f} s after the first hold began, {each}, as '
                'at a restart or another range: those stated hold for neither part. Record the '
                'session in one run of the unit.'
            )
        )
    for kind, how, what in (
        (
            DriftKind.EVEN,
            'drift evenly',
            'this is estimated, and the biases stated are those of its middle',
        ),
        (DriftKind.WANDER, 'wander', 'the standard deviations allow for it'),
        (DriftKind.UNEVEN, 'drift unevenly', _NOT_ESTIMATED),
    ):
        found = [one for one in drifts if one.kind is kind]
        if found:
            each = ' and '.join(_one_drift(one) for one in found)
            text = f'Biases {how} during the session, {each}: {what}. {_REMEDY}'
            large = any(one.is_large for one in found)
            if large and kind is not DriftKind.UNEVEN:
                text = (
                    f'Biases {how} during the session, {each}: they were still moving, and those '
                    f'stated are of its middle. {_REMEDY}'
                )
            words.append(warning(text) if large or kind is DriftKind.UNEVEN else text)
    return words


def _amount(found: Drift) -> str:
    if found.name == 'trend:D_g':
        return f'{significant(found.largest / DEG)} deg/s'
    return f'{significant(found.largest / (STANDARD_GRAVITY / 1000))} mg'


def _one_drift(found: Drift) -> str:
    whose = 'gyros' if found.name == 'trend:D_g' else 'accelerometers'
    by = f'of the {whose} by up to {_amount(found)}'
    odds = chance_in_words(found.log_p)
    if found.kind is DriftKind.EVEN:
        return f'{by} ({found.name}, {odds})'
    return f'{by} ({odds})' if found.kind is DriftKind.UNEVEN else by


_NOT_ESTIMATED = 'no term describes this, and errors may exceed the standard deviations'
_REMEDY = (
    'Let the unit run until it is warm, keep the session short, and return to the first attitudes '
    'at its end.'
)
"""What helps against a drift, even or not."""
