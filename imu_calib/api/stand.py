"""Run a stand live, with simulated hardware and the nodes of a real one."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration.calibration import Calibration
from ..common.errors import ImuCalibError, InputError, NotObservable
from ..common.files import user_path
from ..common.processes import ENDS_WITH
from ..common.stream import NS
from ..estimation import hand as free_positions
from ..estimation.forecast import check_session
from ..estimation.setup import Setup
from ..model.earth import Site
from ..recordings.rosbag2 import JOURNAL, Recording, open_recording
from ..recordings.storage import RecordingError
from ..recordings.writer import FINISHED
from ..session.imu import ImuSpec
from ..session.keywords import Named, OnStand, Stated, with_keywords
from ..session.plan import Plan
from ..session.table import Table
from ..simulation.options import (
    DAY,
    BiasStep,
    StandOptions,
    ThermalDrift,
    WarmUp,
    load_imperfections,
)
from ..simulation.true_table import TrueTable
from .session import TRUE_TABLE, SimulatedHardware

if TYPE_CHECKING:
    from typing_extensions import Unpack

_COMMAND = 'imu_calib.cli.main'
_ERRORS = {error.exit_code: error for error in (InputError, NotObservable)}


class _OnSimulatedStand(SimulatedHardware, OnStand, total=False):
    """A session that is run live on simulated hardware."""


@dataclass(frozen=True, eq=False)
class StandRun:
    """A completed session of a simulated stand."""

    path: Path  #: Its folder.
    recording: Path  #: The recording used for the calibration.
    calibration: Calibration  #: The result, as in calibration.yaml of the folder.
    truth: Calibration  #: The unit's true parameters.
    true_table: Path | None  #: File of the true table; None if it is as described.

    def __repr__(self) -> str:
        return f'<StandRun: {self.calibration} in {self.path}>'


@with_keywords(_OnSimulatedStand)
def stand(
    plan: Named,
    output: Named = 'stand',
    *,
    imu: Named | None = None,
    table: Named = 'three_axis',
    serial: str | None = None,
    **stated: Unpack[_OnSimulatedStand],
) -> StandRun:
    """Run a plan live on a simulated stand: all nodes in one process of its own.

    `simulate` and `calibrate` give the same result much faster. This tests the nodes as on a real
    stand, which only the command can run (`imu-calib stand --port`).

    Args:
        plan: Name or file.
        output: Folder to create.
        imu: Name or file; None for fog_medium, or mems_counts if the plan is run by hand.
        table: The turntable: name or file.
        serial: Serial number of the unit.
        KEYWORDS
        **stated: The keywords from `truth` on, all optional; Luoyang's latitude by default.

    Raises:
        InputError: A file is missing or broken, the folder exists already, they do not match each
            other, or a node does not start.
        NotObservable: The session gives no calibration; the text states why.
        ImuCalibError: There is no middleware for the nodes.
    """
    options = {'imu': imu, 'table': table, 'serial': serial, **stated}
    folder = user_path(output)
    given = {name.replace('_', '-'): value for name, value in options.items()}
    words = [f'--{name}={value}' for name, value in given.items() if value is not None]
    _run(['stand', f'--output={folder}', *words, '--', str(plan)])
    drawn = folder / TRUE_TABLE
    return StandRun(
        folder,
        folder / JOURNAL,
        Calibration.load(folder / 'calibration.yaml'),
        Calibration.load(folder / 'truth.yaml'),
        drawn if drawn.exists() else None,
    )


def _run(words: list[str]) -> None:
    """Run a command line in a process that ends with this one; its errors name keywords."""
    process = subprocess.Popen(
        [
            sys.executable,
            '-m',
            'imu_calib.common.processes',
            sys.executable,
            '-m',
            _COMMAND,
            *words,
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, ENDS_WITH: str(os.getpid())},
        text=True,
    )
    try:
        _, errors = process.communicate()
    finally:
        if process.poll() is None:
            # It stops the table first.
            process.send_signal(signal.SIGTERM)
            process.communicate()
    if process.returncode == 0:
        return
    if process.returncode == 128 + signal.SIGINT:
        raise KeyboardInterrupt
    text = errors.rpartition('imu-calib stand: ')[2].strip()
    for name in signature(stand).parameters:
        text = re.sub(rf'--{name.replace("_", "-")}\b(?!-)', f'`{name}`', text)
    raise _ERRORS.get(process.returncode, ImuCalibError)(text)


# What a stand is asked before it starts: whether its session could give a result.


def setup_of_stand(
    stated: Stated, imu: ImuSpec, plan: Plan, table: Table | None, site: Site
) -> Setup:
    """Return the set-up of a live session, with the stated method and terms."""
    terms, changes, search = stated.sensor_terms, stated.changes, stated.search_terms
    return Setup(
        imu, plan, table, site, stated.method, terms=terms, changes=changes, search_terms=search
    )


def check_stand(setup: Setup) -> None:
    """Refuse what the method could not solve; if north is unknown, name what would determine it."""
    try:
        check_session(setup)
    except NotObservable as error:
        table = setup.table
        if table is None or table.azimuth is not None:
            raise
        check_session(replace(setup, table=replace(table, azimuth=0.0)))
        raise NotObservable(
            f'{error} Here the file of the table says where north is (azimuth: 12.3 deg); that of '
            f'{table.name} does not.'
        ) from None


def has_simulated_hands(setup: Setup) -> bool:
    """Return whether a session is one that simulated hands can hold: free positions."""
    return setup.method_name == free_positions.NAME


def true_table_of(imperfections: Named, table: Table | None, seed: int) -> TrueTable | None:
    """Return the simulated table where imperfections differ from its description."""
    return load_imperfections(imperfections, StandOptions(), table, seed).true


def truth_in_session(
    true: Calibration, found: Calibration, imperfections: Named, table: Table | None
) -> tuple[Calibration, list[str]]:
    """Return the true parameters at the temperature of a session, and what they leave out.

    Args:
        true: As stated, at the reference temperature of the imperfections.
        found: The result of the session, at its mean temperature.
        imperfections: Of the simulated unit.
        table: Description of the table; None in a hand.
    """
    options = load_imperfections(imperfections, StandOptions(), table, 0)
    notes, reference = [], options.warming.reference
    seen = found.provenance.get('temperature')
    if seen is not None and options.thermal_drift != ThermalDrift():
        true = replace(true, model=options.thermal_drift.on(true.model, seen['mean'] - reference))
        notes.append(
            f'The truth above is that of {seen["mean"]:.2f} degC, the mean of the session; '
            f'truth.yaml has it at {reference:g} degC.'
        )
    parts = {'warm-up': options.warm_up != WarmUp(), 'step': options.bias_step != BiasStep()}
    if left_out := ' and '.join(name for name, there in parts.items() if there):
        notes.append(
            f'The truth above is that without the {left_out} of the biases, which the imperfections'
            ' add: error/std of D_g and D_a contains them.'
        )
    return true, notes


# Journals of live sessions: whether one is complete, and when it ends.


SETTINGS, OPTIONS = 'settings', 'options.yaml'  #: Within the folder of a stand's session.


def can_be_resumed(folder: Path) -> bool:
    """Return whether a folder has a session of a stand that is not complete."""
    if not (folder / SETTINGS / OPTIONS).is_file():
        return False
    recording = _opened(folder / JOURNAL)
    # One that is unreadable is begun anew.
    return recording is None or FINISHED not in recording.custom_data


def end_of_journal(journal: Path) -> float | None:
    """Return the last whole second of a journal, s after simulated hardware began.

    None if it is unreadable or empty.
    """
    recording = _opened(journal)
    if recording is None:
        return None
    with recording:
        end = recording.end_ns
        if end is None:
            logged = (times.log for _, _, times in recording.messages())
            end = max((int(log.max()) for log in logged if len(log)), default=None)
    # A session lasts less than a day, and seeds begin whole days apart.
    return None if end is None else float((end - StandOptions.start_time) % DAY // NS)


def _opened(journal: Path) -> Recording | None:
    try:
        return open_recording(journal)
    except RecordingError:
        return None
