"""Message objects to serialised bytes (XCDR1, final structs) and back."""

from __future__ import annotations

import struct
from typing import Any

from rosbags.serde import SerdeError

from ....common.errors import InputError
from .interfaces import STORE

_HEADER = 4
"""Bytes of the encapsulation header."""


def serialize_message(message: Any, prefix: bytes = b'') -> bytes:
    """Return the bytes of a message, encapsulation header included.

    Args:
        message: A message object.
        prefix: Bytes between the header and the message; a multiple of eight.

    Raises:
        TypeError: A list holds an element of another type, which no assignment has checked.
    """
    try:
        written = STORE.serialize_cdr(message, message.TYPE_NAME, little_endian=True)
    except (AttributeError, TypeError, ValueError, struct.error, SerdeError) as error:
        raise TypeError(message.invalid_field() or f'{message.TYPE_NAME}: {error}.') from error
    # Cyclone DDS moves words of four bytes.
    padding = bytes(-len(written) % 4)
    return b''.join((written[:_HEADER], prefix, written[_HEADER:], padding))


def deserialize_message(payload: bytes, message_class: Any, skip: int = 0) -> Any:
    """Return the message that bytes hold.

    Args:
        payload: Serialised message with its encapsulation header.
        message_class: Class of the message.
        skip: Bytes between the header and the message.

    Raises:
        InputError: The bytes contradict the type.
    """
    if skip:
        payload = payload[:_HEADER] + payload[_HEADER + skip :]
    try:
        return STORE.deserialize_cdr(payload, message_class.TYPE_NAME)
    except SerdeError as error:
        raise InputError(
            f'{len(payload)} bytes do not hold a {message_class.TYPE_NAME}: {error}'
        ) from error
