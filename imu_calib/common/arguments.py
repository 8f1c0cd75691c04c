"""Refuse arguments of a wrong type in a sentence, by the annotations of a function.

Libraries that do this (typeguard, beartype) need the classes that annotations name; most of them
are loaded for type checkers alone, and their errors are no sentences for a person.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from numbers import Integral, Real
from typing import Any, ParamSpec, TypeVar

from .errors import InputError
from .units import point_for_comma

Arguments = ParamSpec('Arguments')
Returned = TypeVar('Returned')
_ALIASES = {
    'Named': 'str | Path',
    'Recorded': 'str | Path | DataFrame | ndarray | Sequence',
    'AnyCalibration': 'Calibration | ThermalCalibration',
    'Progress': 'Callable',
}
"""Names of unions and protocols in annotations, and what they stand for."""
_WORDS = {
    'None': 'None',
    'bool': 'True or False',
    'int': 'a whole number',
    'float': 'a number',
    'str': 'a text',
    'Path': 'a path',
    'Callable': 'a function',
    'Sequence': 'a list',
    'ndarray': 'an array',
    'Mapping': 'a mapping',
}
_PROTOCOLS: dict[str, Any] = {
    'int': Integral,
    'float': Real,
    'Callable': Callable,
    'Sequence': Sequence,
    'Mapping': Mapping,
}
"""Kinds that types of other libraries, numpy among them, belong to without being derived."""
_LONGEST = 60
"""Characters of a value that is shown: a line of a terminal has room for it and its sentence."""


def checked(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
    """Check the arguments of a function that is called from Python, before it begins."""
    known = signature(function)

    @wraps(function)
    def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
        check(known, args, kwargs)
        return function(*args, **kwargs)

    return called


def check(known: Signature, args: tuple[object, ...], kwargs: Mapping[str, object]) -> None:
    """Refuse arguments that are not of the annotated types."""
    try:
        given = known.bind(*args, **kwargs).arguments
    except TypeError:
        if 'bag' in known.parameters and sum(map(_is_array, args)) > 1:
            raise InputError(
                'Gyro and accelerometer are one argument, and need their rate: '
                'calibrate((gyro, accel), rate=200).'
            ) from None
        # Missing or unknown arguments: the call itself says so, with the name of the function.
        return
    for name, value in given.items():
        parameter = known.parameters[name]
        several = parameter.kind is Parameter.VAR_POSITIONAL
        for one in value if several else (value,):
            if isinstance(parameter.annotation, str):
                _check(name, one, _parsed(parameter.annotation))


def _is_array(value: object) -> bool:
    return _is_of(value, 'ndarray') or _is_of(value, 'DataFrame')


def _check(name: str, value: object, annotation: ast.expr) -> None:
    """Refuse a value that is of no member of a union, and elements of a list likewise."""
    kinds = _members(annotation)
    for kind in kinds:
        if _is_of(value, _name(kind)):
            for where, one, part in _elements(name, value, kind):
                _check(where, one, part)
            return
    words = [_words(_name(kind)) for kind in kinds]
    listed = ' or '.join([', '.join(words[:-1]), words[-1]] if words[1:] else words)
    hint = point_for_comma(value) if _WORDS['float'] in words else ''
    raise InputError(f'`{name}`: found {_found(value)}, expected {listed}.{hint}')


@cache
def _parsed(annotation: str) -> ast.expr:
    """Return an annotation, which is text in this package: its classes may not be loaded."""
    return ast.parse(annotation, mode='eval').body


def _members(node: ast.expr) -> list[ast.expr]:
    if isinstance(node, ast.BinOp):
        return [*_members(node.left), *_members(node.right)]
    if isinstance(node, ast.Name) and node.id in _ALIASES:
        return _members(_parsed(_ALIASES[node.id]))
    return [node]


def _name(kind: ast.expr) -> str:
    return ast.unparse(kind.value if isinstance(kind, ast.Subscript) else kind)


def _is_of(value: object, kind: str) -> bool:
    if kind in _PROTOCOLS:
        # True is an integer, and a text a sequence, of which neither is meant.
        return isinstance(value, _PROTOCOLS[kind]) and not (
            isinstance(value, bool | str) and kind != 'Callable'
        )
    # There is an object of a class only if it is loaded: the name is enough.
    return value is None if kind == 'None' else kind in {c.__name__ for c in type(value).__mro__}


def _elements(name: str, value: object, kind: ast.expr) -> Iterator[tuple[str, object, ast.expr]]:
    """Yield the elements of a list or a mapping, each with its name and annotation."""
    if not isinstance(kind, ast.Subscript):
        return
    if isinstance(value, Mapping) and isinstance(kind.slice, ast.Tuple):
        of_keys, of_values = kind.slice.elts
        for key, one in value.items():
            yield f'a key of {name}', key, of_keys
            yield f'{name}[{key!r}]', one, of_values
    elif isinstance(value, Sequence):
        for k, one in enumerate(value):
            yield f'{name}[{k}]', one, kind.slice


def _words(kind: str) -> str:
    return _WORDS.get(kind, f'{"an" if kind[0] in "AEIOU" else "a"} {kind}')


def _found(value: object) -> str:
    """Return a plain value as it is written, of any other its type."""
    if value is None or isinstance(value, str | int | float):
        text = repr(value)
        return text if len(text) <= _LONGEST else f'{text[:_LONGEST]}...'
    return f'a value of the type {type(value).__name__}'
