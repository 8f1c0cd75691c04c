"""What a stand is asked before it starts: whether its session could give a result."""

from __future__ import annotations

from dataclasses import replace

from ..common.errors import NotObservable
from ..estimation import hand as free_positions
from ..estimation.forecast import check_session
from ..estimation.methods import Setup
from ..model.earth import Site
from ..session.imu import ImuSpec
from ..session.plan import Plan
from ..session.table import Table
from ..simulation.motion import TrueTable
from ..simulation.options import StandOptions, load_imperfections
from .named import Named
from .session import Stated


def setup_of_stand(
    stated: Stated, imu: ImuSpec, plan: Plan, table: Table | None, site: Site
) -> Setup:
    """Return the set-up of a live session, with the stated method and terms.

    Raises:
        InputError: There is no such term.
    """
    terms, changes, search = stated.sensor_terms, stated.changes, stated.search_terms
    return Setup(
        imu, plan, table, site, stated.method, terms=terms, changes=changes, search_terms=search
    )


def check_stand(setup: Setup) -> None:
    """Refuse what the method could not solve; if north is unknown, name what would determine it.

    Raises:
        InputError: The table cannot run the plan, or there is no such method.
        NotObservable: The text states what cannot be determined, and why.
    """
    try:
        check_session(setup)
    except NotObservable as error:
        table = setup.table
        if table is None or table.azimuth is not None:
            raise
        check_session(replace(setup, table=replace(table, azimuth=0.0)))
        raise NotObservable(
            f'{error} Here the file of the table says where north is (azimuth: 12.3 deg); that of '
            f'{table.name} does not.'
        ) from None


def has_simulated_hands(setup: Setup) -> bool:
    """Return whether a session is one that simulated hands can hold: free positions."""
    return setup.method_name == free_positions.NAME


def true_table_of(imperfections: Named, table: Table | None, seed: int) -> TrueTable | None:
    """Return the simulated table where imperfections differ from its description.

    Raises:
        InputError: There is no such file, or it is broken.
    """
    return load_imperfections(imperfections, StandOptions(), table, seed).true
