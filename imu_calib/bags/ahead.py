"""The next compressed chunk is unpacked in a thread while the one before is decoded."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Generic, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future, ThreadPoolExecutor

    from .mcap_chunk import Chunk

Stored = TypeVar('Stored')
Content = TypeVar('Content')


class ReadAhead(Generic[Stored, Content]):
    """Loads chunks, compressed ones before they are asked for, one at a time.

    Unpacking takes as long as all the rest of reading and lets go of the interpreter, so that a
    second core does it. Files are read in the thread that asks: what reads them knows of no other.

    Args:
        chunks: In the order in which they will be asked for.
        fetch: Reads what is stored of one.
        unpack: Makes its content of that.

    """

    def __init__(
        self,
        chunks: Sequence[Chunk],
        fetch: Callable[[Chunk], Stored],
        unpack: Callable[[Stored], Content],
    ) -> None:
        self._fetch, self._unpack = fetch, unpack
        self._following = {one.start: after for one, after in pairwise(chunks)}
        self._begun: tuple[int, Future[Content]] | None = None
        self._pool: ThreadPoolExecutor | None = None

    def load(self, chunk: Chunk) -> Content:
        """Return a chunk, and begin with the one that follows it."""
        if self._begun is not None and self._begun[0] == chunk.start:
            content = self._begun[1].result()
            self._begun = None
        else:
            content = self._unpack(self._fetch(chunk))
        following = self._following.get(chunk.start)
        if following is not None and following.compression and self._begun is None:
            self._begin(following)
        return content

    def _begin(self, chunk: Chunk) -> None:
        try:
            stored = self._fetch(chunk)
        except (OSError, InputError):
            # It is said when that chunk is asked for.
            return
        if self._pool is None:
            # Most commands never need it, and it takes longer to load than the rest of reading.
            from concurrent.futures import ThreadPoolExecutor

            self._pool = ThreadPoolExecutor(1, 'unpacking')
        self._begun = chunk.start, self._pool.submit(self._unpack, stored)
