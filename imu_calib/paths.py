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
    """Write a file whole or not at all; a link stays one, and its file is written.

    A device or a pipe, /dev/null or /dev/stdout, takes the text as it comes: a file put in its
    place would take it from all programs.

    Raises:
        InputError: It cannot be written.
    """
    target = path.resolve()
    temporary = target.with_name(target.name + '.part')
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_text(text, encoding='utf-8')
            return
        temporary.write_text(text, encoding='utf-8')
        temporary.replace(target)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise InputError(f'{path}: cannot be written ({error.strerror}).') from None
