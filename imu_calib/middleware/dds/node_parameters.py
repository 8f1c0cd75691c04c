"""Parameters of a node: typed, described, checked before they change."""

from __future__ import annotations

import array
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


class ParameterException(Exception):
    """Root of what goes wrong with parameters."""


class ParameterAlreadyDeclaredException(ParameterException):
    """It is declared twice."""


class ParameterNotDeclaredException(ParameterException):
    """It was never declared."""


class InvalidParameterTypeException(ParameterException):
    """Its value has another type than declared."""


class InvalidParameterValueException(ParameterException):
    """Its value is out of range, or refused by a callback."""


@dataclass
class FloatingPointRange:
    """From and to which value a float parameter may go; the step is not enforced."""

    from_value: float = 0.0
    to_value: float = 0.0
    step: float = 0.0


@dataclass
class IntegerRange:
    """From and to which value an integer parameter may go; the step is not enforced."""

    from_value: int = 0
    to_value: int = 0
    step: int = 0


@dataclass
class ParameterDescriptor:
    """What a parameter is: rcl_interfaces/ParameterDescriptor."""

    name: str = ''
    type: int = 0
    description: str = ''
    additional_constraints: str = ''
    read_only: bool = False
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = field(default_factory=list)
    integer_range: list[IntegerRange] = field(default_factory=list)


@dataclass
class SetParametersResult:
    """Whether a change is accepted, and why not: rcl_interfaces/SetParametersResult."""

    successful: bool = False
    reason: str = ''


class ParameterType(IntEnum):
    """Types of a value."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9


_SCALARS = {
    bool: ParameterType.BOOL,
    int: ParameterType.INTEGER,
    float: ParameterType.DOUBLE,
    str: ParameterType.STRING,
}
_ARRAY_OF = {
    ParameterType.BOOL: ParameterType.BOOL_ARRAY,
    ParameterType.INTEGER: ParameterType.INTEGER_ARRAY,
    ParameterType.DOUBLE: ParameterType.DOUBLE_ARRAY,
    ParameterType.STRING: ParameterType.STRING_ARRAY,
}


def type_of(value: Any) -> ParameterType:
    """Return the parameter type of a value.

    Raises:
        TypeError: No parameter holds such a value.

    """
    if value is None:
        return ParameterType.NOT_SET
    if type(value) in _SCALARS:
        return _SCALARS[type(value)]
    if isinstance(value, (list, tuple, array.array, np.ndarray)):
        kinds = {_SCALARS.get(type(v)) for v in list(value)}
        if not kinds:
            return ParameterType.BYTE_ARRAY
        kind = kinds.pop()
        if kind is not None and not kinds:
            return _ARRAY_OF[kind]
        if value and all(isinstance(v, bytes) for v in value):
            return ParameterType.BYTE_ARRAY
    raise TypeError(f'{value!r} is not a valid value of a parameter.')


class Parameter:
    """A named value."""

    Type = ParameterType

    def __init__(self, name: str, type_: ParameterType | None = None, value: Any = None) -> None:
        found = type_of(value)
        if type_ is not None and not _agrees(type_, value):
            raise ValueError(f"Type '{type_.name}' and value '{value}' do not agree")
        self.name = name
        self.value = list(value) if isinstance(value, tuple) else value
        self.type_ = found if type_ is None else type_

    def __repr__(self) -> str:
        return f'Parameter(name={self.name!r}, type={self.type_.name}, value={self.value!r})'


def _agrees(kind: ParameterType, value: Any) -> bool:
    found = type_of(value)
    # An empty list is a list of anything.
    empty = found is ParameterType.BYTE_ARRAY and len(value) == 0
    return found == kind or (empty and kind >= ParameterType.BYTE_ARRAY)


class Parameters:
    """The parameters of one node."""

    def __init__(self, overrides: dict[str, Any], node: str) -> None:
        self.overrides = overrides
        self._node = node
        self._values: dict[str, Parameter] = {}
        self._descriptors: dict[str, ParameterDescriptor] = {}
        self.callbacks: list[Callable[[list[Parameter]], Any]] = []

    def declare(
        self,
        name: str,
        value: Any = None,
        descriptor: ParameterDescriptor | None = None,
        ignore_override: bool = False,
    ) -> Parameter:
        """Declare a parameter; the value of a file or an argument replaces the default.

        Args:
            name: Name.
            value: Default, or the type of a parameter that must be given.
            descriptor: What it is.
            ignore_override: Take the default whatever files and arguments say.

        Raises:
            ParameterException: Declared before, or of the wrong type, or refused.

        """
        if name in self._values:
            raise ParameterAlreadyDeclaredException(
                f'Parameter {name!r} of {self._node} is declared twice.'
            )
        described = descriptor or ParameterDescriptor(dynamic_typing=value is None)
        described.name = name
        kind = value if isinstance(value, ParameterType) else type_of(value)
        if isinstance(value, ParameterType):
            value = None
        if not described.dynamic_typing:
            described.type = int(kind)
        if not ignore_override and name in self.overrides:
            value = self.overrides[name]
        parameter = Parameter(name, value=value)
        self._descriptors[name] = described
        if parameter.type_ is not ParameterType.NOT_SET:
            result = self._judge(parameter)
            if not result.successful:
                del self._descriptors[name]
                raise _exception(result)(f'Parameter {name!r} of {self._node}: {result.reason}')
        self._values[name] = self._typed(parameter)
        return self._values[name]

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

    def has(self, name: str) -> bool:
        """Tell whether a parameter is declared."""
        return name in self._values

    def set(self, parameters: Iterable[Parameter]) -> list[SetParametersResult]:
        """Change parameters one after the other.

        Raises:
            ParameterNotDeclaredException: One of them is not declared.

        """
        return [self._set(p) for p in parameters]

    def _set(self, parameter: Parameter) -> SetParametersResult:
        self.get(parameter.name)
        if self._descriptors[parameter.name].read_only:
            reason = f'Trying to set a read-only parameter: {parameter.name}.'
            return SetParametersResult(successful=False, reason=reason)
        result = self._judge(parameter)
        if result.successful:
            self._values[parameter.name] = self._typed(parameter)
        return result

    def _typed(self, parameter: Parameter) -> Parameter:
        kind = ParameterType(self._descriptors[parameter.name].type)
        if kind is ParameterType.NOT_SET or parameter.type_ is ParameterType.NOT_SET:
            return parameter
        return Parameter(parameter.name, kind, parameter.value)

    def _judge(self, parameter: Parameter) -> SetParametersResult:
        described = self._descriptors[parameter.name]
        kind = ParameterType(described.type)
        if not described.dynamic_typing and not _agrees(kind, parameter.value):
            return _Mistyped(
                successful=False,
                reason=f'found {parameter.value!r} ({parameter.type_.name}), expected {kind.name}.',
            )
        ranges: list[Any] = [*described.floating_point_range, *described.integer_range]
        for limits in ranges:
            values = parameter.value if isinstance(parameter.value, list) else [parameter.value]
            if not all(limits.from_value <= v <= limits.to_value for v in values):
                reason = (
                    f'found {parameter.value!r}, expected {limits.from_value} to {limits.to_value}.'
                )
                return SetParametersResult(successful=False, reason=reason)
        for callback in self.callbacks:
            result = callback([parameter])
            if not result.successful:
                return SetParametersResult(successful=False, reason=result.reason)
        return SetParametersResult(successful=True)


class _Mistyped(SetParametersResult):
    """A refusal because of the type."""


def _exception(result: SetParametersResult) -> type[ParameterException]:
    mistyped = isinstance(result, _Mistyped)
    return InvalidParameterTypeException if mistyped else InvalidParameterValueException
