"""Attitudes against the readings: a unit loose in its mount or on isolators, a slipping encoder."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml
from extent import again
from other_faults import ARCSEC, GRADES, fed_with, loose, on_isolators, stepped
from other_sessions import errors, fed, recorded
from other_world import World, schedule

from imu_calib.common.config import Section
from imu_calib.common.files import named_file
from imu_calib.session.table import ASSUMED, Table, load_table, read_table

SHORT = World(dwell=12.0)
MOTIONS = [motion for motion in schedule(SHORT) if motion.way]
INSTANT = MOTIONS[15].start + 0.5  #: In a move between two dwells.
TURNED = 100 * ARCSEC * np.array([0.56, -0.37, 0.74])


@pytest.fixture(scope='module')
def undescribed() -> Table:
    """Nothing is said of how good it is: what is assumed of a decent one holds."""
    stated = yaml.safe_load(named_file('tables', 'three_axis').read_text(encoding='utf-8'))
    left = {key: value for key, value in stated.items() if key not in ASSUMED}
    return read_table(Section(left, 'three_axis'))


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
def test_it_is_named_with_the_time_and_estimated(joint, words, grade, exact, undescribed) -> None:
    """It was called positioning errors, and misalignments were off by thirty deviations."""
    unit = GRADES[grade]
    if joint is None:
        blocks = loose(SHORT, unit, 0, TURNED, INSTANT)
    else:
        of_table, of_imu = recorded(SHORT, unit, 0)
        blocks = stepped(of_table, joint, 100 * ARCSEC, INSTANT), of_imu
    # A table that is stated exact by default, or one with errors as of a laboratory.
    table = None if exact else undescribed
    calibrator = fed(SHORT, unit, find_terms=True, table=table, blocks=blocks)
    found = calibrator.finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    (sentence,) = [one for one in found.findings if 'the misalignments are those before it' in one]
    assert re.search(words, sentence)
    assert not [one for one in found.findings if 'positioning errors of' in one]


@pytest.mark.parametrize(
    ('exact', 'grade', 'seed', 'words'),
    [
        (False, 'consumer', 5, 'may have moved by'),  # Hardly significant.
        (False, 'consumer', 7, 'The unit moved by'),  # The scatter of motions explains it, too.
        (True, 'medium', 3, 'may have moved by'),  # As likely as two moves in error.
        (True, 'medium', 19, 'may have moved by'),  # An encoder's errors are a rival, too.
        again(True, 'navigation', 15, 'may have moved by'),
        again(True, 'consumer', 5, 'may have moved by'),
        (False, 'consumer', 6, 'The unit moved by'),  # It was called a reading of its last joint.
        again(False, 'navigation', 9, 'The unit moved by'),
    ],
)
def test_one_that_is_not_certain_widens_what_it_may_turn(
    exact, grade, seed, words, undescribed
) -> None:
    """Misalignments were off by 9 to 2800 standard deviations, and nothing said so."""
    name = 'the same, on an exact table' if exact else 'moved by 100 arcsec in its mount'
    table = load_table('three_axis') if exact else undescribed
    calibrator, unit = fed_with(name, grade, seed, table)
    found = calibrator.finish().calibration
    assert np.abs(errors(found, unit)).max() < 4.5
    assert any(words in one for one in found.findings)


@pytest.mark.parametrize('seed', [4, again(3), again(8)])
def test_isolators_that_are_not_certain_widen_biases(seed, undescribed) -> None:
    """Biases of accelerometers were off by five standard deviations, and nothing said so."""
    calibrator, unit = fed_with('isolators, 10 arcsec/g', 'consumer', seed, undescribed)
    found = calibrator.finish().calibration
    assert np.abs(errors(found, unit)).max() < 4.5
    assert any('may turn in its mount with the force on it' in one for one in found.findings)


@pytest.mark.parametrize('seed', [4, again(0), again(16)])
def test_turns_smaller_than_any_table_shows_are_not_named(seed) -> None:
    """Units that do not turn were to be taken off isolators, for 0.2 arcsec per g."""
    name = 'nothing, on an exact table'
    found = fed_with(name, 'navigation', seed, load_table('three_axis'))[0].finish().calibration
    assert not any('in its mount' in one for one in found.findings)


@pytest.mark.parametrize('seed', [2, again(5)])
def test_isolators_that_look_like_a_quadratic_term_are_named_beside_it(seed, undescribed) -> None:
    """At six faces accelerometers cannot tell them apart: D_a was off by seven deviations."""
    calibrator, unit = fed_with('isolators, 10 arcsec/g', 'consumer', seed, undescribed)
    found = calibrator.finish().calibration
    assert np.abs(errors(found, unit)).max() < 4.5
    (said,) = [one for one in found.findings if 'in its mount with the force on it' in one]
    assert 'accel_quadratic' in said and 'would explain it as well' in said


@pytest.mark.parametrize(
    ('grade', 'by'),
    [('consumer', 60 * ARCSEC), ('navigation', 10 * ARCSEC), again('medium', 60 * ARCSEC)],
)
def test_a_unit_that_turns_with_the_force_is_named(grade, by, undescribed) -> None:
    """It was called a quadratic term, with D_a off by 26 deviations, or attitude errors."""
    unit = GRADES[grade]
    blocks = on_isolators(SHORT, unit, 0, by * np.array([0.7, -0.5, 0.51]))
    calibrator = fed(SHORT, unit, find_terms=True, table=undescribed, blocks=blocks)
    found = calibrator.finish().calibration
    assert np.abs(errors(found, unit)).max() < 4.5
    assert not found.parameters[24:]
    (sentence,) = [f for f in found.findings if 'turns in its mount with the force on it' in f]
    said = re.search('by ([0-9.]+) arcsec per g', sentence)
    assert said and float(said[1]) * ARCSEC == pytest.approx(by, rel=0.15)
    assert not [f for f in found.findings if 'errors of' in f]
