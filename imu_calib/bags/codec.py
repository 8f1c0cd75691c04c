"""The two compressions of recordings, imported on demand."""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING, Any

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from .remote import AnyPath

_ZSTD_MODULES = ('zstandard', 'compression.zstd', 'backports.zstd')
"""The first one can unpack into given memory, in three quarters of the others' time."""
_BLOCK = 1 << 20
"""Bytes decompressed at once."""
_PIECE = 1 << 17
"""Bytes of a block of known size that are unpacked at once: few enough to remain in the processor's
cache until they are copied, and enough that the interpreter, needed once per piece, costs
little."""

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


class CodecError(Exception):
    """Corrupt compressed data; the caller adds which."""


def decompressor(compression: str) -> Callable[[bytes | memoryview], bytes]:
    """Return the function that unpacks one compressed block.

    Args:
        compression: '', 'lz4' or 'zstd', as named in mcap chunks.

    Returns:
        A function that raises CodecError for corrupt data.

    Raises:
        InputError: The compression is unknown, or its package is not installed.
    """
    if compression == '':
        return bytes
    if compression == 'lz4':
        return _guarded(_lz4().decompress)
    if compression == 'zstd':
        module = _zstd()
        if module.__name__ == 'zstandard':
            return _guarded(_zstandard_decompress(module))
        return _guarded(module.decompress)
    raise InputError(f'Unknown compression {compression!r}: expected none, lz4 or zstd.')


def unpacked_into(memory: memoryview, data: bytes | memoryview, compression: str) -> bool:
    """Unpack one compressed block into memory of its stated size.

    Unpacking it at once allocates fresh memory several times, which the system clears page by page:
    four times as long as unpacking alone.

    Args:
        memory: (size,) bytes.
        data: The block.
        compression: 'lz4' or 'zstd'.

    Returns:
        Whether it is one valid frame of that size; `decompressor` handles all other cases.
    """
    module = _lz4() if compression == 'lz4' else _zstd()
    try:
        if module.__name__ == 'zstandard':
            return _read_into(memory, data, module)
        lz4 = compression == 'lz4'
        frame = module.LZ4FrameDecompressor() if lz4 else module.ZstdDecompressor()
        return _moved_into(memory, data, frame)
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


def _moved_into(memory: memoryview, data: bytes | memoryview, frame: Any) -> bool:
    """Unpack a frame piece by piece, and copy each into memory."""
    used = 0
    while used < len(memory):
        piece = frame.decompress(data, min(_PIECE, len(memory) - used))
        memory[used : used + len(piece)] = piece
        used += len(piece)
        data = b''
        if not piece:
            return False
    # The end marker of a frame may still follow.
    beyond = b'' if frame.eof else frame.decompress(b'', 1)
    return bool(frame.eof) and not beyond and not frame.unused_data


def compressor(compression: str) -> Callable[[bytes], bytes]:
    """Return the function that packs one block; arguments and errors as `decompressor`."""
    if compression == '':
        return bytes
    if compression == 'lz4':
        pack_lz4: Callable[[bytes], bytes] = _lz4().compress
        return pack_lz4
    if compression == 'zstd':
        module = _zstd()
        own = module.__name__ == 'zstandard'
        pack: Callable[[bytes], bytes] = (
            module.ZstdCompressor().compress if own else module.compress
        )
        return pack
    raise InputError(f'Unknown compression {compression!r}: expected none, lz4 or zstd.')


def unpack_file(source: AnyPath, target: Path) -> str:
    """Unpack a zstd file block by block, as far as possible.

    Args:
        source: Compressed file.
        target: File to write.

    Returns:
        The error before the end of the source; empty without.

    Raises:
        InputError: No package for zstd is installed.
        OSError: A file cannot be read or written.
    """
    module = _zstd()
    stream = _FrameStream(module)
    with source.open('rb') as packed, target.open('wb') as unpacked:
        try:
            while block := packed.read(_BLOCK):
                unpacked.writelines(stream.feed(block))
        except _errors() as error:
            return str(error)
    return '' if stream.at_boundary else 'the compressed data ends in the middle of a frame'


class _FrameStream:
    """Decompress a sequence of zstd frames with any of the packages."""

    def __init__(self, module: Any) -> None:
        self._module = module
        self._frame: Any = None
        self.at_boundary = True

    def _new_frame(self) -> Any:
        if self._module.__name__ == 'zstandard':
            return self._module.ZstdDecompressor().decompressobj()
        return self._module.ZstdDecompressor()

    def feed(self, block: bytes) -> list[bytes]:
        """Return the unpacked content of the next bytes of the file."""
        pieces = []
        while block:
            if self._frame is None:
                self._frame = self._new_frame()
            pieces.append(self._frame.decompress(block))
            self.at_boundary = bool(self._frame.eof)
            block = self._frame.unused_data if self.at_boundary else b''
            if self.at_boundary:
                self._frame = None
        return pieces


def _zstandard_decompress(module: Any) -> Callable[[bytes | memoryview], bytes]:
    def decompress(data: bytes | memoryview) -> bytes:
        content: bytes
        if module.frame_content_size(data) > 0:
            content = module.ZstdDecompressor().decompress(data)
            return content
        # A frame need not state its size, which the one-shot call of this package requires.
        frame = module.ZstdDecompressor().decompressobj()
        content = frame.decompress(data)
        if not frame.eof:
            raise CodecError('the zstd frame is cut off')
        return content

    return decompress


def _guarded(
    function: Callable[[bytes | memoryview], bytes],
) -> Callable[[bytes | memoryview], bytes]:
    def decompress(data: bytes | memoryview) -> bytes:
        try:
            return function(data)
        except _errors() as error:
            raise CodecError(str(error)) from None

    return decompress


@cache
def _errors() -> tuple[type[Exception], ...]:
    """Return the exceptions of the packages for corrupt data."""
    packages = [_optional(name) for name in _ZSTD_MODULES]
    own = [package.ZstdError for package in packages if package is not None]
    return (RuntimeError, ValueError, EOFError, MemoryError, *own)


@cache
def _optional(name: str) -> Any:
    """Import a package; None if it is missing, for which Python would search again each time."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _zstd() -> Any:
    for name in _ZSTD_MODULES:
        module = _optional(name)
        if module is not None:
            return module
    raise InputError(
        'This recording is compressed with zstd, and no Python package for it is installed: '
        'install python3-zstandard (apt) or zstandard (pip).'
    )


def _lz4() -> Any:
    module = _optional('lz4.frame')
    if module is None:
        raise InputError(
            'This recording is compressed with lz4, and no Python package for it is installed: '
            'install python3-lz4 (apt) or lz4 (pip).'
        )
    return module
