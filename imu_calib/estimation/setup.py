"""The set-up of a calibrator: prior knowledge of a session."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from ..model.earth import Site
from ..model.parameters import Parameter
from ..model.session_terms import Change
from ..model.terms import Term
from ..session.imu import ImuSpec
from ..session.plan import Plan, Step
from ..session.segments_file import ListedSegments
from ..session.table import Table
from ..session.units_file import MountedUnit


@dataclass(frozen=True, eq=False)
class Setup:
    """Prior knowledge of a session."""

    imu: ImuSpec  #: Description of the Imu stream's numbers.
    plan: Plan  #: The plan; `plan.UNPLANNED` if unknown: joint states give the attitudes.
    table: Table | None  #: The table of the joint states; None for the IMU alone.
    site: Site  #: Gravity and Earth rate.
    #: Name of the solver; None takes the joint estimate where it applies, else the plan's own
    #: method.
    method: str | None = None
    serial_number: str = ''  #: Unit of the type `ImuSpec.id`; empty if not stated.
    terms: tuple[Term, ...] = ()  #: Terms to estimate beyond the method's parameters.
    changes: tuple[Change, ...] = ()  #: Coefficients of the session's terms, likewise.
    search_terms: bool = False  #: Whether to search for terms that the session shows.
    segments: ListedSegments | None = None  #: Holds and turns to use; None for those found.

    @property
    def method_name(self) -> str:
        """Name of the solver."""
        from .methods import default_method

        return self.method or default_method(self.plan)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters estimated in any session.

        Raises:
            InputError: There is no such method, or it does not support terms.
        """
        from .methods import estimated_parameters

        return estimated_parameters(self.method_name, self.terms)

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """Steps of the plan on the table; empty without one."""
        return () if self.table is None else self.plan.steps(self.table)

    @property
    def plan_alone(self) -> bool:
        """Whether the method is a closed form, which uses the plan's positions alone."""
        from .methods import JOINT

        return self.method_name not in JOINT

    def of_unit(self, unit: MountedUnit, imu: ImuSpec) -> Setup:
        """Return the set-up of one of several units with a common plan, table and site."""
        assert self.table is not None, 'several units are turned by a table'
        mounted = unit.table(self.table)
        return replace(self, imu=imu, serial_number=unit.serial_number, table=mounted)
