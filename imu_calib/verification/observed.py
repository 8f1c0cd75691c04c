"""What a recording offers to hold a calibration against: rests and turns, with their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..earth import Site
from ..errors import NotObservable
from ..imu import ImuSpec, TriadSpec
from ..methods.evidence import Evidence, noise
from ..methods.timebase import in_table_time
from ..plan import Plan
from ..segmentation.labelling import label
from ..segmentation.session import Segmented
from ..stamping import StampingClock
from ..stream import Floats, Units
from ..turntable import Table


@dataclass(frozen=True, eq=False)
class Rest:
    """A stretch at rest.

    Attributes:
        name: Position of the plan, attitude, or a number.
        at: When it began, s after the first.
        output: (6,) mean output, rad/s and m/s^2 by the recording's own description of the IMU.
        variance: (6,) its variance.
        attitude: (3, 3) R_nb in east, north, up of the table's azimuth; None where unknown.

    """

    name: str
    at: float
    output: Floats
    variance: Floats
    attitude: Floats | None


@dataclass(frozen=True, eq=False)
class Spin:
    """Whole turns about the vertical, measured by an encoder.

    Attributes:
        name: Position of the plan, axis that is up, or a number.
        output: (3,) mean gyro output, rad/s.
        variance: (3,) its variance.
        up: (3,) up in body axes.
        rate: By the encoder, about up, rad/s of the IMU's clock.
        duration: s.
        rate_error: Standard deviation of the encoder's rate, relative.

    """

    name: str
    output: Floats
    variance: Floats
    up: Floats
    rate: float
    duration: float
    rate_error: float


@dataclass(frozen=True, eq=False)
class Observed:
    """A session to be held against a calibration.

    Attributes:
        rests: Stretches at rest, in order.
        turns: Whole turns, in order; none where attitudes are unknown.
        site: Gravity and Earth rate.
        imu: How the recording describes its IMU.
        sample_rate: Samples per second, Hz.
        north_known: Whether the attitudes are against north.
        positioning: Standard deviation of an arrival of the table, rad; 0 when not stated.
        clock_std: Of the rate between the clocks of table and IMU, relative.
        notes: What was left out, in sentences.

    """

    rests: tuple[Rest, ...]
    turns: tuple[Spin, ...]
    site: Site
    imu: ImuSpec
    sample_rate: float
    north_known: bool
    positioning: float
    clock_std: float
    notes: tuple[str, ...] = ()

    @property
    def with_attitudes(self) -> bool:
        """Whether directions can be compared, or lengths alone."""
        return all(rest.attitude is not None for rest in self.rests)

    def reading(self, spec: ImuSpec) -> tuple[float, float]:
        """Return by what the outputs are to be multiplied to be read as another description does.

        Who applies a calibration takes the numbers of the stream for what the calibration says
        that they are: gyros and accelerometers, dimensionless.

        Args:
            spec: The calibration's description of the IMU.

        """
        return (
            self._si_per_number(spec.units, spec.gyro)
            / self._si_per_number(self.imu.units, self.imu.gyro),
            self._si_per_number(spec.units, spec.accel)
            / self._si_per_number(self.imu.units, self.imu.accel),
        )

    def _si_per_number(self, units: Units, triad: TriadSpec) -> float:
        if units is Units.SI:
            return 1.0
        return triad.scale_factor * (self.sample_rate if units is Units.PULSES else 1.0)


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
        plan: What was run; `plan.UNPLANNED` where nobody knows: rests are then named by their
            attitudes, or numbered where nobody tells those either.
        table: The table whose joint states came in; None with the IMU alone.
        clock: What the calibration says of the clock that stamps the samples; None where its
            parameters are by that clock.

    Raises:
        InputError: The setpoints name none of the plan's positions.
        NotObservable: Neither rests nor turns were found.

    """
    with_angles = any(s.attitude is not None for s in session.segments) or bool(session.turns)
    labelled = label(session, plan, table if with_angles or plan.is_stated else None)
    if not labelled.segments and not labelled.turns:
        raise NotObservable(
            f'Neither rests nor whole turns were found in {session.samples} IMU samples '
            f'({session.duration:.0f} s): nothing can be compared.'
        )
    walk = noise(labelled.segments, imu)
    # The attitudes of a plan that a person holds by hand are good to degrees, no more.
    known = not plan.by_hand and all(s.attitude is not None for s in labelled.segments)
    evidence = Evidence(
        labelled.segments,
        labelled.turns,
        plan,
        site,
        session.clock,
        None,
        walk,
        units=imu.units,
    )
    evidence, faster = _by_the_clock_of(clock, evidence)
    start = labelled.segments[0].start if labelled.segments else 0
    rests = tuple(
        Rest(
            segment.position or str(k + 1),
            (segment.start - start) * 1e-9,
            segment.statistics.mean,
            segment.variance(walk, site.gravity),
            segment.attitude if known else None,
        )
        for k, segment in enumerate(evidence.segments)
    )
    turns = tuple(
        Spin(
            turn.position or str(k + 1),
            turn.statistics.mean[:3],
            turn.variance(walk, site.north_rate),
            turn.up,
            turn.rate() / faster,
            turn.statistics.duration,
            turn.rate_error,
        )
        for k, turn in enumerate(evidence.turns)
        if known
    )
    # A plan of turns alone names no rests.
    rates = [
        s.statistics.samples / s.statistics.duration for s in labelled.segments or labelled.turns
    ]
    return Observed(
        rests,
        turns,
        site,
        imu,
        float(np.median(rates)),
        north_known=table is not None and table.azimuth is not None,
        positioning=table.positioning if table is not None else 0.0,
        clock_std=evidence.turns_clock_std,
        notes=(*labelled.notes, *session.losses),
    )


def _by_the_clock_of(clock: StampingClock | None, evidence: Evidence) -> tuple[Evidence, float]:
    """Return a session by the clock by which a calibration is, and what its turns' rates need.

    A calibration that knows the ratio is by the table's clock, and so is a session that tells it;
    one that does not tell is stamped by the same clock. Other calibrations of pulses are by the
    clock of the stamps, for which the table's rates are to be divided by the ratio.

    Returns:
        The session, and the divisor.

    """
    if clock is None:
        pulses = evidence.units is Units.PULSES
        return evidence, 1 + evidence.clock_rate()[0] if pulses else 1.0
    if not evidence.clocks_compared:
        # Weighed with what quartz may differ by, the ratio would come out smaller.
        known = replace(evidence.clock, rate=clock.faster, rate_std=0.0)
        evidence = replace(evidence, clock=known)
    return in_table_time(evidence), 1.0
