"""The next compressed chunks are unpacked on two cores while those before are decoded."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Generic, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future, ThreadPoolExecutor

    from .mcap_chunk import Stretch

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
        stretches: In the order in which they will be asked for.
        fetch: Reads what is stored of one.
        unpack: Makes its content of that.

    """

    def __init__(
        self,
        stretches: Sequence[Stretch],
        fetch: Callable[[Stretch], Stored],
        unpack: Callable[[Stored], Content],
    ) -> None:
        self._fetch, self._unpack = fetch, unpack
        self._following = {one.start: after for one, after in pairwise(stretches)}
        self._begun: dict[int, tuple[Stored, Future[Content]]] = {}
        self._pool: ThreadPoolExecutor | None = None

    def load(self, stretch: Stretch) -> Content:
        """Return a chunk, and begin with those that follow it."""
        stored, future = self._begun.pop(stretch.start, None) or (self._fetch(stretch), None)
        self._begin(stretch)
        if future is None or future.cancel():
            return self._unpack(stored)
        if not future.done():
            self._help(stretch)
        return future.result()

    def _begin(self, stretch: Stretch) -> None:
        """Hand over the chunks that follow one."""
        for after in self._after(stretch):
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

    def _help(self, stretch: Stretch) -> None:
        """Unpack a chunk that follows one and that the thread has not come to."""
        from concurrent.futures import Future

        for after in self._after(stretch):
            begun = self._begun.get(after.start)
            if begun is not None and begun[1].cancel():
                unpacked: Future[Content] = Future()
                unpacked.set_result(self._unpack(begun[0]))
                self._begun[after.start] = begun[0], unpacked
                return

    def _after(self, stretch: Stretch) -> Iterator[Stretch]:
        """Yield the compressed chunks that follow one without another in between."""
        for _ in range(_AHEAD):
            following = self._following.get(stretch.start)
            if following is None or not following.compression:
                return
            stretch = following
            yield stretch
