"""Results of a calibrator, of a completed session and of one in progress; their provenance."""

from __future__ import annotations

import math
import platform
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ..common.budget import Budget, ErrorSource
from ..common.errors import ImuCalibError, InputError, NotObservable
from ..common.files import version
from ..common.finding import Finding, warning, with_full_stop
from ..common.stream import Floats, Units, iso
from ..common.units import DEG, counted
from ..estimation.evidence import Evidence
from ..estimation.joint import Comparison
from ..estimation.setup import Setup
from ..estimation.solution import Solution
from ..estimation.term_tests import summary
from ..model.earth import EARTH_RATE
from ..model.parameters import Parameter, ParameterKind, bias_units
from ..model.sensors import terms_of
from ..model.session_terms import terms_in_words
from ..segmentation.course import Signals
from ..segmentation.labelling import Labelled
from ..segmentation.noise import session_noise
from ..segmentation.segmented import Segmented
from ..session.imu import StampingClock
from ..session.table_errors import clock_share
from .agreement import with_gravity
from .calibration import Calibration, ResidualRow
from .provenance import check_plausible

if TYPE_CHECKING:
    import pandas


def calibrated(
    setup: Setup,
    solution: Solution,
    origin: dict[str, object],
    findings: tuple[str, ...],
    clock: StampingClock | None = None,
) -> Calibration:
    """Return a solution as a calibration, with the uncertainty of gravity and its provenance.

    Raises:
        NotObservable: Its parameters are not plausible: every reader of its file would refuse it.
    """
    calibration = Calibration(
        setup.imu,
        solution.model,
        solution.covariance,
        tuple(
            ResidualRow(r.position, r.start * 1e-9, r.value[:3], r.value[3:])
            for r in solution.residuals
        ),
        findings,
        origin,
        setup.serial_number,
        solution.parameters,
        None if solution.shares is None else Budget.from_shares(solution.shares),
        solution.changes,
        clock,
    )
    calibration = with_gravity(calibration, setup.site)
    try:
        check_plausible(calibration, 'The result is not that of a strapdown IMU')
    except InputError as error:
        raise NotObservable(
            f'{error} Possible causes: sensors that saturate, and a description of another unit or '
            'table.',
            *findings,
        ) from None
    return calibration


@dataclass(frozen=True, eq=False)
class Result:
    """A calibration with the data that it was made from."""

    calibration: Calibration  #: The result as a value.
    solution: Solution  #: Result of the method, with gravity taken as exact.
    session: Segmented  #: Contents of the streams.
    labelled: Labelled  #: Its segments by name.
    #: Comparison with the plan's closed form; None without one.
    comparison: Comparison | None = None
    basis: Basis | None = None  #: Input from which it was concluded; None for a unit in the hand.
    signals: Signals | None = None  #: Of the IMU, as means; None where they were not kept.

    def __repr__(self) -> str:
        """Return one line: a notebook would show the statistics of every dwell."""
        dwells = counted(len(self.labelled.segments), 'static dwell')
        # A unit in the hand has no turns by an encoder.
        turns = len(self.labelled.turns)
        of_turns = f' and {counted(turns, "turn")}' if turns else ''
        return f'<Result: {self.calibration} of {dwells}{of_turns}>'

    def _repr_html_(self) -> str:
        """Return the calibration as a small table, for a notebook."""
        return self.calibration._repr_html_()

    @property
    def findings(self) -> tuple[str, ...]:
        """What the user of the calibration must know, in sentences."""
        return self.calibration.findings

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the parameters as a pandas.DataFrame, as `Calibration.to_dataframe` does."""
        return self.calibration.to_dataframe()

    @property
    def terms(self) -> tuple[str, ...]:
        """Sentences on each term, estimated or not, and its smallest detectable size."""
        if self.solution.tests:
            return tuple(summary(self.solution.tests, by_hand=self.calibration.by_hand))
        names = ', '.join(term.name for term in terms_of(self.solution.parameters))
        return (f'terms: {names or "none"}',)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md."""
        found = self.calibration
        rows = zip(found.parameters, found.values, found.std, strict=True)
        return {
            'calibration': found.to_dict(),
            'parameters': [
                {'name': p.name, 'value': float(value), 'std': float(std), 'unit': p.unit.si}
                for p, value, std in rows
                if np.isfinite(std)
            ],
            'terms': list(self.terms),
            'duration': float(self.session.duration),
            'samples': int(self.session.samples),
        }


@dataclass(frozen=True, eq=False)
class Review:
    """How far a session has come."""

    session: Segmented  #: Contents of the streams.
    parameters: tuple[Parameter, ...]  #: What the method estimates.
    std: Floats  #: (n,) their standard deviations so far, SI units; NaN if not determined.
    unsupported: tuple[int, ...]  #: Steps of the plan run so far with too little data.
    result: Result | None  #: The calibration, if the data determines all of it.
    refusal: str  #: Why there is none, else empty.


_LATER = (
    'Provisional: further terms, such as gyro_asymmetry, are looked for when the session ends.',
)


@dataclass(frozen=True, eq=False)
class Basis:
    """What the result of a solved session depends on."""

    setup: Setup  #: Prior knowledge of the session.
    evidence: Evidence  #: The evidence that was solved.
    session: Segmented  #: Contents of the streams.
    labelled: Labelled  #: Its segments by name.
    comparison: Comparison | None  #: Comparison with the plan's closed form; None without one.
    lost: tuple[str, ...]  #: Sentences on unused data.
    final: bool  #: Whether the session is over.

    def concluded(self, solution: Solution) -> Result:
        """Return a solution's result, with the uncertainty of gravity and the table's clock."""
        setup, comparison = self.setup, self.comparison
        findings = (
            *(() if self.final or not setup.search_terms else _LATER),
            *solution.findings,
            *(comparison.finding() if comparison is not None else []),
            *self.lost,
            *assumption_findings(setup, solution),
            *rounding_findings(setup, self.evidence, solution.parameters, solution.std),
        )
        origin = provenance(setup, self.evidence, self.session, solution, comparison)
        origin |= noise(self.evidence) if self.final else {}
        clock = stamping(setup, self.evidence)
        calibration = calibrated(setup, solution, origin, findings, clock)
        if setup.table is not None and setup.table.clock:
            share = clock_share(
                calibration.model, calibration.parameters, setup.imu.units, setup.table.clock
            )
            calibration = calibration.with_share(ErrorSource.TABLE_CLOCK, share)
        return Result(calibration, solution, self.session, self.labelled, comparison, self)


# The provenance of a calibration; sentences on unused data and missing steps of a session.


def provenance(
    setup: Setup,
    evidence: Evidence,
    session: Segmented,
    solution: Solution,
    comparison: Comparison | None = None,
) -> dict[str, object]:
    """Return the provenance in a calibration file, by key (docs/parameters.md)."""
    clock, seen, table = session.clock, session.temperature, setup.table
    residuals = np.array([r.value for r in solution.residuals]).reshape(-1, 6)
    rms = np.sqrt((residuals**2).mean(axis=0)) if len(residuals) else np.full(6, np.nan)
    special: dict[str, object] = {}
    if missing := evidence.missing_positions():
        special['missing_positions'] = missing
    if solution.bias_drift is not None:
        special['bias_drift'] = [float(v) for v in solution.bias_drift]
        special['bias_instability'] = [float(v) for v in evidence.instability]
    if table is not None and solution.search is not None:
        # As good as the best known one, where the session contradicts an exact one.
        table = solution.search.estimate.equations.evidence.table or table
    changes = () if solution.changes is None else solution.changes.changes
    # About any axis of the unit. Turns by hand are faster in their middle than on average, and
    # moves between positions turn several joints at once: the session itself is within this rate.
    rates = [abs(float(turn.rate())) for turn in evidence.turns]
    rates += [move.fastest for move in session.moves]
    special |= _gravity_off(evidence, solution)
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
        'by_hand': setup.plan.by_hand,
        'table': None if table is None else table.name,
        **({'table_simulated': True} if table is not None and table.simulated else {}),
        'table_errors': None if table is None else table.error_sizes,
        'table_errors_assumed': None if table is None else list(table.not_stated),
        'table_clock_std': None if table is None else table.clock,
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
        'duration': session.duration,
        **({'marks': session.facts.marks.tolist()} if len(session.facts.marks) else {}),
        'samples': sum(s.statistics.samples for s in evidence.segments)
        + sum(t.statistics.samples for t in evidence.turns),
        'random_walk': [float(v) for v in evidence.walk],
        'residual_rms': [_or_none(v) for v in rms],
        'condition_number': solution.condition,
        'highest_rate': max(rates, default=None),
        'temperature': seen and {'mean': seen.mean, 'lowest': seen.lowest, 'highest': seen.highest},
        **special,
        'clock': {
            'offset_s': clock.offset,
            'offset_std_s': clock.offset_std,
            'rate_ppm': clock.rate * 1e6,
            'rate_std_ppm': clock.rate_std * 1e6,
            'motions': clock.motions,
        },
        'versions': {
            'imu_calib': version(),
            'python': platform.python_version(),
            'numpy': np.__version__,
            'scipy': scipy.__version__,
        },
    }


def _gravity_off(evidence: Evidence, solution: Solution) -> dict[str, object]:
    """Return by how much the accelerometers at rest miss gravity, before and after calibration.

    Ratios, at the worst static dwell; the length of a force does not depend on the attitude. What
    no more dwells than unknowns leave says nothing of the calibration.
    """
    of_accels = np.array([p.triad == 'a' for p in solution.parameters])
    if not (evidence.segments and np.isfinite(solution.std[of_accels]).all()):
        return {}
    means = np.array([s.statistics.mean for s in evidence.segments])
    _, forces = solution.model.compensate(means[:, :3], means[:, 3:])
    before, after = (
        float(np.abs(np.linalg.norm(f, axis=1) / evidence.site.gravity - 1).max())
        for f in (means[:, 3:], forces)
    )
    unknowns = int(np.count_nonzero(solution.std[of_accels]))
    if evidence.free and len(evidence.segments) <= unknowns:
        return {'gravity_off_before': before}
    return {'gravity_off_before': before, 'gravity_off_after': after}


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


def _or_none(value: float) -> float | None:
    """Return a number, or None if it is not known."""
    return float(value) if np.isfinite(value) else None


def losses_of_all_segments(session: Segmented, labelled: Labelled, setup: Setup) -> list[str]:
    """Return sentences that no dwell or whole turn was found, and why."""
    if not session.samples:
        return ['The IMU stream is empty: nothing can be determined.']
    if not session.duration:
        losses = [f'{loss}.' for loss in session.losses]
        return [' '.join([f'None of {session.samples} IMU samples can be used.', *losses])]
    looked_for = 'Neither a static dwell nor a whole turn'
    if setup.plan.is_stated:
        looked_for = f'None of the positions of plan {setup.plan.name}'
    text = (
        f'{looked_for} was found in {session.samples} IMU samples ({session.duration:.0f} s): '
        'nothing can be determined.'
    )
    reasons = sorted({r.reason for r in labelled.rejected})
    loose = len(session.segments)
    if loose and setup.plan.is_stated:
        text += f' {loose} static dwells fit no position of the plan.'
    sentences = [*(f'Left out: {reason}' for reason in reasons[:3]), *session.losses]
    return [text, *(f'{sentence}.' for sentence in sentences)]


def bad_samples_first(error: ImuCalibError, session: Segmented) -> ImuCalibError:
    """Return a refusal that first names its cause: bad samples or stamps, or a unit that turned."""
    false = session.false_samples
    sentence = session.frozen or (false.sentences[0] if false.is_large else '')
    sentence = sentence or session.mistimed or session.turning
    if not sentence:
        return error
    said = re.compile(f'({warning("")})?{re.escape(sentence)}\\.')
    others = tuple(said.sub('', text).strip() for text in error.args)
    refusal = error.among(before=(f'{sentence}.',))
    refusal.args = (refusal.args[0], *others)
    return refusal


_AGAIN = '; it was measured again'
MISSING = 'Missing from the recording:'  #: How the sentence on missing positions begins.


def loss_findings(
    setup: Setup, evidence: Evidence, labelled: Labelled, session: Segmented
) -> list[str]:
    """Return sentences on data not used or outside the plan, and on missing steps of the plan."""
    sentences: list[str] = []
    missing = evidence.missing_positions()
    if missing:
        text = f'{MISSING} position {", ".join(missing)}.'
        sentences.append(Finding(text, lost=True))
    if setup.plan.is_stated:
        sentences += _beside_plan(setup, labelled)
    found = {segment.position for segment in labelled.segments}
    alike: dict[tuple[bool, bool, str], list[str]] = {}
    for rejected in labelled.rejected:
        again = _AGAIN if rejected.position in found else ''
        reason = rejected.reason + ('' if rejected.turn else again)
        at = f'{(rejected.start - (session.start or 0)) * 1e-9:.0f} s'
        known = rejected.position is not None
        alike.setdefault((known, rejected.turn, reason), []).append(rejected.position or at)
    for (known, turn, reason), names in alike.items():
        what = 'a turn is left out' if turn else 'left out'
        place = 'Position' if known else 'At'
        text = f'{place} {", ".join(dict.fromkeys(names))}: {what}, {reason}.'
        sentences.append(Finding(text, lost=known and not reason.endswith(_AGAIN)))
    sentences += [
        f'Position {segment.position}: {note}.'
        for segment in labelled.segments
        for note in segment.notes
    ]
    sentences += map(with_full_stop, (*labelled.notes, *session.losses))
    return list(dict.fromkeys(sentences))


def _beside_plan(setup: Setup, labelled: Labelled) -> list[str]:
    """Return sentences on dwells that fit no position of the plan, and on their use."""
    of_plan = labelled.of_plan(setup.plan).segments
    # Every session begins where the table happens to stand.
    begins = labelled.segments[:1]
    if not setup.plan_alone and [s for s in labelled.segments if s not in of_plan] == [*begins]:
        return []
    names = [str(s.position) for s in labelled.segments if s not in of_plan]
    if not names:
        return []
    becomes = f'{setup.method_name} uses them all the same'
    if setup.plan_alone:
        becomes = f"{setup.method_name}, which uses the plan's positions alone, leaves them out"
    fit = f'Static dwells that count as no position of plan {setup.plan.name}'
    return [f'{fit}: {"; ".join(names)}: {becomes}.']


def assumption_findings(setup: Setup, solution: Solution) -> list[str]:
    """Return sentences on assumptions about the table that its file does not state but are used."""
    table = None if setup.plan.by_hand or solution.shares is None else setup.table
    if table is None:
        return []
    forces = any(parameter.triad == 'a' for parameter in solution.parameters)
    clock = Finding(
        f'The clock of table {table.name} is taken as exact: no K_a has an uncertainty of it, as '
        'samples per interval need. State its standard deviation in the file of the table '
        '(`clock: 5 ppm`, for instance).',
        effect=math.inf,
    )
    return [
        *([table.assumption] if table.assumption else []),
        *([clock] if table.clock_assumed and forces and setup.imu.units.per_interval else []),
    ]


def rounding_findings(
    setup: Setup, evidence: Evidence, parameters: Sequence[Parameter], deviations: Floats
) -> list[str]:
    """Return a warning of gyros without the noise that makes rounding errors average out.

    They read nearly the same rate in every attitude, so that a mean of counts has one error in all
    of them: of noise s and counts q up to q exp(-2 pi^2 s^2 / q^2) / pi, at most q / 2. From
    s = q / 2 on it is a uniform error of q^2 / 12 in each sample.

    Args:
        setup: Of the session.
        evidence: Its static dwells.
        parameters: The n that are estimated.
        deviations: (n,) their standard deviations, SI.

    Source: Widrow, Kollar, Liu 1996, Statistical theory of quantization, IEEE Trans. Instrum. Meas.
    45(2), 353-361: the first term of the characteristic function's series.
    """
    seen = np.array([s.statistics.sample_variance for s in evidence.segments]).reshape(-1, 6)
    seen = seen[np.isfinite(seen).all(axis=1)]
    count = setup.imu.gyro.scale_factor
    # The rate of the Earth moves readings over finer counts.
    if setup.imu.units is not Units.COUNTS or not len(seen) or count < EARTH_RATE:
        return []
    noise = np.maximum(np.median(seen[:, :3], axis=0) / count**2 - 1 / 12, 0.0)
    error = count * np.exp(-2 * np.pi**2 * noise) / np.pi
    names = [
        p.name
        for p, std in zip(parameters, deviations, strict=True)
        if p.triad == 'g' and p.kind is ParameterKind.BIAS and p.row < 3 and error[p.row] > std
    ]
    if not names:
        return []
    shown = bias_units(by_hand=setup.plan.by_hand)[0]
    return [
        warning(
            f'The gyros at rest have less noise than their counts of {count / shown.scale:.2g} '
            f'{shown.unit} resolve, so that rounding has the same error in every static dwell: '
            f'{", ".join(names)} may be off by up to half a count, more than the standard '
            'deviation, and the residuals of turns exceed their noise. Set a smaller range or a '
            'wider bandwidth of the unit.',
            effect=math.inf,
        )
    ]
