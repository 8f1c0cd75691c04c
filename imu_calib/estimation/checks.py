"""Checks of every solution: axes, scales, clocks, encoders and the latitude."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from ..common.budget import ErrorSource
from ..common.errors import Contradiction, InputError, NotObservable
from ..common.finding import Finding, warning
from ..common.gaussian import FIVE_SIGMA
from ..common.stream import Floats
from ..common.units import DEG, DEG_H, PPM, rounded
from ..model.earth import EARTH_RATE
from ..model.parameters import AXES
from ..model.sensors import TIMES, SensorModel, wrong_scale_sentences
from ..segmentation.segments import Segment
from ..session.imu import SCALE_LIMIT
from .evidence import Evidence

_AXIS_LIMIT = 0.5  #: Of an axis's largest response: beyond it, axes are exchanged, not misaligned.
_FAR_SCALE = 0.1  #: Share: data sheets allow percents.
_COARSE_STEP = 2e-3 * DEG
"""Smallest steps of encoders that are reported, rad: 7 arcsec, 17.5 bits. A judgement: finer ones
are no reason to buy others."""

_WELL_KNOWN_CLOCKS = 5e-6  #: Of the rate: below it, K_g is still known to 5 ppm.
_LEAST_EARTH_RATE = 0.01 * DEG_H
"""rad/s: effect of a latitude that is wrong by some hundredths of a degree."""
_DETERMINED = 0.2
"""Of the Earth's rate: with a larger uncertainty, the latitude has one of over ten degrees."""


def no_turn_about(axis: int) -> NotObservable:
    """Return a sentence for body axes without a turn."""
    name = AXES[axis]
    return NotObservable(
        f'No whole turn about {name.upper()} was found: K_g{name} and the responses of the gyros '
        f'to {name.upper()} cannot be determined.'
    )


def turns_scatter_finding(scatter: float) -> str:
    """Report the scatter of turns beyond their noise, by chi-square per degree of freedom."""
    times = float(np.sqrt(scatter))
    return Finding(
        f'Between turns the gyros scatter {times:.1f} times more than within them: the standard '
        'deviations of K_g and E_g are widened. Possible causes: rates beyond their range, and a '
        'scale factor that depends on the rate.',
        effect=times - 1,
    )


_SET_BY_CLOCKS = 0.7
"""Of the clocks' deviation: K_g that is known better does not rest on them, but on moves, which are
angles. A judgement: less than half of the variance."""


def clock_finding(evidence: Evidence, best: float = math.inf) -> list[str]:
    """Report clocks that the session does not compare well: their rate directly changes K_g.

    Args:
        evidence: The session.
        best: Least standard deviation of a K_g; infinite where all rest on turns.
    """
    std = evidence.turns_clock_std
    if std < _WELL_KNOWN_CLOCKS or best < _SET_BY_CLOCKS * std:
        return []
    return [
        Finding(
            f'The clocks of IMU and table could be compared to {std / PPM:.0f} ppm only: K_g is '
            'known no better. Joint states at 20 Hz or more, of stamps that do not jitter, would '
            'improve it.',
            ErrorSource.CLOCK,
        )
    ]


def encoder_finding(evidence: Evidence) -> list[str]:
    """Report encoders whose steps hide the rates of turns."""
    by_steps = [t.rate_std(evidence.walk) for t in evidence.turns if t.step >= _COARSE_STEP]
    worst = max(by_steps, default=0.0)
    if evidence.encoder_step < _COARSE_STEP or worst < _WELL_KNOWN_CLOCKS:
        return []
    return [
        Finding(
            f'The encoder angles come in steps of {evidence.encoder_step / DEG:.2g} deg: the rates '
            f'of turns, and so K_g, are known to {worst / PPM:.0f} ppm at worst. Finer angles, '
            'more turns, or rates of no whole number of steps per joint state would improve it.',
            ErrorSource.ENCODER_RATE,
        )
    ]


def far_scales(model: SensorModel) -> list[str]:
    """Report outputs so far from the nominal scale that the description may be another unit's."""
    scales = {
        'gyros': abs(float(np.linalg.det(model.gyro.response))) ** (1 / 3),
        'accelerometers': abs(float(np.linalg.det(model.accel.response))) ** (1 / 3),
    }
    return [
        warning(
            f'The {name} read {scale:.3f} times what their description states: check that it is '
            f'that of this unit.{TIMES if name == "gyros" else ""}'
        )
        for name, scale in scales.items()
        if abs(scale - 1) > _FAR_SCALE
    ]


def check_axes(response: Floats, name: str, what: str) -> None:
    """Raise if a response matches no orientation of three real axes.

    Args:
        response: (3, 3), row i the channel, column j the axis of the plan; dimensionless.
        name: Of the sensors, for the message.
        what: The input, for the message.

    Raises:
        InputError: The response is many times, or a fraction of, its nominal value: other units.
        NotObservable: Axes are swapped, mirrored or turned; names them.
    """
    scale = abs(float(np.linalg.det(response))) ** (1 / 3)
    if not 1 / SCALE_LIMIT < scale < SCALE_LIMIT:
        raise InputError(
            f'The {name} read {scale:.4g} times what they should of {what}: check the units and '
            "the scale factor of the IMU's description."
            f'{wrong_scale_sentences(scale, name)}'
        )
    largest = np.abs(response).max(axis=1)
    if np.all(np.diag(response) == largest) and np.all(
        np.abs(response - np.diag(largest)).max(axis=1) < _AXIS_LIMIT * largest
    ):
        return
    words = []
    for i in range(3):
        j = int(np.argmax(np.abs(response[i])))
        sign = '-' if response[i, j] < 0 else ''
        if j != i or sign:
            words.append(f'{AXES[i]} answers to {sign}{AXES[j].upper()}')
    kind = 'mirrored' if np.linalg.det(response) < 0 else 'swapped'
    if not words:
        kind, words = 'turned', [f'{name} answer by {np.round(response, 2).tolist()}']
    raise Contradiction(
        f'The axes of the {name} are {kind} against the attitudes: {", ".join(words)}. Give the '
        "mounting in the table's YAML, or correct the driver."
    )


class WrongLatitude(Contradiction):
    """The gyros see the Earth rate of another latitude."""

    def __init__(self, text: str, seen: float = float('nan'), misfit: float = float('inf')) -> None:
        super().__init__(text)
        self.seen = seen  #: That latitude, rad.
        #: Difference of the whole rate from the Earth's, in standard deviations.
        self.misfit = misfit


def _with_std(value: float, std: float) -> str:
    return ' +- '.join(rounded(value, std))


def check_latitude(
    evidence: Evidence, earth: Floats, covariance: Floats, freedom: float = np.inf
) -> None:
    """Raise if the gyros contradict the latitude: gravity and the biases depend on it.

    Args:
        evidence: The session, with the site that was given.
        earth: (3,) Earth rate by the gyros, against the plumb line, rad/s.
        covariance: (3, 3) its covariance.
        freedom: Degrees of freedom of its size: with few, deviations follow Student's t, whose
            tails are long.

    Raises:
        WrongLatitude: States the observed and the expected rate, and which latitude would fit.
        Contradiction: No latitude does.
    """
    site = evidence.site
    up_std = float(np.sqrt(covariance[2, 2]))
    level = float(np.hypot(earth[0], earth[1]))
    level_std = float(np.sqrt(max(covariance[0, 0], covariance[1, 1])))
    limit = -float(scipy.special.stdtrit(freedom, scipy.special.ndtr(-FIVE_SIGMA)))
    far_up = abs(earth[2] - site.up_rate) > max(limit * up_std, _LEAST_EARTH_RATE)
    far_level = abs(level - site.north_rate) > max(limit * level_std, _LEAST_EARTH_RATE)
    if not (far_up or far_level):
        return
    seen = float(np.arctan2(earth[2], level))
    total = float(np.hypot(earth[2], level))
    total_std = max(up_std, level_std)
    text = (
        f'the gyros see an Earth rate of {_with_std(earth[2] / DEG_H, up_std / DEG_H)} deg/h up '
        f'(expected {site.up_rate / DEG_H:.2f}) and {_with_std(level / DEG_H, level_std / DEG_H)} '
        f'deg/h horizontal (expected {site.north_rate / DEG_H:.2f})'
    )
    if abs(total - EARTH_RATE) > limit * total_std:
        raise Contradiction(
            f'The data contradicts itself: {text}, {total / DEG_H:.2f} deg/h in all, where the '
            f'Earth turns at {EARTH_RATE / DEG_H:.2f} deg/h at any latitude. The rate test does '
            'not fit the static dwells (saturated turns, clocks that differ, drift).'
        )
    fits = ''
    if total_std < _DETERMINED * EARTH_RATE:
        fits = f' It fits a latitude of {_with_std(seen / DEG, total_std / total / DEG)} deg.'
    raise WrongLatitude(
        f'The data contradicts the latitude {site.latitude / DEG:.2f} deg: {text}.{fits}',
        seen,
        abs(total - EARTH_RATE) / total_std,
    )


# The latitude seen by the gyros at rest, to check a stated one before the estimate.

_NOMINAL = 0.03
"""Relative uncertainty of nominal scale factors of gyros; data sheets of cheap units state it
(MPU-9150: sensitivity tolerance of 3 %)."""
_FEWEST = 3  #: Static dwells: three in two attitudes determine six unknowns by nine readings.
_MEASURED = np.radians(10.0)
"""rad: a latitude with a larger uncertainty is not reported, as with `_DETERMINED`."""


def vertical_earth_rate(segments: Sequence[Segment]) -> tuple[float, float] | None:
    """Return the Earth rate about up in several attitudes and its deviation, rad/s, if determined.

    Least squares over dwells k with attitudes R_k = R_nb: y_k = b + R_k' w, of the biases b and the
    Earth rate w in the table's frame; the effect of misalignments on 15 deg/h is neglected. The
    deviation includes the scatter about the fit and that of nominal scale factors.

    Source: docs/mathematics.md, 'Latitude at a glance'.
    """
    known = [s for s in segments if s.attitude is not None]
    if len(known) < _FEWEST:
        return None
    rows = np.vstack([np.hstack([np.eye(3), np.asarray(s.attitude).T]) for s in known])
    read = np.concatenate([s.statistics.mean[:3] for s in known])
    solution, _, rank, _ = np.linalg.lstsq(rows, read, rcond=1e-6)
    freedom = len(read) - rows.shape[1]
    if rank < rows.shape[1] or freedom < 1:
        return None
    scatter = float(np.sum((read - rows @ solution) ** 2)) / freedom
    variance = float(np.linalg.inv(rows.T @ rows)[-1, -1]) * scatter
    up = float(solution[-1])
    return up, float(np.hypot(np.sqrt(variance), _NOMINAL * up))


def measured_latitude(up: float, std: float) -> tuple[float, float] | None:
    """Return the latitude of an Earth rate about up and its deviation; None if uncertain."""
    latitude = float(np.arcsin(np.clip(up / EARTH_RATE, -1.0, 1.0)))
    slope = EARTH_RATE * max(float(np.cos(latitude)), float(np.sin(_MEASURED)))
    found = std / slope
    return (latitude, found) if found < _MEASURED else None


def contradicts(up: float, std: float, stated: float) -> bool:
    """Return whether an Earth rate about up contradicts a stated latitude (rad)."""
    return bool(abs(up - EARTH_RATE * np.sin(stated)) > FIVE_SIGMA * std)
