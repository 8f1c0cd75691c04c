"""Predict the results of a plan before it is run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.views import predicted_frame
from ..common.errors import InputError
from ..common.files import write_whole
from ..common.parallel import run_all
from ..common.processes import by_one_thread
from ..common.progress import Progress, silent
from ..common.units import DEG, counted, parse
from ..estimation import hand as free_positions
from ..estimation.forecast import (
    ChangeForecast,
    Forecast,
    TermForecast,
    best_table_findings,
    forecast,
    forecast_changes,
    forecast_terms,
    listed,
)
from ..estimation.methods import check_plan, closed_form_of
from ..estimation.modulation import LEAST_RISE
from ..estimation.optimise import Optimum, Reached
from ..estimation.optimise import optimise as best_plan
from ..estimation.optimise import reach as shortest_dwells
from ..estimation.predict import duration
from ..estimation.setup import Setup
from ..model.earth import LUOYANG
from ..model.parameters import Parameter
from ..model.sensors import SensorModel, parameters_of, terms_of
from ..session.imu import ImuSpec
from ..session.keywords import Named, Optimised, Planned, Stated, as_imu, as_plan, with_keywords
from ..session.plan import Plan
from ..session.table import Table
from .files import output_path
from .session import DEFAULT_TRUTH, as_truth, usual_unit

if TYPE_CHECKING:
    import pandas
    from typing_extensions import Unpack

_ANY_PLAN = 'twelve_position'  #: Start of a search for a plan; its content has no effect.

_USUAL_RATE = 60.0  #: deg/s; a choice: every supplied table turns as fast, in 6 s a turn.


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted results of a session."""

    setup: Setup  #: Plan, method, table, IMU and site.
    #: Of the method: standard deviations, and the smallest that the session allows.
    forecast: Forecast
    #: Of the plan's closed form, in addition to a joint estimate; None without one.
    closed_form: Forecast | None
    #: Information of the session on each term of the sensors, added alone.
    terms: tuple[TermForecast, ...]
    #: Information on biases and scale factors that trend, warm up or follow a stated temperature,
    #: each kind alone.
    changes: tuple[ChangeForecast, ...]
    notes: tuple[str, ...]  #: Sentences on parameters that rely on a table that is stated exact.

    def __repr__(self) -> str:
        setup, count = self.setup, len(self.forecast.parameters)
        return (
            f'<Prediction of plan {setup.plan.name} with IMU {setup.imu.id}: '
            f'{counted(count, "parameter")} by {self.forecast.method}>'
        )

    @property
    def std(self) -> dict[str, float]:
        """Standard deviations by the names of the parameters, SI units, NaN if not determined."""
        names = (p.name for p in self.forecast.parameters)
        return dict(zip(names, self.forecast.std.tolist(), strict=True))

    @property
    def duration(self) -> float:
        """Duration on the table, s; NaN for a plan that is run by hand."""
        table = self.setup.table
        if table is None:
            return math.nan
        return times_on(self.setup.plan, table)[0]

    def to_dataframe(self) -> pandas.DataFrame:
        """Return std, the smallest that the session allows (best) and unit, by parameter."""
        found = self.forecast
        by_hand = found.evidence.plan.by_hand
        return predicted_frame(found.parameters, found.std, found.best, by_hand=by_hand)


@with_keywords(Planned)
def predict(
    plan: Plan | Named,
    imu: ImuSpec | Named,
    *,
    truth: Calibration | Named | None = None,
    bias_instability: bool = False,
    temperature_rise: float | None = None,
    **stated: Unpack[Planned],
) -> Prediction:
    """Predict the standard deviations of a session.

    Args:
        plan: Name, file or value.
        imu: Likewise; its noise and the size of its pulses matter.
        truth: Assumed true parameters of the unit, which its counters use; None for cao2022_table1,
            or mems_counts if the plan is run by hand.
        bias_instability: Let the biases drift by the IMU's figure.
        temperature_rise: Linear rise of a recorded temperature over the session, K: predicts the
            parameters that follow it.
        **stated: The session, by keywords of `calibrate`; by default on the three-axis table, which
            does not matter if the plan is run by hand, and at Luoyang's latitude.

    Raises:
        InputError: A file is missing or broken, or they do not match each other.
        NotObservable: The plan cannot determine the parameters with its method.
    """
    setup = setup_of(Stated(plan=plan, imu=imu, **stated))
    model = as_truth(truth or usual_unit(setup.plan)[1]).model
    return predicted(setup, model, drifting=bias_instability, rise=temperature_rise)


@with_keywords(Optimised)
@by_one_thread
def optimise(
    imu: ImuSpec | Named,
    minutes: float,
    *,
    output: Named | None = None,
    truth: Calibration | Named | None = None,
    rate: float | None = None,
    progress: Progress = silent,
    **stated: Unpack[Optimised],
) -> Optimum:
    """Find the plan with the most information in a given time on a table.

    Args:
        imu: Name, file or value; its noise and the size of its pulses matter.
        minutes: Time on the table.
        output: File to write the plan to, which determines its name; or None.
        truth: Assumed true parameters of the unit, which its counters use; None for cao2022_table1.
        rate: Of the turns, deg/s; None for 60, or the limit of the table's slowest joint.
        progress: Called with the progress.

    Returns:
        The plan, and its information on the 24 parameters.

    Raises:
        InputError: A file is missing or broken, `output` is not a valid name of a plan's file, the
            time is too short for any plan, the table reaches too few attitudes, or cannot turn that
            fast.
    """
    target = None if output is None else plan_file(output)
    setup = setup_of(Stated(plan=_ANY_PLAN, imu=imu, **stated))
    model = as_truth(truth or DEFAULT_TRUTH).model
    if rate is None:
        slowest = () if setup.table is None else (j.max_rate / DEG for j in setup.table.joints)
        rate = min((_USUAL_RATE, *slowest))
    with progress('Exchanging attitudes') as show:
        found = best_plan(setup, model, minutes * 60, rate * DEG, show=show)
    if target is not None:
        write_whole(target, found.text(target.stem))
    return found


def plan_file(output: Named) -> Path:
    """Return the path of a plan's file."""
    path = output_path(output)
    if path.suffix != '.yaml':
        raise InputError(f'-o {output}: expected a file that ends in .yaml.')
    return path


@with_keywords(Planned)
def reach(
    plan: Plan | Named,
    imu: ImuSpec | Named,
    wanted: Mapping[str, str | float],
    *,
    output: Named | None = None,
    truth: Calibration | Named | None = None,
    bias_instability: bool = True,
    scheduler: str | None = None,
    **stated: Unpack[Planned],
) -> Reached:
    """Find the shortest dwells that reach standard deviations.

    Args:
        plan: As for `predict`, as are all but `wanted`.
        imu: Its noise and the size of its pulses matter.
        wanted: Standard deviations by the names of parameters: texts with a unit, for instance
            {'D_gx': '0.05 deg/h'}, or numbers in SI units.
        output: File for the plan, which ends in .yaml; None for none.
        truth: As for `predict`.
        bias_instability: Let the biases drift by the IMU's figure, as a session has it.
        scheduler: Address of a Dask scheduler whose worker runs the search; None for this process.

    Returns:
        The plan with these dwells, and its prediction.

    Raises:
        InputError: There is no such parameter, it is not a standard deviation, or a file is missing
            or broken.
        NotObservable: No dwell reaches it; the text states the obstacle.
    """
    target = None if output is None else plan_file(output)
    setup = setup_of(Stated(plan=plan, imu=imu, **stated))
    model = as_truth(truth or usual_unit(setup.plan)[1]).model
    found = shortest(setup, model, wanted, scheduler, drifting=bias_instability)
    if target is not None:
        write_whole(target, found.plan.text(target.stem))
    return found


def setup_of(stated: Stated) -> Setup:
    """Return the set-up of a prediction from the statements."""
    assert stated.plan is not None, 'a prediction is of a plan'
    assert stated.imu is not None, 'a prediction is of an IMU'
    table, site = stated.simulated_table(), stated.site(LUOYANG)
    plan, imu = as_plan(stated.plan), as_imu(stated.imu)
    terms = stated.sensor_terms
    if stated.changes:
        raise InputError(
            f'`terms`: found {stated.terms!r}, expected terms of the sensors: trend, '
            'warm_up and step are predicted without being named, thermal with `temperature_rise`.'
        )
    setup = Setup(imu, plan, None if plan.by_hand else table, site, stated.method, terms=terms)
    check_plan(setup.method_name, plan, site)
    return setup


@by_one_thread
def predicted(
    setup: Setup, truth: SensorModel, *, drifting: bool, rise: float | None = None
) -> Prediction:
    """Predict from a set-up; as `predict`."""
    if rise is not None and not LEAST_RISE <= abs(rise) < math.inf:
        raise InputError(
            f'`temperature_rise`: found {rise:g} K, expected {LEAST_RISE:g} K or more, either way.'
        )
    setup.plan.check_range(setup.imu)
    found = forecast(setup, truth, drifting=drifting, rise=rise or 0.0)
    closed_form = closed_form_of(found.method, setup.plan)
    own = None
    if closed_form is not None:
        plain = replace(setup, method=closed_form, terms=())
        own = forecast(plain, truth, drifting=drifting, rise=rise or 0.0)
    of_terms = tuple(forecast_terms(found, setup, truth, drifting=drifting))
    changes = forecast_changes(found, setup, truth, drifting=drifting)
    notes = tuple(best_table_findings(found, truth))
    return Prediction(setup, found, own, of_terms, changes, notes)


def with_best_deviations(own: Forecast, joint: Forecast) -> Forecast:
    """Combine the deviations of a closed form with those of a joint estimate, as the best.

    Either may estimate terms that the other does not.
    """
    parameters = parameters_of(terms_of((*own.parameters, *joint.parameters)))
    columns = [dict(zip(f.parameters, f.std.tolist(), strict=True)) for f in (own, joint)]
    std, best = (np.array([c.get(p, np.nan) for p in parameters]) for c in columns)
    return replace(own, parameters=parameters, std=std, best=best)


def is_widened_by_leaning_holds(found: Forecast) -> bool:
    """Return whether holds that lean add to the deviations: in the hand, by named attitudes."""
    return found.evidence.plan.by_hand and found.method != free_positions.NAME


def times_on(plan: Plan, table: Table) -> tuple[float, float]:
    """Return the duration of a plan on a table, and of its dwells alone, s."""
    steps = plan.steps(table)
    return duration(steps, table), sum(step.dwell for step in steps)


@by_one_thread
def shortest(
    setup: Setup,
    truth: SensorModel,
    wanted: Mapping[str, str | float],
    scheduler: str | None = None,
    *,
    drifting: bool = False,
) -> Reached:
    """Find the shortest dwells that reach standard deviations."""
    if not wanted:
        raise InputError('`reach`: found no parameter, expected NAME=STD of one at least.')
    setup.plan.check_range(setup.imu)
    parameters = {p.name: p for p in listed(setup)}
    read = dict(_wanted(name, value, parameters) for name, value in wanted.items())
    one = partial(shortest_dwells, setup, truth, drifting=drifting)
    return run_all(one, [read], scheduler=scheduler)[0]


def _wanted(
    name: str, value: str | float, parameters: Mapping[str, Parameter]
) -> tuple[str, float]:
    """Parse a standard deviation of a parameter."""
    parameter = parameters.get(name.strip())
    if parameter is None or value == '':
        known = ', '.join(parameters)
        raise InputError(f'`reach` {name}={value}: expected NAME=STD, NAME one of {known}.')
    std = value
    if isinstance(value, str):
        std = parse(value, parameter.unit.dimension, f'`reach` {name}')
    assert not isinstance(std, str)
    if not std > 0:
        raise InputError(f'`reach` {name}={value}: a standard deviation is above zero.')
    return parameter.name, std
