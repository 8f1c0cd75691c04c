"""Fetch the bytes of a remote file by ranges, each once.

Fetched bytes are kept in a sparse local temporary file for the lifetime of the copy: a recording
that is read and then hashed is transferred once, and one whose summary is read is hardly
transferred at all.
"""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError
from .retries import with_retries

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

BLOCK = 1 << 18
"""Fewest bytes of a request: on a usual line their transfer takes as long as the latency."""
AHEAD = 1 << 23
"""Most bytes of a request. Sequential reads double the size each time up to this: the latency is
then small in comparison, and the memory of a worker suffices easily."""


class Copy:
    """The bytes of a file requested so far, in a temporary file."""

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


class Reader(io.BufferedIOBase):
    """An open file: a position in a copy."""

    def __init__(self, copy: Copy) -> None:
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
