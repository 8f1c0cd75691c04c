"""Results of a calibrator: of a completed session, and of one in progress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.budget import Budget
from ..common.errors import InputError, NotObservable
from ..common.stream import Floats
from ..common.units import counted
from ..estimation.checks import Solution
from ..estimation.joint import Comparison
from ..estimation.methods import Setup
from ..estimation.term_tests import summary
from ..model.parameters import Parameter
from ..model.sensors import terms_of
from ..segmentation.labelling import Labelled
from ..segmentation.stream_facts import Segmented
from ..session.imu import check_plausible
from ..session.table_errors import StampingClock
from .calibration import Calibration, ResidualRow
from .gravity import with_gravity

if TYPE_CHECKING:
    from .basis import Basis


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
        None if solution.shares is None else Budget.of(solution.shares),
        solution.changes,
        clock,
    )
    calibration = with_gravity(calibration, setup.site)
    try:
        check_plausible(calibration, 'The result is not that of a strapdown IMU')
    except InputError as error:
        raise NotObservable(
            ' '.join(
                [
                    f'{error} Sensors that saturate, and a description of another '
                    'unit or table, are possible causes.',
                    *findings,
                ]
            )
        ) from None
    return calibration


@dataclass(frozen=True, eq=False)
class Result:
    """A calibration with the data that it was made from.

    Attributes:
        calibration: The result as a value.
        solution: Result of the method, with gravity taken as exact.
        session: Contents of the streams.
        labelled: Its segments by name.
        comparison: Comparison with the plan's closed form; None without one.
        basis: Input from which it was concluded; None for a unit in the hand.
    """

    calibration: Calibration
    solution: Solution
    session: Segmented
    labelled: Labelled
    comparison: Comparison | None = None
    basis: Basis | None = None

    def __repr__(self) -> str:
        """Return one line: a notebook would show the statistics of every dwell."""
        dwells = counted(len(self.labelled.segments), 'static dwell')
        # A unit in the hand has no turns by an encoder.
        turns = len(self.labelled.turns)
        of_turns = f' and {counted(turns, "turn")}' if turns else ''
        return f'<Result: {self.calibration} of {dwells}{of_turns}>'

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
    """How far a session has come.

    Attributes:
        session: Contents of the streams.
        parameters: What the method estimates.
        std: (n,) their standard deviations so far, SI units; NaN if not determined.
        unsupported: Steps of the plan run so far with too little data.
        result: The calibration, if the data determines all of it.
        refusal: Why there is none, else empty.
    """

    session: Segmented
    parameters: tuple[Parameter, ...]
    std: Floats
    unsupported: tuple[int, ...]
    result: Result | None
    refusal: str
