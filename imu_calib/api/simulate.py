"""Simulate a recording of a stand or of a unit in the hand."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.parallel import Progress, silent
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
from ..estimation.methods import check_plan
from ..model.earth import LUOYANG
from ..recordings.cdr import Messages
from ..recordings.cdr_codec import encode_imu, encode_joints, encode_setpoints, encode_temperatures
from ..recordings.rosbag2 import Kind
from ..recordings.writer import RecordingWriter
from ..session.imu import COLDEST, HOTTEST, ImuSpec
from ..session.metadata import describe
from ..session.plan import Plan
from ..session.table import Table
from ..simulation.hand import as_planned
from ..simulation.options import StandOptions, load_imperfections
from ..simulation.stand import IMU_TOPIC, TEMPERATURE_TOPIC, SimulatedStand
from .keywords import AtSite, with_keywords
from .named import Named, as_imu, as_plan, as_table, load_truth
from .outputs import new_folder, removed_on_failure
from .session import TRUE_TABLE, Stated, azimuth_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

TRUTH = 'truth.yaml'
"""File in a simulated recording: the true parameters of the unit."""

_TABLE = 'three_axis'


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated recording.

    Attributes:
        path: Its folder.
        plan: The plan that was run.
        truth: The true parameters of the unit, also in the file `TRUTH` of the folder.
        duration: s.
        true_table: The file of the true table; None if it is as described.
    """

    path: Path
    plan: Plan
    truth: Calibration
    duration: float
    true_table: Path | None

    def __repr__(self) -> str:
        """Return one line."""
        return f'<Simulated: {self.duration:.0f} s of plan {self.plan.name} in {self.path}>'


@with_keywords(AtSite)
def simulate(
    plan: Plan | Named,
    output: Named,
    *,
    imu: ImuSpec | Named = 'fog_medium',
    table: Table | Named | None = None,
    truth: Calibration | Named = 'cao2022_table1',
    azimuth: float | None = None,
    bias_instability: bool = False,
    imperfections: Named | None = None,
    seed: int = 0,
    serial: str | None = None,
    start: str | datetime | None = None,
    temperature: float | None = None,
    compression: str = '',
    progress: Progress = silent,
    **site: Unpack[AtSite],
) -> Simulated:
    """Simulate a session and write its recording.

    Args:
        plan: Name, file or value. A value is not written to the recording, and `calibrate` must be
            given it.
        output: Folder to create.
        imu: Likewise: units and noise of the IMU's samples.
        table: Likewise; None for the three-axis table, and for none if the plan is by hand.
        truth: The unit's true parameters.
        azimuth: True heading of the table's zero against north, about up, deg.
        bias_instability: Let the biases drift by the IMU's figure.
        imperfections: Faults of the stand: name or file.
        seed: The same seed gives the same bits.
        serial: Serial number of the unit.
        start: Date of the first sample, ISO 8601, UTC if it states no zone; None for
            2023-11-14T22:13:20Z.
        temperature: Of the unit at the start, degC; None for 25, at which the true parameters hold.
            `imperfections` state its effect on them; a plan by hand gets its topic by it.
        compression: '', 'lz4' or 'zstd', of the recording.
        progress: Shows the progress; nothing by default.
        **site: `latitude` to `gravity_std` as of `calibrate`, to be stated in the recording; None
            for Luoyang's latitude.

    Raises:
        InputError: A file is missing or broken, they do not match each other, the folder exists, or
            its parent folder does not.
        NotObservable: The plan cannot determine the parameters with its method.
    """
    if seed < 0:
        raise InputError(f'`seed`: found {seed}, expected 0 or more.')
    target = new_folder(output)
    place = Stated(**site).site(LUOYANG)
    spec = as_imu(imu)
    # Errors are relative to nominal scale factors: those of this unit.
    true = replace(load_truth(truth, spec), imu=spec)
    steps = as_plan(plan)
    check_plan(steps.method, steps, place)
    named = None if steps.by_hand else table or _TABLE
    blocks: Iterator[tuple[str, Block]]
    stands = None if named is None else as_table(named)
    stated = options_of(
        stands,
        azimuth,
        imperfections,
        seed,
        bias_instability=bias_instability,
        start=start,
        temperature=temperature,
    )
    if stands is None:
        _refuse_table(steps, table, azimuth)
        held = as_planned(steps, np.random.default_rng([seed, 1]))
        read = held.blocks(spec, true.model, place, stated, seed, epoch=stated.start_time)
        duration, blocks = held.duration, _in_the_hand(read, stated, thermometer=temperature)
    else:
        stand = SimulatedStand(steps, stands, spec, true.model, place, stated, seed)
        duration, blocks = stand.duration, stand.blocks()
    data = describe(plan, imu, named, place, serial or '')
    with removed_on_failure(target):
        with RecordingWriter(target, data, compression) as writer:
            write_blocks(writer, blocks, duration, progress)
        true.save(target / TRUTH)
        true_table = save_true_table(target, stated, stands)
    return Simulated(target, steps, true, duration, true_table)


def options_of(
    table: Table | None,
    azimuth: float | None,
    imperfections: Named | None,
    seed: int,
    *,
    bias_instability: bool,
    start: str | datetime | None,
    temperature: float | None,
) -> StandOptions:
    """Return how a simulated stand differs from its descriptions; arguments as for `simulate`.

    Raises:
        InputError: The file is broken, or an azimuth, a date or a temperature is invalid.
    """
    options = StandOptions(
        azimuth=azimuth_of(azimuth or 0.0),
        # A uniform error of this half width has the table's stated standard deviation.
        positioning_error=0.0 if table is None else math.sqrt(3) * table.positioning,
        bias_instability=bias_instability,
    )
    if imperfections is not None:
        options = load_imperfections(imperfections, options, table, seed)
    return _with_date_and_temperature(options, start, temperature)


def write_blocks(
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


def save_true_table(folder: Path, options: StandOptions, table: Table | None) -> Path | None:
    """Write the true table if it differs from its description; return its file."""
    if table is None or options.true is None:
        return None
    path = folder / TRUE_TABLE
    options.true.save(path, table)
    return path


def _with_date_and_temperature(
    options: StandOptions, start: str | datetime | None, temperature: float | None
) -> StandOptions:
    """Return options with the stated date and temperature."""
    if start is not None:
        options = replace(options, start_time=_stamp_of(start))
    if temperature is not None:
        if not COLDEST <= temperature <= HOTTEST:
            raise InputError(
                f'`temperature`: found {temperature:g} degC, expected {COLDEST:g} to {HOTTEST:g}.'
            )
        above = temperature - options.warming.reference
        options = replace(options, warming=replace(options.warming, offset=above))
    return options


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
