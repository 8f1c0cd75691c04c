"""Parameters of a node: typed, described, and checked when declared.

Without parameter services they keep the values of files and arguments.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

_KINDS = {bool: 'BOOL', int: 'INTEGER', float: 'DOUBLE', str: 'STRING'}


class ParameterException(Exception):
    """Base of all errors of parameters."""


class ParameterAlreadyDeclaredException(ParameterException):
    """It is declared twice."""


class ParameterNotDeclaredException(ParameterException):
    """It was not declared."""


class InvalidParameterTypeException(ParameterException):
    """Its value has another type than declared."""


class InvalidParameterValueException(ParameterException):
    """Its value is out of range."""


@dataclass
class FloatingPointRange:
    """Range of a float parameter; the step is not enforced."""

    from_value: float = 0.0
    to_value: float = 0.0
    step: float = 0.0


class IntegerRange(FloatingPointRange):
    """Range of an integer parameter."""


@dataclass
class ParameterDescriptor:
    """Description of a parameter: the used part of rcl_interfaces/ParameterDescriptor."""

    description: str = ''
    read_only: bool = False
    floating_point_range: list[FloatingPointRange] = field(default_factory=list)
    integer_range: list[IntegerRange] = field(default_factory=list)


@dataclass(frozen=True)
class Parameter:
    """A named value."""

    name: str
    value: Any


class Parameters:
    """The parameters of one node."""

    def __init__(self, overrides: dict[str, Any], node: str) -> None:
        self._overrides = overrides
        self._node = node
        self._values: dict[str, Parameter] = {}

    def declare(
        self, name: str, value: Any, descriptor: ParameterDescriptor | None = None
    ) -> Parameter:
        """Declare a parameter; a value from a file or an argument replaces the default.

        Args:
            name: Name.
            value: Default; its type is the parameter's.
            descriptor: Its description.

        Raises:
            ParameterException: Declared before, or of the wrong type, or out of range.
        """
        where = f'Parameter {name!r} of {self._node}'
        if name in self._values:
            raise ParameterAlreadyDeclaredException(f'{where} is declared twice.')
        found = self._overrides.get(name, value)
        kind = _kind(value)
        # An empty list matches a list of any type.
        if _kind(found) != kind and not (found == [] and isinstance(value, list)):
            raise InvalidParameterTypeException(
                f'{where}: found {found!r} ({_kind(found)}), expected {kind}.'
            )
        described = descriptor or ParameterDescriptor()
        for limits in (*described.floating_point_range, *described.integer_range):
            if not limits.from_value <= found <= limits.to_value:
                raise InvalidParameterValueException(
                    f'{where}: found {found!r}, expected {limits.from_value} to {limits.to_value}.'
                )
        self._values[name] = Parameter(name, found)
        return self._values[name]

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names given, and those declared."""
        return list(self._overrides), list(self._values)

    def get(self, name: str) -> Parameter:
        """Return a parameter.

        Raises:
            ParameterNotDeclaredException: It is not declared.
        """
        if name not in self._values:
            raise ParameterNotDeclaredException(
                f'Parameter {name!r} of {self._node} is not declared.'
            )
        return self._values[name]


def _kind(value: Any) -> str:
    """Return ROS's name for the type of a value, or Python's if ROS has no such parameter."""
    if isinstance(value, list):
        kinds = {_kind(one) for one in value}
        return f'{kinds.pop()}_ARRAY' if len(kinds) == 1 else 'list of several types'
    return _KINDS.get(type(value), type(value).__name__)
