"""Message classes out of message definitions, checked on every assignment."""

from __future__ import annotations

import array
import ast
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .codec import CODES
from .interfaces import Field, interface

if TYPE_CHECKING:
    from collections.abc import Callable

_LIMITS = {
    f'{sign}int{bits}': (0, 2**bits - 1) if sign else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    for sign in ('', 'u')
    for bits in (8, 16, 32, 64)
}

# get_fields_and_field_types speaks IDL.
_IDL = {'float64': 'double', 'float32': 'float', 'bool': 'boolean', 'byte': 'octet'}


class Message:
    """A message as rclpy has it: keywords make it, defaults are zeros, wrong types are refused.

    As in ROS with ROS_PYTHON_CHECK_FIELDS=1, a wrong type raises AssertionError with the field's
    name. Fixed arrays of numbers are numpy arrays, sequences of numbers are `array.array`.
    """

    TYPE_NAME: ClassVar[str]
    NESTED: ClassVar[dict[str, type[Message]]]
    CHECKS: ClassVar[dict[str, Callable[[Any], Any]]]
    DEFAULTS: ClassVar[dict[str, Callable[[], Any]]]
    __slots__ = ()

    def __init__(self, **fields: Any) -> None:
        unknown = fields.keys() - self.CHECKS.keys()
        if unknown:
            raise AssertionError(
                f'{type(self).__name__} has no field {", ".join(sorted(unknown))}; '
                f'it has {", ".join(self.CHECKS)}'
            )
        for name, default in self.DEFAULTS.items():
            if name in fields:
                setattr(self, name, fields[name])
            else:
                object.__setattr__(self, name, default())

    def __setattr__(self, name: str, value: Any) -> None:
        check = self.CHECKS.get(name)
        if check is None:
            raise AttributeError(f'{type(self).__name__} has no field {name!r}')
        object.__setattr__(self, name, check(value))

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        pairs = ((getattr(self, n), getattr(other, n)) for n in self.CHECKS)
        return all(bool(np.all(a == b)) if isinstance(a, np.ndarray) else a == b for a, b in pairs)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        fields = ', '.join(f'{n}={getattr(self, n)!r}' for n in self.CHECKS)
        return f'{self.TYPE_NAME.replace("/", ".")}({fields})'

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        """Return the names of the fields and their types."""
        return {f.name: _spelled(f) for f in interface(cls.TYPE_NAME).fields}


@cache
def message_class(name: str) -> type[Message]:
    """Return the class of a message.

    Args:
        name: Full name, for instance sensor_msgs/msg/Imu.

    Raises:
        InputError: There is no definition of that name.

    """
    described = interface(name)
    nested = {f.name: message_class(f.base) for f in described.fields if f.nested}
    content: dict[str, Any] = {
        '__slots__': tuple(f.name for f in described.fields),
        '__doc__': f'{name}, made from its definition.',
        'TYPE_NAME': name,
        'NESTED': nested,
        'CHECKS': {f.name: _check(f, nested.get(f.name)) for f in described.fields},
        'DEFAULTS': {f.name: _default(f, nested.get(f.name)) for f in described.fields},
    }
    content.update((n, _constant(kind, text)) for n, kind, text in described.constants)
    return type(name.rpartition('/')[2], (Message,), content)


def _spelled(field: Field) -> str:
    base = _IDL.get(field.base, field.base.replace('/msg/', '/'))
    if field.sequence:
        return f'sequence<{base}{f", {field.size}" if field.size else ""}>'
    return f'{base}[{field.size}]' if field.size else base


def _constant(kind: str, text: str) -> Any:
    if kind == 'byte':
        return bytes([int(text)])
    if kind == 'bool':
        return text.lower() in {'true', '1'}
    return text.strip('"\'') if kind == 'string' else ast.literal_eval(text)


def _default(field: Field, inner: type[Message] | None) -> Callable[[], Any]:
    code = CODES.get(field.base)
    if field.many and code is not None and field.base not in {'byte', 'bool'}:
        if field.sequence:
            return lambda: array.array(code)
        return lambda: np.zeros(field.size, code)
    one = inner if inner is not None else _default_scalar(field)
    if field.many:
        return lambda: [] if field.sequence else [one() for _ in range(field.size)]
    return one


def _default_scalar(field: Field) -> Callable[[], Any]:
    zero: Any = {'string': '', 'byte': b'\x00', 'bool': False, 'float64': 0.0, 'float32': 0.0}.get(
        field.base, 0
    )
    if field.default:
        zero = type(zero)(ast.literal_eval(field.default))
    return lambda: zero


def _check(field: Field, inner: type[Message] | None) -> Callable[[Any], Any]:
    one = _check_one(field, inner)
    if not field.many:
        return one
    code = CODES.get(field.base)
    if code is None or field.base in {'byte', 'bool'}:
        return _check_list(field, one)
    return _check_numbers(field, one, code)


def _check_one(field: Field, inner: type[Message] | None) -> Callable[[Any], Any]:
    name = field.name
    if field.base in _LIMITS:
        return _check_integer(field)
    expected: dict[str, tuple[Any, str]] = {
        'string': (str, "'str'"),
        'byte': (bytes, "'bytes' of length 1"),
        'bool': (bool, "'bool'"),
        'float64': (float, "'float'"),
        'float32': (float, "'float'"),
    }
    kind, article = expected.get(field.base, (inner, f'{inner.__name__!r}' if inner else ''))

    def check(value: Any) -> Any:
        # A numpy float64 is a float too; plain floats are stored as rclpy stores them.
        if not isinstance(value, kind) or (kind is bytes and len(value) != 1):
            raise AssertionError(
                f"The '{name}' field must be of type {article}, not {type(value).__name__!r}"
            )
        if field.string_bound and len(value) > field.string_bound:
            raise AssertionError(f"The '{name}' field is longer than {field.string_bound}")
        return value

    return check


def _check_integer(field: Field) -> Callable[[Any], Any]:
    low, high = _LIMITS[field.base]

    def check(value: Any) -> Any:
        if not isinstance(value, int):
            raise AssertionError(
                f"The '{field.name}' field must be of type 'int', not {type(value).__name__!r}"
            )
        if not low <= value <= high:
            raise AssertionError(
                f"The '{field.name}' field must be an integer in [{low}, {high}], not {value}"
            )
        return value

    return check


def _check_size(field: Field, value: Any) -> None:
    if field.size and (len(value) > field.size or (not field.sequence and len(value) < field.size)):
        at_most = 'at most ' if field.sequence else ''
        raise AssertionError(
            f"The '{field.name}' field must have {at_most}{field.size} elements, not {len(value)}"
        )


def _refuse_scalar(field: Field, value: Any) -> None:
    if isinstance(value, (str, bytes)) or not hasattr(value, '__len__'):
        raise AssertionError(
            f"The '{field.name}' field must be a sequence of {field.base!r}, "
            f'not {type(value).__name__!r}'
        )


def _check_list(field: Field, one: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        _refuse_scalar(field, value)
        _check_size(field, value)
        for element in value:
            one(element)
        return list(value) if not isinstance(value, list) else value

    return check


def _check_numbers(field: Field, one: Callable[[Any], Any], code: str) -> Callable[[Any], Any]:
    kind = np.dtype(code)

    def check(value: Any) -> Any:
        _refuse_scalar(field, value)
        _check_size(field, value)
        if isinstance(value, array.array) and value.typecode == code:
            return value if field.sequence else np.array(value, kind)
        if isinstance(value, np.ndarray) and not field.sequence:
            if value.dtype != kind or value.ndim != 1:
                raise AssertionError(
                    f"The '{field.name}' field must be a row of {field.base}, not {value.dtype}"
                )
            return value
        # A sequence of one's own is checked element by element, numpy elements too, as in ROS.
        for element in value:
            one(element)
        return array.array(code, value) if field.sequence else np.array(value, kind)

    return check
