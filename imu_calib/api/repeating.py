"""Repeat a simulated session: errors of its method against its stated deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.views import compared_frame, draw_normalised
from ..common.errors import InputError, NotObservable
from ..common.parallel import Progress, by_one_thread, silent
from ..common.units import counted
from ..estimation.methods import Setup
from ..estimation.methods import method as solver
from ..model.earth import LUOYANG
from ..session.imu import ImuSpec
from ..session.plan import Plan
from ..simulation.options import StandOptions
from ..simulation.repetition import Outcome, Study, economical, repeat
from .keywords import Planned, with_keywords
from .named import Named, as_imu, as_plan, load_truth
from .session import Stated

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure
    from typing_extensions import Unpack

_MOST_RUNS = 1_000_000
"""Chosen: of about a second each they take eleven days of one processor, and a gigabyte."""


@dataclass(frozen=True, eq=False)
class MonteCarloResult:
    """A session that was simulated and calibrated many times.

    Attributes:
        setup: Plan, method, table, IMU and site.
        outcome: Errors and standard deviations of every run, and their statistics.
        findings: Messages for the user, in sentences.
    """

    setup: Setup
    outcome: Outcome
    findings: tuple[str, ...]

    def __repr__(self) -> str:
        """Return one line."""
        setup, runs = self.setup, len(self.outcome.errors)
        return (
            f'<MonteCarloResult of plan {setup.plan.name} by {setup.method_name}: '
            f'{counted(runs, "run")}>'
        )

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the statistics of the runs by parameter, as a pandas.DataFrame.

        Columns: mean error (bias), scatter of the errors (spread), stated standard deviation,
        largest error (worst), root mean square of the errors over their stated standard deviations
        (normalised), unit.

        Raises:
            InputError: pandas is not installed.
        """
        outcome = self.outcome
        columns = {
            'bias': outcome.bias,
            'spread': outcome.spread,
            'stated': outcome.mean_stated,
            'worst': outcome.worst,
        }
        return compared_frame(outcome.parameters, columns, {'normalised': outcome.rms})

    def plot(self) -> Figure:
        """Draw the errors over the stated standard deviations; return the matplotlib Figure.

        Raises:
            InputError: matplotlib is not installed.
        """
        setup, outcome = self.setup, self.outcome
        title = f'{setup.plan.name}, {setup.method_name}: {len(outcome.errors)} runs'
        known = np.isfinite(outcome.mean_stated)
        names = [p.name for p, k in zip(outcome.parameters, known, strict=True) if k]
        return draw_normalised(title, names, outcome.normalised[:, known])


@with_keywords(Planned)
@by_one_thread
def montecarlo(
    plan: Plan | Named,
    imu: ImuSpec | Named = 'fog_medium',
    *,
    runs: int = 100,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    truth: Calibration | Named = 'cao2022_table1',
    bias_instability: bool = False,
    progress: Progress = silent,
    **stated: Unpack[Planned],
) -> MonteCarloResult:
    """Simulate a session with many seeds, calibrate from each, and compare with the truth.

    Args:
        plan: Name, file or value.
        imu: Likewise.
        runs: Number of sessions.
        seed: Of the first; the outcome depends only on the seeds.
        jobs: Number of processes. More than one require a program whose code is below
            `if __name__ == '__main__':`, as multiprocessing does.
        scheduler: Address of a Dask scheduler whose workers run them (tcp://host:8786); requires
            the extra fleet.
        truth: The unit's true parameters.
        bias_instability: Let the biases drift by the IMU's figure.
        progress: Shows the progress; nothing by default.
        **stated: The session, by keywords of `calibrate`; by default on the three-axis table, at
            Luoyang's latitude. The true latitude and gravity are drawn by their standard
            deviations. A stated azimuth is known to the calibrator; without one each run has
            another, unknown azimuth.

    Raises:
        InputError: A file is missing or broken, they do not match each other, the plan is run by
            hand, or no scheduler answers.
        NotObservable: No run gave an estimate; the text states why.
    """
    for name, value, least in (('runs', runs, 1), ('jobs', jobs, 1), ('seed', seed, 0)):
        if value < least:
            raise InputError(f'`{name}`: found {value}, expected a whole number from {least} on.')
    if runs > _MOST_RUNS:
        raise InputError(f'`runs`: found {runs}, expected at most {_MOST_RUNS}.')
    study = _study(Stated(**stated), as_plan(plan), as_imu(imu), truth, drifting=bias_instability)
    with progress('simulating and calibrating') as show:
        outcome = repeat(study, runs, seed, jobs, show, scheduler)
    refusals = sorted({r.refusal for r in outcome.refused})
    if len(outcome.refused) == runs:
        raise NotObservable(f'All of {runs} runs were refused: {refusals[0]}')
    held = study.setup.table
    findings = [held.assumption] if held is not None and held.assumption else []
    if refusals:
        findings.append(f'Refused: {len(outcome.refused)} runs. {" ".join(refusals[:5])}')
    return MonteCarloResult(study.setup, outcome, tuple(findings))


def _study(
    stated: Stated, plan: Plan, imu: ImuSpec, truth: Calibration | Named, *, drifting: bool
) -> Study:
    """Return the study to repeat."""
    table, site = stated.simulated_table(), stated.site(LUOYANG)
    terms, changes = stated.sensor_terms, stated.changes
    if stated.method is not None:
        # Refuse it before the first run, not in it.
        solver(stated.method, terms, changes)
    if plan.by_hand:
        raise InputError(f'Plan {plan.name} is run by hand: only a table can be simulated here.')
    plan.steps(table)
    stand = StandOptions(
        # A uniform error of this half width has the table's stated standard deviation.
        positioning_error=math.sqrt(3) * table.positioning,
        bias_instability=drifting,
    )
    setup = Setup(
        imu,
        plan,
        table,
        site,
        stated.method,
        terms=terms,
        changes=changes,
        search_terms=stated.search_terms,
    )
    return Study(setup, load_truth(truth, imu).model, economical(stand), table.azimuth)
