"""The parts of a recording that a calibration can be compared with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..common.errors import NotObservable
from ..common.stream import Floats, Units
from ..model.earth import Site
from ..segmentation.labelling import label
from ..segmentation.stream_facts import Segmented
from ..session.imu import ImuSpec
from ..session.plan import Plan
from ..session.table import Table
from ..session.table_errors import StampingClock
from .evidence import Evidence
from .timebase import in_table_time


@dataclass(frozen=True, eq=False)
class Observed:
    """A session to verify a calibration by.

    Attributes:
        evidence: Dwells and turns by name; without attitudes and turns if these are unknown.
        imu: The recording's description of its IMU.
        sample_rate: Samples per second, Hz.
        notes: What was left out, in sentences.
    """

    evidence: Evidence
    imu: ImuSpec
    sample_rate: float
    notes: tuple[str, ...] = ()

    @property
    def site(self) -> Site:
        """Gravity and Earth rate."""
        return self.evidence.site

    @property
    def with_attitudes(self) -> bool:
        """Whether directions can be compared, not only lengths."""
        return all(s.attitude is not None for s in self.evidence.segments)

    def reading(self, spec: ImuSpec) -> tuple[float, float]:
        """Return the factors on the outputs for reading them by another description.

        A user of a calibration interprets the stream by the calibration's own description of the
        IMU. The factors are for gyros and accelerometers, dimensionless.
        """
        gyro, accel = self._si_per_number(spec) / self._si_per_number(self.imu)
        return float(gyro), float(accel)

    def _si_per_number(self, spec: ImuSpec) -> Floats:
        if spec.units is Units.SI:
            return np.ones(2)
        scales = np.array([spec.gyro.scale_factor, spec.accel.scale_factor])
        return scales * (self.sample_rate if spec.units.per_interval else 1.0)


def observe(
    session: Segmented,
    imu: ImuSpec,
    site: Site,
    plan: Plan,
    table: Table | None,
    clock: StampingClock | None = None,
) -> Observed:
    """Collect dwells and turns of a session.

    Args:
        session: Contents of the streams.
        imu: The recording's description of its IMU.
        site: Gravity and Earth rate.
        plan: The plan that was run; `plan.UNPLANNED` if unknown: dwells are then named by their
            attitudes, or numbered if those are unknown.
        table: The table whose joint states were recorded; None for the IMU alone.
        clock: The calibration's estimate of the stamping clock; None if its parameters refer to
            that clock.

    Raises:
        InputError: The setpoints name none of the plan's positions.
        NotObservable: Neither dwells nor turns were found.
    """
    with_angles = any(s.attitude is not None for s in session.segments) or bool(session.turns)
    labelled = label(session, plan, table if with_angles or plan.is_stated else None)
    if not labelled.segments and not labelled.turns:
        raise NotObservable(
            f'Neither static dwells nor whole turns were found in {session.samples} IMU samples '
            f'({session.duration:.0f} s): nothing can be compared.'
        )
    # A plan of turns alone has no named dwells.
    timed = [s.statistics for s in labelled.segments or labelled.turns]
    sample_rate = float(np.median([s.samples / s.duration for s in timed]))
    # Attitudes held by hand are accurate to degrees only.
    known = not plan.by_hand and all(s.attitude is not None for s in labelled.segments)
    segments = tuple(
        replace(s, position=s.position or str(k + 1), attitude=s.attitude if known else None)
        for k, s in enumerate(labelled.segments)
    )
    turns = tuple(
        replace(t, position=t.position or str(k + 1)) for k, t in enumerate(labelled.turns)
    )
    named = replace(labelled, segments=segments, turns=turns)
    evidence = _by_the_clock_of(clock, Evidence.of(named, session, plan, imu, site, table))
    evidence = evidence if known else replace(evidence, turns=(), moves=())
    return Observed(evidence, imu, sample_rate, (*labelled.notes, *session.losses))


def _by_the_clock_of(clock: StampingClock | None, evidence: Evidence) -> Evidence:
    """Return a session by the clock that the calibration refers to.

    A calibration that states the clock ratio refers to the table's clock, and so does a session
    that determines it; a session that does not is taken to be stamped by the same clock. Other
    calibrations of pulses refer to the stamping clock, by which the table's turns take longer.
    """
    if clock is not None:
        if not evidence.clocks_compared:
            # With the prior of quartz clocks, the estimated ratio would be too small.
            known = replace(evidence.clock, rate=clock.faster, rate_std=0.0)
            evidence = replace(evidence, clock=known)
        return in_table_time(evidence)
    if not evidence.units.per_interval:
        return evidence
    faster = 1 + evidence.clock_rate()[0]
    turns = (
        t if t.seconds is None else replace(t, seconds=t.seconds * faster) for t in evidence.turns
    )
    return replace(evidence, turns=tuple(turns))
