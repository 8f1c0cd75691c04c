"""Paths of recordings: local, or URLs of fsspec."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias

from ..common.errors import InputError
from ..common.files import require, user_path
from .remote_copy import Copy, Reader
from .retries import with_retries

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem


def is_url(name: object) -> bool:
    """Return whether a name is a URL instead of a local path."""
    return isinstance(name, str) and '://' in name


def located(name: str | AnyPath) -> AnyPath:
    """Return the local or remote path for a name.

    Raises:
        InputError: It is a URL whose protocol is unknown, needs a library that is not installed,
            or cannot be reached.
    """
    if isinstance(name, RemotePath):
        return name
    return RemotePath.at(str(name)) if is_url(name) else user_path(name)


def local(path: AnyPath) -> Path:
    """Return a local path for a C library; a remote file is fetched whole.

    Raises:
        InputError: It cannot be fetched.
    """
    return path.fetched() if isinstance(path, RemotePath) else path


class RemotePath:
    """A file or folder read by fsspec, with the methods of `Path` that the readers use.

    Args:
        url: As given.
        files: Its file system.
        inside: Its path there.
        kind: 'file', 'directory' or '' if there is nothing, and the bytes of a file if known.
    """

    def __init__(self, url: str, files: AbstractFileSystem, inside: str, kind: _Kind) -> None:
        self._url = url
        self._files = files
        self._inside = inside
        self._kind = kind
        self._copy: Copy | None = None
        self._held: dict[str, RemotePath] | None = None

    @classmethod
    def at(cls, url: str) -> RemotePath:
        """Return the path of a URL.

        Raises:
            InputError: As in `located`.
        """
        require('fsspec', f'{url} (a URL)', 'remote')
        import fsspec

        try:
            files, inside = fsspec.core.url_to_fs(url)
            # In a long-lived process, cached listings would be out of date.
            files.invalidate_cache()
        except Exception as error:
            # Each protocol has its own exceptions for a host, a file or an option that it lacks.
            raise InputError(
                f'{url}: cannot be opened ({error}). The extra remote brings what reads S3 and '
                "HTTP (pip install 'imu_calib[remote]'); other protocols need libraries of their "
                'own.'
            ) from None
        inside = inside.rstrip('/')
        return cls(url.rstrip('/'), files, inside, _looked_up(url, files, inside))

    def __str__(self) -> str:
        return self._url

    def __truediv__(self, name: str) -> RemotePath:
        if self._held is not None and name in self._held:
            return self._held[name]
        return self.with_inside(f'{self._inside}/{name}')

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self._inside.rsplit('/', 1)[-1]

    @property
    def suffix(self) -> str:
        """Ending of the name, with its dot."""
        return PurePosixPath(self.name).suffix

    def with_name(self, name: str) -> RemotePath:
        """Return the path of another name in the same folder."""
        return self.with_inside(f'{self._inside.rpartition("/")[0]}/{name}')

    def with_inside(self, inside: str, kind: _Kind | None = None) -> RemotePath:
        """Return another path of the same file system; looks it up if its kind is not given."""
        below = inside.removeprefix(f'{self._inside}/')
        known = below != inside
        url = f'{self._url}/{below}' if known else str(self._files.unstrip_protocol(inside))
        kind = _looked_up(url, self._files, inside) if kind is None else kind
        return RemotePath(url, self._files, inside, kind)

    def exists(self) -> bool:
        """Return whether it exists."""
        return self._kind != _NOTHING

    def is_file(self) -> bool:
        """Return whether it is a file."""
        return self._kind[0] == 'file'

    def is_dir(self) -> bool:
        """Return whether it is a folder."""
        return self._kind[0] == 'directory'

    def iterdir(self) -> Iterator[RemotePath]:
        """Yield the entries of a folder.

        Raises:
            InputError: It cannot be listed.
        """
        if self._held is None:
            entries = with_retries(self._url, lambda: self._files.ls(self._inside, detail=True))
            # Kept, with their fetched content: a folder is listed more than once.
            self._held = {path.name: path for path in self._paths(entries)}
        yield from self._held.values()

    def below(self) -> Iterator[RemotePath]:
        """Yield all files below a folder at any depth, by one listing.

        Raises:
            InputError: It cannot be listed.
        """
        entries = with_retries(self._url, lambda: self._files.find(self._inside, detail=True))
        yield from self._paths(entries.values())

    def matching(self) -> Iterator[RemotePath]:
        """Yield the paths that match this one as a pattern (*, ?, **).

        Raises:
            InputError: It cannot be listed.
        """
        entries = with_retries(self._url, lambda: self._files.glob(self._inside, detail=True))
        yield from self._paths(entries.values())

    def _paths(self, entries: Any) -> Iterator[RemotePath]:
        for entry in sorted(entries, key=lambda e: str(e['name'])):
            inside = str(entry['name']).rstrip('/')
            # A folder that was created explicitly in a bucket lists itself.
            if inside != self._inside:
                yield self.with_inside(inside, (entry['type'], entry.get('size')))

    def stat(self) -> os.stat_result:
        """Return the size of a file; other fields are not known."""
        return os.stat_result((0, 0, 0, 0, 0, 0, self._opened().size, 0, 0, 0))

    def open(self, mode: str = 'rb', buffering: int = -1) -> io.BufferedIOBase:
        """Open a file for reading its bytes."""
        assert mode == 'rb', 'what lies elsewhere is read'
        del buffering  # Bytes are buffered in the temporary file.
        return Reader(self._opened())

    def read_text(self, encoding: str = 'utf-8') -> str:
        """Read a text."""
        with self.open() as file:
            return file.read().decode(encoding)

    def fetched(self) -> Path:
        """Fetch the whole file; return its local path, valid for the lifetime of this path.

        Raises:
            OSError: There is no such file.
            InputError: It cannot be fetched.
        """
        held = self._opened()
        held.fill(0, held.size)
        return held.path

    def _opened(self) -> Copy:
        if not self.is_file():
            code = errno.EISDIR if self.is_dir() else errno.ENOENT
            raise OSError(code, os.strerror(code), self._url)
        if self._copy is None:
            self._copy = Copy(self._url, self._files, self._inside, self._kind[1])
        return self._copy


AnyPath: TypeAlias = Path | RemotePath
_Kind: TypeAlias = tuple[str, int | None]
_NOTHING: _Kind = ('', None)


def _looked_up(url: str, files: AbstractFileSystem, inside: str) -> _Kind:
    """Return the kind of a path, and its size."""
    try:
        entry = with_retries(url, lambda: files.info(inside))
    except FileNotFoundError:
        return _NOTHING
    return entry['type'], entry.get('size')
