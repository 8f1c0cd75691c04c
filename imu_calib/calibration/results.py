"""Results of a calibrator, of a completed session and of one in progress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.budget import Budget, ErrorSource
from ..common.errors import InputError, NotObservable
from ..common.stream import Floats
from ..common.units import counted
from ..estimation.evidence import Evidence
from ..estimation.joint import Comparison
from ..estimation.setup import Setup
from ..estimation.solution import Solution
from ..estimation.term_tests import summary
from ..model.parameters import Parameter
from ..model.sensors import terms_of
from ..segmentation.labelling import Labelled
from ..segmentation.segmented import Segmented
from ..segmentation.signal_means import Signals
from ..session.plausibility import check_plausible
from ..session.stamping import StampingClock
from ..session.table_errors import clock_share
from .calibration import Calibration, ResidualRow
from .findings import assumption_findings, noise, provenance, stamping
from .gravity import with_gravity


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
    def terms(self) -> tuple[str, ...]:
        """Sentences on each term, estimated or not, and its smallest detectable size."""
        if self.solution.tests:
            return tuple(summary(self.solution.tests))
        names = ', '.join(term.name for term in terms_of(self.solution.parameters))
        return (f'terms: {names or "none"}',)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md.

        Raises:
            InputError: An estimated parameter is not a finite number.
        """
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
