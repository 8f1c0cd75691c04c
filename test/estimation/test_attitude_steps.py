"""Attitudes against the readings: a unit loose in its mount or on isolators, a slipping encoder."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import other_sessions
import pytest
import yaml
from extent import again
from other_sessions import CONSUMER, EPOCH, MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import DEG, Unit, Vector, World, sample_integrals, schedule

from imu_calib.common.config import Section
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, JointBlock
from imu_calib.session.table import ASSUMED, Table, read_table

SHORT = World(dwell=12.0)
MOTIONS = [motion for motion in schedule(SHORT) if motion.way]
INSTANT = MOTIONS[15].start + 0.5  #: In a move between two dwells.
ARCSEC = DEG / 3600
TURNED = 100 * ARCSEC * np.array([0.56, -0.37, 0.74])
UNITS = {'consumer': CONSUMER, 'medium': MEDIUM, 'navigation': NAVIGATION}


@pytest.fixture(scope='module')
def undescribed() -> Table:
    """Nothing is said of how good it is: what is assumed of a decent one holds."""
    stated = yaml.safe_load(named_file('tables', 'three_axis').read_text(encoding='utf-8'))
    left = {key: value for key, value in stated.items() if key not in ASSUMED}
    return read_table(Section(left, 'three_axis'))


def seconds_of(stamp: Floats) -> Floats:
    return np.asarray((stamp - EPOCH * 10**9) * 1e-9)


def loose(imu: ImuBlock, unit: Unit, turned: Vector | Floats) -> ImuBlock:
    """A unit that turns in its mount by small angles within a tenth of a second."""
    done = np.clip((seconds_of(imu.stamp) - INSTANT) / 0.1, 0.0, 1.0)
    return moving(imu, unit, done[:, None] * turned)


def on_isolators(imu: ImuBlock, unit: Unit, by: float) -> ImuBlock:
    """A unit whose weight is beside its isolators: it turns about across that and gravity."""
    forces = [pushed for _, pushed, *_ in sample_integrals(SHORT, unit.rate, 0.0)]
    up = np.array(forces) * unit.rate / SHORT.gravity
    return moving(imu, unit, np.cross(by * np.array([0.7, -0.5, 0.51]), up))


def moving(imu: ImuBlock, unit: Unit, turned: Floats) -> ImuBlock:
    """A unit that is turned in its mount by small angles (n, 3)."""
    new = []
    for values, pulse in ((imu.gyro, unit.gyro_pulse), (imu.accel, unit.accel_pulse)):
        true = values - np.cross(turned, values)
        if values is imu.gyro:
            # Of counts, which are rates, each sample is a hundredth of a second.
            per_sample = 100 / pulse if unit.counts else 1 / pulse
            true += np.diff(turned, axis=0, prepend=turned[:1]) * per_sample
        # A counter goes on from the part of a pulse that it holds; rates are rounded one by one.
        total = np.floor(np.cumsum(true, axis=0) + 0.5)
        new.append(np.rint(true) if unit.counts else np.diff(total, axis=0, prepend=0))
    return ImuBlock(imu.stamp, *new)


def slipped(joints: JointBlock, joint: int, angle: float) -> JointBlock:
    position = joints.position.copy()
    position[seconds_of(joints.stamp) > INSTANT, joint] += angle
    return replace(joints, position=position)


@pytest.mark.parametrize('exact', [True, again(False)])
@pytest.mark.parametrize('grade', ['consumer', again('medium'), again('navigation')])
@pytest.mark.parametrize(
    ('joint', 'words'),
    [
        (None, 'moved by .* in its mount'),
        again(1, 'readings of joint middle step by'),
        again(2, 'readings of joint inner step by'),
    ],
)
def test_it_is_named_with_the_time_and_estimated(
    joint, words, grade, exact, undescribed, monkeypatch
) -> None:
    """It was called positioning errors, and misalignments were off by thirty deviations."""
    unit = UNITS[grade]

    def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
        of_table, of_imu = recorded(world, unit, seed)
        if joint is None:
            return of_table, loose(of_imu, unit, TURNED)
        return slipped(of_table, joint, 100 * ARCSEC), of_imu

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    # A table that is stated exact by default, or one with errors as of a laboratory.
    table = None if exact else undescribed
    found = fed(SHORT, unit, find_terms=True, table=table).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    (sentence,) = [one for one in found.findings if 'the misalignments are those before it' in one]
    assert re.search(words, sentence)
    assert not [one for one in found.findings if 'positioning errors of' in one]


@pytest.mark.parametrize(
    ('grade', 'by'),
    [('consumer', 60 * ARCSEC), ('navigation', 10 * ARCSEC), again('medium', 60 * ARCSEC)],
)
def test_a_unit_that_turns_with_the_force_is_named(grade, by, undescribed, monkeypatch) -> None:
    """It was called a quadratic term, with D_a off by 26 deviations, or attitude errors."""
    unit = UNITS[grade]

    def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
        of_table, of_imu = recorded(world, unit, seed)
        return of_table, on_isolators(of_imu, unit, by)

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    found = fed(SHORT, unit, find_terms=True, table=undescribed).finish().calibration
    assert np.abs(errors(found, unit)).max() < 4.5
    assert not found.parameters[24:]
    (sentence,) = [f for f in found.findings if 'turns in its mount with the force on it' in f]
    said = re.search('by ([0-9.]+) arcsec per g', sentence)
    assert said and float(said[1]) * ARCSEC == pytest.approx(by, rel=0.15)
    assert not [f for f in found.findings if 'errors of' in f]
