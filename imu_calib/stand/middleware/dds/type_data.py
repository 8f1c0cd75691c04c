"""The wheel's descriptions of topic types (XTypes), kept beside the bytecode.

The wheel builds them in Python at every start of a process, which takes a sixth of the time of a
node's start. They depend on the definition and on the wheel alone.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

_LENGTH = 4
"""Bytes of the length of the first of the two parts."""


def describe(idl: Any, name: str) -> None:
    """Give a type its description: the kept one, or that of the wheel, which is then kept.

    Args:
        idl: The wheel's type.
        name: Distinguishes it from every other type, and from every other definition of it.
    """
    made = idl.__idl__
    path = _folder() / f'{sha256(f"{_wheel()} {name}".encode()).hexdigest()}.xtypes'
    kept = _read(path)
    if kept is None or not hasattr(made, '_xt_bytedata'):
        made.fill_type_data()
        _write(path, getattr(made, '_xt_bytedata', ()))
        return
    # What is not None is not built again.
    made._xt_data, made._xt_bytedata = kept, kept


def _folder() -> Path:
    return Path(cache_from_source(__file__)).parent


@cache
def _wheel() -> str:
    """Return what changes with the wheel, as of the source of bytecode: size and date."""
    import cyclonedds

    builder = Path(cyclonedds.__path__[0], 'idl', '_xt_builder.py')
    with suppress(OSError):
        found = builder.stat()
        return f'{found.st_size} {found.st_mtime_ns}'
    return ''


def _read(path: Path) -> tuple[bytes, bytes] | None:
    """Return both parts of a kept description; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, parts = content[:32], content[32:]
    if sha256(parts).digest() != digest:
        return None
    end = _LENGTH + int.from_bytes(parts[:_LENGTH], 'little')
    return parts[_LENGTH:end], parts[end:]


def _write(path: Path, parts: tuple[bytes, ...]) -> None:
    """Keep a description, as Python keeps bytecode: not if that is not wanted or possible."""
    if sys.dont_write_bytecode or len(parts) != 2:
        return
    content = len(parts[0]).to_bytes(_LENGTH, 'little') + b''.join(parts)
    own = path.with_suffix(f'.{os.getpid()}')
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        own.write_bytes(sha256(content).digest() + content)
        # Whole or not at all: other nodes read it meanwhile.
        own.replace(path)
