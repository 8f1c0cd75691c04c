"""Paths as people write them, and files that are written whole."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from .errors import InputError


def user_path(name: str | Path) -> Path:
    """Return a path with its leading `~` or `~user` filled in.

    Raises:
        InputError: There is no such home folder.

    """
    try:
        return Path(name).expanduser()
    except RuntimeError:
        raise InputError(f'{name}: there is no such home folder.') from None


def write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all.

    Raises:
        InputError: It cannot be written.

    """
    temporary = path.with_name(path.name + '.part')
    try:
        temporary.write_text(text, encoding='utf-8')
        temporary.replace(path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(f'{path}: cannot be written ({error.strerror}).') from None
