"""Make a result from a solution and its session."""

from __future__ import annotations

from dataclasses import dataclass

from ..common.budget import Source
from ..estimation.checks import Solution
from ..estimation.evidence import Evidence
from ..estimation.joint import Comparison
from ..estimation.methods import Setup
from ..segmentation.labelling import Labelled
from ..segmentation.stream_facts import Segmented
from ..session.table_errors import clock_share
from .calibrator_provenance import noise, provenance, stamping
from .calibrator_results import Result, calibrated
from .losses import assumption_findings

_LATER = (
    'Provisional: terms are looked for when the session ends (`terms` auto); a scale factor that '
    'differs between the senses, say, is not in this estimate.',
)


@dataclass(frozen=True, eq=False)
class Basis:
    """A solved session, as far as its result depends on it.

    Attributes:
        setup: Prior knowledge of the session.
        evidence: The evidence that was solved.
        session: Contents of the streams.
        labelled: Its segments by name.
        comparison: Comparison with the plan's closed form; None without one.
        lost: Sentences on unused data.
        final: Whether the session is over.
    """

    setup: Setup
    evidence: Evidence
    session: Segmented
    labelled: Labelled
    comparison: Comparison | None
    lost: tuple[str, ...]
    final: bool

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
            calibration = calibration.with_share(Source.TABLE_CLOCK, share)
        return Result(calibration, solution, self.session, self.labelled, comparison, self)
