"""Two units on one table: which of their errors are one, column by column."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evidence import SITE, evidence_of
from scipy.spatial.transform import Rotation

from imu_calib.common.budget import ErrorSource
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.table_effects import CommonSizes, CommonTable
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors

MOUNT = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
ERRORS = TableErrors(1e-4, 2e-4, 3e-4, 4e-4)
ANGLES = np.radians([[0.0, 0, 0], [90.0, 0, 0], [90.0, 90, 0]])
SIZES = CommonSizes(ERRORS, PositioningErrors(4e-6, 7e-6))


def unit(mount: Any, offset: float, rests: Any = (0, 1, 2), **other: Any) -> Equations:
    """A unit that saw some of three rests and a turn after them, by a clock that is ahead."""
    table = replace(load_table('three_axis'), mount=mount, errors=ERRORS)
    whole, ahead = evidence_of(), round(offset * 1e9)
    segments = tuple(
        replace(
            whole.segments[k],
            start=k * 100 * 10**9 + ahead,
            end=(k * 100 + 50) * 10**9 + ahead,
            angles=ANGLES[k],
            attitude=table.attitude(ANGLES[k]),
            attitude_error=2e-6,
            position=f'p{k}',
        )
        for k in rests
    )
    up = table.attitude(ANGLES[2])[2]
    turn = replace(
        whole.turns[0],
        start=400 * 10**9 + ahead,
        end=450 * 10**9 + ahead,
        angles=ANGLES[2],
        joint=0,
        up=up,
        up_error=3e-6,
        rate_error=1e-5,
    )
    clock = replace(whole.clock, epoch=float(ahead), offset=offset)
    given = {'segments': segments, 'turns': (turn,), 'table': table, 'clock': clock, **other}
    return Equations(replace(whole, **given))


@pytest.fixture(scope='module')
def units() -> list[Equations]:
    site = replace(SITE, latitude_std=1e-4)
    return [
        unit(np.eye(3), 5.0, positioning=3e-6, site=site),
        unit(MOUNT, -20.0, (1, 2), positioning=1e-6, site=site),
    ]


@pytest.fixture(scope='module')
def states(units: list[Equations]) -> list[Any]:
    return [equations.nominal() for equations in units]


def of(found: Any, source: ErrorSource) -> list[Any]:
    """The columns of a source, of each unit."""
    which = [k for k, one in enumerate(found.sources) if one is source]
    return [columns[:, which] for columns in found.columns]


def test_joints_that_stop_err_once_for_all_units(units: Any, states: Any) -> None:
    found = CommonTable(units, SIZES).errors_at(states)
    names = [n for n, s in zip(found.names, found.sources, strict=True) if n]
    outer, middle, inner = (j.name for j in load_table('three_axis').joints)
    assert names == [
        f'{outer} at p0',
        f'{outer} at p1',
        f'{middle} at p0',
        f'{middle} at p2',
        f'{inner} at p0',
    ]
    # The larger of the two stated sizes, and what was found on top of it.
    size = np.hypot(3e-6, 4e-6)
    stated = np.array([s is ErrorSource.POSITIONING_STATED for s in found.sources])
    np.testing.assert_allclose(found.sizes[stated], size)
    assert not found.sizes[~stated].any()
    first, second = of(found, ErrorSource.POSITIONING_STATED)
    for equations, state, columns, rests in zip(
        units, states, (first, second), ((0, 1, 2), (1, 2)), strict=True
    ):
        runs = [(0, [0]), (0, [1, 2]), (1, [0, 1]), (1, [2]), (2, [0, 1, 2])]
        for column, (joint, run) in zip(columns.T, runs, strict=True):
            lean = np.zeros((len(rests), 3, 1))
            for own, k in enumerate(rests):
                if k in run:
                    table = equations.evidence.table
                    lean[own, :, 0] = table.joint_axis(joint, ANGLES[k])
            # Of the turn the middle and inner joints are where they stopped last, in its mean.
            wanted = equations.attitude_error_effects(state, lean, np.zeros((1, 3, 1)))[:, 0] * size
            rows = equations.layout.dwell.ravel()
            np.testing.assert_allclose(column[rows], wanted[rows], atol=1e-18)


def test_stops_and_encoders_err_about_the_axes_of_the_table(units: Any, states: Any) -> None:
    found = CommonTable(units, SIZES).errors_at(states)
    for source, size in ((ErrorSource.STOPS, 7e-6), (ErrorSource.ENCODER_NOISE, 2e-6)):
        both = of(found, source)
        # Three rests of three axes; an error about up shows in no force and hardly in a rate.
        for equations, state, columns, rests in zip(
            units, states, both, ((0, 1, 2), (1, 2)), strict=True
        ):
            lean = np.zeros((len(rests), 3, 9))
            for own, k in enumerate(rests):
                lean[own, :, 3 * k : 3 * k + 3] = equations.evidence.table.mount.T * size
            wanted = equations.attitude_error_effects(state, lean, np.zeros((1, 3, 9)))
            np.testing.assert_allclose(columns[:, :9], wanted, atol=1e-18)
        extra = 0 if source is ErrorSource.STOPS else 3
        assert both[0].shape[1] <= 9 + extra
    turning = of(found, ErrorSource.ENCODER_NOISE)[0][units[0].layout.turn[0], 9:]
    lean = np.eye(3)[None] * 3e-6
    wanted = units[0].attitude_error_effects(states[0], np.zeros((3, 3, 3)), lean)
    rows = units[0].layout.turn[0]
    kept = wanted[:, np.any(wanted != 0, axis=0)]
    np.testing.assert_allclose(turning, kept[rows], atol=1e-18)


def test_latitude_table_and_rates_err_for_all(units: Any, states: Any) -> None:
    found = CommonTable(units, SIZES).errors_at(states)
    # What neither unit sees is no unknown.
    all_of = [u.table_error_effects(s) for u, s in zip(units, states, strict=True)]
    seen = np.any([columns.any(axis=0) for columns in all_of], axis=0)
    for k, (equations, state) in enumerate(zip(units, states, strict=True)):
        latitude = of(found, ErrorSource.LATITUDE)[k][:, 0]
        np.testing.assert_allclose(latitude, equations.latitude_derivatives(state) * 1e-4)
        rates = of(found, ErrorSource.ENCODER_RATE)[k]
        np.testing.assert_allclose(rates, equations.encoder_rate_effects(state))
        table = of(found, ErrorSource.TABLE)[k]
        np.testing.assert_allclose(table, equations.table_error_effects(state)[:, seen], atol=1e-18)


def test_sizes_are_those_that_a_unit_found(units: Any) -> None:
    found = replace(units[0], positioning=PositioningErrors(1e-6, 2e-6))
    assert CommonSizes.of_one_unit(found) == CommonSizes(ERRORS, PositioningErrors(1e-6, 2e-6))
    bare = Equations(evidence_of())
    assert CommonSizes.of_one_unit(bare) == CommonSizes(TableErrors(), PositioningErrors())


def test_the_share_of_what_is_stated_is_of_squares(units: Any) -> None:
    assert CommonTable(units, SIZES).stated_share == pytest.approx(9 / 25)
    none = [unit(np.eye(3), 0.0), unit(MOUNT, 0.0)]
    nothing = CommonSizes(ERRORS, PositioningErrors())
    assert CommonTable(none, nothing).stated_share == 1.0
