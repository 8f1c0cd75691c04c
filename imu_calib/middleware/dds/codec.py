"""Message objects to serialised bytes (XCDR1, final structs) and back."""

from __future__ import annotations

import array
import struct
from typing import Any

import numpy as np

from ...errors import InputError
from .interfaces import Field, interface

HEADER = b'\x00\x01\x00\x00'
"""Encapsulation: plain CDR, little-endian."""

CODES = {
    'int8': 'b',
    'uint8': 'B',
    'int16': 'h',
    'uint16': 'H',
    'int32': 'i',
    'uint32': 'I',
    'int64': 'q',
    'uint64': 'Q',
    'float32': 'f',
    'float64': 'd',
    'bool': '?',
    'byte': 'B',
}
"""Codes of the primitive types for struct, array and numpy."""


def serialize_message(message: Any, prefix: bytes = b'') -> bytes:
    """Return the bytes of a message, encapsulation header included.

    Args:
        message: A message object.
        prefix: Bytes between the header and the message; a multiple of eight.

    Raises:
        TypeError: A list holds an element of another type, which no assignment has checked.

    """
    out = bytearray(prefix)
    _write(out, message)
    # Cyclone DDS moves words of four bytes.
    return HEADER + bytes(out) + bytes(-len(out) % 4)


def deserialize_message(payload: bytes, message_class: Any, skip: int = 0) -> Any:
    """Return the message that bytes hold.

    Args:
        payload: Serialised message with its encapsulation header.
        message_class: Class of the message.
        skip: Bytes between the header and the message.

    Raises:
        InputError: The bytes contradict the type.

    """
    reader = _Reader(payload, 4 + skip)
    try:
        return reader.message(message_class)
    except (struct.error, ValueError, IndexError) as error:
        raise InputError(
            f'{len(payload)} bytes do not hold a {message_class.TYPE_NAME}: {error}.'
        ) from error


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _write(out: bytearray, message: Any) -> None:
    for field in interface(message.TYPE_NAME).fields:
        value = getattr(message, field.name)
        write = _write_many if field.many else _write_one
        try:
            write(out, field, value)
        except (AttributeError, UnicodeError, struct.error) as error:
            raise TypeError(f'{message.TYPE_NAME}: {field.name} is {value!r}: {error}.') from error


def _write_many(out: bytearray, field: Field, values: Any) -> None:
    if field.sequence:
        _write_number(out, 'I', len(values))
    code = CODES.get(field.base)
    if code is None or field.base == 'byte':
        for value in values:
            _write_one(out, field, value)
    elif len(values):
        _align(out, struct.calcsize(code))
        out += np.asarray(values, f'<{code}').tobytes()


def _write_one(out: bytearray, field: Field, value: Any) -> None:
    if field.nested:
        _write(out, value)
    elif field.base == 'string':
        text = value.encode() + b'\x00'
        _write_number(out, 'I', len(text))
        out += text
    elif field.base == 'byte':
        out += value
    else:
        _write_number(out, CODES[field.base], value)


def _write_number(out: bytearray, code: str, value: float) -> None:
    _align(out, struct.calcsize(code))
    out += struct.pack(f'<{code}', value)


class _Reader:
    """Walks through the bytes of one message."""

    def __init__(self, payload: bytes, start: int) -> None:
        if len(payload) < start or payload[0] != 0 or payload[1] > 1:
            raise InputError(f'{payload[:4].hex()} is not the header of a plain CDR message.')
        self._payload = payload
        self._at = start
        self._order = '<' if payload[1] else '>'

    def message(self, message_class: Any) -> Any:
        message = message_class()
        for field in interface(message_class.TYPE_NAME).fields:
            inner = message_class.NESTED.get(field.name)
            setattr(message, field.name, self._field(field, inner))
        return message

    def _field(self, field: Field, inner: Any) -> Any:
        if not field.many:
            return self._one(field, inner)
        count = int(self._number('I')) if field.sequence else field.size
        if count > len(self._payload):
            raise ValueError(f'{field.name} of {count} elements')
        if field.base in CODES and field.base not in {'byte', 'bool'}:
            return self._numbers(field, count)
        return [self._one(field, inner) for _ in range(count)]

    def _one(self, field: Field, inner: Any) -> Any:
        if field.nested:
            return self.message(inner)
        if field.base == 'string':
            return self._bytes(int(self._number('I')))[:-1].decode()
        if field.base == 'byte':
            return self._bytes(1)
        return self._number(CODES[field.base])

    def _numbers(self, field: Field, count: int) -> Any:
        code = CODES[field.base]
        kind = np.dtype(f'{self._order}{code}')
        if count:
            self._align(kind.itemsize)
        values = np.frombuffer(self._bytes(count * kind.itemsize), kind).astype(code)
        return array.array(code, values.tobytes()) if field.sequence else values

    def _number(self, code: str) -> Any:
        self._align(struct.calcsize(code))
        return struct.unpack(self._order + code, self._bytes(struct.calcsize(code)))[0]

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _bytes(self, count: int) -> bytes:
        start, self._at = self._at, self._at + count
        if self._at > len(self._payload):
            raise ValueError(f'it ends {self._at - len(self._payload)} bytes too early')
        return self._payload[start : self._at]
