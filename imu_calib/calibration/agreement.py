"""Whether calibrations of one unit agree within their uncertainties, and the share of gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ..common.budget import ErrorSource, Share
from ..common.finding import Finding
from ..common.gaussian import FIVE_SIGMA
from ..common.stream import Floats
from ..common.units import DEG, PPM, significant
from ..model.earth import Site
from ..model.parameters import Parameter, indices_of
from ..model.sensors import gravity_covariance, gravity_slope
from .calibration import Calibration

# Effect of the uncertainty of the assumed gravity on the parameters of a calibration.


def with_gravity(calibration: Calibration, site: Site) -> Calibration:
    """Return a calibration that includes the uncertainty of its gravity."""
    share = gravity_covariance(calibration.model, calibration.parameters, site.gravity_relative_std)
    findings = (*calibration.findings, *_gravity_findings(calibration, site))
    return replace(
        calibration.with_share(ErrorSource.GRAVITY, Share.known(share)), findings=findings
    )


def gravity_deviation(calibration: Calibration) -> Floats:
    """Return the effect of one standard deviation of gravity on the parameters, (n,).

    Its outer product is part of the covariance. The error is common to all calibrations made with
    the same gravity at one place. Zero if no such deviation is stated.
    """
    gravity = calibration.provenance.get('gravity')
    std = calibration.provenance.get('gravity_std')
    if not (isinstance(gravity, float) and isinstance(std, float) and gravity > 0):
        return np.zeros(len(calibration.parameters))
    return gravity_slope(calibration.model, calibration.parameters) * (std / gravity)


def without_gravity(calibration: Calibration) -> Floats:
    """Return the covariance of a calibration for exact gravity, (n, n).

    The subtraction is limited so that a covariance remains: for parameters that were changed later,
    the deviation differs from the one that was added.
    """
    deviation, std = gravity_deviation(calibration), calibration.std
    if not deviation.any():
        return calibration.covariance.copy()
    known = np.isfinite(std) & (std > 0)
    scaled = deviation[known] / std[known]
    correlation = calibration.covariance[np.ix_(known, known)] / np.outer(std[known], std[known])
    # P - t v v' has no negative eigenvalue up to t = 1 / (v' P^-1 v).
    most = float(scaled @ np.linalg.pinv(correlation, hermitian=True) @ scaled)
    share = np.outer(deviation, deviation) / max(1.0, most)
    return np.asarray(calibration.covariance - share)


def same_place(calibration: Calibration, gravity: object, latitude_deg: object) -> bool:
    """Return whether a calibration was made with this gravity (m/s^2) at this latitude."""
    where = calibration.provenance
    pairs = ((where.get('gravity'), gravity), (where.get('latitude_deg'), latitude_deg))
    return all(
        isinstance(own, float) and isinstance(other, float) and math.isclose(own, other)
        for own, other in pairs
    )


def _gravity_findings(calibration: Calibration, site: Site) -> tuple[str, ...]:
    if not calibration.has_accelerometers:
        return ()
    if not site.height_assumed:
        return site.contradictions
    return (
        Finding(
            'Gravity was computed for height 0 m, since no height is stated: this adds '
            f'{site.gravity_relative_std / PPM:.0f} ppm to the standard deviation of every K_a. '
            'State `height`, or `gravity` as measured.',
            ErrorSource.GRAVITY,
        ),
    )


# Test whether calibrations agree, by parameter.

FALSE_ALARM = 0.01
"""Probability that calibrations of an unchanged unit are found to differ in any parameter, as in
`calibration.verify.DOUBT`; shared among the parameters (Bonferroni)."""

FEWEST_FOR_A_STEP = 4
"""Fewest sessions of a parameter for a search of steps: a line and a step are three numbers."""

_NO_VARIANCE = 1e-9
"""Of the largest eigenvalue of a correlation: smaller ones are rounding. Double precision, 1e-16
times some hundred rows, leaves a margin for files written with fewer digits."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """Differences of k calibrations of one unit, compared with their covariances."""

    parameters: tuple[Parameter, ...]  #: n of them.
    #: (n,) about the value that fits all calibrations best; NaN if all are exact.
    chi_square: Floats
    freedom: NDArray[np.int64]  #: (n,) its degrees of freedom.
    chance: Floats  #: (n,) probability of this chi-square or more, for an unchanged unit.
    total: float  #: Chi-square of all parameters together, by the whole covariances.
    total_freedom: int  #: Its degrees of freedom.
    total_chance: float  #: Its probability.

    @property
    def limit(self) -> float:
        """Probability below which one parameter counts as changed."""
        return FALSE_ALARM / max(1, int(np.sum(self.freedom > 0)))

    @property
    def differ(self) -> NDArray[np.bool_]:
        """(n,) mask of the parameters that differ significantly."""
        return np.asarray((self.freedom > 0) & (self.chance < self.limit))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that differ significantly."""
        return tuple(p.name for p, off in zip(self.parameters, self.differ, strict=True) if off)

    @property
    def consistent(self) -> bool:
        """Whether all of them together are consistent with chance."""
        return self.total_freedom == 0 or self.total_chance >= FALSE_ALARM


def two_units(calibrations: Sequence[Calibration], names: Sequence[str]) -> list[str]:
    """Return sentences on calibrations, without serial numbers, that differ as units do.

    The angles between input axes are those of the sensors to each other. Of ten pairs of five
    MPU-9150 all differ so in one of them, recordings of one unit by 2.3 deviations at most.
    """
    first, found = calibrations[0], []
    for other, name in zip(calibrations[1:], names[1:], strict=True):
        if first.serial_number and other.serial_number:
            continue
        pairs = zip(first.free_of_frame, other.free_of_frame, strict=False)
        far = [
            (abs(apart) / std, abs(apart) / DEG, f'{one.group.words} {axis}')
            for one, its in pairs
            if one.group == its.group
            for axis, apart, std in zip(
                one.group.names, one.values - its.values, np.hypot(one.std, its.std), strict=True
            )
            if std > 0
        ]
        deviations, degrees, angle = max(far, default=(0.0, 0.0, ''))
        if deviations > FIVE_SIGMA:
            found.append(
                f'{name} and {names[0]} may be of two units: {angle} differs by '
                f'{significant(degrees)} deg, {deviations:.0f} standard deviations, and angles '
                'between input axes hardly change. Calibrate each unit with its serial number.'
            )
    return found


def agreement(
    calibrations: Sequence[Calibration], parameters: Sequence[Parameter]
) -> tuple[Agreement, Floats]:
    """Compare calibrations of independent sessions.

    The differences d of all from the first have the covariance S = A P A', with P that of all the
    parameters and A = [1, -1]: chi-square is d' S^-1 d, equal to that about the generalised
    least-squares mean, for any choice of the first (docs/mathematics.md, 'Calibrations side by
    side').

    Args:
        calibrations: k of them, two or more, with the nominal scale factors of the first.
        parameters: n parameters in all of them.

    Returns:
        The agreement, and the (k - 1, n) standard deviations of the differences from the first.
    """
    count, size = len(calibrations) - 1, len(parameters)
    values = np.array([c.model.values(tuple(parameters)) for c in calibrations])
    apart = values[1:] - values[0]
    spread = _covariance(calibrations, parameters)
    blocks = [spread[k::size, k::size] for k in range(size)]
    each = [_chi_square(apart[:, k], block) for k, block in enumerate(blocks)]
    total, total_freedom = _chi_square(apart.ravel(), spread)
    square = np.array([s if f else np.nan for s, f in each])
    freedom = np.array([f for _, f in each], dtype=np.int64)
    chance = np.where(freedom > 0, scipy.special.chdtrc(np.maximum(freedom, 1), square), np.nan)
    found = Agreement(
        tuple(parameters),
        square,
        freedom,
        chance,
        total,
        total_freedom,
        float(scipy.special.chdtrc(max(total_freedom, 1), total)),
    )
    std = np.sqrt(np.diag(spread)).reshape(count, size)
    return found, std


def _covariance(calibrations: Sequence[Calibration], parameters: Sequence[Parameter]) -> Floats:
    """Return the covariance of the differences from the first, ((k - 1) n, (k - 1) n).

    The error of gravity is common to calibrations made with the same gravity at one place, and
    cancels in their difference (docs/mathematics.md, 'Gravity').
    """
    count, size = len(calibrations), len(parameters)
    whole = np.zeros((count, size, count, size))
    places = [indices_of(parameters, c.parameters) for c in calibrations]
    by_gravity = [gravity_deviation(c)[rows] for c, rows in zip(calibrations, places, strict=True)]
    for i, (one, rows) in enumerate(zip(calibrations, places, strict=True)):
        whole[i, :, i] = without_gravity(one)[np.ix_(rows, rows)]
        where = one.provenance
        for j, other in enumerate(calibrations):
            if i == j or same_place(other, where.get('gravity'), where.get('latitude_deg')):
                whole[i, :, j] += np.outer(by_gravity[i], by_gravity[j])
    flat = whole.reshape(count * size, count * size)
    differences = np.hstack([-np.ones((count - 1, 1)), np.eye(count - 1)])
    matrix = np.kron(differences, np.eye(size))
    return np.asarray(matrix @ flat @ matrix.T)


def _chi_square(apart: Floats, spread: Floats) -> tuple[float, int]:
    """Return chi-square and its degrees of freedom, without directions of no variance."""
    deviation = np.sqrt(np.maximum(np.diag(spread), 0.0))
    known = deviation > 0
    if not known.any():
        return float('nan'), 0
    scaled = deviation[known]
    values, vectors = np.linalg.eigh(spread[np.ix_(known, known)] / np.outer(scaled, scaled))
    good = values > _NO_VARIANCE * values[-1]
    along = vectors.T @ (apart[known] / scaled)
    return float(np.sum(along[good] ** 2 / values[good])), int(good.sum())
