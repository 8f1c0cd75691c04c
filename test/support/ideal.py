"""Sessions as a method sees them, from outputs that a test computes itself: no streams."""

from collections.abc import Sequence

import numpy as np

from imu_calib.common.stream import Floats
from imu_calib.estimation.evidence import Evidence
from imu_calib.model.earth import Site
from imu_calib.segmentation.clock import fit_clock
from imu_calib.segmentation.segments import Segment, Statistics, Turn
from imu_calib.session.plan import Plan


def mean_of(outputs: Floats, duration: float = 100.0) -> Statistics:
    """The statistics of a stretch with these (6,) mean outputs."""
    return Statistics(
        samples=round(100 * duration),
        missing=0,
        duration=duration,
        mean=np.asarray(outputs, dtype=float),
        walk_gain=np.full(6, 1 / duration),
        quantisation_variance=np.zeros(6),
        end_points=np.asarray(outputs, dtype=float),
        blocks=tuple(np.empty((0, 4)) for _ in range(6)),
        drift=np.full(6, np.nan),
    )


def evidence(
    plan: Plan,
    site: Site,
    outputs: Floats,
    turns: Sequence[Turn] = (),
    *,
    azimuth: float | None = 0.0,
    walk: Floats | None = None,
) -> Evidence:
    """A session with (p, 6) outputs at the positions of a plan that have a dwell, exactly there."""
    held = [p for p in plan.positions if p.dwell > 0]
    segments = tuple(
        Segment(k * 10**9, (k + 1) * 10**9, mean_of(row, p.dwell), p.attitude, p.id)
        for k, (p, row) in enumerate(zip(held, outputs, strict=True))
    )
    noise = np.full(6, 1e-9) if walk is None else walk
    return Evidence(segments, tuple(turns), plan, site, fit_clock([]), azimuth, noise)
