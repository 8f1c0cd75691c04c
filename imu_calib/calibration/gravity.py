"""Effect of the uncertainty of the assumed gravity on the parameters of a calibration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..common.budget import ErrorSource, Share
from ..common.finding import Finding, warning
from ..common.stream import Floats
from ..common.units import DEG, PPM
from ..model.earth import MEASURED, VAGUE, Site, normal_gravity
from ..model.sensors import gravity_covariance, gravity_slope
from .calibration import Calibration

_ANOMALY = 0.003
"""Largest plausible relative difference of a measured gravity from normal gravity: 10 km of height,
above any laboratory, make 0.3 %, and gravity anomalies a tenth of that (EGM2008)."""


def with_gravity(calibration: Calibration, site: Site) -> Calibration:
    """Return a calibration that includes the uncertainty of its gravity."""
    share = gravity_covariance(calibration.model, calibration.parameters, site.gravity_relative_std)
    findings = (*calibration.findings, *_findings(calibration, site))
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


def _findings(calibration: Calibration, site: Site) -> list[str]:
    if not calibration.has_accelerometers:
        return []
    if not site.height_assumed:
        return _latitude_contradiction(site)
    return [
        Finding(
            'Gravity was computed for height 0 m, since no height is stated: this adds '
            f'{site.gravity_relative_std / PPM:.0f} ppm to the standard deviation of every K_a. '
            'State `height`, or `gravity` as measured.',
            ErrorSource.GRAVITY,
        )
    ]


def _latitude_contradiction(site: Site) -> list[str]:
    """Return a sentence if a measured gravity does not agree with the latitude."""
    if site.gravity_source != MEASURED or site.latitude_std > 0.99 * VAGUE:
        return []
    south, here, north = (
        normal_gravity(site.latitude + sign * site.latitude_std, site.height or 0.0)
        for sign in (-1, 0, 1)
    )
    off = site.gravity / here - 1
    if abs(off) <= _ANOMALY + abs(north - south) / (2 * here):
        return []
    return [
        warning(
            f'The stated gravity of {site.gravity:.4f} m/s^2 is {100 * off:+.2f} % off normal '
            f'gravity at latitude {site.latitude / DEG:.2f} deg, {here:.4f} m/s^2: K_a is wrong by '
            'as much if it is a mistake. Check `gravity` and `latitude`.',
            effect=math.inf,
        )
    ]
