"""Segments to parameters: one module per published method, and the joint estimate of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ..common.errors import InputError
from ..model.earth import Site
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import parameters_of
from ..model.session_terms import Change, names_of
from ..model.terms import G_SENSITIVITY, Term
from ..session.plan import Plan
from . import hand, joint
from .closed_forms import positions, skewed
from .evidence import Evidence, in_table_time
from .solution import Solution

JOINT: dict[str, tuple[Term, ...]] = {'joint': (), 'joint_33': (G_SENSITIVITY,)}
"""The estimates from all of a session at once, and the terms that they include."""


@dataclass(frozen=True)
class Method:
    """A method of estimation."""

    #: Its solver; raises `NotObservable`, naming what is missing and what it does not determine.
    solve: Callable[[Evidence], Solution]
    estimates: tuple[Parameter, ...]  #: The parameters that it determines.
    #: Raises `NotObservable` for a plan that it cannot solve.
    check: Callable[[Plan, Site], None] = lambda _plan, _site: None
    #: The joint estimate that also solves its sessions; None where there is none: gyros alone, a
    #: skewed gyro, unknown attitudes.
    joint: str | None = None


METHODS: dict[str, Method] = {
    hand.NAME: Method(hand.refuse, hand.ESTIMATES, lambda plan, _: hand.check(plan)),
    **{
        name: Method(partial(joint.solve, terms=terms), parameters_of(terms))
        for name, terms in JOINT.items()
    },
    'n_positions': Method(
        positions.solve_n_positions,
        positions.N_POSITIONS_ESTIMATES,
        lambda plan, _: positions.check_positions(plan),
        joint='joint_33',
    ),
    'off_axis_four': Method(
        positions.solve_off_axis_four, positions.GYRO_ESTIMATES, positions.check_off_axis_four
    ),
    'rate_24': Method(
        positions.solve_rate_24,
        PARAMETERS,
        lambda plan, _: positions.check_positions(plan, PARAMETERS),
        joint='joint',
    ),
    'six_position': Method(positions.solve_six_position, PARAMETERS, joint='joint'),
    skewed.NAME: Method(
        skewed.solve_skewed, skewed.SKEWED_ESTIMATES, lambda plan, _: positions.check_turns(plan)
    ),
    'static_six': Method(
        positions.solve_static_six, positions.GYRO_ESTIMATES, positions.check_static_six
    ),
    'twelve_position': Method(positions.solve_twelve_position, PARAMETERS, joint='joint'),
}


def method(
    name: str,
    terms: tuple[Term, ...] = (),
    changes: tuple[Change, ...] = (),
    *,
    find_terms: bool = False,
) -> Callable[[Evidence], Solution]:
    """Return the solver of a name, for terms and changes beside the method's parameters.

    With `find_terms` it estimates other significant terms, too, if the method supports terms.

    Raises:
        InputError: Unknown method (the message lists all), or one without terms.
    """
    if name not in METHODS:
        raise InputError(f'No method is called {name!r}; there are: {", ".join(sorted(METHODS))}.')
    if name in JOINT:
        own = (*JOINT[name], *terms)
        solve = partial(joint.solve, terms=own, changes=changes, find_terms=find_terms)
        return partial(_in_table_time, solve)
    if name == hand.NAME:
        hand.check_terms(terms, changes)
    elif terms or changes:
        raise InputError(
            f'Method {name} estimates its own parameters and no further terms '
            f'({", ".join([*(t.name for t in terms), *names_of(changes)])}); '
            f'{" and ".join(JOINT)} do.'
        )
    return partial(_in_table_time, METHODS[name].solve)


def provisional(
    name: str, terms: tuple[Term, ...] = (), changes: tuple[Change, ...] = ()
) -> Callable[[Evidence], Solution]:
    """Return the solver for a session in progress: `method` without a search for terms."""
    if name not in JOINT:
        return method(name, terms, changes)
    solve = partial(joint.provisional, terms=(*JOINT[name], *terms), changes=changes)
    return partial(_in_table_time, solve)


def _in_table_time(solve: Callable[[Evidence], Solution], evidence: Evidence) -> Solution:
    return solve(in_table_time(evidence))


def estimated_parameters(name: str, terms: tuple[Term, ...] = ()) -> tuple[Parameter, ...]:
    """Return the parameters that a method estimates, terms added."""
    method(name, terms)
    if name in JOINT:
        return parameters_of((*JOINT[name], *terms))
    return METHODS[name].estimates


def default_method(plan: Plan) -> str:
    """Return the joint estimate where it solves sessions of a plan's method, else that method."""
    known = METHODS.get(plan.method)
    return plan.method if known is None or known.joint is None else known.joint


def closed_form_of(name: str, plan: Plan) -> str | None:
    """Return the closed form to compare a joint estimate of a plan with, None if there is none."""
    return plan.method if name in JOINT and default_method(plan) != plan.method else None


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
    for checked in filter(None, (name, closed_form_of(name, plan))):
        METHODS[checked].check(plan, site)
