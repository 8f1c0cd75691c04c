"""The two compressions of recordings, imported on demand."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from ..common.errors import InputError
from .mcap_records import ChunkGroup
from .remote import AnyPath

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor


_ZSTD_MODULES = ('compression.zstd', 'backports.zstd', 'zstandard')
"""Python's own from 3.14 on, the same for earlier ones, and what Ubuntu 24.04 has."""
_BLOCK = 1 << 20  #: Bytes of a file read at once.
_FED = 1 << 11
"""Bytes of a file unpacked at once, to 64 MiB at most: a block of zstd has 4 bytes or more and
unpacks to 128 KiB or less (RFC 8878, 3.1.1.2)."""
_PIECES = {'zstd': 1 << 15, 'lz4': 1 << 17}
"""Bytes of a block of known size that are unpacked at once: few enough to remain in the processor's
cache until they are copied, and enough that the interpreter, needed once per piece, costs
little. The packages for zstd make no copy of their own up to 32 KiB; that for lz4 copies the rest
of its input with each piece."""

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


class CodecError(Exception):
    """Corrupt compressed data; the caller adds which."""


def unpack(data: bytes | memoryview, compression: str, most: int) -> bytes:
    """Unpack a block compressed by '', 'lz4' or 'zstd', as named in mcap chunks.

    What holds more than `most` bytes is refused without unpacking the rest.
    """
    if compression == '':
        return bytes(data)
    module = _module(compression)
    beyond = CodecError(f'it unpacks to more than {most} bytes')
    content: bytes
    try:
        if module.__name__ == 'zstandard':
            # This package applies its limit to frames that do not state their size.
            if module.frame_content_size(data) > most:
                raise beyond
            content = module.ZstdDecompressor().decompress(data, max_output_size=most)
            return content
        frame = _decompressor(module)
        content = frame.decompress(data, most + 1)
    except _errors() as error:
        raise CodecError(str(error)) from None
    if len(content) > most:
        raise beyond
    if not frame.eof:
        raise CodecError('the frame is cut off')
    return content


def unpacked_into(memory: memoryview, data: bytes | memoryview, compression: str) -> bool:
    """Unpack a block of lz4 or zstd into memory of its stated size.

    Unpacking it at once allocates fresh memory several times, which the system clears page by page:
    four times as long as unpacking alone. Return whether it is one valid frame of that size;
    `unpack` handles others.
    """
    module = _module(compression)
    try:
        if module.__name__ == 'zstandard':
            return _read_into(memory, data, module)
        return _moved_into(memory, data, _decompressor(module), _PIECES[compression])
    except _errors():
        return False


def _read_into(memory: memoryview, data: bytes | memoryview, module: Any) -> bool:
    """Let zstandard unpack into memory."""
    stated = module.get_frame_parameters(data)
    # A frame that states its size is unpacked there without another copy. This reader does not
    # notice a missing checksum at the end.
    if stated.content_size != len(memory) or stated.has_checksum:
        return False
    with module.ZstdDecompressor().stream_reader(data, read_across_frames=True) as frames:
        return frames.readinto(memory) == len(memory) and not frames.read(1)


def _moved_into(memory: memoryview, data: bytes | memoryview, frame: Any, most: int) -> bool:
    """Unpack a frame piece by piece, and copy each into memory."""
    used = 0
    while used < len(memory):
        piece = frame.decompress(data, min(most, len(memory) - used))
        memory[used : used + len(piece)] = piece
        used += len(piece)
        data = b''
        if not piece:
            return False
    # The end marker of a frame may still follow.
    beyond = b'' if frame.eof else frame.decompress(b'', 1)
    return bool(frame.eof) and not beyond and not frame.unused_data


def compressor(compression: str) -> Callable[[bytes], bytes]:
    """Return the function that packs one block by '', 'lz4' or 'zstd', as named in mcap chunks."""
    if compression == '':
        return bytes
    module = _module(compression)
    own = module.__name__ == 'zstandard'
    pack: Callable[[bytes], bytes] = module.ZstdCompressor().compress if own else module.compress
    return pack


def unpack_file(source: AnyPath, target: Path) -> str:
    """Unpack a zstd file piece by piece, as far as possible.

    Return the error before the end of the source; empty without.
    """
    stream = _FrameStream(_module('zstd'))
    with source.open('rb') as packed, target.open('wb') as content:
        try:
            while block := packed.read(_BLOCK):
                for start in range(0, len(block), _FED):
                    content.writelines(stream.unpack(block[start : start + _FED]))
        except _errors() as error:
            return str(error)
    return '' if stream.at_boundary else 'the compressed data ends in the middle of a frame'


class _FrameStream:
    """Decompress a sequence of zstd frames with any of the packages."""

    def __init__(self, module: Any) -> None:
        self._module = module
        self._frame: Any = None
        self._stated: int | None = None
        self._used = 0
        self.at_boundary = True

    def unpack(self, block: bytes) -> Iterator[bytes]:
        """Yield the unpacked content of the next bytes of the file."""
        while block:
            if self._frame is None:
                self._frame = _decompressor(self._module)
                self._stated, self._used = _stated_size(self._module, block), 0
            piece = self._frame.decompress(block)
            self._used += len(piece)
            if self._stated is not None and self._used > self._stated:
                raise CodecError(f'a frame unpacks to more than the {self._stated} bytes it states')
            yield piece
            self.at_boundary = bool(self._frame.eof)
            block = self._frame.unused_data if self.at_boundary else b''
            if self.at_boundary:
                self._frame = None


def _decompressor(module: Any) -> Any:
    """Return an object that unpacks one frame."""
    if module.__name__ == 'lz4.frame':
        return module.LZ4FrameDecompressor()
    frame = module.ZstdDecompressor()
    return frame.decompressobj() if module.__name__ == 'zstandard' else frame


def _stated_size(module: Any, start: bytes) -> int | None:
    """Return the bytes that a zstd frame unpacks to; None if its start does not state them."""
    try:
        if module.__name__ == 'zstandard':
            size: int = module.frame_content_size(start)
            return None if size < 0 else size
        stated: int | None = module.get_frame_info(start).decompressed_size
        return stated
    except _errors():
        return None


@cache
def _errors() -> tuple[type[Exception], ...]:
    """Return the exceptions for corrupt data, of the packages too."""
    packages = [_optional(name) for name in _ZSTD_MODULES]
    own = [package.ZstdError for package in packages if package is not None]
    return (CodecError, RuntimeError, ValueError, EOFError, MemoryError, OverflowError, *own)


@cache
def _optional(name: str) -> Any:
    """Import a package; None if it is missing, for which Python would search again each time."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _module(compression: str) -> Any:
    """Return the package for a compression."""
    if compression not in _PIECES:
        raise InputError(f'Unknown compression {compression!r}: expected none, lz4 or zstd.')
    for name in _ZSTD_MODULES if compression == 'zstd' else ('lz4.frame',):
        module = _optional(name)
        if module is not None:
            return module
    package = 'zstandard' if compression == 'zstd' else 'lz4'
    raise InputError(
        f'This recording is compressed with {compression}, and no Python package for it is '
        f'installed: install python3-{package} (apt) or {package} (pip).'
    )


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
