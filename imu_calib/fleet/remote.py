"""Recordings that lie elsewhere: copied here for as long as they are read."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from ..extras import require
from .recordings import is_url

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

TRIES = 3
"""Of a copy: a connection that is lost once is nothing, one that is lost three times is."""
_PAUSE = 0.5
"""s before the second try; doubled before the third: a server that restarts takes about that."""


@contextmanager
def local(recording: str) -> Iterator[Path]:
    """Give the path at which a recording can be read; what was copied for it goes afterwards.

    The copy takes the space of the recording in the folder for temporary files (TMPDIR).

    Args:
        recording: Path, or URL that fsspec understands (s3://bucket/folder).

    Raises:
        InputError: There is no such recording, its protocol needs a library that is not
            installed, or its connection was lost `TRIES` times.

    """
    if not is_url(recording):
        yield Path(recording)
        return
    require('fsspec', f'{recording} (a URL)', 'fleet')
    with tempfile.TemporaryDirectory(prefix='imu_calib_') as folder:
        yield _copied(recording, Path(folder))


def _copied(url: str, folder: Path) -> Path:
    import fsspec

    try:
        files, path = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(f'{url}: cannot be opened. {error}') from None
    target = folder / (path.rstrip('/').rsplit('/', 1)[-1] or 'recording')
    for again in range(TRIES):
        if again:
            time.sleep(_PAUSE * 2 ** (again - 1))
        last = _fetch(files, path, target, url)
        if last is None:
            return target
    raise InputError(
        f'{url}: not read after {TRIES} tries ({type(last).__name__}: {last}). Check the network, '
        'and run the command again.'
    ) from last


def _fetch(files: AbstractFileSystem, path: str, target: Path, url: str) -> Exception | None:
    """Copy a file or a folder; return what went wrong and may go better next time."""
    try:
        files.invalidate_cache()
        if files.isdir(path):
            files.get(path.rstrip('/'), str(target), recursive=True)
        else:
            files.get_file(path, str(target))
    except FileNotFoundError:
        raise InputError(f'{url}: no such recording.') from None
    except PermissionError as error:
        raise InputError(f'{url}: cannot be read ({error}).') from None
    except Exception as error:
        # Each protocol has errors of its own for a connection that is lost.
        return error
    return None
