"""Locate the files shipped with the code: config, plans, message definitions."""

from __future__ import annotations

from pathlib import Path

from .errors import InputError
from .files import user_path

_PACKAGE = Path(__file__).resolve().parent
_CHECKOUT = _PACKAGE.parent


def share_folder() -> Path:
    """Return the folder that holds `config`.

    In a checkout (including an editable install) it is the checkout; else it is share/imu_calib of
    the prefix of the installation, a ROS workspace or a Python environment.

    Raises:
        InputError: None of them contains the package's files.
    """
    candidates = [_CHECKOUT, *(p / 'share' / 'imu_calib' for p in _PACKAGE.parents)]
    for folder in candidates:
        if (folder / 'config' / 'plans').is_dir():
            return folder
    raise InputError(
        'The files of imu_calib are not installed: there is no share/imu_calib/config/plans '
        f'above {_PACKAGE}.'
    )


def message_folder() -> Path:
    """Return the folder of the suite's .msg files.

    Raises:
        InputError: The package's files are not installed.
    """
    folder = share_folder()
    for candidate in (folder / 'msg_defs' / 'msg', folder.parent / 'imu_calib_msgs' / 'msg'):
        if candidate.is_dir():
            return candidate
    raise InputError(f'The message definitions of imu_calib are not installed beside {folder}.')


def named_file(kind: str, name: str | Path) -> Path:
    """Return the YAML file for a name or path given by the user.

    Args:
        kind: Folder below config: 'plans', 'imus', 'tables', 'truths', 'devices' or
            'imperfections'.
        name: A shipped name ('twelve_position'), or a path to the user's file.

    Raises:
        InputError: Neither exists; the message lists the shipped names.
    """
    path = user_path(name)
    if path.suffix in {'.yaml', '.yml'} or path.parent != Path():
        if path.is_file():
            return path
        what = 'a folder' if path.is_dir() else 'a device or a pipe'
        raise InputError(
            f'{path}: {what}, expected a file.' if path.exists() else f'{path}: no such file.'
        )
    file = share_folder() / 'config' / kind / f'{path.name}.yaml'
    if file.is_file():
        return file
    if path.is_file():
        return path
    raise InputError(f'No {kind.rstrip("s")} is called {str(name)!r}; there are: {shipped(kind)}.')


def is_shipped(kind: str, name: str) -> bool:
    """Return whether a file of a kind is shipped under a name."""
    return name in shipped(kind).split(', ')


def shipped(kind: str) -> str:
    """List the shipped names of a kind of file, as for `named_file`."""
    return ', '.join(sorted(p.stem for p in (share_folder() / 'config' / kind).glob('*.yaml')))
