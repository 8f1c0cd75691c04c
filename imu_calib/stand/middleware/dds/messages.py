"""Message classes from message definitions, with types checked at every assignment."""

from __future__ import annotations

import array
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from rosbags.interfaces import Nodetype

from .interfaces import interface

if TYPE_CHECKING:
    from collections.abc import Callable

# get_fields_and_field_types returns IDL.
_IDL = {'float64': 'double', 'float32': 'float', 'bool': 'boolean', 'byte': 'octet'}
_KINDS = {'float64': float, 'float32': float, 'bool': bool, 'string': str}
"""Python types of the scalars; others are int."""


class _Octet(bytes):
    """One byte, serialised as a number."""

    __slots__ = ()

    def __index__(self) -> int:
        # Signed, as struct's code for it.
        return int.from_bytes(self, 'little', signed=True)


class _Numbers(array.array):  # type: ignore[type-arg]
    """A sequence of numbers as in rclpy, serialised like an array of numpy."""

    __slots__ = ()

    def __repr__(self) -> str:
        return repr(array.array(self.typecode, self))

    def view(self, _: Any) -> bytes:
        """Return the bytes."""
        return self.tobytes()


@dataclass(frozen=True)
class Field:
    """Storage of one field.

    Attributes:
        idl: Its type in IDL.
        default: Returns the value in a new message.
        check: Returns the stored form of a value; raises AssertionError for another type.
        read: Returns the stored form of a value read from bytes; None for the same.
    """

    idl: str
    default: Callable[[], Any]
    check: Callable[[str, Any], Any]
    read: Callable[[Any], Any] | None = None


class Message:
    """A message as in rclpy: created by keywords, with defaults of zero; wrong types are refused.

    As in ROS with ROS_PYTHON_CHECK_FIELDS=1, a wrong type raises AssertionError with the field's
    name. Fixed arrays of numbers are numpy arrays, sequences of numbers are `array.array`. Arrays
    of bool and of byte are not supported; no message here has them.
    """

    TYPE_NAME: ClassVar[str]
    FIELDS: ClassVar[dict[str, Field]]
    __slots__ = ()

    def __init__(self, **values: Any) -> None:
        unknown = values.keys() - self.FIELDS.keys()
        if unknown:
            raise AssertionError(
                f'{type(self).__name__} has no field {", ".join(sorted(unknown))}; '
                f'it has {", ".join(self.FIELDS)}'
            )
        for name, field in self.FIELDS.items():
            if name in values:
                setattr(self, name, values[name])
            else:
                object.__setattr__(self, name, field.default())

    def __setattr__(self, name: str, value: Any) -> None:
        field = self.FIELDS.get(name)
        if field is None:
            raise AttributeError(f'{type(self).__name__} has no field {name!r}')
        object.__setattr__(self, name, field.check(name, value))

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(np.all(getattr(self, n) == getattr(other, n)) for n in self.FIELDS)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        fields = ', '.join(f'{n}={getattr(self, n)!r}' for n in self.FIELDS)
        return f'{self.TYPE_NAME.replace("/", ".")}({fields})'

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return the names of the fields and their types."""
        return {name: field.idl for name, field in cls.FIELDS.items()}

    def invalid_field(self) -> str:
        """Return the field with a wrong value that no assignment has checked, else empty."""
        for name, field in self.FIELDS.items():
            value = getattr(self, name)
            try:
                field.check(name, value)
            except AssertionError as error:
                return f'{self.TYPE_NAME}: {name} is {value!r}: {error}.'
            for inner in value if isinstance(value, list) else [value]:
                if isinstance(inner, Message) and (reason := inner.invalid_field()):
                    return reason
        return ''


@cache
def message_class(name: str) -> Any:
    """Return the class of a message.

    Args:
        name: Full name, for instance sensor_msgs/msg/Imu.

    Raises:
        InputError: There is no definition of that name.
    """
    described = interface(name)
    fields = {n: _field(desc, described.defaults.get(n, '')) for n, desc in described.fields}
    content: dict[str, Any] = {
        **{n: _octet(v) if kind == 'byte' else v for n, kind, v in described.constants},
        '__slots__': tuple(fields),
        '__doc__': f'{name}, made from its definition.',
        'TYPE_NAME': name,
        'FIELDS': fields,
    }
    made = type(name.rpartition('/')[2], (Message,), content)
    described.cls = _reader(made)
    return made


def _reader(made: Any) -> Callable[..., Any]:
    """Return a constructor for values read from bytes: their types are right."""
    keep = [(getattr(made, n).__set__, field.read) for n, field in made.FIELDS.items()]

    def read(*values: Any) -> Any:
        message = made.__new__(made)
        for (set_to, convert), value in zip(keep, values, strict=True):
            set_to(message, value if convert is None else convert(value))
        return message

    return read


def _octet(number: Any = 0) -> _Octet:
    return _Octet([number & 0xFF])


def _field(description: Any, default: str = '') -> Field:
    kind, details = description
    if kind == Nodetype.NAME:
        inner = message_class(details)
        return Field(details.replace('/msg/', '/'), inner, _check(inner))
    if kind == Nodetype.BASE:
        base, bound = details
        return _scalar(base, bound, default)
    return _many(*details, fixed=kind == Nodetype.ARRAY)


def _scalar(base: str, bound: int, default: str) -> Field:
    idl = _IDL.get(base, base)
    if base == 'byte':
        one = _check(bytes, 'one byte', lambda v: len(v) == 1)
        return Field(idl, _octet, lambda name, value: _octet(*one(name, value)), _octet)
    kind = _KINDS.get(base, int)
    zero = kind(default) if default else kind()
    if kind is int:
        low, high = np.iinfo(base).min, np.iinfo(base).max
        check = _check(int, f'an integer in [{low}, {high}]', lambda v: low <= v <= high)
    elif bound:
        check = _check(str, f'a string of at most {bound}', lambda v: len(v) <= bound)
    else:
        check = _check(kind)
    return Field(idl, lambda: zero, check)


def _many(inner: Any, size: int, *, fixed: bool) -> Field:
    """Return the storage of an array of `size` elements, or of a sequence with at most `size`."""
    one = _field(inner)
    bound = f', {size}' if size else ''
    idl = f'{one.idl}[{size}]' if fixed else f'sequence<{one.idl}{bound}>'
    check = partial(_check_many, one, size, fixed)
    if inner[0] == Nodetype.NAME or inner[1][0] == 'string':
        first = size if fixed else 0
        return Field(idl, lambda: [one.default() for _ in range(first)], partial(check, list))
    code = np.dtype(inner[1][0]).char
    if fixed:
        make = partial(np.array, dtype=code)
        return Field(idl, partial(np.zeros, size, code), partial(check, make), np.array)
    numbers = partial(_Numbers, code)
    return Field(idl, numbers, partial(check, numbers), lambda v: numbers(v.tobytes()))


def _check_many(
    one: Field, size: int, fixed: bool, make: Callable[[Any], Any], name: str, values: Any
) -> Any:
    if isinstance(values, (str, bytes)) or not hasattr(values, '__len__'):
        raise AssertionError(f"The '{name}' field must be a sequence of {one.idl}, not {values!r}")
    if size and (len(values) > size or (fixed and len(values) < size)):
        most = '' if fixed else 'at most '
        raise AssertionError(
            f"The '{name}' field must have {most}{size} elements, not {len(values)}"
        )
    # Elements are checked one by one, numpy's too, as in ROS.
    for value in values:
        one.check(name, value)
    return values if isinstance(values, list) and make is list else make(values)


def _check(
    kind: type, expected: str = '', fits: Callable[[Any], bool] | None = None
) -> Callable[[str, Any], Any]:
    def check(name: str, value: Any) -> Any:
        # A numpy float64 is a float too; plain floats are stored, as in rclpy.
        if not isinstance(value, kind) or (fits is not None and not fits(value)):
            article = expected or f'of type {kind.__name__!r}'
            raise AssertionError(f"The '{name}' field must be {article}, not {value!r}")
        return value

    return check
