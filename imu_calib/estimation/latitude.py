"""The latitude seen by the gyros at rest, to check a stated one before the estimate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.gaussian import FIVE_SIGMA
from ..model.earth import EARTH_RATE
from ..segmentation.segments import Segment

_NOMINAL = 0.03
"""Relative uncertainty of nominal scale factors of gyros; data sheets of cheap units state it
(MPU-9150: sensitivity tolerance of 3 %)."""
_FEWEST = 3  #: Static dwells: three in two attitudes determine six unknowns by nine readings.
_DETERMINED = np.radians(10.0)
"""rad: a latitude with a larger uncertainty is not reported, as in `checks`."""


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
    slope = EARTH_RATE * max(float(np.cos(latitude)), float(np.sin(_DETERMINED)))
    found = std / slope
    return (latitude, found) if found < _DETERMINED else None


def contradicts(up: float, std: float, stated: float) -> bool:
    """Return whether an Earth rate about up contradicts a stated latitude (rad)."""
    return bool(abs(up - EARTH_RATE * np.sin(stated)) > FIVE_SIGMA * std)
