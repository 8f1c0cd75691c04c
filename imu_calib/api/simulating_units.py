"""Simulate a recording of several units on one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.parallel import Progress, silent
from ..common.units import counted
from ..estimation.methods import check_plan
from ..model.earth import LUOYANG
from ..recordings.writer import RecordingWriter
from ..session.metadata import describe, mount_description, shared_description, unit_description
from ..session.plan import Plan
from ..session.table import Table
from ..session.units_file import TRUTHS, MountedUnit, spread_seeds
from ..simulation.stand import SeveralOnTable, SimulatedUnit
from .keywords import AtSite, with_keywords
from .named import Named, as_imu, as_plan, as_table, as_units, load_truth
from .outputs import new_folder, removed_on_failure
from .session import Stated
from .simulate import options_of, save_true_table, write_blocks

if TYPE_CHECKING:
    from typing_extensions import Unpack

_UNITS_TABLE = 'three_axis'
_TRUTH = 'cao2022_table1'


@dataclass(frozen=True, eq=False)
class SimulatedUnits:
    """A simulated recording of several units.

    Attributes:
        path: Its folder.
        plan: The plan that was run.
        truths: The true parameters of each unit by serial number, also in the folder `TRUTHS`.
        duration: s.
        true_table: The file of the true table; None if it is as described.
    """

    path: Path
    plan: Plan
    truths: Mapping[str, Calibration]
    duration: float
    true_table: Path | None

    def __repr__(self) -> str:
        """Return one line."""
        units = counted(len(self.truths), 'unit')
        return f'<SimulatedUnits: {self.duration:.0f} s of {units} in {self.path}>'


@with_keywords(AtSite)
def simulate_units(
    plan: Plan | Named,
    output: Named,
    imus: Named | Sequence[MountedUnit],
    *,
    table: Table | Named | None = None,
    truth: Calibration | Named = _TRUTH,
    azimuth: float | None = None,
    bias_instability: bool = False,
    imperfections: Named | None = None,
    seed: int = 0,
    start: str | datetime | None = None,
    temperature: float | None = None,
    compression: str = '',
    progress: Progress = silent,
    **site: Unpack[AtSite],
) -> SimulatedUnits:
    """Simulate a session of several units on one table and write its recording.

    Args:
        plan: Name, file or value; one of a table.
        output: Folder to create.
        imus: File of the units (docs/files/units.md), or the units.
        table: Name, file or value; None for the three-axis table.
        truth: True parameters of the units that state none.
        azimuth: As for `simulate`, as are all that follow.
        bias_instability: Of every unit, by its own figure.
        imperfections: Those of the table are the same for all units.
        seed: Of the table, and of the units that state none.
        start: Date of the first sample.
        temperature: degC.
        compression: '', 'lz4' or 'zstd'.
        progress: Shows the progress.
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
    listed = as_units(imus)
    place = Stated(**site).site(LUOYANG)
    steps = as_plan(plan)
    check_plan(steps.method, steps, place)
    if steps.by_hand:
        raise InputError(
            f'`imus`: plan {steps.name} is run by hand, without a table: expected one unit (`imu`).'
        )
    stands = as_table(table or _UNITS_TABLE)
    options = options_of(
        stands,
        azimuth,
        imperfections,
        seed,
        bias_instability=bias_instability,
        start=start,
        temperature=temperature,
    )
    units, truths = [], {}
    for one, own_seed in zip(listed, spread_seeds(listed, seed), strict=True):
        spec = as_imu(one.imu)
        true = replace(load_truth(one.truth or truth, spec), imu=spec)
        truths[one.serial_number] = replace(true, serial_number=one.serial_number)
        unit = SimulatedUnit(one.topic, spec, true.model, one.mount, one.lever, own_seed)
        units.append(unit)
    stand = SeveralOnTable(steps, stands, units, place, options, seed)
    data = shared_description(describe(plan, listed[0].imu, table or _UNITS_TABLE, place))
    for one in listed:
        data |= unit_description(one.topic, one.imu, one.serial_number)
        if one.turned:
            data |= mount_description(one.topic, one.mount)
    with removed_on_failure(target):
        with RecordingWriter(target, data, compression) as writer:
            write_blocks(writer, stand.blocks(), stand.duration, progress)
        (target / TRUTHS).mkdir()
        for number, true in truths.items():
            true.save(target / TRUTHS / f'{number}.yaml')
        true_table = save_true_table(target, options, stands)
    return SimulatedUnits(target, steps, truths, stand.duration, true_table)
