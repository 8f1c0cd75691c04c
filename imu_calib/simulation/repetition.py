"""Simulate one session many times: compare the errors of a method with its stated deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..calibration.calibrator import calibrator_of
from ..common.errors import NotObservable
from ..common.parallel import run_all
from ..common.stream import Block, Floats
from ..estimation.hand import in_frame_of_accelerometers
from ..estimation.setup import Setup
from ..model.parameters import PARAMETERS, Parameter, indices_of
from ..model.sensors import SensorModel
from ..session.table import Table
from .hand import as_planned
from .options import StandOptions
from .stand import simulate
from .true_table import TableSizes, TrueTable

_BLOCK_SECONDS = 300.0
"""s computed at once: longer blocks take less time."""
_JOINT_STATES = 25.0
"""Hz: fewer than a stand's, without a visible loss."""


@dataclass(frozen=True, eq=False)
class Study:
    """The session to repeat."""

    setup: Setup  #: Set-up of the calibrator.
    truth: SensorModel  #: True sensors.
    options: StandOptions  #: Imperfections of the hardware.
    #: True heading of the table's zero, rad; None draws another for each run.
    azimuth: float | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """Result of one session."""

    seed: int  #: Its seed.
    parameters: tuple[Parameter, ...]  #: The estimated ones; none if refused.
    error: Floats  #: (n,) estimate less truth, SI units; NaN for a triad that was not estimated.
    std: Floats  #: (n,) standard deviations stated.
    refusal: str = ''  #: Why there is no estimate, else empty.


@dataclass(frozen=True, eq=False)
class RunStatistics:
    """Results of all runs."""

    runs: tuple[Run, ...]  #: All, in the order of their seeds.

    @property
    def refused(self) -> tuple[Run, ...]:
        """Runs without an estimate."""
        return tuple(run for run in self.runs if run.refusal)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that the runs estimated."""
        return next((run.parameters for run in self.runs if not run.refusal), ())

    @property
    def errors(self) -> Floats:
        """Errors of the runs that gave an estimate, (runs, n)."""
        return self._columns([run.error for run in self.runs if not run.refusal])

    @property
    def stated(self) -> Floats:
        """Standard deviations that those runs stated, (runs, n)."""
        return self._columns([run.std for run in self.runs if not run.refusal])

    def _columns(self, rows: list[Floats]) -> Floats:
        return np.array(rows).reshape(len(rows), len(self.parameters))

    @property
    def bias(self) -> Floats:
        """Mean error, (n,)."""
        return np.asarray(self.errors.mean(axis=0))

    @property
    def spread(self) -> Floats:
        """Standard deviation of the errors about their mean, (n,); NaN below two runs."""
        if len(self.errors) < 2:
            return np.full(len(self.parameters), np.nan)
        return np.asarray(self.errors.std(axis=0, ddof=1))

    @property
    def mean_stated(self) -> Floats:
        """Root mean square of the standard deviations stated, (n,)."""
        return np.asarray(np.sqrt((self.stated**2).mean(axis=0)))

    @property
    def worst(self) -> Floats:
        """Largest error, (n,)."""
        return np.asarray(np.abs(self.errors).max(axis=0))

    @property
    def rms(self) -> Floats:
        """Root mean square of the errors over their standard deviations, (n,): one is right."""
        return np.asarray(np.sqrt((self.normalised**2).mean(axis=0)))

    @property
    def normalised(self) -> Floats:
        """Errors over the standard deviations stated with them, (runs, n)."""
        stated = self.stated
        return np.divide(self.errors, stated, out=np.zeros_like(stated), where=stated > 0)


def run_once(study: Study, seed: int) -> Run:
    """Simulate a session of the hardware and calibrate from it."""
    setup, azimuth = study.setup, study.azimuth
    if azimuth is None:
        azimuth = float(np.random.default_rng([seed, 1]).uniform(-np.pi, np.pi))
    options = _with_table_errors(replace(study.options, azimuth=azimuth), setup.table, seed)
    # The true site is drawn from the uncertainty stated to the calibrator.
    off, north = np.random.default_rng([seed, 2]).standard_normal(2)
    here = setup.site
    site = replace(
        here,
        gravity=here.gravity + float(off) * here.gravity_std,
        latitude=here.latitude + float(north) * here.latitude_std,
    )
    calibrator = calibrator_of(setup)
    blocks: Iterable[Block]
    if setup.table is None:
        held = as_planned(setup.plan, np.random.default_rng([seed, 1]))
        blocks = held.blocks(setup.imu, study.truth, site, options, seed)
    else:
        simulated = simulate(setup.plan, setup.table, setup.imu, study.truth, site, options, seed)
        blocks = (block for _, block in simulated)
    for block in blocks:
        calibrator.add_block(block)
    try:
        calibration = calibrator.finish().calibration
    except NotObservable as error:
        return Run(seed, (), np.empty(0), np.empty(0), str(error))
    # Attitudes that nobody stated leave the axes to be chosen: those of the accelerometers.
    truth = in_frame_of_accelerometers(study.truth) if calibration.in_the_hand else study.truth
    # Terms found in some sessions only are not parameters of the study.
    wanted = {*PARAMETERS, *setup.parameters}
    parameters = tuple(p for p in calibration.parameters if p in wanted)
    places = indices_of(parameters, calibration.parameters)
    std = calibration.std[places]
    wrong = calibration.values[places] - truth.values(parameters)
    return Run(seed, parameters, np.where(np.isfinite(std), wrong, np.nan), std)


def _with_table_errors(options: StandOptions, table: Table | None, seed: int) -> StandOptions:
    """Return hardware whose table errs as its file states, or as is assumed of it."""
    if table is None or options.true is not None:
        return options
    if table.positioning:
        # Of that standard deviation, uniform.
        options = replace(options, positioning_error=math.sqrt(3) * table.positioning)
    if table.errors.exact:
        return options
    stated = table.errors
    sizes = TableSizes(
        zeros=stated.zeros,
        orthogonality=stated.orthogonality,
        wobble=(stated.wobble, stated.wobble),
        encoder=(stated.encoder, stated.encoder),
    )
    first, *others = TrueTable.drawn(table, sizes, seed).joints
    # Its zero is the azimuth.
    first = replace(first, zero=table.joints[0].zero)
    return replace(options, true=TrueTable((first, *others)))


def economical(options: StandOptions) -> StandOptions:
    """Return the same hardware with fewer, longer blocks: half the time for each session.

    The joint states come at 25 Hz, which causes no visible loss, even through a turn.
    """
    return replace(options, block_length=_BLOCK_SECONDS, joint_state_rate=_JOINT_STATES)


def repeat(
    study: Study,
    runs: int,
    seed: int = 0,
    jobs: int | None = None,
    show: Callable[[int, int], None] | None = None,
    scheduler: str | None = None,
) -> RunStatistics:
    """Repeat a session with seeds `seed`, `seed` + 1 and so on.

    The outcome depends on the seeds alone, not on where they are run.

    Args:
        study: The session.
        runs: Number of repetitions.
        seed: Of the first run.
        jobs: Processes; as many as there are cores if not given.
        show: Called with the number of runs done and in total.
        scheduler: As in `run_all`.

    Raises:
        InputError: The stand cannot run the plan, the method does not exist, or no scheduler
            answers.
    """
    seeds = range(seed, seed + runs)
    done = 0

    def ended(_: Run) -> None:
        nonlocal done
        done += 1
        if show is not None:
            show(done, runs)

    one = partial(run_once, study)
    return RunStatistics(tuple(run_all(one, seeds, jobs=jobs, scheduler=scheduler, ended=ended)))
