"""What a calibrator returns: of a session that is over, and of one that goes on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..budget import Budget
from ..calibration import Calibration, ResidualRow
from ..estimation.term_tests import summary
from ..gravity import with_gravity
from ..methods.cross_check import Comparison
from ..methods.solution import Solution
from ..model import Parameter, terms_of
from ..segmentation.labelling import Labelled
from ..segmentation.segmented import Segmented
from ..stamping import StampingClock
from ..stream import Floats
from ..units import counted
from .setup import Setup

if TYPE_CHECKING:
    from .basis import Basis


def calibrated(
    setup: Setup,
    solution: Solution,
    origin: dict[str, object],
    findings: tuple[str, ...],
    clock: StampingClock | None = None,
) -> Calibration:
    """Return a solution as a calibration, with the doubt of gravity, of a session's origin."""
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
        None if solution.shares is None else Budget.of(solution.shares),
        solution.changes,
        clock,
    )
    return with_gravity(calibration, setup.site)


@dataclass(frozen=True, eq=False)
class Result:
    """A calibration with all that led to it.

    Attributes:
        calibration: The result as a value.
        solution: What the method returned; gravity is taken as exact in it.
        session: What the streams contain.
        labelled: Its segments by name.
        comparison: How the closed form of the plan compares; None where there is none beside.
        basis: What it was concluded from; None of a unit in the hand.
    """

    calibration: Calibration
    solution: Solution
    session: Segmented
    labelled: Labelled
    comparison: Comparison | None = None
    basis: Basis | None = None

    def __repr__(self) -> str:
        """Return a line: a notebook would show the statistics of every dwell."""
        dwells = counted(len(self.labelled.segments), 'static dwell')
        # A unit in the hand has none by an encoder.
        turns = len(self.labelled.turns)
        beside = f' and {counted(turns, "turn")}' if turns else ''
        return f'<Result: {self.calibration} of {dwells}{beside}>'

    @property
    def terms(self) -> tuple[str, ...]:
        """Sentences on each term, estimated or off, and from which size on it would be found."""
        if self.solution.tests:
            return tuple(summary(self.solution.tests))
        names = ', '.join(term.name for term in terms_of(self.solution.parameters))
        return (f'terms: {names or "none"}',)

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, SI units, by the keys of docs/files/output.md.

        Raises:
            InputError: A parameter that counts as estimated is no finite number.
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
