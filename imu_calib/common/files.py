"""Expand paths, read files and no devices, and write files atomically."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
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
