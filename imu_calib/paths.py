"""Expand paths, and write files atomically."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from .errors import InputError

_LONGEST = 100
"""Characters of a path that are shown if the system refuses it, as it does names beyond 255."""


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


def write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all; a link is kept, and its target is written.

    A device or a pipe, /dev/null or /dev/stdout, is written directly: a file in its place would
    hide it from all programs.

    Raises:
        InputError: It cannot be written.
    """
    target = path.resolve()
    temporary = target.with_name(target.name + '.part')
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_text(text, encoding='utf-8', errors='backslashreplace')
            return
        temporary.write_text(text, encoding='utf-8', errors='backslashreplace')
        temporary.replace(target)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(f'{path}: cannot be written ({error.strerror}).') from None
