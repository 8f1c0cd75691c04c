"""Segments to parameters: one module per published method, and the joint estimate of all."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..common.errors import InputError
from ..model.earth import Site
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import parameters_of
from ..model.session_terms import Change, names_of
from ..model.terms import G_SENSITIVITY, Term
from ..session.plan import Plan
from . import hand as free_positions
from . import joint
from .checks import Solution
from .closed_forms import positions as n_positions
from .closed_forms import positions as six_position
from .closed_forms import positions as twelve_position
from .closed_forms import skewed
from .closed_forms import skewed as off_axis_four
from .closed_forms import skewed as rate_24
from .closed_forms import skewed as static_six
from .evidence import Evidence, in_table_time

METHODS: dict[str, Callable[[Evidence], Solution]] = {
    free_positions.NAME: free_positions.refuse,
    'joint': joint.solve,
    'joint_33': partial(joint.solve, terms=(G_SENSITIVITY,)),
    'n_positions': n_positions.solve_n_positions,
    'off_axis_four': off_axis_four.solve_off_axis_four,
    'rate_24': rate_24.solve_rate_24,
    'six_position': six_position.solve_six_position,
    'skewed': skewed.solve_skewed,
    'static_six': static_six.solve_static_six,
    'twelve_position': twelve_position.solve_twelve_position,
}

JOINT: dict[str, tuple[Term, ...]] = {'joint': (), 'joint_33': (G_SENSITIVITY,)}
"""The estimates from all of a session at once, and the terms that they include."""

_ESTIMATES: dict[str, tuple[Parameter, ...]] = {
    free_positions.NAME: free_positions.ESTIMATES,
    'n_positions': n_positions.N_POSITIONS_ESTIMATES,
    'off_axis_four': static_six.GYRO_ESTIMATES,
    'rate_24': PARAMETERS,
    'six_position': PARAMETERS,
    'skewed': skewed.SKEWED_ESTIMATES,
    'static_six': static_six.GYRO_ESTIMATES,
    'twelve_position': PARAMETERS,
}
"""Parameters of the other methods."""

_JOINT_OF = {
    'n_positions': 'joint_33',
    'rate_24': 'joint',
    'six_position': 'joint',
    'twelve_position': 'joint',
}
"""Closed forms for all sensors at known attitudes, whose sessions the joint estimate also solves.

Sessions of the others need their own method: the joint estimate does not solve for gyros alone, a
skewed gyro, or unknown attitudes.
"""

_CHECKS: dict[str, Callable[[Plan, Site], None]] = {
    free_positions.NAME: lambda plan, _: free_positions.check(plan),
    'n_positions': lambda plan, _: n_positions.check_positions(plan),
    'off_axis_four': off_axis_four.check_off_axis_four,
    'rate_24': lambda plan, _: n_positions.check_positions(plan, PARAMETERS),
    'skewed': lambda plan, _: n_positions.check_turns(plan),
    'static_six': static_six.check_static_six,
}


def method(
    name: str,
    terms: tuple[Term, ...] = (),
    changes: tuple[Change, ...] = (),
    *,
    find_terms: bool = False,
) -> Callable[[Evidence], Solution]:
    """Return the solver of a name.

    Args:
        name: Of the method.
        terms: To be estimated in addition to the method's parameters.
        changes: Coefficients of changes during the session, likewise.
        find_terms: Estimate other terms that are significant, too, if the method supports terms.

    Raises:
        InputError: Unknown method (the message lists all), or one without terms.
    """
    if name not in METHODS:
        raise InputError(f'No method is called {name!r}; there are: {", ".join(sorted(METHODS))}.')
    if name in JOINT:
        own = (*JOINT[name], *terms)
        solve = partial(joint.solve, terms=own, changes=changes, find_terms=find_terms)
        return partial(_in_table_time, solve)
    if terms or changes:
        raise InputError(
            f'Method {name} estimates its own parameters and no further terms '
            f'({", ".join([*(t.name for t in terms), *names_of(changes)])}); '
            f'{" and ".join(JOINT)} do.'
        )
    return partial(_in_table_time, METHODS[name])


def provisional(
    name: str, terms: tuple[Term, ...] = (), changes: tuple[Change, ...] = ()
) -> Callable[[Evidence], Solution]:
    """Return the solver for a session in progress: `method` without a search for terms.

    Raises:
        InputError: As `method`.
    """
    if name in JOINT:
        own = (*JOINT[name], *terms)
        return partial(_in_table_time, partial(joint.provisional, terms=own, changes=changes))
    return method(name, terms, changes)


def _in_table_time(solve: Callable[[Evidence], Solution], evidence: Evidence) -> Solution:
    return solve(in_table_time(evidence))


def estimated_parameters(name: str, terms: tuple[Term, ...] = ()) -> tuple[Parameter, ...]:
    """Return the parameters that a method estimates, terms added.

    Raises:
        InputError: Unknown method, or one without terms.
    """
    method(name, terms)
    if name in JOINT:
        return parameters_of((*JOINT[name], *terms))
    return _ESTIMATES[name]


def default_method(plan: Plan) -> str:
    """Return the joint estimate where it solves sessions of a plan's method, else that method."""
    return _JOINT_OF.get(plan.method, plan.method)


def closed_form_of(name: str, plan: Plan) -> str | None:
    """Return the closed form to compare a joint estimate of a plan with, None if there is none."""
    return plan.method if name in JOINT and plan.method in _JOINT_OF else None


def check_plan(name: str, plan: Plan, site: Site) -> None:
    """Raise if a plan cannot be solved by its method, before it is run.

    Raises:
        InputError: Unknown method, or one that needs a plan where there is none.
        NotObservable: Names the parameters that the plan cannot separate.
    """
    method(name)
    if not plan.is_stated and name not in JOINT:
        raise InputError(
            f'Method {name} needs the plan that was run, and none is stated; without a plan there '
            f'are {", ".join(JOINT)}.'
        )
    # Parameters that a closed form cannot separate are poorly determined by any estimate.
    for held in (name, closed_form_of(name, plan)):
        if held in _CHECKS:
            _CHECKS[held](plan, site)
