"""Unpack the next compressed chunks on two cores while earlier ones are decoded."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Generic, TypeVar

from ..common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future, ThreadPoolExecutor

    from .mcap_chunk import ChunkGroup

Stored = TypeVar('Stored')
Content = TypeVar('Content')

_AHEAD = 3
"""Chunks in progress: one unpacked by the thread, one by the caller while it waits, and a next one
for the thread."""


class ReadAhead(Generic[Stored, Content]):
    """Load chunks, compressed ones in advance.

    Unpacking takes longer than the rest of reading and releases the interpreter lock, so a second
    core does it; a caller that waits for it unpacks the chunk after. Files are read in the caller's
    thread: their readers are not thread-safe.

    Args:
        groups: In the order in which they will be requested.
        fetch: Reads the stored bytes of one.
        unpack: Converts these to its content.
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
        """Return a chunk, and start those that follow it."""
        stored, future = self._begun.pop(group.start, None) or (self._fetch(group), None)
        self._begin(group)
        if future is None or future.cancel():
            return self._unpack(stored)
        if not future.done():
            self._help(group)
        return future.result()

    def _begin(self, group: ChunkGroup) -> None:
        """Submit the chunks that follow one."""
        for after in self._after(group):
            if after.start in self._begun:
                continue
            try:
                stored = self._fetch(after)
            except (OSError, InputError):
                # The error is raised when that chunk is requested.
                return
            # Imported here: most commands never need it, and its import takes longer than that of
            # the rest.
            from concurrent.futures import ThreadPoolExecutor

            self._pool = self._pool or ThreadPoolExecutor(1, 'unpacking')
            self._begun[after.start] = stored, self._pool.submit(self._unpack, stored)

    def _help(self, group: ChunkGroup) -> None:
        """Unpack a following chunk that the thread has not started."""
        from concurrent.futures import Future

        for after in self._after(group):
            begun = self._begun.get(after.start)
            if begun is not None and begun[1].cancel():
                unpacked: Future[Content] = Future()
                unpacked.set_result(self._unpack(begun[0]))
                self._begun[after.start] = begun[0], unpacked
                return

    def _after(self, group: ChunkGroup) -> Iterator[ChunkGroup]:
        """Yield the compressed chunks that follow one without interruption."""
        for _ in range(_AHEAD):
            following = self._following.get(group.start)
            if following is None or not following.compression:
                return
            group = following
            yield group
