"""The calibrator: blocks of columns in, a calibration out. One object, live and offline."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
import scipy

from . import __version__
from .budget import Budget, Source
from .calibration import Calibration, ResidualRow
from .earth import Site
from .errors import Contradiction, InputError, NotObservable
from .gravity import gravity_covariance, with_gravity
from .imu import ImuSpec
from .methods import (
    JOINT,
    check_plan,
    closed_form_beside,
    default_method,
    estimates,
    method,
    provisional,
)
from .methods.comparison import Comparison
from .methods.solution import Solution
from .model import AXES, Parameter, SensorModel, Term, terms_of
from .model.session_terms import Change, spelled
from .noise import session_noise
from .observation.evidence import Evidence
from .observation.information import reached
from .plan import Plan
from .progress import unsupported_steps
from .segmentation.labelling import Labelled, label
from .segmentation.segmenter import Segmenter
from .segmentation.session import Segmented
from .stamping import StampingClock
from .stream import Block, Floats
from .table_clock import clock_share
from .turntable import Table
from .units import DEG

_YEAR_2000, _YEAR_2200 = 946_684_800 * 10**9, 7_258_118_400 * 10**9


_LATER = (
    'Provisional: terms are looked for when the session ends (--terms auto); a scale factor that '
    'differs between the senses, say, is not in this estimate.',
)


@dataclass(frozen=True, eq=False)
class Setup:
    """What a calibrator must know beforehand.

    Attributes:
        imu: What the numbers of the Imu stream mean.
        plan: What is run; `plan.UNPLANNED` where nobody knows, and joint states tell the attitudes.
        table: The table whose joint states come in; None when the IMU stands alone.
        site: Gravity and Earth rate.
        method: Name of the solver; None takes the joint estimate where it applies, else the plan's
            own method.
        serial_number: Which unit of the type `imu.id`; empty where nobody stated it.
        terms: To be estimated besides what the method estimates.
        changes: Coefficients of the session's terms, likewise.
        look: Whether terms that the session shows are estimated too.

    """

    imu: ImuSpec
    plan: Plan
    table: Table | None
    site: Site
    method: str | None = None
    serial_number: str = ''
    terms: tuple[Term, ...] = ()
    changes: tuple[Change, ...] = ()
    look: bool = False

    @property
    def method_name(self) -> str:
        """Name of the solver."""
        return self.method or default_method(self.plan)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is estimated whatever the session shows.

        Raises:
            InputError: There is no such method, or it knows no terms.

        """
        return estimates(self.method_name, self.terms)

    @property
    def plan_alone(self) -> bool:
        """Whether the method is a closed form, which knows the plan's positions alone."""
        return self.method_name not in JOINT


@dataclass(frozen=True, eq=False)
class Result:
    """A calibration with all that led to it.

    Attributes:
        calibration: The result as a value.
        solution: What the method returned; gravity is taken as exact in it.
        session: What the streams contain.
        labelled: Its segments by name.
        comparison: How the closed form of the plan compares; None where there is none beside.

    """

    calibration: Calibration
    solution: Solution
    session: Segmented
    labelled: Labelled
    comparison: Comparison | None = None


@dataclass(frozen=True, eq=False)
class Review:
    """How far a session has come.

    Attributes:
        session: What the streams contain.
        parameters: What the method estimates.
        std: (n,) their standard deviations reached, SI units; NaN for what is not determined.
        unsupported: Steps of the plan seen so far that left too little.
        result: The calibration, where the data determines all of it.
        refusal: Why there is none, else empty.

    """

    session: Segmented
    parameters: tuple[Parameter, ...]
    std: Floats
    unsupported: tuple[int, ...]
    result: Result | None
    refusal: str


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
        self._solver = method(*asked, look=setup.look)
        self._glance = provisional(*asked)
        self._segmenter = Segmenter(setup.imu, setup.table)

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
        return self._solve(session, final=True)

    def snapshot(self) -> Calibrator:
        """Return a calibrator with all that came in so far; this one goes on by itself.

        What the snapshot finishes with is what a session that ended here would give.
        """
        return copy.deepcopy(self)

    def review(self) -> Review:
        """Say of a snapshot how far the session has come: solve, or what is determined already.

        Terms that nobody asked for are looked for at the end alone: the search takes several times
        as long as the estimate, and what a session goes on to show may change what it finds.

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
        labelled = label(session, self._setup.plan, self._setup.table)
        unsupported = unsupported_steps(session, labelled, self._setup.plan, self._setup.table)
        try:
            result = self._solve(session, final=final)
        except NotObservable as error:
            std = self._reached(labelled, session)
            return self._review(session, std, unsupported, None, str(error))
        calibration = result.calibration
        std = dict(zip(calibration.parameters, calibration.std, strict=True))
        return self._review(session, std, unsupported, result, '')

    def _review(
        self,
        session: Segmented,
        std: dict[Parameter, float],
        unsupported: tuple[int, ...],
        result: Result | None,
        refusal: str,
    ) -> Review:
        wanted = self._setup.parameters
        reached = np.array([std.get(parameter, np.nan) for parameter in wanted])
        return Review(session, wanted, reached, unsupported, result, refusal)

    def _reached(self, labelled: Labelled, session: Segmented) -> dict[Parameter, float]:
        """Return the standard deviations of what is determined already, NaN for the rest."""
        parameters = tuple(p for p in self._setup.parameters if p.row < len(AXES))
        try:
            noise_alone = reached(self.evidence(labelled, session), parameters)
        except NotObservable:
            return {}
        setup, ideal = self._setup, SensorModel()
        doubt = setup.site.gravity_doubt
        share = np.diag(gravity_covariance(ideal, parameters, doubt))
        if setup.table is not None:
            clock = clock_share(ideal, parameters, setup.imu.units, setup.table.clock)
            share = share + np.diag(clock.covariance)
        return dict(zip(parameters, np.sqrt(noise_alone**2 + share), strict=True))

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
        setup = self._setup
        return Evidence.of(labelled, session, setup.plan, setup.imu, setup.site, setup.table)

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

        Raises:
            InputError: The outputs are not in the units that the IMU's description states.
            NotObservable: The data cannot give all parameters, or contradicts itself.

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

    def _solve(self, session: Segmented, *, final: bool) -> Result:
        setup = self._setup
        labelled = label(session, setup.plan, setup.table)
        used = self._used(labelled)
        if not used.segments and not used.turns:
            raise NotObservable(_nothing_found(session, labelled, setup))
        evidence = self._evidence(used, session)
        lost = _what_was_lost(setup, evidence, labelled, session)
        try:
            solver = self._solver if final else self._glance
            solution, comparison = self._estimate(evidence, labelled, session, solver)
        except NotObservable as error:
            raise type(error)(' '.join([str(error), *lost])) from None
        contradiction = comparison.finding() if comparison is not None else []
        findings = (
            *(() if final or not setup.look else _LATER),
            *solution.findings,
            *contradiction,
            *lost,
            *_assumed(setup, solution),
        )
        calibration = Calibration(
            setup.imu,
            solution.model,
            solution.covariance,
            tuple(
                ResidualRow(r.position, r.start * 1e-9, r.value[:3], r.value[3:])
                for r in solution.residuals
            ),
            findings,
            _provenance(setup, evidence, session, solution, comparison)
            | (_noise(evidence) if final else {}),
            setup.serial_number,
            solution.parameters,
            None if solution.shares is None else Budget.of(solution.shares),
            solution.changes,
            _stamping(setup, evidence),
        )
        calibration = with_gravity(calibration, setup.site)
        if setup.table is not None and setup.table.clock:
            share = clock_share(
                calibration.model, calibration.parameters, setup.imu.units, setup.table.clock
            )
            calibration = calibration.with_share(Source.TABLE_CLOCK, share)
        return Result(calibration, solution, session, labelled, comparison)


def _nothing_found(session: Segmented, labelled: Labelled, setup: Setup) -> str:
    if not session.samples:
        return 'The IMU stream is empty: nothing can be determined.'
    if not session.duration:
        told = ' '.join(f'{loss}.' for loss in session.losses)
        return f'None of {session.samples} IMU samples can be used. {told}'
    looked_for = 'Neither a rest nor a whole turn'
    if setup.plan.is_stated:
        looked_for = f'None of the positions of plan {setup.plan.name}'
    text = (
        f'{looked_for} was found in {session.samples} IMU samples ({session.duration:.0f} s): '
        'nothing can be determined.'
    )
    reasons = sorted({r.reason for r in labelled.rejected})
    loose = len(session.segments)
    if loose and setup.plan.is_stated:
        text += f' {loose} stretches at rest fit no position of the plan.'
    sentences = [*(f'Left out: {reason}' for reason in reasons[:3]), *session.losses]
    return ' '.join([text, *(f'{sentence}.' for sentence in sentences)])


def _what_was_lost(
    setup: Setup, evidence: Evidence, labelled: Labelled, session: Segmented
) -> list[str]:
    """Say what of the session was not used or fits no plan, and what of the plan is missing."""
    sentences = []
    missing = evidence.missing()
    if missing:
        sentences.append(f'Missing from the recording: position {", ".join(missing)}.')
    if setup.plan.is_stated:
        sentences += _beside_plan(setup, labelled)
    found = {segment.position for segment in labelled.segments}
    alike: dict[tuple[bool, bool, str], list[str]] = {}
    for rejected in labelled.rejected:
        again = '; it was measured again' if rejected.position in found else ''
        reason = rejected.reason + ('' if rejected.turn else again)
        at = f'{(rejected.start - (session.start or 0)) * 1e-9:.0f} s'
        known = rejected.position is not None
        alike.setdefault((known, rejected.turn, reason), []).append(rejected.position or at)
    for (known, turn, reason), names in alike.items():
        what = 'a turn is left out' if turn else 'left out'
        place = 'Position' if known else 'At'
        sentences.append(f'{place} {", ".join(dict.fromkeys(names))}: {what}, {reason}.')
    sentences += [
        f'Position {segment.position}: {note}.'
        for segment in labelled.segments
        for note in segment.notes
    ]
    sentences += [f'{loss}.' for loss in (*labelled.notes, *session.losses)]
    return list(dict.fromkeys(sentences))


def _assumed(setup: Setup, solution: Solution) -> list[str]:
    """Say what is assumed of the table, which its file does not state, where a method counts it."""
    table = None if setup.plan.by_hand or solution.shares is None else setup.table
    return [table.assumption] if table is not None and table.assumption else []


def _beside_plan(setup: Setup, labelled: Labelled) -> list[str]:
    """Say which rests fit no position of the plan, and what becomes of them."""
    of_plan = labelled.of_plan(setup.plan).segments
    names = [str(s.position) for s in labelled.segments if s not in of_plan]
    if not names:
        return []
    becomes = f'{setup.method_name} uses them all the same'
    if setup.plan_alone:
        becomes = f"{setup.method_name}, which knows the plan's positions alone, leaves them out"
    return [f'Rests that fit no position of plan {setup.plan.name}: {"; ".join(names)}: {becomes}.']


def _provenance(
    setup: Setup,
    evidence: Evidence,
    session: Segmented,
    solution: Solution,
    comparison: Comparison | None = None,
) -> dict[str, object]:
    clock = session.clock
    residuals = np.array([r.value for r in solution.residuals]).reshape(-1, 6)
    rms = np.sqrt((residuals**2).mean(axis=0)) if len(residuals) else np.full(6, np.nan)
    special: dict[str, object] = {}
    missing = evidence.missing()
    if missing:
        special['missing_positions'] = missing
    if solution.wandering is not None:
        special['bias_wander'] = [float(v) for v in solution.wandering]
    if comparison is not None:
        special['closed_form'] = comparison.document()
    if solution.tests:
        special['tests_of_terms'] = {test.name: test.document() for test in solution.tests}
    return {
        'recorded': _date(session.start),
        'method': setup.method_name,
        'terms': [*(t.name for t in terms_of(solution.parameters)), *spelled(_changing(solution))],
        'terms_looked_for': setup.look and bool(solution.tests),
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
        'highest_rate': max((abs(float(t.rate())) for t in evidence.turns), default=None),
        'temperature': _temperature(session),
        **special,
        'clock': {
            'offset_s': clock.offset,
            'offset_std_s': clock.offset_std,
            'rate_ppm': clock.rate * 1e6,
            'rate_std_ppm': clock.rate_std * 1e6,
            'motions': clock.motions,
        },
        'versions': {
            'imu_calib': __version__,
            'numpy': np.__version__,
            'scipy': scipy.__version__,
        },
    }


def _changing(solution: Solution) -> tuple[Change, ...]:
    return () if solution.changes is None else solution.changes.changes


def _noise(evidence: Evidence) -> dict[str, object]:
    """Return the noise that the session showed, for a session that is over: it takes its time."""
    seen = session_noise([s.statistics for s in evidence.segments], evidence.walk)
    return {'noise': {name: channel.document() for name, channel in seen.items()}}


def _date(stamp: int | None) -> str | None:
    """Return when a recording began, UTC; None where its stamps count from something else."""
    if stamp is None or not _YEAR_2000 < stamp < _YEAR_2200:
        return None
    return datetime.fromtimestamp(stamp // 10**9, timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')


def _stamping(setup: Setup, evidence: Evidence) -> StampingClock | None:
    """Return the clock that stamps the samples, where motions compare it with the table's."""
    if setup.table is None or not evidence.clocks_compared:
        return None
    unit = ' '.join([setup.imu.id, setup.serial_number]).strip()
    faster, std = evidence.clock_rate()
    return StampingClock(f'stamps of {unit}', f'clock of table {setup.table.name}', faster, std)


def _temperature(session: Segmented) -> dict[str, float] | None:
    seen = session.temperature
    if seen is None:
        return None
    return {'mean': seen.mean, 'lowest': seen.lowest, 'highest': seen.highest}


def _or_none(value: float) -> float | None:
    """Return a number, or None for one that is not known."""
    return float(value) if np.isfinite(value) else None
