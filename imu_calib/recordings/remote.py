"""Paths of recordings: local, or URLs of fsspec."""

from __future__ import annotations

import errno
import io
import os
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np

from ..common.errors import InputError
from ..common.files import require, user_path

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem


Result = TypeVar('Result')

TRIES = 3  #: Tries of a request: a connection may be lost once, but three times is an error.
PAUSE = 0.5
"""s before the second try; doubled before the third: about the restart time of a server."""


def with_retries(url: str, request: Callable[[], Result]) -> Result:
    """Return the result of a request; repeat it if the connection is lost.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: No right to read, or the connection was lost `TRIES` times.
    """
    lost: Exception | None = None
    for again in range(TRIES):
        if again:
            time.sleep(PAUSE * 2 ** (again - 1))
        try:
            return request()
        except Exception as error:
            # Each protocol has its own exceptions for a lost connection.
            lost = _behind(error)
            if isinstance(lost, FileNotFoundError):
                raise
            if _is_refusal(lost):
                raise InputError(
                    f'{url}: reading it is not permitted ({lost}). Set the credentials of the '
                    'protocol (for s3 AWS_PROFILE, or AWS_ACCESS_KEY_ID and so on).'
                ) from None
    raise InputError(
        f'{url}: not read after {TRIES} tries ({type(lost).__name__}: {lost}). Check the network, '
        'and run the command again.'
    ) from lost


def _behind(error: Exception) -> Exception:
    """Return the cause of an error: over HTTP, a lost server appears as a file that is not found.

    For a missing file on S3, the cause is the server's reply.
    """
    cause = error.__cause__
    found = isinstance(error, FileNotFoundError) and isinstance(cause, Exception)
    return error if not found or hasattr(cause, 'response') else cause  # type: ignore[return-value]


def _is_refusal(error: Exception) -> bool:
    return (
        isinstance(error, PermissionError)
        or 'Credentials' in type(error).__name__
        or getattr(error, 'status', None) in {401, 403}
    )


BLOCK = 1 << 18
"""Fewest bytes of a request: on a usual line their transfer takes as long as the latency."""
AHEAD = 1 << 23
"""Most bytes of a request. Sequential reads double the size each time up to this: the latency is
then small in comparison, and the memory of a worker suffices easily."""


class FetchedFile:
    """The bytes of a remote file requested so far, by ranges, each once, in a temporary file.

    It is sparse, and kept for the lifetime of this object: a recording that is read and then hashed
    is transferred once, and one whose summary is read is hardly transferred at all.
    """

    def __init__(self, url: str, files: AbstractFileSystem, inside: str, size: int | None) -> None:
        self._url = url
        self._files = files
        self._inside = inside
        folder = Path(tempfile.mkdtemp(prefix='imu_calib_'))
        self.path = folder / (inside.rsplit('/', 1)[-1] or 'recording')
        self._file = self.path.open('w+b', buffering=0)
        self._there = np.zeros(0, np.bool_)
        self._next, self._run = -1, 0
        self.size = 0
        weakref.finalize(self, _discard, self._file, folder)
        if size is None:
            # A server that does not state the length of a file sends all of it.
            self._keep_whole(self._requested(None, None))
        else:
            self.size = size
            self._there = np.zeros(-(-size // BLOCK), np.bool_)

    def read(self, start: int, end: int) -> bytes:
        """Return bytes, fewer at the end of the file."""
        end = min(end, self.size)
        if start >= end:
            return b''
        self.fill(start, end)
        return os.pread(self._file.fileno(), end - start, start)

    def fill(self, start: int, end: int) -> None:
        """Fetch the missing bytes of a range, and more if it continues the last one."""
        first, stop = start // BLOCK, -(-end // BLOCK)
        missing = np.flatnonzero(~self._there[first:stop]) + first
        if not len(missing):
            return
        begin = int(missing[0])
        ahead = 2 * self._run if begin == self._next else 0
        wanted = max(int(missing[-1]) + 1, begin + min(ahead, AHEAD // BLOCK))
        self._next = min(wanted, len(self._there))
        self._run = self._next - begin
        for run in _runs(np.flatnonzero(~self._there[begin : self._next]) + begin):
            self._fetch(run[0], run[-1] + 1)

    def _fetch(self, first: int, stop: int) -> None:
        """Fetch consecutive blocks."""
        start, end = first * BLOCK, min(stop * BLOCK, self.size)
        content = self._requested(start, end)
        if len(content) == self.size != end - start:
            # A server that does not support ranges.
            self._keep_whole(content)
            return
        self._write(content, start)
        self._there[first:stop] = True

    def _requested(self, start: int | None, end: int | None) -> bytes:
        expected = None if start is None or end is None else end - start

        def request() -> bytes:
            content: bytes = self._files.cat_file(self._inside, start=start, end=end)
            if expected is not None and len(content) not in {expected, self.size}:
                raise EOFError(f'{len(content)} of {expected} bytes came from byte {start} on')
            return content

        try:
            return with_retries(self._url, request)
        except FileNotFoundError:
            raise InputError(f'{self._url}: is no longer there.') from None

    def _keep_whole(self, content: bytes) -> None:
        self.size = len(content)
        self._write(content, 0)
        self._there = np.ones(-(-self.size // BLOCK), np.bool_)

    def _write(self, content: bytes, start: int) -> None:
        try:
            view = memoryview(content)
            while view:
                written = os.pwrite(self._file.fileno(), view, start)
                view, start = view[written:], start + written
        except OSError as error:
            raise InputError(
                f'{self._url}: the parts that are read are kept in {self.path.parent}, which '
                f'cannot be written ({error.strerror}). Set TMPDIR to a folder with room for '
                f'{self.size / 1e6:.0f} MB.'
            ) from None


def _runs(blocks: np.ndarray[Any, np.dtype[np.int64]]) -> Iterator[list[int]]:
    """Split blocks into runs that are one request each."""
    most = AHEAD // BLOCK
    for run in np.split(blocks, np.flatnonzero(np.diff(blocks) > 1) + 1):
        for k in range(0, len(run), most):
            yield run[k : k + most].tolist()


def _discard(file: io.FileIO, folder: Path) -> None:
    file.close()
    shutil.rmtree(folder, ignore_errors=True)


class RemoteReader(io.BufferedIOBase):
    """An open file: a position in a copy."""

    def __init__(self, copy: FetchedFile) -> None:
        self._copy = copy
        self._position = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._copy.size}[whence]
        self._position = max(base + offset, 0)
        return self._position

    def read(self, size: int | None = -1) -> bytes:
        """Read bytes, all remaining ones without a size."""
        end = self._copy.size if size is None or size < 0 else self._position + size
        content = self._copy.read(self._position, end)
        self._position += len(content)
        return content

    read1 = read


def is_url(name: object) -> bool:
    """Return whether a name is a URL instead of a local path."""
    return isinstance(name, str) and '://' in name


def located(name: str | AnyPath) -> AnyPath:
    """Return the local or remote path for a name."""
    if isinstance(name, RemotePath):
        return name
    return RemotePath.at(str(name)) if is_url(name) else user_path(name)


def local(path: AnyPath) -> Path:
    """Return a local path for a C library; a remote file is fetched whole."""
    return path.fetched() if isinstance(path, RemotePath) else path


class RemotePath:
    """A file or folder read by fsspec, with the methods of `Path` that the readers use.

    Its kind is 'file', 'directory' or '' if there is nothing, with the bytes of a file if known.
    """

    def __init__(self, url: str, files: AbstractFileSystem, inside: str, kind: _Kind) -> None:
        self._url = url
        self._files = files
        self._inside = inside
        self._kind = kind
        self._copy: FetchedFile | None = None
        self._held: dict[str, RemotePath] | None = None

    @classmethod
    def at(cls, url: str) -> RemotePath:
        """Return the path of a URL."""
        require('fsspec', f'{url} (a URL)', 'remote')
        import fsspec

        try:
            files, inside = fsspec.core.url_to_fs(url)
            # In a long-lived process, cached listings would be out of date.
            files.invalidate_cache()
        except Exception as error:
            # Each protocol has its own exceptions for a host, a file or an option that it lacks.
            raise InputError(
                f'{url}: cannot be opened ({error}). S3 and HTTP need the extra remote (pip '
                "install '.[remote]' in a clone of imu_calib), others their own libraries."
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
        """Yield the entries of a folder."""
        if self._held is None:
            entries = with_retries(self._url, lambda: self._files.ls(self._inside, detail=True))
            # Kept, with their fetched content: a folder is listed more than once.
            self._held = {path.name: path for path in self._paths(entries)}
        yield from self._held.values()

    def below(self) -> Iterator[RemotePath]:
        """Yield all files below a folder at any depth, by one listing."""
        entries = with_retries(self._url, lambda: self._files.find(self._inside, detail=True))
        yield from self._paths(entries.values())

    def matching(self) -> Iterator[RemotePath]:
        """Yield the paths that match this one as a pattern (*, ?, **)."""
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
        return RemoteReader(self._opened())

    def read_text(self, encoding: str = 'utf-8') -> str:
        """Read a text."""
        with self.open() as file:
            return file.read().decode(encoding)

    def fetched(self) -> Path:
        """Fetch the whole file; return its local path, valid for the lifetime of this path."""
        held = self._opened()
        held.fill(0, held.size)
        return held.path

    def _opened(self) -> FetchedFile:
        if not self.is_file():
            code = errno.EISDIR if self.is_dir() else errno.ENOENT
            raise OSError(code, os.strerror(code), self._url)
        if self._copy is None:
            self._copy = FetchedFile(self._url, self._files, self._inside, self._kind[1])
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
