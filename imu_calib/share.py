"""Where the files that ship beside the code are: config, plans, message definitions."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from .errors import InputError

_CHECKOUT = Path(__file__).resolve().parent.parent


def share_folder() -> Path:
    """Return the folder that holds `config`.

    A ROS share folder of the running environment comes first, then the checkout (an editable
    install has no data files of its own), then the data folder of the Python environment.

    Raises:
        InputError: None of them holds the package's files.

    """
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    package = Path(__file__).resolve()
    ament = [p / 'share' / 'imu_calib' for p in prefixes if package.is_relative_to(p.resolve())]
    candidates = [*ament, _CHECKOUT, Path(sys.prefix) / 'share' / 'imu_calib']
    for folder in candidates:
        if (folder / 'config' / 'plans').is_dir():
            return folder
    looked = ', '.join(str(folder) for folder in candidates)
    raise InputError(f'The files of imu_calib are not installed: no config/plans in {looked}.')


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
    """Return the YAML file that a name or a path of the user means.

    Args:
        kind: Folder below config: 'plans', 'imus' or 'tables'.
        name: A shipped name ('twelve_position'), or a path to a file of the user's.

    Raises:
        InputError: Neither exists; the message lists the shipped names.

    """
    path = Path(name).expanduser()
    if path.suffix in {'.yaml', '.yml'} or path.parent != Path():
        if path.is_file():
            return path
        raise InputError(f'{path}: no such file.')
    folder = share_folder() / 'config' / kind
    shipped = folder / f'{path.name}.yaml'
    if shipped.is_file():
        return shipped
    known = ', '.join(sorted(p.stem for p in folder.glob('*.yaml')))
    raise InputError(f'No {kind.rstrip("s")} is called {str(name)!r}; there are: {known}.')
