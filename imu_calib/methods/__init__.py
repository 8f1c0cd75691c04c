"""Segments to parameters: one module per published method, and the joint estimate of all."""

from __future__ import annotations

from collections.abc import Callable

from ..earth import Site
from ..errors import InputError
from ..model import PARAMETERS, Parameter, extended_parameters
from ..plan import Plan
from . import (
    free,
    joint,
    n_positions,
    off_axis_four,
    rate_24,
    six_position,
    skewed,
    static_six,
    twelve_position,
)
from .evidence import Evidence
from .solution import Solution

METHODS: dict[str, Callable[[Evidence], Solution]] = {
    free.NAME: free.refuse,
    'joint': joint.solve,
    'joint_33': joint.solve_33,
    'n_positions': n_positions.solve,
    'off_axis_four': off_axis_four.solve,
    'rate_24': rate_24.solve,
    'six_position': six_position.solve,
    'skewed': skewed.solve,
    'static_six': static_six.solve,
    'twelve_position': twelve_position.solve,
}

_CHECKS: dict[str, Callable[[Plan, Site], None]] = {
    'n_positions': lambda plan, _: n_positions.check(plan),
    'off_axis_four': off_axis_four.check,
    'rate_24': lambda plan, _: rate_24.check(plan),
    'skewed': lambda plan, _: skewed.check(plan),
    'static_six': static_six.check,
}


def method(name: str) -> Callable[[Evidence], Solution]:
    """Return the solver of a name.

    Raises:
        InputError: No such method; lists those that exist.

    """
    if name not in METHODS:
        raise InputError(f'No method is called {name!r}; there are: {", ".join(sorted(METHODS))}.')
    return METHODS[name]


def estimates(name: str) -> tuple[Parameter, ...]:
    """Return the parameters that a method estimates.

    Raises:
        InputError: No such method.

    """
    method(name)
    with_g = name in {'joint_33', 'n_positions'}
    found = extended_parameters(with_g=with_g, skewed=int(name == 'skewed'))
    if name == free.NAME:
        return tuple(p for p, exists in zip(PARAMETERS, free.FREE, strict=True) if exists)
    if name in {'off_axis_four', 'skewed', 'static_six'}:
        return tuple(p for p in found if p.triad == 'g')
    return found


def check_plan(name: str, plan: Plan, site: Site) -> None:
    """Refuse a plan that its method cannot solve, before anybody runs it.

    Raises:
        InputError: No such method.
        NotObservable: Names the parameters that the plan cannot tell apart.

    """
    method(name)
    if name in _CHECKS:
        _CHECKS[name](plan, site)
