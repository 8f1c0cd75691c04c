"""Errors of a table that enter the outputs of all units on it.

Units on one table go through the same attitudes, with the same errors: the positioning error of
each stop, the uncertainty of its axes, zeros and encoders, the noise of its encoders, and the
latitude of the site. Each of these is one unknown of deviation one, for any number of units;
azimuth and tilts are in the state of each unit, and are the same.

Source: docs/mathematics.md, 'Several units on one table'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..common.budget import ErrorSource
from ..common.gaussian import FIVE_SIGMA
from ..common.rotations import shortest
from ..common.stream import Floats
from ..common.units import ARCSEC
from ..model.parameters import PARAMETERS
from ..model.sensors import Triad
from ..segmentation.segments import Segment, Turn
from ..session.table_errors import TableErrors
from .equations import Equations
from .evidence import UP, Evidence
from .positioning_errors import PositioningErrors, axes_of, stops_of
from .session_model import Nuisance

TABLE_STATE = (Nuisance.AZIMUTH, Nuisance.TILT_X, Nuisance.TILT_Y)
"""Entries of each unit's state that belong to the table."""

SHARED = frozenset(
    {
        ErrorSource.POSITIONING_STATED,
        ErrorSource.POSITIONING_FOUND,
        ErrorSource.STOPS,
        ErrorSource.TABLE,
        ErrorSource.LATITUDE,
        ErrorSource.ENCODER_RATE,
        ErrorSource.ENCODER_NOISE,
    }
)
"""Sources whose errors are the same for all units on a table."""

_COLUMN_SOURCES = (
    ErrorSource.POSITIONING_STATED,
    ErrorSource.POSITIONING_STATED,
    ErrorSource.TABLE,
    ErrorSource.LATITUDE,
    ErrorSource.ENCODER_RATE,
    ErrorSource.STOPS,
    ErrorSource.ENCODER_NOISE,
)
"""Source of each array of columns that `CommonTable._unit_columns` returns, in its order.

Positioning errors of joints are two: of stopped joints, and at the ends of whole motions.
"""


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """The errors that enter the outputs of all units."""

    #: Source of each of the k errors, in units of its prior standard deviation.
    sources: tuple[ErrorSource, ...]
    #: Name of each, for messages; empty for one that is not determined separately.
    names: tuple[str, ...]
    #: (k,) prior standard deviation of each error with a name, rad; 0 for the others.
    sizes: Floats
    #: For each unit the (m, k) changes of its outputs by one standard deviation.
    columns: tuple[Floats, ...]


@dataclass(frozen=True)
class CommonSizes:
    """Assumed sizes of the errors of a table."""

    errors: TableErrors  #: Of its axes, zeros and encoders.
    #: Positioning errors of joints and stops beyond its description.
    positioning: PositioningErrors

    @classmethod
    def of_one_unit(cls, unit: Equations) -> CommonSizes:
        """Return the estimates of one unit by itself."""
        table = unit.evidence.table
        return cls(TableErrors() if table is None else table.errors, unit.positioning)


class CommonTable:
    """The table of several units: which stops, turns and errors are common."""

    def __init__(self, units: Sequence[Equations], sizes: CommonSizes) -> None:
        self._units = units
        evidences = [unit.evidence for unit in units]
        self._rests = _numbered_by_time([_times(e, e.segments) for e in evidences])
        self._turns = _numbered_by_time([_times(e, e.turns) for e in evidences])
        self.stated = max(e.positioning for e in evidences)
        self.positioning = sizes.positioning
        self._joint_errors, self._joint_names = _joint_effects(evidences)
        self._table_attitude_errors = [
            e.with_table_errors(sizes.errors).table_attitude_errors
            if e.table
            else (np.zeros(0), np.zeros(0))
            for e in evidences
        ]

    @property
    def stated_share(self) -> float:
        """Share of the variance of positioning errors that the table's description states."""
        whole = self.stated**2 + self.positioning.joints**2
        return self.stated**2 / whole if whole else 1.0

    def errors_at(self, states: Sequence[Floats]) -> CommonErrors:
        """Return the common errors, their effects linearised at the states (n,) of the units."""
        joints = float(np.hypot(self.stated, self.positioning.joints))
        found = [
            self._unit_columns(k, unit, state, joints)
            for k, (unit, state) in enumerate(zip(self._units, states, strict=True))
        ]
        sources = [s for s, part in zip(_COLUMN_SOURCES, found[0], strict=True) for _ in part.T]
        columns = [np.hstack(parts) for parts in found]
        # Only the errors of joints have a name and a size.
        named = len(self._joint_names)
        names = [*self._joint_names, *[''] * (len(sources) - named)]
        sizes = np.where(np.arange(len(sources)) < named, joints, 0.0)
        # Errors that no unit observes are left out.
        seen = np.any([part.any(axis=0) for part in columns], axis=0)
        kept = np.flatnonzero(seen)
        return CommonErrors(
            tuple(sources[k] for k in kept),
            tuple(names[k] for k in kept),
            sizes[kept],
            tuple(part[:, kept] for part in columns),
        )

    def _unit_columns(self, k: int, unit: Equations, state: Floats, joints: float) -> list[Floats]:
        """Return the effect of each kind of error on the outputs of a unit, (m, e) each."""
        evidence = unit.evidence
        assert evidence.table is not None
        stopping = unit.attitude_error_effects(state, *self._joint_errors[k])
        table = unit.attitude_error_effects(state, *self._table_attitude_errors[k])
        latitude = unit.latitude_derivatives(state)[:, None] * evidence.site.latitude_std
        rates = _summed(unit.encoder_rate_effects(state), self._turns[k], _count(self._turns))
        by_way = [n for n, t in zip(self._turns[k], evidence.turns, strict=True) if t.whole_way]
        ways = _summed(
            unit.rest_to_rest_effects(state), np.array(by_way, dtype=np.intp), _count(self._turns)
        )
        # About the axes of the table's mounting, which all units have in common.
        inward = evidence.table.mount.T
        rests, turned = self._rests[k], self._turns[k]
        count = _count(self._rests)
        same = np.full(len(evidence.segments), self.positioning.stops)
        stops = _blocks(rests, count, same, inward)
        reading = np.array([s.attitude_error for s in evidence.segments])
        noise = _blocks(rests, count, reading, inward)
        up_errors = np.array([t.up_error for t in evidence.turns])
        turning = _blocks(turned, _count(self._turns), up_errors, inward)
        only_dwells = np.zeros((len(evidence.turns), 3, stops.shape[2]))
        of_dwells = unit.attitude_error_effects(state, noise, only_dwells)
        of_turns = unit.attitude_error_effects(
            state, np.zeros((len(evidence.segments), 3, turning.shape[2])), turning
        )
        return [
            stopping * joints,
            ways * joints,
            table,
            latitude,
            rates,
            unit.attitude_error_effects(state, stops, only_dwells),
            np.hstack([of_dwells, of_turns]),
        ]


def shares_a_table(equations: Equations) -> bool:
    """Return whether all parts of a session have joint angles of a table."""
    evidence = equations.evidence
    if evidence.table is None or evidence.plan.by_hand or evidence.free:
        return False
    if evidence.attitude_steps:
        # Of this unit alone.
        return False
    return all(part.angles is not None for part in evidence.parts)


def dwell_counts(units: Sequence[Equations]) -> tuple[list[int], int]:
    """Return the number of the table's dwells that each unit saw, and their total."""
    evidences = [unit.evidence for unit in units]
    dwells = _numbered_by_time([_times(e, e.segments) for e in evidences])
    return [len(np.unique(mine)) for mine in dwells], _count(dwells)


def _joint_effects(evidences: Sequence[Evidence]) -> tuple[list[tuple[Floats, Floats]], list[str]]:
    """Return the effect of positioning errors of joints, one error for all units at each stop.

    Rotations (s, 3, e) and (t, 3, e) of each unit, and the names of the stops.
    """
    table = evidences[0].table
    assert table is not None
    parts = [part for e in evidences for part in e.parts]
    order = np.argsort(np.concatenate([_times(e, e.parts)[:, 0] for e in evidences]), kind='stable')
    angles = [_angles(e) for e in evidences]
    restarts = [one for e in evidences for one in e.restarts]
    columns, names = [], []
    for joint, readings in enumerate(np.concatenate(angles).T):
        axes = [
            axes_of(e.table or table, joint, own, e.turns)
            for e, own in zip(evidences, angles, strict=True)
        ]
        for stop in stops_of(joint, readings, parts, order.tolist(), restarts):
            column = np.zeros((len(parts), 3))
            column[stop] = np.concatenate(axes)[stop]
            columns.append(column)
            names.append(f'{table.joints[joint].name} at {parts[stop[0]].position}')
    ends = np.cumsum([len(own) for own in angles])[:-1]
    split = zip(evidences, np.split(np.stack(columns, axis=2), ends), strict=True)
    return [(own[: len(e.segments)], own[len(e.segments) :]) for e, own in split], names


def _angles(evidence: Evidence) -> Floats:
    """Return the joint angles of dwells, then of turns, (s + t, joints) rad."""
    return np.array([p.angles for p in evidence.parts]).reshape(len(evidence.parts), -1)


def _times(evidence: Evidence, parts: Sequence[Segment | Turn]) -> Floats:
    """Return start and end by the table's clock, (k, 2) s."""
    clock = evidence.clock
    stamps = np.array([[part.start, part.end] for part in parts], dtype=np.float64).reshape(-1, 2)
    since = (stamps - clock.epoch) * 1e-9
    return np.asarray(stamps * 1e-9 - clock.offset - clock.rate * since)


def _numbered_by_time(times: Sequence[Floats]) -> list[NDArray[np.intp]]:
    """Number dwells, or turns, of several units by start and end (k, 2), s.

    Those at the same time have one number, from 0 in the order of time.

    Between two dwells, and between two turns, the table moves: different ones are apart in time.
    """
    found = [np.zeros(len(of), dtype=np.intp) for of in times]
    owners = [(unit, k) for unit, of in enumerate(times) for k in range(len(of))]
    owners.sort(key=lambda owner: times[owner[0]][owner[1], 0])
    number, end, shortest = -1, -np.inf, 0.0
    for unit, k in owners:
        begin, own_end = times[unit][k]
        # Half of the shorter one: clocks differ by some samples, dwells are tens of seconds long.
        if begin > end - min(own_end - begin, shortest) / 2:
            number, end, shortest = number + 1, own_end, own_end - begin
        end, shortest = max(end, own_end), min(shortest, own_end - begin)
        found[unit][k] = number
    return found


def _count(numbers: Sequence[NDArray[np.intp]]) -> int:
    """Return how many different dwells, or turns, `_numbered_by_time` found."""
    return 1 + max((int(of.max(initial=-1)) for of in numbers), default=-1)


def _blocks(numbers: NDArray[np.intp], count: int, sizes: Floats, axes: Floats) -> Floats:
    """Return the effect of `count` common rotations on k attitudes, (k, 3, 3 count).

    Rotation `numbers` (k,) acts on each attitude, by `sizes` (k,) rad about its axes, the columns
    of (3, 3) in body axes.
    """
    result = np.zeros((len(numbers), 3, 3 * count))
    for k, number in enumerate(numbers.tolist()):
        result[k, :, 3 * number : 3 * number + 3] = sizes[k] * axes
    return result


def _summed(columns: Floats, numbers: NDArray[np.intp], count: int) -> Floats:
    """Return columns (m, t) summed by their numbers, (m, count)."""
    result = np.zeros((len(columns), count))
    for k, number in enumerate(numbers.tolist()):
        result[:, number] += columns[:, k]
    return result


# The accelerometers at rest show the tilt. Its effect on a solver is the difference of the solver's
# results for the outputs that its own solution predicts on the tilted table and on a level one: for
# twelve positions 1 - cos tilt in K_a, for others more (docs/mathematics.md, 'Twelve positions').

Accelerometers = Callable[[Evidence], Triad]  #: A closed form for the accelerometers of a session.

_SIGNIFICANT = 0.5
"""An error of so many standard deviations gets a sentence and widens them, by 12 %; smaller ones
are negligible against them."""


@dataclass(frozen=True, eq=False)
class Tilt:
    """The plumb line by the accelerometers at rest."""

    up: Floats  #: (3,) unit vector in the frame of the attitudes.
    std: float  #: Standard deviation of its direction about either level axis, rad.

    @property
    def size(self) -> float:
        """Angle to the vertical of the attitudes, rad."""
        return float(np.hypot(self.up[0], self.up[1]))

    @property
    def is_significant(self) -> bool:
        """Whether it exceeds the noise of two axes, which it does by chance once in 270 000."""
        return self.size > FIVE_SIGMA * self.std

    def levelled(self, vector: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Return a (3,) vector of the frame of the attitudes against the plumb line.

        Its covariance (3, 3) is without that of the tilt.
        """
        turned = shortest(self.up, UP)
        leaning = np.cross(np.eye(3)[:2], vector) * self.std
        return turned @ vector, turned @ covariance @ turned.T + leaning.T @ leaning


def tilt_bias(evidence: Evidence, accel: Triad, solver: Accelerometers, tilt: Tilt) -> Floats:
    """Return the errors of a closed form by a tilt, (12,) in the order of the parameters."""

    def solved(up: Floats) -> Floats:
        forces = evidence.site.gravity * np.einsum('skj,k->sj', evidence.dwell_attitudes, up)
        outputs = forces @ accel.response.T + accel.bias
        segments = tuple(
            replace(s, statistics=replace(s.statistics, mean=np.append(s.statistics.mean[:3], y)))
            for s, y in zip(evidence.segments, outputs, strict=True)
        )
        return solver(replace(evidence, segments=segments)).vector()

    return solved(tilt.up) - solved(UP)


def widened_for_tilt(
    evidence: Evidence, accel: Triad, covariance: Floats, solver: Accelerometers, tilt: Tilt
) -> tuple[Floats, list[str]]:
    """Add the effect of a significant tilt to the accelerometers' covariance, and report it.

    It is not corrected: six positions show the tilt about one axis but not about the other, and a
    partly corrected result would not be that of the published formula.
    """
    if not tilt.is_significant:
        return covariance, []
    own = slice(12, 24)
    bias = tilt_bias(evidence, accel, solver, tilt)
    std = np.sqrt(np.diag(covariance)[own])
    ratio = np.divide(np.abs(bias), std, out=np.zeros(12), where=std > 0)
    worst = int(np.argmax(ratio))
    if ratio[worst] < _SIGNIFICANT:
        return covariance, []
    widened = covariance.copy()
    widened[own, own] += np.outer(bias, bias)
    return widened, [
        f'The table is tilted by {tilt.size / ARCSEC:.0f} arcsec, which this closed form takes to '
        f'be horizontal: {PARAMETERS[12 + worst].name} is biased by {ratio[worst]:.1f} standard '
        'deviations, and the standard deviations of the accelerometers are widened by that. Level '
        'the table, or take the joint estimate, which estimates the tilt.'
    ]
