"""Calibrate a unit on a table, or several together, from a recording or a live stream."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..common.errors import Contradiction, ImuCalibError, InputError, NotObservable
from ..common.finding import warning
from ..common.stream import Block, Mode
from ..estimation import joint
from ..estimation.common_unknowns import Contradicting, TableEstimate, join
from ..estimation.evidence import Evidence
from ..estimation.information import attainable_std
from ..estimation.joint import Comparison
from ..estimation.methods import check_plan, closed_form_of, method, provisional
from ..estimation.search import SearchResult
from ..estimation.setup import Setup
from ..estimation.solution import Solution
from ..estimation.table_effects import shares_a_table
from ..model.parameters import AXES, Parameter
from ..model.sensors import SensorModel, gravity_covariance, has_motion_terms
from ..segmentation.labelling import Labelled, label
from ..segmentation.segmented import Segmented
from ..segmentation.segmenter import Segmenter
from ..session.plan import Step
from ..session.table_errors import clock_share
from .mistakes import (
    dead_channels,
    explained,
    joints_in_degrees,
    refuse_separate_messages,
    with_facts,
    wrong_joint_signs,
)
from .results import (
    Basis,
    Result,
    Review,
    bad_samples_first,
    loss_findings,
    losses_of_all_segments,
)

if TYPE_CHECKING:
    from .hand import HandCalibrator

_ENOUGH = 0.5
"""Share of a dwell that must be usable: less increases its noise by more than a factor 1.4."""

_SAME_RATE = 0.2
"""Relative tolerance on the commanded rate. A judgement: scale factors are percents off, and the
rates of a supplied plan differ by a quarter or more."""


def unsupported_steps(session: Segmented, labelled: Labelled, setup: Setup) -> tuple[int, ...]:
    """Return the indices of steps seen without sufficient data, ascending, with the current one.

    Turns that saturate the gyros would do so again, and are not among them.
    """
    plan = setup.plan
    seen = [s.step for s in session.setpoints if s.plan == plan.name and s.mode is not Mode.HOLD]
    # Steps are run in order: one whose setpoints were lost with all else was run as well.
    last = max(seen, default=-1)
    # The signed rate about up of every step with turns: those of its position, in order.
    tests = {p.id: list(p.rate_test.rates) for p in plan.positions if p.rate_test is not None}
    rates = {
        step.index: tests[step.position].pop(0) for step in setup.steps if step.mode is Mode.RATE
    }
    return tuple(
        step.index
        for step in setup.steps
        if step.index <= last
        and not _is_supported(step, labelled, rates.get(step.index))
        and not plan.position(step.position).saturates(rates.get(step.index, 0.0), setup.imu)
    )


def _is_supported(step: Step, labelled: Labelled, rate: float | None) -> bool:
    if step.mode is Mode.RATE:
        return rate is not None and any(
            turn.position == step.position and abs(turn.rate() - rate) < _SAME_RATE * abs(rate)
            for turn in labelled.turns
        )
    if not step.dwell:
        return True
    quiet = sum(
        segment.statistics.duration
        for segment in labelled.segments
        if segment.position == step.position
    )
    return quiet >= _ENOUGH * step.dwell


class Calibrator:
    """Collect blocks as they come and solve on request.

    The result depends on the sequence of each topic and its stamps, but not on how topics
    interleave or how blocks are cut.

    Raises:
        InputError: The method does not exist.
        NotObservable: No session of the plan can determine the method's parameters.
    """

    def __init__(self, setup: Setup) -> None:
        check_plan(setup.method_name, setup.plan, setup.site)
        self._setup = setup
        arguments = setup.method_name, setup.terms, setup.changes
        self._solver = method(*arguments, find_terms=setup.search_terms)
        self._glance = provisional(*arguments)
        self._segmenter = Segmenter(setup.imu, setup.table, setup.segments)
        self._gathered: tuple[tuple[object, ...], Evidence] | None = None

    def add_block(self, block: Block) -> None:
        """Add a block of any topic."""
        self._segmenter.add_block(block)

    def finish(self) -> Result:
        """End the session and solve."""
        session = self._segmenter.finish()
        refuse_separate_messages(session)
        if session.foreign_joints:
            raise InputError(session.foreign_joints)
        with with_facts(session):
            return self._solve(session, self._labelled(session), final=True)

    def snapshot(self) -> Calibrator:
        """Return a calibrator with all data so far; this one continues independently.

        Finishing the snapshot gives the result of a session that ended here.
        """
        other = copy.copy(self)
        other._segmenter = self._segmenter.snapshot()
        return other

    def review(self) -> Review:
        """Solve a snapshot, or return what is determined already.

        Terms that were not asked for are searched for only at the end: the search takes several
        times as long as the estimate, and later data may change what it finds.
        """
        return self._reviewed(final=False)

    def conclude(self) -> Review:
        """End the session: return the result of `finish`, or how far the session has come."""
        return explained(self._reviewed(final=True))

    def _reviewed(self, *, final: bool) -> Review:
        session = self._segmenter.finish()
        labelled = self._labelled(session)
        unsupported = unsupported_steps(session, labelled, self._setup)
        result, refusal = None, ''
        try:
            result = self._solve(session, labelled, final=final)
            found = result.calibration
            std = dict(zip(found.parameters, found.std.tolist(), strict=True))
        except NotObservable as error:
            refusal, std = str(error), self._reached(labelled, session)
        wanted = self._setup.parameters
        reached = np.array([std.get(parameter, np.nan) for parameter in wanted])
        return Review(session, wanted, reached, unsupported, result, refusal)

    def _reached(self, labelled: Labelled, session: Segmented) -> dict[Parameter, float]:
        """Return the standard deviations of determined parameters, NaN for the rest."""
        parameters = tuple(p for p in self._setup.parameters if p.row < len(AXES))
        try:
            noise_alone = attainable_std(self.evidence(labelled, session), parameters)
        except NotObservable:
            return {}
        setup, ideal = self._setup, SensorModel()
        relative_std = setup.site.gravity_relative_std
        share = np.diag(gravity_covariance(ideal, parameters, relative_std))
        if setup.table is not None:
            clock = clock_share(ideal, parameters, setup.imu.units, setup.table.clock)
            share = share + np.diag(clock.covariance)
        return dict(zip(parameters, np.sqrt(noise_alone**2 + share).tolist(), strict=True))

    def evidence(self, labelled: Labelled, session: Segmented) -> Evidence:
        """Return a labelled session as input of the method.

        Raises:
            NotObservable: Neither the data nor the IMU's description determines the noise.
        """
        return self._evidence(self._used(labelled), session)

    def _used(self, labelled: Labelled) -> Labelled:
        """Return the segments that the method uses."""
        setup = self._setup
        return labelled.of_plan(setup.plan) if setup.plan_alone else labelled

    def _evidence(self, labelled: Labelled, session: Segmented) -> Evidence:
        """Collect the evidence; shared if the session contains the plan's positions alone."""
        setup, parts = self._setup, (labelled.segments, labelled.turns, session)
        if self._gathered is None or self._gathered[0] != parts:
            known = setup.plan, setup.imu, setup.site, setup.table
            found = Evidence.from_session(labelled, session, *known)
            self._gathered = parts, replace(found, coarse=has_motion_terms(setup.terms))
        return self._gathered[1]

    def _estimate(
        self,
        evidence: Evidence,
        labelled: Labelled,
        session: Segmented,
        solver: Callable[[Evidence], Solution],
    ) -> tuple[Solution, Comparison | None]:
        """Solve; for a joint estimate, also by the closed form of the plan.

        Contradictions found by the closed form are refused: a joint estimate could reduce the
        weight of half of the data until the other half agrees.
        """
        name = closed_form_of(self._setup.method_name, self._setup.plan)
        if name is None:
            return solver(evidence), None
        closed: Solution | NotObservable
        try:
            closed = method(name)(self._evidence(labelled.of_plan(self._setup.plan), session))
        except Contradiction:
            raise
        except NotObservable as error:
            closed = error
        try:
            solution = solver(evidence)
        except InputError:
            # Parameters that part of a session does not determine may have any value.
            if isinstance(closed, NotObservable):
                raise closed from None
            raise
        if isinstance(closed, NotObservable):
            return solution, Comparison.refused(name, str(closed))
        return solution, Comparison.between(solution, closed, name)

    def _labelled(self, session: Segmented) -> Labelled:
        """Return the session's segments by the names of the plan."""
        return label(session, self._setup.plan, self._setup.table)

    def _solve(self, session: Segmented, labelled: Labelled, *, final: bool) -> Result:
        """Solve a labelled session; search for terms only if it is `final`."""
        if final and (mistake := self._mistake(session)):
            # The search for terms would take long, and all that it says follows from that.
            raise bad_samples_first(Contradiction(mistake), session)
        try:
            return self._solve_as_stated(session, labelled, final=final)
        except NotObservable as error:
            mistake = '' if final else self._mistake(session)
            refusal = Contradiction(mistake) if mistake else error
            raise bad_samples_first(refusal, session) from None
        except InputError as error:
            raise bad_samples_first(error, session) from None

    def _mistake(self, session: Segmented) -> str:
        """Return that joint states are in degrees or of the wrong sign; empty if neither."""
        if self._setup.table is None:
            return joints_in_degrees(session)
        return joints_in_degrees(session) or wrong_joint_signs(session, self._setup.table)

    def _solve_as_stated(self, session: Segmented, labelled: Labelled, *, final: bool) -> Result:
        setup = self._setup
        used = self._used(labelled)
        if not used.segments and not used.turns:
            raise NotObservable(*losses_of_all_segments(session, labelled, setup))
        evidence = self._evidence(used, session)
        lost = loss_findings(setup, evidence, labelled, session)
        try:
            solver = self._solver if final else self._glance
            solution, comparison = self._estimate(evidence, labelled, session, solver)
        except NotObservable as error:
            causes = tuple(dead_channels(session))
            raise error.among(before=causes, after=tuple(lost)) from None
        except InputError as error:
            if dead := dead_channels(session):
                raise NotObservable(*dead, *error.args) from None
            raise
        except np.linalg.LinAlgError as error:
            # Channels without noise make covariances singular.
            singular = f'The equations of the session have no solution ({error}).'
            raise NotObservable(*dead_channels(session), singular, *lost) from None
        found = Basis(setup, evidence, session, labelled, comparison, tuple(lost), final)
        return found.concluded(solution)


_NOBODY = (
    'Its data on the table contradicts the other unit (chi-square {square:.0f} with {freedom} '
    'degrees of freedom): it is unknown which of the two is right, and each is calibrated by '
    'itself. A third unit would show which.'
)
_ODD = (
    'Its data on the table contradicts the other units (chi-square {square:.0f} with {freedom} '
    'degrees of freedom): it is calibrated by itself. Possible causes: a unit that is loose on the '
    'fixture, samples that froze, a clock that jumps, and sensors that differ from their '
    'description.'
)


_PARTIAL = (
    'It saw {seen} of the {of_all} static dwells of all units, and is calibrated by itself: its '
    'samples ended, froze or began late.'
)


@dataclass(frozen=True, eq=False)
class SharedResults:
    """Results of several units."""

    #: One for each unit: with the shared unknowns if it took part, else unchanged.
    results: tuple[Result | None, ...]
    #: Errors of the table estimated from all; None if fewer than two took part.
    table: TableEstimate | None
    shared: tuple[int, ...]  #: Places of the units that took part.
    left_out: Mapping[int, str]  #: Why others did not, by their place.


def estimate_together(alone: Sequence[Result | None], names: Sequence[str]) -> SharedResults:
    """Estimate the shared unknowns of several units on one table once, from all of them.

    Results of the joint estimate on a table with known joint angles take part: closed forms, units
    in the hand and failures remain unchanged.

    Args:
        alone: The result of each unit by itself; None if it failed.
        names: Name of each, for messages and for the provenance of the others.
    """
    results = list(alone)
    parts = {k: part for k, one in enumerate(alone) if one and (part := _basis_and_search(one))}
    places = list(parts)
    if len(places) < 2:
        return SharedResults(tuple(results), None, (), {})
    try:
        joined = join([search.estimate for _, search in parts.values()])
    except ImuCalibError as error:
        finding = f'What the units share could not be estimated from all of them: {error}'
        return SharedResults(_noted(results, dict.fromkeys(places, finding)), None, (), {})
    shared, left_out = [], {}
    for i, estimate in joined.estimates.items():
        place = places[i]
        basis, search = parts[place]
        found = replace(search, estimate=estimate)
        try:
            solution = joint.concluded(found, basis.setup.terms, basis.setup.changes)
            results[place] = basis.concluded(solution)
        except ImuCalibError as error:
            left_out[place] = f'With what the units share it is refused: {error}'
            continue
        shared.append(place)
    for place in shared:
        others = [names[other] for other in shared if other != place]
        if (result := results[place]) is not None and others:
            calibration = result.calibration
            provenance = {**calibration.provenance, 'shared_with': others}
            results[place] = replace(
                result, calibration=replace(calibration, provenance=provenance)
            )
    for i, seen, of_all in joined.partial:
        left_out[places[i]] = _PARTIAL.format(seen=seen, of_all=of_all)
    for odd in joined.contradicting:
        left_out[places[odd.unit]] = _words(odd, others=len(shared))
    if joined.contradicting and not joined.estimates:
        # Of the last two, which one is wrong cannot be determined.
        last = [p for p in places if p not in left_out]
        left_out |= {p: _words(joined.contradicting[-1], others=0) for p in last}
    return SharedResults(_noted(results, left_out), joined.table, tuple(shared), left_out)


def _basis_and_search(result: Result) -> tuple[Basis, SearchResult] | None:
    basis, search = result.basis, result.solution.search
    if basis is None or search is None or not shares_a_table(search.estimate.equations):
        return None
    return basis, search


def _words(odd: Contradicting, *, others: int) -> str:
    words = _ODD if others else _NOBODY
    return words.format(square=odd.chi_square, freedom=odd.freedom)


def _noted(
    results: Sequence[Result | None], findings: Mapping[int, str]
) -> tuple[Result | None, ...]:
    """Return results with one more sentence on some of them."""
    found = list(results)
    for place, sentence in findings.items():
        if (result := found[place]) is not None:
            calibration = result.calibration
            noted = replace(calibration, findings=(*calibration.findings, warning(sentence)))
            found[place] = replace(result, calibration=noted)
    return tuple(found)


def calibrator_of(setup: Setup) -> Calibrator | HandCalibrator:
    """Return the calibrator for a set-up: with a table, or in free positions."""
    if setup.method_name != 'free_positions':
        return Calibrator(setup)
    # On first use: a session on a table does not need it.
    from .hand import HandCalibrator

    return HandCalibrator(setup)
