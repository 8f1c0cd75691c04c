"""What a recording offers to hold a calibration against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..earth import Site
from ..errors import NotObservable
from ..imu import ImuSpec
from ..observation.evidence import Evidence
from ..observation.timebase import in_table_time
from ..plan import Plan
from ..segmentation.labelling import label
from ..segmentation.segmented import Segmented
from ..stamping import StampingClock
from ..stream import Floats, Units
from ..turntable import Table


@dataclass(frozen=True, eq=False)
class Observed:
    """A session to be held against a calibration.

    Attributes:
        evidence: Dwells and turns by name; without attitudes and turns where these are unknown.
        imu: How the recording describes its IMU.
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
        """Whether directions can be compared, or lengths alone."""
        return all(s.attitude is not None for s in self.evidence.segments)

    def reading(self, spec: ImuSpec) -> tuple[float, float]:
        """Return by what the outputs are to be multiplied to be read as another description does.

        Who applies a calibration takes the numbers of the stream for what the calibration's
        description of the IMU says that they are: gyros and accelerometers, dimensionless.
        """
        gyro, accel = self._si_per_number(spec) / self._si_per_number(self.imu)
        return float(gyro), float(accel)

    def _si_per_number(self, spec: ImuSpec) -> Floats:
        if spec.units is Units.SI:
            return np.ones(2)
        scales = np.array([spec.gyro.scale_factor, spec.accel.scale_factor])
        return scales * (self.sample_rate if spec.units is Units.PULSES else 1.0)


def observe(
    session: Segmented,
    imu: ImuSpec,
    site: Site,
    plan: Plan,
    table: Table | None,
    clock: StampingClock | None = None,
) -> Observed:
    """Collect what a session offers.

    Args:
        session: What the streams contain.
        imu: How the recording describes its IMU.
        site: Gravity and Earth rate.
        plan: What was run; `plan.UNPLANNED` where unknown: dwells are then named by their
            attitudes, or numbered where those are unknown.
        table: The table whose joint states came in; None with the IMU alone.
        clock: What the calibration says of the clock that stamps the samples; None where its
            parameters are by that clock.

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
    # A plan of turns alone names no dwells.
    timed = [s.statistics for s in labelled.segments or labelled.turns]
    sample_rate = float(np.median([s.samples / s.duration for s in timed]))
    # The attitudes of a plan that a person holds by hand are good to degrees, no more.
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
    """Return a session by the clock by which a calibration is.

    A calibration that knows the ratio is by the table's clock, and so is a session that tells it;
    one that does not tell is stamped by the same clock. Other calibrations of pulses are by the
    clock of the stamps, which finds that the table's turns take longer.
    """
    if clock is not None:
        if not evidence.clocks_compared:
            # Weighed with what quartz may differ by, the ratio would come out smaller.
            known = replace(evidence.clock, rate=clock.faster, rate_std=0.0)
            evidence = replace(evidence, clock=known)
        return in_table_time(evidence)
    if evidence.units is not Units.PULSES:
        return evidence
    faster = 1 + evidence.clock_rate()[0]
    turns = (
        t if t.seconds is None else replace(t, seconds=t.seconds * faster) for t in evidence.turns
    )
    return replace(evidence, turns=tuple(turns))
