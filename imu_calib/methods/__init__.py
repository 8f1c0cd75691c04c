"""Segments to parameters: one module per published method, and the joint estimate of all."""

from __future__ import annotations

from collections.abc import Callable

from ..errors import InputError
from . import joint, six_position, twelve_position
from .evidence import Evidence
from .solution import Solution

METHODS: dict[str, Callable[[Evidence], Solution]] = {
    'joint': joint.solve,
    'joint_33': joint.solve_33,
    'six_position': six_position.solve,
    'twelve_position': twelve_position.solve,
}


def method(name: str) -> Callable[[Evidence], Solution]:
    """Return the solver of a name.

    Raises:
        InputError: No such method; lists those that exist.

    """
    if name not in METHODS:
        raise InputError(f'No method is called {name!r}; there are: {", ".join(sorted(METHODS))}.')
    return METHODS[name]
