"""Expand paths, read files and no devices, and write files atomically."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Protocol

from .errors import InputError

_LONGEST = 100
"""Characters of a path that are shown if the system refuses it, as it does names beyond 255."""
_KEPT = 40
"""Characters of a name in that of a file half written: of four bytes each they leave room."""


def user_path(name: str | Path) -> Path:
    """Return a path with a leading `~` or `~user` expanded.

    Raises:
        InputError: There is no such home folder, or no file can have this name.
    """
    try:
        path = Path(name).expanduser()
        path.stat()
    except RuntimeError:
        raise InputError(f'{name}: there is no such home folder.') from None
    except (FileNotFoundError, NotADirectoryError):
        return path
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f'{str(name)[:_LONGEST]!r}: no file can be found there ({reason}).'
        ) from None
    return path


def printable(text: str) -> str:
    """Return a text as UTF-8 can hold it: names of files may have bytes of another encoding."""
    return text.encode('utf-8', 'backslashreplace').decode('utf-8')


class AnyFile(Protocol):
    """A path, local or remote."""

    def exists(self) -> bool:
        """Return whether there is anything."""

    def is_file(self) -> bool:
        """Return whether it is a file, no device and no pipe."""

    def is_dir(self) -> bool:
        """Return whether it is a folder."""

    def open(self, mode: str) -> Any:
        """Open it."""


def refuse_device(path: AnyFile) -> None:
    """Refuse a device or a pipe, whose contents may never come, or never end.

    Raises:
        InputError: It is one.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f'{path}: found a device or a pipe, expected a file.')


def read_bytes(path: AnyFile) -> bytes:
    """Return the contents of a file.

    Raises:
        InputError: It is no file, or cannot be read.
    """
    refuse_device(path)
    try:
        with path.open('rb') as file:
            return bytes(file.read())
    except OSError as error:
        raise InputError(f'{path}: cannot be read ({error.strerror or error}).') from None


def read_text(path: AnyFile) -> str:
    """Return the text of a file in UTF-8, without a byte order mark.

    Raises:
        InputError: It is no file, cannot be read, or is no text.
    """
    try:
        return read_bytes(path).decode('utf-8-sig')
    except UnicodeDecodeError:
        raise InputError(f'{path}: found binary data, expected text in UTF-8.') from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, as `write_by`.

    Args:
        path: The file.
        content: Bytes, or a text that is written in UTF-8.

    Raises:
        InputError: It cannot be written.
    """
    if isinstance(content, str):
        content = content.encode('utf-8', 'backslashreplace')
    write_by(path, lambda file: file.write(content))


def write_by(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file whole or not at all; a link is kept, and its target is written.

    A device or a pipe, /dev/null or /dev/stdout, is written directly: a file in its place would
    hide it from all programs.

    Args:
        path: The file.
        write: Called with the open file.

    Raises:
        InputError: It cannot be written; a file that was there is unchanged.
    """
    target = path.resolve()
    temporary = target.with_name(f'.{target.name[:_KEPT]}.{os.urandom(4).hex()}.part')
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open('wb') as file:
                write(file)
            return
        with temporary.open('wb') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            temporary.chmod(path.stat().st_mode)
        temporary.replace(target)
    except OSError as error:
        raise InputError(f'{path}: cannot be written ({error.strerror or error}).') from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


# Locate the files shipped with the code: config, plans, message definitions.

_PACKAGE = Path(__file__).resolve().parents[1]
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


# The version of the installed package, which setup.py takes from package.xml.


def version() -> str:
    """Return the installed version; '0+unknown' for a checkout that is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version('imu_calib')
    except PackageNotFoundError:
        return '0+unknown'


# Optional libraries.


def require(library: str, what: str, extra: str) -> None:
    """Raise an error if an optional library is not installed.

    Args:
        library: Name to import.
        what: The feature that needs it, as the beginning of a sentence.
        extra: Extra of this package that installs it.

    Raises:
        InputError: It is not installed; explains how to install it.
    """
    if find_spec(library) is None:
        raise InputError(
            f'{what} needs {library}, which is not installed. Run '
            f"{sys.executable} -m pip install 'imu_calib[{extra}]', or install {library}."
        )
