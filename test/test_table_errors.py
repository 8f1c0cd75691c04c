"""A table whose axes, zeros and encoders are not quite what its file says, told so or not."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from sessions import SITE, fed, gathered, paper_imu, quick_plan, session, stand, truth

from imu_calib.budget import Source
from imu_calib.calibrator import Setup
from imu_calib.config import Section
from imu_calib.errors import InputError
from imu_calib.methods import joint
from imu_calib.methods.evidence import Evidence
from imu_calib.simulation.true_table import TableSizes, TrueTable
from imu_calib.stream import Floats
from imu_calib.table_errors import TableErrors
from imu_calib.turntable import load_table, read_table
from imu_calib.units import ARCSEC

TABLE = load_table('three_axis')
SIZES = {
    'zeros': 30 * ARCSEC,
    'orthogonality': 10 * ARCSEC,
    'wobble': 3 * ARCSEC,
    'encoder': 3 * ARCSEC,
}


def about(vector: Floats) -> Floats:
    """The rotation by a vector's length about it, by the series of the exponential."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    total, power = np.eye(3), np.eye(3)
    for k in range(1, 40):
        power = power @ cross / k
        total = total + power
    return total


ANGLES = np.array([[0.7, -1.1, 2.3], [-2.9, 0.4, 1.2], [0.0, np.pi / 2, -np.pi / 2]])
Z, X, Y = np.eye(3)[2], np.eye(3)[0], np.eye(3)[1]
AXES, SMALL = (Z, X, Z), 1e-6


def attitude(angles: Floats, change) -> Floats:
    """A table with one error: `change(joint, angle)` gives axis, further angle, and lean before."""
    result = np.eye(3)
    for k, angle in enumerate(angles):
        axis, more, lean = change(k, angle)
        result = result @ about(lean) @ about(axis * (angle + more))
    return result @ TABLE.mount


def lean_of(change) -> Floats:
    """How the body turns about its own axes by one error, (n, 3) per unit of it."""
    found = []
    for angles in ANGLES:
        right = attitude(angles, lambda k, a: (AXES[k], 0.0, np.zeros(3)))
        turned = right.T @ attitude(angles, change)
        found.append([turned[2, 1], turned[0, 2], turned[1, 0]])
    return np.array(found) / SMALL


def spans(columns: Floats, wanted: Floats) -> bool:
    """Whether errors, all angles together, are combinations of columns (n, 3, e)."""
    columns = columns.reshape(-1, columns.shape[2])
    wanted = wanted.ravel()
    left = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return bool(np.abs(left).max() < 1e-5)


def of_joint(which: int, axis=None, more=None, lean=None):
    """A change of one joint alone."""

    def change(k: int, a: float):
        if k != which:
            return AXES[k], 0.0, np.zeros(3)
        return (
            AXES[k] if axis is None else axis,
            0.0 if more is None else SMALL * more(a),
            np.zeros(3) if lean is None else SMALL * lean(a),
        )

    return change


@pytest.mark.parametrize('joint_number', [1, 2])
def test_a_zero_and_an_encoder_turn_the_body_as_the_table_would(joint_number) -> None:
    zeros = replace(TABLE, errors=TableErrors(zeros=1.0)).leaning(ANGLES)
    assert spans(zeros, lean_of(of_joint(joint_number, more=lambda a: 1.0)))
    encoder = replace(TABLE, errors=TableErrors(encoder=1.0)).leaning(ANGLES)
    assert encoder.shape[2] == 12
    assert spans(encoder[:, :, 4 * joint_number :], lean_of(of_joint(joint_number, more=np.cos)))
    twice = lean_of(of_joint(joint_number, more=lambda a: np.sin(2 * a)))
    (column,) = [
        c for c in np.moveaxis(encoder, 2, 0) if np.allclose(c * np.sqrt(2), twice, atol=1e-5)
    ]
    assert column.shape == (3, 3)


@pytest.mark.parametrize('joint_number', [1, 2])
@pytest.mark.parametrize('direction', [0, 1])
def test_an_axis_that_leans_turns_the_body_as_the_table_would(joint_number, direction) -> None:
    across = (Y, Z) if joint_number == 1 else (X, Y)
    lean = SMALL * across[direction]
    axis = about(lean) @ AXES[joint_number]
    columns = replace(TABLE, errors=TableErrors(orthogonality=1.0)).leaning(ANGLES)
    assert columns.shape[2] == 4
    mine = columns[:, :, 2 * (joint_number - 1) : 2 * joint_number]
    assert spans(mine, lean_of(of_joint(joint_number, axis=axis)))
    wobble = replace(TABLE, errors=TableErrors(wobble=1.0)).leaning(ANGLES)
    once = of_joint(joint_number, lean=lambda a: across[direction] * np.cos(a))
    assert spans(wobble[:, :, 8 * joint_number : 8 * (joint_number + 1)], lean_of(once))


@cache
def recorded(seed: int) -> Evidence:
    """A session on a table with all of it, drawn once per seed; its description says how large."""
    sizes = {k: (v, v) if k in {'wobble', 'encoder'} else v for k, v in SIZES.items()}
    options = replace(stand(), true=TrueTable.drawn(TABLE, TableSizes(**sizes), seed))
    told = replace(TABLE, errors=TableErrors(**SIZES))
    plan = quick_plan('twelve_position', 20.0)
    blocks = session(plan, options, seed=seed)
    return gathered(fed(blocks, Setup(paper_imu(), plan, told, SITE, None)))


@pytest.mark.parametrize('seed', [1, 2])
def test_a_table_that_says_what_it_may_be_off_is_answered_honestly(seed) -> None:
    solution = joint.solve(recorded(seed))
    off = (solution.model.vector() - truth().model.vector()) / solution.std
    assert np.abs(off).max() < 4.5
    assert solution.findings == ()


def test_a_table_that_is_taken_as_exact_is_not() -> None:
    solution = joint.solve(replace(recorded(2), table=None))
    off = (solution.model.vector() - truth().model.vector()) / solution.std
    assert np.abs(off).max() > 8


def test_the_budget_has_a_line_for_it() -> None:
    told = joint.solve(recorded(1))
    exact = joint.solve(replace(recorded(1), table=TABLE))
    share = told.shares[Source.TABLE].covariance
    # Misalignments are against axes that nobody knows better; biases of gyros hardly feel them.
    assert np.sqrt(share[3, 3]) > 0.5 * told.std[3]
    assert np.sqrt(share[9, 9]) < 0.2 * told.std[9]
    assert Source.TABLE not in exact.shares


def test_sizes_are_read_and_kept_within_reason() -> None:
    joint_of = '{name: a, axis: z, max_rate: 9 deg/s, max_acceleration: 9 deg/s^2}'
    text = f'name: t\njoints: [{joint_of}]\n'
    lines = ''.join(f'{f.name}: {k + 1} arcsec\n' for k, f in enumerate(fields(TableErrors)))
    errors = read_table(Section.parse(text + lines, 'table.yaml')).errors
    assert errors == TableErrors(*(ARCSEC * k for k in (1, 2, 3, 4)))
    assert TABLE.errors.exact
    with pytest.raises(InputError, match='wobble: found 2 deg, expected 0 to 1 deg'):
        read_table(Section.parse(text + 'wobble: 2 deg\n', 'table.yaml'))
