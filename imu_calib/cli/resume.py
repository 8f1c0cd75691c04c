"""Settings in a stand's folder, used to resume an interrupted session."""

from __future__ import annotations

import argparse
import os
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import yaml

from ..api.stand import OPTIONS, SETTINGS, can_be_resumed, end_of_journal
from ..calibration.calibration import Calibration
from ..common.errors import InputError
from ..common.files import named_file, read_text, user_path, write_whole
from ..recordings.rosbag2 import JOURNAL
from . import several
from .terminal import ERRORS

RESULT = 'calibration.yaml'
_RUNNING = 'running'
_FILES = {
    'plan': 'plans',
    'imu': 'imus',
    'table': 'tables',
    'device': 'devices',
    'truth': 'truths',
    'imperfections': 'imperfections',
}
"""Options that name a file, with its kind."""
_OF_THE_RUN = frozenset(
    {'command', 'run', 'default_of', 'closing_line', 'output', 'resume', 'start'}
    | {'web', 'web_host', 'control', 'verbose'}
)
"""Options of one run, which do not belong to the session."""
_MAY_CHANGE = frozenset(
    {'port', 'baud', 'speed', 'network', 'without', 'processes', 'table_port', 'table_baud'}
    | {'specification'}
)
"""A device or a network may have another name after a power failure; the speed of a simulation has
no effect; a unit may have failed permanently."""
_OUTAGE = 12
"""Time without simulated hardware, s of its time: longer than the accepted silence of joint states,
and by the stamps of the IMU, which differ by tenths of a second, than `labelling.OUTAGE`."""
_PATIENCE = 30.0
"""Longest wait for the nodes of a killed run, s: they stop the table first, and wait for the
acknowledgement."""


def save_settings(
    arguments: argparse.Namespace, folder: Path, truth: Calibration | None = None
) -> None:
    """Write the settings of a session into its folder, with paths of the copies there.

    Files are copied: the session is resumed unchanged even if the originals change. `truth` is of
    a single simulated unit, whose node takes it from there.
    """
    settings = folder / SETTINGS
    settings.mkdir()
    for option, kind in _FILES.items():
        name = getattr(arguments, option)
        if name:
            write_whole(settings / f'{option}.yaml', read_text(named_file(kind, name)))
    if arguments.imus:
        several.save_settings(arguments, settings)
    elif truth is not None and not arguments.truth:
        truth.save(settings / 'truth.yaml')
    kept = {k: v for k, v in vars(arguments).items() if k not in {*_OF_THE_RUN, *_FILES, 'imus'}}
    # Last: a folder without it does not belong to a stand.
    write_whole(settings / OPTIONS, yaml.safe_dump(kept))
    _point_at_copies(arguments, settings)


def restore(arguments: argparse.Namespace) -> Path:
    """Set the options of the interrupted session; return its folder."""
    folder = user_path(arguments.resume)
    settings = folder / SETTINGS
    try:
        kept: Any = yaml.safe_load((settings / OPTIONS).read_text(encoding='utf-8'))
        if not isinstance(kept, dict):
            raise ValueError('it holds no options')
    except (OSError, ValueError, yaml.YAMLError) as error:
        if not folder.is_dir():
            raise InputError(f'--resume {folder}: there is no such folder.') from None
        if isinstance(error, FileNotFoundError | NotADirectoryError):
            raise InputError(f'--resume: {folder} holds no session of imu-calib stand.') from None
        reason = error.strerror if isinstance(error, OSError) else ' '.join(str(error).split())
        raise InputError(f'--resume: {settings / OPTIONS} cannot be read ({reason}).') from None
    _refuse_other_settings(arguments, folder)
    if arguments.port and not kept.get('port'):
        raise InputError(f'--resume {folder}: its hardware is simulated; leave --port out.')
    for name, value in kept.items():
        if name not in _MAY_CHANGE or getattr(arguments, name) == arguments.default_of(name):
            setattr(arguments, name, value)
    _point_at_copies(arguments, settings)
    return folder


def check_unfinished(folder: Path) -> None:
    """Refuse to resume a complete session."""
    if not can_be_resumed(folder):
        raise InputError(f'--resume {ended(folder)}')


def switched_on_at(folder: Path) -> float:
    """Return when simulated hardware is switched on again, s after its epoch."""
    end = end_of_journal(folder / JOURNAL)
    return 0.0 if end is None else end + _OUTAGE


def command(folder: str) -> str:
    """Return the command that resumes a session in a folder."""
    return f'imu-calib stand --resume {shlex.quote(folder)}'


@contextmanager
def locked_folder(folder: Path) -> Iterator[int]:
    """Lock a folder for this run; yield the file descriptor that its nodes must inherit.

    The lock ends with the last process that has it, in every case.
    """
    descriptor = os.open(folder / _RUNNING, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(descriptor, folder)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, str(os.getpid()).encode(), 0)
        yield descriptor
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    # What Linux has is imported where it is used.
    import fcntl

    deadline = time.monotonic() + _PATIENCE
    waits = False
    while True:
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        number = os.pread(descriptor, 20, 0).decode(errors='replace')
        if _runs(number):
            raise InputError(
                f'{folder}: the stand of this folder still runs (process {number}). End it with '
                'Ctrl-C first, or let it finish.'
            )
        if time.monotonic() > deadline:
            raise InputError(f'{folder}: nodes of the interrupted stand still run. End them first.')
        if not waits:
            waits = True
            ERRORS.print('The nodes of the interrupted stand are still ending.')
        time.sleep(0.1)


def _runs(number: str) -> bool:
    try:
        os.kill(int(number), 0)
    except (ValueError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return True


def _point_at_copies(arguments: argparse.Namespace, settings: Path) -> None:
    for option in (*_FILES, 'imus'):
        copy = settings / f'{option}.yaml'
        if copy.is_file():
            setattr(arguments, option, str(copy))


def _refuse_other_settings(arguments: argparse.Namespace, folder: Path) -> None:
    given = [
        name
        for name, value in vars(arguments).items()
        if name not in _OF_THE_RUN
        and name not in _MAY_CHANGE
        and value != arguments.default_of(name)
    ]
    if arguments.output != arguments.default_of('output'):
        given.append('output')
    if given:
        named, known = (
            ', '.join('PLAN' if n == 'plan' else f'--{n.replace("_", "-")}' for n in names)
            for names in (given, sorted(_MAY_CHANGE))
        )
        raise InputError(
            f'--resume {folder}: found {named} too, expected at most {known} and those of the '
            'page: the session goes on with the settings it began with.'
        )


def ended(folder: Path) -> str:
    """Return how the session of a folder ended that cannot be resumed, and where its result is."""
    for result in (folder / RESULT, folder / several.CALIBRATIONS):
        if result.is_file() or (result.is_dir() and any(result.iterdir())):
            return f'{folder}: its session is complete; the result is {result}.'
    return (
        f'{folder}: its session has ended without a result and cannot be resumed. '
        f'imu-calib calibrate {shlex.quote(str(folder / JOURNAL))} says why.'
    )
