"""A recording, or a live stream, of a unit on a table: columns in, a calibration out."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import Contradiction, InputError, NotObservable
from ..gravity import gravity_covariance
from ..methods import check_plan, closed_form_beside, method, provisional
from ..methods.cross_check import Comparison
from ..methods.solution import Solution
from ..model import AXES, Parameter, SensorModel
from ..model.motion import has_motion_terms
from ..observation.evidence import Evidence
from ..observation.information import attainable_std
from ..segmentation.labelling import Labelled, label
from ..segmentation.segmented import Segmented
from ..segmentation.segmenter import Segmenter
from ..stream import Block
from ..table_clock import clock_share
from .basis import Basis
from .losses import loss_findings, nothing_found
from .results import Result, Review
from .setup import Setup
from .unsupported import unsupported_steps


class Calibrator:
    """Takes blocks in as they come and solves when asked.

    The result depends on the sequence of each topic and its stamps: not on how topics interleave,
    nor on how blocks were cut.

    Raises:
        InputError: The method does not exist.
        NotObservable: The plan cannot give the method its parameters, however it is run.
    """

    def __init__(self, setup: Setup) -> None:
        check_plan(setup.method_name, setup.plan, setup.site)
        self._setup = setup
        asked = setup.method_name, setup.terms, setup.changes
        self._solver = method(*asked, look=setup.search_terms)
        self._glance = provisional(*asked)
        self._segmenter = Segmenter(setup.imu, setup.table)
        self._gathered: tuple[tuple[object, ...], Evidence] | None = None

    def feed(self, block: Block) -> None:
        """Take a block of any topic in."""
        self._segmenter.feed(block)

    def finish(self) -> Result:
        """End of the session: solve.

        Raises:
            InputError: The data is not what the set-up says it is.
            NotObservable: The data cannot give all parameters; says which and why.
        """
        session = self._segmenter.finish()
        if session.strangers:
            raise InputError(session.strangers)
        return self._solve(session, self._labelled(session), final=True)

    def snapshot(self) -> Calibrator:
        """Return a calibrator with all that came in so far; this one goes on by itself.

        What the snapshot finishes with is what a session that ended here would give.
        """
        other = copy.copy(self)
        other._segmenter = self._segmenter.snapshot()
        return other

    def review(self) -> Review:
        """Say of a snapshot how far the session has come: solve, or what is determined already.

        Terms that were not asked for are searched for at the end alone: the search takes several
        times as long as the estimate, and what a session goes on to show may change what it finds.

        Raises:
            InputError: The data is not what the set-up says it is.
        """
        return self._reviewed(final=False)

    def conclude(self) -> Review:
        """End of the session: what `finish` gives, or how far it has come.

        Raises:
            InputError: The data is not what the set-up says it is.
        """
        return self._reviewed(final=True)

    def _reviewed(self, *, final: bool) -> Review:
        session = self._segmenter.finish()
        labelled = self._labelled(session)
        unsupported = unsupported_steps(session, labelled, self._setup.plan, self._setup.steps)
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
        """Return the standard deviations of what is determined already, NaN for the rest."""
        parameters = tuple(p for p in self._setup.parameters if p.row < len(AXES))
        try:
            noise_alone = attainable_std(self.evidence(labelled, session), parameters)
        except NotObservable:
            return {}
        setup, ideal = self._setup, SensorModel()
        doubt = setup.site.gravity_doubt
        share = np.diag(gravity_covariance(ideal, parameters, doubt))
        if setup.table is not None:
            clock = clock_share(ideal, parameters, setup.imu.units, setup.table.clock)
            share = share + np.diag(clock.covariance)
        return dict(zip(parameters, np.sqrt(noise_alone**2 + share).tolist(), strict=True))

    def evidence(self, labelled: Labelled, session: Segmented) -> Evidence:
        """Return a labelled session as what the method works on.

        Raises:
            NotObservable: Neither the data nor the IMU's description tells the noise.
        """
        return self._evidence(self._used(labelled), session)

    def _used(self, labelled: Labelled) -> Labelled:
        """Return what the method works on."""
        setup = self._setup
        return labelled.of_plan(setup.plan) if setup.plan_alone else labelled

    def _evidence(self, labelled: Labelled, session: Segmented) -> Evidence:
        """Gather evidence; the same once more where a session is of the plan's positions alone."""
        setup, parts = self._setup, (labelled.segments, labelled.turns, session)
        if self._gathered is None or self._gathered[0] != parts:
            found = Evidence.of(labelled, session, setup.plan, setup.imu, setup.site, setup.table)
            self._gathered = parts, replace(found, coarse=has_motion_terms(setup.terms))
        return self._gathered[1]

    def _estimate(
        self,
        evidence: Evidence,
        labelled: Labelled,
        session: Segmented,
        solver: Callable[[Evidence], Solution],
    ) -> tuple[Solution, Comparison | None]:
        """Solve; a joint estimate with the closed form of the plan beside it.

        What a closed form finds contradictory is refused: a joint estimate could weigh half of
        the data down until the other half agrees.
        """
        name = closed_form_beside(self._setup.method_name, self._setup.plan)
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
            # What a part of a session cannot determine may come out as anything.
            if isinstance(closed, NotObservable):
                raise closed from None
            raise
        if isinstance(closed, NotObservable):
            return solution, Comparison.refused(name, str(closed))
        return solution, Comparison.of(solution, closed, name)

    def _labelled(self, session: Segmented) -> Labelled:
        return label(session, self._setup.plan, self._setup.table)

    def _solve(self, session: Segmented, labelled: Labelled, *, final: bool) -> Result:
        setup = self._setup
        used = self._used(labelled)
        if not used.segments and not used.turns:
            raise NotObservable(nothing_found(session, labelled, setup))
        evidence = self._evidence(used, session)
        lost = loss_findings(setup, evidence, labelled, session)
        try:
            solver = self._solver if final else self._glance
            solution, comparison = self._estimate(evidence, labelled, session, solver)
        except NotObservable as error:
            raise type(error)(' '.join([str(error), *lost])) from None
        found = Basis(setup, evidence, session, labelled, comparison, tuple(lost), final)
        return found.concluded(solution)
