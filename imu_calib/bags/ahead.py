"""The next compressed chunks are unpacked on two cores while those before are decoded."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Generic, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future, ThreadPoolExecutor

    from .mcap_chunk import ChunkGroup

Stored = TypeVar('Stored')
Content = TypeVar('Content')

_AHEAD = 3
"""Chunks that are begun: one that a thread unpacks, one to help with, one for the thread to go on
with meanwhile."""


class ReadAhead(Generic[Stored, Content]):
    """Loads chunks, compressed ones before they are asked for.

    Unpacking takes longer than all the rest of reading and lets go of the interpreter, so that a
    second core does it; who waits for it unpacks the chunk after. Files are read in the thread
    that asks: what reads them knows of no other.

    Args:
        groups: In the order in which they will be asked for.
        fetch: Reads what is stored of one.
        unpack: Makes its content of that.

    """

    def __init__(
        self,
        groups: Sequence[ChunkGroup],
        fetch: Callable[[ChunkGroup], Stored],
        unpack: Callable[[Stored], Content],
    ) -> None:
        self._fetch, self._unpack = fetch, unpack
        self._following = {one.start: after for one, after in pairwise(groups)}
        self._begun: dict[int, tuple[Stored, Future[Content]]] = {}
        self._pool: ThreadPoolExecutor | None = None

    def load(self, group: ChunkGroup) -> Content:
        """Return a chunk, and begin with those that follow it."""
        stored, future = self._begun.pop(group.start, None) or (self._fetch(group), None)
        self._begin(group)
        if future is None or future.cancel():
            return self._unpack(stored)
        if not future.done():
            self._help(group)
        return future.result()

    def _begin(self, group: ChunkGroup) -> None:
        """Hand over the chunks that follow one."""
        for after in self._after(group):
            if after.start in self._begun:
                continue
            try:
                stored = self._fetch(after)
            except (OSError, InputError):
                # It is said when that chunk is asked for.
                return
            # Most commands never need it, and it takes longer to load than the rest of reading.
            from concurrent.futures import ThreadPoolExecutor

            self._pool = self._pool or ThreadPoolExecutor(1, 'unpacking')
            self._begun[after.start] = stored, self._pool.submit(self._unpack, stored)

    def _help(self, group: ChunkGroup) -> None:
        """Unpack a chunk that follows one and that the thread has not come to."""
        from concurrent.futures import Future

        for after in self._after(group):
            begun = self._begun.get(after.start)
            if begun is not None and begun[1].cancel():
                unpacked: Future[Content] = Future()
                unpacked.set_result(self._unpack(begun[0]))
                self._begun[after.start] = begun[0], unpacked
                return

    def _after(self, group: ChunkGroup) -> Iterator[ChunkGroup]:
        """Yield the compressed chunks that follow one without another in between."""
        for _ in range(_AHEAD):
            following = self._following.get(group.start)
            if following is None or not following.compression:
                return
            group = following
            yield group
