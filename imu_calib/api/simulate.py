"""Simulate recordings of a stand or a hand, of several units, and many sessions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.views import compared_frame, draw_normalised
from ..common.errors import InputError, NotObservable
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..common.stream import (
    YEAR_2200,
    Block,
    ImuBlock,
    JointBlock,
    SetpointBlock,
    SkewBlock,
    Stamps,
    TemperatureBlock,
)
from ..common.units import counted
from ..estimation.methods import check_plan
from ..estimation.methods import method as solver
from ..estimation.setup import Setup
from ..model.earth import LUOYANG, Site
from ..recordings.cdr import Messages
from ..recordings.cdr_codec import (
    Kind,
    encode_imu,
    encode_joints,
    encode_setpoints,
    encode_temperatures,
)
from ..recordings.writer import RecordingWriter
from ..session.imu import COLDEST, HOTTEST, ImuSpec
from ..session.keywords import (
    AtSite,
    Named,
    Option,
    Planned,
    Stated,
    as_imu,
    as_plan,
    as_table,
    azimuth_of,
    with_defaults,
    with_keywords,
)
from ..session.metadata import (
    SIMULATED,
    describe,
    mount_description,
    shared_description,
    unit_description,
)
from ..session.plan import Plan
from ..session.table import Table
from ..session.units_file import TRUTHS, MountedUnit, spread_seeds
from ..simulation.hand import as_planned
from ..simulation.options import StandOptions, begin_of, load_imperfections
from ..simulation.repetition import RunStatistics, Study, economical, repeat
from ..simulation.stand import (
    IMU_TOPIC,
    TEMPERATURE_TOPIC,
    SeveralOnTable,
    SimulatedStand,
    SimulatedUnit,
)
from .files import new_folder, removed_on_failure
from .session import (
    DEFAULT_TRUTH,
    HELD_UNIT,
    TRUE_TABLE,
    Drifting,
    Imperfect,
    as_units,
    load_truth,
    usual_unit,
)

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure
    from typing_extensions import Unpack

TRUTH = 'truth.yaml'  #: File in a simulated recording: the true parameters of the unit.

_TABLE = 'three_axis'
_OF_SITE = AtSite.__annotations__


class SimulatedTable(TypedDict, total=False):
    """The simulated table."""

    table: Annotated[
        Table | Named | None,
        'Name, file or value; None for the three-axis table, and for none if the plan is by hand.',
        Option('default: three_axis; none where the plan is run by hand', 'NAME|FILE'),
    ]


class TrueUnit(TypedDict, total=False):
    """What only the simulation knows."""

    truth: Annotated[
        Calibration | Named | None,
        f"The unit's true parameters; None for `{DEFAULT_TRUTH}`, or `{HELD_UNIT}` if the plan is "
        'by hand, which a unit with a serial number has with departures of its own, a tenth of '
        'each parameter.',
        Option(
            f"the unit's true parameters (a calibration file; default: {DEFAULT_TRUTH}, or "
            f'{HELD_UNIT} where the plan is run by hand; units with serial numbers differ from it, '
            'and from each other, by a tenth)',
            'NAME|FILE',
        ),
    ]
    azimuth: Annotated[
        float | None,
        "True heading of the table's zero against north, about up, deg.",
        Option("true heading of the table's zero (against north, about up; default: 0)", 'DEG'),
    ]


class InRecording(TypedDict, total=False):
    """The simulated recording."""

    seed: Annotated[
        int,
        'The same seed gives the same bits.',
        Option('same seed, same bits (default: 0)', default=0),
    ]
    compression: Annotated[
        str,
        "'', 'lz4' or 'zstd', of the recording.",
        Option('compression of the recording', default='', choices=('lz4', 'zstd')),
    ]
    start: Annotated[
        str | datetime | None,
        'Date of the first sample, ISO 8601, UTC if it states no zone; None for '
        '2023-11-14T22:13:20Z and a day later with each seed.',
        Option(
            'when the recording begins, for instance 2026-01-31T12:00:00Z (default: '
            '2023-11-14T22:13:20Z, a day later with each seed)',
            'DATE',
        ),
    ]
    temperature: Annotated[
        float | None,
        'Of the unit at the start, degC; None for 25, at which the true parameters hold. '
        '`imperfections` state its effect on them; a plan by hand gets its topic by it.',
        Option(
            'temperature of the unit at the start, degC (default: 25, at which the true parameters '
            'hold); --imperfections state its effect',
            'T',
        ),
    ]


class Simulation(SimulatedTable, TrueUnit, Drifting, Imperfect, InRecording, total=False):
    """A simulated session, without its site."""


class SimulationAt(Simulation, AtSite, total=False):
    """A simulated session at a site, which the recording states."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated recording."""

    path: Path  #: Its folder.
    plan: Plan  #: The plan that was run.
    truth: Calibration  #: The true parameters of the unit, also in the file `TRUTH` of the folder.
    duration: float  #: s.
    true_table: Path | None  #: The file of the true table; None if it is as described.

    def __repr__(self) -> str:
        return f'<Simulated: {self.duration:.0f} s of plan {self.plan.name} in {self.path}>'


@with_keywords(SimulationAt)
def simulate(
    plan: Plan | Named,
    output: Named,
    *,
    imu: ImuSpec | Named | None = None,
    serial: str | None = None,
    progress: Progress = silent,
    **stated: Unpack[SimulationAt],
) -> Simulated:
    """Simulate a session and write its recording.

    Args:
        plan: Name, file or value. A value is not written to the recording, and `calibrate` must be
            given it.
        output: Folder to create.
        imu: Likewise: units and noise of the IMU's samples; None for fog_medium, or mems_counts if
            the plan is run by hand.
        serial: Serial number of the unit.
        progress: Shows the progress; nothing by default.
        KEYWORDS
        **stated: The keywords from `table` on, all optional; the recording states the site,
            Luoyang's latitude by default.

    Raises:
        InputError: A file is missing or broken, they do not match each other, the folder exists, or
            its parent folder does not.
        NotObservable: The plan cannot determine the parameters with its method.
    """
    given = with_defaults(SimulationAt, stated)
    target, place, steps = _prepared(plan, output, given)
    usual, usual_truth = usual_unit(steps)
    imu = imu or usual
    spec, true = _true_unit(imu, given['truth'], serial or '', usual_truth)
    named = None if steps.by_hand else given['table'] or _TABLE
    blocks: Iterator[tuple[str, Block]]
    stands = None if named is None else as_table(named)
    options, seed = _options(stands, given), given['seed']
    if stands is None:
        _refuse_table(steps, given['table'], given['azimuth'])
        held = as_planned(steps, np.random.default_rng([seed, 1]))
        read = held.blocks(spec, true.model, place, options, seed, epoch=options.start_time)
        duration = held.duration
        blocks = _in_the_hand(read, options, thermometer=given['temperature'])
    else:
        stand = SimulatedStand(steps, stands, spec, true.model, place, options, seed)
        duration, blocks = stand.duration, stand.blocks()
    data = describe(plan, imu, named, place, serial or '') | {SIMULATED: 'true'}
    with removed_on_failure(target):
        with RecordingWriter(target, data, given['compression']) as writer:
            _write_blocks(writer, blocks, duration, progress)
        true.save(target / TRUTH)
        true_table = _save_true_table(target, options, stands)
    return Simulated(target, steps, true, duration, true_table)


def _prepared(plan: Plan | Named, output: Named, given: SimulationAt) -> tuple[Path, Site, Plan]:
    """Return the folder to create, the site and the plan of a session."""
    if given['seed'] < 0:
        raise InputError(f'`seed`: found {given["seed"]}, expected 0 or more.')
    of_site: dict[str, Any] = {n: value for n, value in given.items() if n in _OF_SITE}
    target, place, steps = new_folder(output), Stated(**of_site).site(LUOYANG), as_plan(plan)
    check_plan(steps.method, steps, place)
    return target, place, steps


def _true_unit(
    imu: ImuSpec | Named,
    truth: Calibration | Named | None,
    serial: str,
    usual: str = DEFAULT_TRUTH,
) -> tuple[ImuSpec, Calibration]:
    """Return a unit's description and true parameters, relative to its nominal scale factors."""
    spec = as_imu(imu)
    known = load_truth(truth, spec, serial, usual)
    return spec, replace(known, imu=spec, serial_number=serial or known.serial_number)


def _options(table: Table | None, given: Simulation) -> StandOptions:
    """Return how a simulated stand differs from its descriptions."""
    options = StandOptions(
        azimuth=azimuth_of(given['azimuth'] or 0.0),
        # A uniform error of this half width has the table's stated standard deviation.
        positioning_error=0.0 if table is None else math.sqrt(3) * table.positioning,
        bias_instability=given['bias_instability'],
    )
    if given['imperfections'] is not None:
        options = load_imperfections(given['imperfections'], options, table, given['seed'])
    start = given['start']
    begin = begin_of(given['seed']) if start is None else _stamp_of(start)
    options = replace(options, start_time=begin)
    temperature = given['temperature']
    if temperature is not None:
        if not COLDEST <= temperature <= HOTTEST:
            raise InputError(
                f'`temperature`: found {temperature:g} degC, expected {COLDEST:g} to {HOTTEST:g}.'
            )
        above = temperature - options.warming.reference
        options = replace(options, warming=replace(options.warming, offset=above))
    return options


def _write_blocks(
    writer: RecordingWriter,
    blocks: Iterable[tuple[str, Block]],
    duration: float,
    progress: Progress,
) -> None:
    """Write blocks of topics to a recording, and show the progress over a duration, s."""
    with progress('simulating') as show:
        first = None
        for topic, block in blocks:
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic.removeprefix("/")}', kind.type_name, messages, stamp)
            first = int(stamp[0]) if first is None else first
            show(int(stamp[-1]) - first, round(duration * 1e9))


def _save_true_table(folder: Path, options: StandOptions, table: Table | None) -> Path | None:
    """Write the true table if it differs from its description; return its file."""
    if table is None or options.true is None:
        return None
    path = folder / TRUE_TABLE
    options.true.save(path, table)
    return path


def _stamp_of(start: str | datetime) -> int:
    """Return a date as a stamp, ns."""
    try:
        date = start if isinstance(start, datetime) else datetime.fromisoformat(_iso(start))
    except ValueError:
        raise InputError(
            f'`start`: found {start}, expected a date as 2026-01-31 or 2026-01-31T12:00:00Z.'
        ) from None
    if date.tzinfo is None:
        date = date.replace(tzinfo=timezone.utc)
    seconds = (date - datetime(1970, 1, 1, tzinfo=timezone.utc)).total_seconds()
    if not 0 <= seconds < YEAR_2200:
        raise InputError(f'`start`: found {start}, expected a date from 1970 to 2200.')
    return round(seconds * 1e6) * 1000


def _iso(text: str) -> str:
    """Return a date in the form that Python 3.10 reads: with the offset of UTC, not its letter."""
    return f'{text[:-1]}+00:00' if text[-1:] in {'Z', 'z'} else text


def _in_the_hand(
    samples: Iterable[ImuBlock], options: StandOptions, *, thermometer: float | None
) -> Iterator[tuple[str, Block]]:
    """Yield the recorded data of a unit in the hand: temperatures only if stated."""
    for block in samples:
        yield IMU_TOPIC, block
        if thermometer is not None and len(block):
            stamp = block.stamp[:1]
            times = np.asarray((stamp - options.start_time) * 1e-9, dtype=np.float64)
            yield TEMPERATURE_TOPIC, TemperatureBlock(stamp, options.warming.celsius(times))


def _refuse_table(plan: Plan, table: Table | Named | None, azimuth: float | None) -> None:
    """Refuse options of a table for a plan without one."""
    for name, found in (('table', table), ('azimuth', azimuth)):
        if found is not None:
            raise InputError(
                f'`{name}`: found {found}, expected none: plan {plan.name} is run by hand, '
                'without a table.'
            )


def serialised(block: Block) -> tuple[Kind, Messages, Stamps]:
    """Serialise a block: return its kind, its messages, and when each was recorded."""
    if isinstance(block, ImuBlock):
        return Kind.IMU, encode_imu(block), block.stamp
    if isinstance(block, SkewBlock):
        return Kind.SKEW, encode_imu(block.as_imu()), block.stamp
    if isinstance(block, JointBlock):
        return Kind.JOINTS, encode_joints(block), block.stamp
    if isinstance(block, SetpointBlock):
        stamps = np.array([s.stamp for s in block.setpoints], dtype=np.int64)
        return Kind.SETPOINTS, encode_setpoints(block), stamps
    return Kind.TEMPERATURES, encode_temperatures(block), block.stamp


# Simulate a recording of several units on one table.


@dataclass(frozen=True, eq=False)
class SimulatedUnits:
    """A simulated recording of several units."""

    path: Path  #: Its folder.
    plan: Plan  #: The plan that was run.
    #: The true parameters of each unit by serial number, also in the folder `TRUTHS`.
    truths: Mapping[str, Calibration]
    duration: float  #: s.
    true_table: Path | None  #: The file of the true table; None if it is as described.

    def __repr__(self) -> str:
        units = counted(len(self.truths), 'unit')
        return f'<SimulatedUnits: {self.duration:.0f} s of {units} in {self.path}>'


@with_keywords(SimulationAt)
def simulate_units(
    plan: Plan | Named,
    output: Named,
    imus: Named | Sequence[MountedUnit],
    *,
    progress: Progress = silent,
    **stated: Unpack[SimulationAt],
) -> SimulatedUnits:
    """Simulate a session of several units on one table and write its recording.

    Args:
        plan: Name, file or value; one of a table.
        output: Folder to create.
        imus: File of the units (docs/files/units.md), or the units.
        progress: Shows the progress.
        **stated: As for `simulate`: `truth` and `seed` of the units that state none, imperfections
            of the table the same for all units.

    Raises:
        InputError: A file is missing or broken, they do not match each other, the folder exists, or
            its parent folder does not.
        NotObservable: The plan cannot determine the parameters with its method.
    """
    given = with_defaults(SimulationAt, stated)
    target, place, steps = _prepared(plan, output, given)
    listed = as_units(imus)
    if steps.by_hand:
        raise InputError(
            f'`imus`: plan {steps.name} is run by hand, without a table: expected one unit (`imu`).'
        )
    table, seed = given['table'] or _TABLE, given['seed']
    stands = as_table(table)
    options = _options(stands, given)
    units, truths = [], {}
    for one, own_seed in zip(listed, spread_seeds(listed, seed), strict=True):
        spec, true = _true_unit(one.imu, one.truth or given['truth'], one.serial_number)
        truths[one.serial_number] = true
        unit = SimulatedUnit(one.topic, spec, true.model, one.mount, one.lever, own_seed)
        units.append(unit)
    stand = SeveralOnTable(steps, stands, units, place, options, seed)
    data = shared_description(describe(plan, listed[0].imu, table, place)) | {SIMULATED: 'true'}
    for one in listed:
        data |= unit_description(one.topic, one.imu, one.serial_number)
        if one.turned:
            data |= mount_description(one.topic, one.mount)
    with removed_on_failure(target):
        with RecordingWriter(target, data, given['compression']) as writer:
            _write_blocks(writer, stand.blocks(), stand.duration, progress)
        (target / TRUTHS).mkdir()
        for number, true in truths.items():
            true.save(target / TRUTHS / f'{number}.yaml')
        true_table = _save_true_table(target, options, stands)
    return SimulatedUnits(target, steps, truths, stand.duration, true_table)


# Repeat a simulated session: errors of its method against its stated deviations.

_MOST_RUNS = 1_000_000
"""Chosen: of about a second each they take eleven days of one processor, and a gigabyte."""


@dataclass(frozen=True, eq=False)
class MonteCarloResult:
    """A session that was simulated and calibrated many times."""

    setup: Setup  #: Plan, method, table, IMU and site.
    outcome: RunStatistics  #: Errors and standard deviations of every run, and their statistics.
    findings: tuple[str, ...]  #: Messages for the user, in sentences.

    def __repr__(self) -> str:
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
        """
        outcome = self.outcome
        columns = {
            'bias': outcome.bias,
            'spread': outcome.spread,
            'stated': outcome.mean_stated,
            'worst': outcome.worst,
        }
        by_hand = self.setup.plan.by_hand
        plain = {'normalised': outcome.rms}
        return compared_frame(outcome.parameters, columns, plain, by_hand=by_hand)

    def plot(self) -> Figure:
        """Draw the errors over the stated standard deviations; return the matplotlib Figure."""
        setup, outcome = self.setup, self.outcome
        title = f'{setup.plan.name}, {setup.method_name}: {len(outcome.errors)} runs'
        known = np.isfinite(outcome.mean_stated)
        names = [p.name for p, k in zip(outcome.parameters, known, strict=True) if k]
        return draw_normalised(title, names, outcome.normalised[:, known])


@with_keywords(Planned)
@by_one_thread
def montecarlo(
    plan: Plan | Named,
    imu: ImuSpec | Named | None = None,
    *,
    runs: int = 100,
    seed: int = 0,
    jobs: int = 1,
    scheduler: str | None = None,
    truth: Calibration | Named | None = None,
    bias_instability: bool = False,
    progress: Progress = silent,
    **stated: Unpack[Planned],
) -> MonteCarloResult:
    """Simulate a session with many seeds, calibrate from each, and compare with the truth.

    Args:
        plan: Name, file or value.
        imu: Likewise; None for fog_medium, or mems_counts if the plan is run by hand.
        runs: Number of sessions.
        seed: Of the first; the outcome depends only on the seeds.
        jobs: Number of processes. More than one require a program whose code is below
            `if __name__ == '__main__':`, as multiprocessing does.
        scheduler: Address of a Dask scheduler whose workers run them (tcp://host:8786); requires
            the extra fleet.
        truth: The unit's true parameters; None for cao2022_table1, or mems_counts likewise.
        bias_instability: Let the biases drift by the IMU's figure.
        progress: Shows the progress; nothing by default.
        **stated: The session, by keywords of `calibrate`; by default on the three-axis table (on
            none if the plan is run by hand), at Luoyang's latitude. The true latitude and gravity
            are drawn by their standard deviations. A stated azimuth is known to the calibrator;
            without one each run has another, unknown azimuth.

    Raises:
        InputError: A file is missing or broken, they do not match each other, or no scheduler
            answers.
        NotObservable: No run gave an estimate; the text states why.
    """
    for name, value, least in (('runs', runs, 1), ('jobs', jobs, 1), ('seed', seed, 0)):
        if value < least:
            raise InputError(f'`{name}`: found {value}, expected a whole number from {least} on.')
    if runs > _MOST_RUNS:
        raise InputError(f'`runs`: found {runs}, expected at most {_MOST_RUNS}.')
    steps = as_plan(plan)
    usual, usual_truth = usual_unit(steps)
    spec, true = as_imu(imu or usual), truth or usual_truth
    study = _study(Stated(**stated), steps, spec, true, drifting=bias_instability)
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
    site = stated.site(LUOYANG)
    if plan.by_hand:
        _refuse_table(plan, stated.table, stated.azimuth)
    table = None if plan.by_hand else stated.simulated_table()
    terms, changes = stated.sensor_terms, stated.changes
    if stated.method is not None:
        # Refuse it before the first run, not in it.
        solver(stated.method, terms, changes)
    if table is not None:
        plan.steps(table)
    stand = StandOptions(
        # A uniform error of this half width has the table's stated standard deviation.
        positioning_error=0.0 if table is None else math.sqrt(3) * table.positioning,
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
    azimuth = 0.0 if table is None else table.azimuth
    return Study(setup, load_truth(truth, imu).model, economical(stand), azimuth)
