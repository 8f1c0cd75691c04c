"""Provenance of a calibration: its session, software and method."""

from __future__ import annotations

import numpy as np
import scipy

from ..common.files import version
from ..common.stream import iso
from ..common.units import DEG
from ..estimation.checks import Solution
from ..estimation.evidence import Evidence
from ..estimation.joint import Comparison
from ..estimation.methods import Setup
from ..model.sensors import terms_of
from ..model.session_terms import terms_in_words
from ..segmentation.noise import session_noise
from ..segmentation.stream_facts import Segmented
from ..session.table_errors import StampingClock


def provenance(
    setup: Setup,
    evidence: Evidence,
    session: Segmented,
    solution: Solution,
    comparison: Comparison | None = None,
) -> dict[str, object]:
    """Return the provenance in a calibration file, by key (docs/parameters.md)."""
    clock, seen = session.clock, session.temperature
    residuals = np.array([r.value for r in solution.residuals]).reshape(-1, 6)
    rms = np.sqrt((residuals**2).mean(axis=0)) if len(residuals) else np.full(6, np.nan)
    special: dict[str, object] = {}
    if missing := evidence.missing_positions():
        special['missing_positions'] = missing
    if solution.bias_drift is not None:
        special['bias_drift'] = [float(v) for v in solution.bias_drift]
    changes = () if solution.changes is None else solution.changes.changes
    if comparison is not None:
        special['closed_form'] = comparison.document()
    if solution.tests:
        special['tests_of_terms'] = {test.name: test.document() for test in solution.tests}
    return {
        'recorded': iso(session.start),
        'method': setup.method_name,
        'terms': [*(t.name for t in terms_of(solution.parameters)), *terms_in_words(changes)],
        'terms_looked_for': setup.search_terms and bool(solution.tests),
        'plan': setup.plan.name or None,
        'table': setup.table.name if setup.table is not None else None,
        'table_clock_std': setup.table.clock if setup.table is not None else None,
        'latitude_deg': setup.site.latitude / DEG,
        'latitude_std_deg': setup.site.latitude_std / DEG,
        'gravity': setup.site.gravity,
        'gravity_source': setup.site.gravity_source,
        'gravity_std': setup.site.gravity_std,
        'height': setup.site.height,
        'height_assumed': setup.site.height_assumed,
        'azimuth_seen_deg': _or_none(solution.azimuth / DEG),
        'azimuth_seen_std_deg': _or_none(solution.azimuth_std / DEG),
        'segments': len(evidence.segments),
        'turns': len(evidence.turns),
        'samples': sum(s.statistics.samples for s in evidence.segments)
        + sum(t.statistics.samples for t in evidence.turns),
        'random_walk': [float(v) for v in evidence.walk],
        'residual_rms': [_or_none(v) for v in rms],
        'condition_number': solution.condition,
        'highest_rate': _highest_rate(evidence, session),
        'temperature': seen and {'mean': seen.mean, 'lowest': seen.lowest, 'highest': seen.highest},
        **special,
        'clock': {
            'offset_s': clock.offset,
            'offset_std_s': clock.offset_std,
            'rate_ppm': clock.rate * 1e6,
            'rate_std_ppm': clock.rate_std * 1e6,
            'motions': clock.motions,
        },
        'versions': {'imu_calib': version(), 'numpy': np.__version__, 'scipy': scipy.__version__},
    }


def noise(evidence: Evidence) -> dict[str, object]:
    """Return the noise of a completed session; this takes time."""
    seen = session_noise([s.statistics for s in evidence.segments], evidence.walk)
    return {'noise': {name: channel.document() for name, channel in seen.items()}}


def stamping(setup: Setup, evidence: Evidence) -> StampingClock | None:
    """Return the stamping clock, if motions compare it with the table's."""
    if setup.table is None or not evidence.clocks_compared:
        return None
    unit = ' '.join([setup.imu.id, setup.serial_number]).strip()
    faster, std = evidence.clock_rate()
    return StampingClock(f'stamps of {unit}', f'clock of table {setup.table.name}', faster, std)


def _highest_rate(evidence: Evidence, session: Segmented) -> float | None:
    """Return the highest rate of the unit about any of its axes, rad/s; None if not rotated.

    Turns by hand are faster in their middle than on average, and moves between positions turn
    several joints at once: they are included, so that the session itself is within this rate.
    """
    rates = [abs(float(turn.rate())) for turn in evidence.turns]
    rates += [move.fastest for move in session.moves]
    return max(rates, default=None)


def _or_none(value: float) -> float | None:
    """Return a number, or None if it is not known."""
    return float(value) if np.isfinite(value) else None
