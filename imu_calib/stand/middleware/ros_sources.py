"""The publisher of a message under rclpy: rcl has it, rclpy of Jazzy does not pass it on.

The struct is rmw_message_info_t of rmw/types.h, unchanged since Galactic: two times, two sequence
numbers, then the publisher's identifier. Every message is checked for this by the middleware's name
in front of the identifier.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from rclpy.utilities import get_rmw_implementation_identifier

_ROOM = 512
"""Bytes for the struct: several times its size in Jazzy (64), so that a longer one fits too."""
_GID = 16
"""Bytes of an identifier (RMW_GID_STORAGE_SIZE in Jazzy; longer ones end in zeros)."""


class _Allocator(ctypes.Structure):
    _fields_ = [(f'entry_{k}', ctypes.c_void_p) for k in range(5)]


class _Serialized(ctypes.Structure):
    _fields_ = [
        ('buffer', ctypes.c_void_p),
        ('length', ctypes.c_size_t),
        ('capacity', ctypes.c_size_t),
        ('allocator', _Allocator),
    ]


class _Info(ctypes.Structure):
    _fields_ = [
        ('times', ctypes.c_int64 * 2),
        ('numbers', ctypes.c_uint64 * 2),
        ('middleware', ctypes.c_char_p),
        ('gid', ctypes.c_uint8 * _GID),
        ('rest', ctypes.c_uint8 * (_ROOM - 40 - _GID)),
    ]


@cache
def _libraries() -> tuple[Any, Any]:
    """Return rcl and rcutils, which rclpy has loaded already."""
    rcl, rcutils = ctypes.CDLL('librcl.so'), ctypes.CDLL('librcutils.so')
    rcutils.rcutils_get_default_allocator.restype = _Allocator
    rcl.rcl_take_serialized_message.argtypes = [ctypes.c_void_p] * 4
    return rcl, rcutils


def take(handle: Any) -> tuple[bytes, bytes] | None:
    """Take a message from a subscription.

    Args:
        handle: Of the subscription, entered.

    Returns:
        Its serialised bytes, and the identifier of its publisher: empty if this middleware does not
        provide it. None if no message waits.
    """
    rcl, rcutils = _libraries()
    taken, info = _Serialized(), _Info()
    allocator = rcutils.rcutils_get_default_allocator()
    rcutils.rcutils_uint8_array_init(
        ctypes.byref(taken), ctypes.c_size_t(0), ctypes.byref(allocator)
    )
    try:
        code = rcl.rcl_take_serialized_message(
            handle.pointer, ctypes.addressof(taken), ctypes.addressof(info), None
        )
        if code != 0:
            rcutils.rcutils_reset_error()
            return None
        payload = ctypes.string_at(taken.buffer, taken.length)
    finally:
        rcutils.rcutils_uint8_array_fini(ctypes.byref(taken))
    known = info.middleware == _middleware()
    return payload, bytes(info.gid) if known else b''


@cache
def _middleware() -> bytes:
    return str(get_rmw_implementation_identifier()).encode()
