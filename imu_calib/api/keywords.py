"""Keywords common to several functions: the statements on a session, which form `Stated`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from inspect import Parameter, signature
from typing import TYPE_CHECKING, ParamSpec, TypedDict, TypeVar

from ..common.config import check
from .session import Stated

if TYPE_CHECKING:
    from ..session.imu import ImuSpec
    from ..session.plan import Plan
    from ..session.table import Table
    from .named import Named

Arguments = ParamSpec('Arguments')
Returned = TypeVar('Returned')


class AtSite(TypedDict, total=False):
    """The site and its uncertainty."""

    latitude: float | None
    latitude_std: float | None
    height: float | None
    height_std: float | None
    gravity: float | None
    gravity_std: float | None


class OnTable(TypedDict, total=False):
    """The table that turns the unit."""

    table: Table | Named | None
    azimuth: float | None


class Solved(TypedDict, total=False):
    """The method of estimation."""

    method: str | None
    terms: str | None


class OfUnit(TypedDict, total=False):
    """The unit and the topics of its samples."""

    imu: ImuSpec | Named | None
    serial: str | None
    imu_topic: str | None
    imu_only: bool


class Planned(AtSite, OnTable, Solved, total=False):
    """A session that is predicted or simulated."""


class Optimised(AtSite, OnTable, total=False):
    """A session whose plan is optimised."""


class OnStand(AtSite, Solved, total=False):
    """A session that is run live."""


class OfSeveral(AtSite, OnTable, Solved, total=False):
    """A recorded session of several units."""

    plan: Plan | Named | None
    joint_topic: str | None
    setpoint_topic: str | None


class Session(OfSeveral, OfUnit, total=False):
    """A recorded session of one unit."""


class Verified(AtSite, OnTable, OfUnit, total=False):
    """A recorded session for verification, without an estimate."""

    plan: Plan | Named | None
    joint_topic: str | None
    setpoint_topic: str | None


def with_keywords(
    kind: type[object],
) -> Callable[[Callable[Arguments, Returned]], Callable[Arguments, Returned]]:
    """Show the keywords of a kind in the signature of a function that takes them by `**`.

    The arguments are checked, as by `checked`. Help, completion, documentation and the command line
    read them from the signature.
    """

    def of(function: Callable[Arguments, Returned]) -> Callable[Arguments, Returned]:
        own = signature(function)
        *named, kept = own.parameters.values()
        more = [
            Parameter(f.name, Parameter.KEYWORD_ONLY, default=f.default, annotation=f.type)
            for f in fields(Stated)
            if f.name in kind.__annotations__
        ]

        @wraps(function)
        def called(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Returned:
            if unknown := set(kwargs) - set(extended.parameters):
                name = function.__name__
                raise TypeError(f'{name}() got an unexpected keyword argument {unknown.pop()!r}')
            check(extended, args, kwargs)
            return function(*args, **kwargs)

        extended = own.replace(parameters=[*named, *more])
        called.__signature__ = extended  # type: ignore[attr-defined]
        # Names that cannot be resolved (`Unpack` is for mypy) would hide the others.
        called.__annotations__ = {
            n: a for n, a in function.__annotations__.items() if n != kept.name
        }
        return called

    return of
