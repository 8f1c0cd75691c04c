"""The files that functions write: in existing folders, complete or not at all."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..common.errors import InputError
from ..common.files import ENDINGS, user_path
from ..recordings.metadata_yaml import NAME
from ..recordings.rosbag2 import is_storage
from ..recordings.storage import refuse_existing
from ..session.keywords import Named


def output_path(output: Named) -> Path:
    """Return the path of a file to be written.

    Raises:
        InputError: Its folder does not exist, it is a folder itself, or a recording, which nobody
            can make again.
    """
    path = _below_a_folder(output)
    if path.is_dir():
        raise InputError(f'{path}: is a folder, expected the name of a file.')
    if path.is_file() and _is_of_a_recording(path.resolve()):
        refuse_existing(path)
    return path


def _is_of_a_recording(path: Path) -> bool:
    return is_storage(path) or (path.name == NAME and any(map(is_storage, path.parent.iterdir())))


def new_folder(output: Named, or_file: str = '') -> Path:
    """Return the path of a folder to create, or of a new file with the ending `or_file`."""
    path = _below_a_folder(output)
    ending = path.suffix.lower()
    if ending in ENDINGS and ending != or_file:
        other = f', or write {or_file} for a text file' if or_file else ''
        raise InputError(
            f'{path}: a recording is a folder with an .mcap file in it: leave out '
            f'{path.suffix}{other}.'
        )
    refuse_existing(path)
    return path


def page_path(output: Named) -> Path:
    """Return the path of an HTML file to be written."""
    path = output_path(output)
    if path.suffix.lower() == '.pdf':
        raise InputError(
            f'{path}: the page is HTML, expected a name that ends in .html; a browser prints it.'
        )
    return path


def output_or_default(output: str | None, default: str) -> str:
    """Return the path of -o, or the default if that does not exist yet.

    Raises:
        InputError: No path is given and the default exists: it may be the only copy of another
            session's result.
    """
    if output is None and user_path(default).exists():
        raise InputError(
            f'{default} exists already: name another with -o, or give -o {default} to overwrite it.'
        )
    return default if output is None else output


def _below_a_folder(output: Named) -> Path:
    if output == '-':
        raise InputError(
            '-: expected a name. /dev/stdout is the standard output, ./- a file of that name.'
        )
    path = user_path(output)
    if not path.parent.is_dir():
        raise InputError(f'{path}: the folder {path.parent} does not exist.')
    return path


@contextmanager
def removed_on_failure(path: Path) -> Iterator[None]:
    """Remove a new folder or file if its writing ends early, by Ctrl-C too."""
    try:
        yield
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        path.unlink(missing_ok=True)
        raise
