"""Samples after gaps that hold the counts of lost ones: of drivers that difference a counter."""

from dataclasses import replace

import numpy as np
import pytest
from extent import again
from other_sessions import MEDIUM, NAVIGATION, errors, fed, in_si, recorded
from other_world import DEG, Damage, Unit, World

from imu_calib.common.stream import NS, Floats, ImuBlock, Stamps, Units
from imu_calib.segmentation.gaps import LONGEST, CountsAfterGaps
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import load_imu

TACTICAL = replace(MEDIUM, gyro_pulse=4.8e-7 * DEG, accel_pulse=2.4e-7)
GRADES = {'tactical': TACTICAL, 'coarse': MEDIUM, 'navigation': NAVIGATION}
DIFFERENCED = World(damage=Damage(lost=1e-3, differenced=True))


@pytest.mark.parametrize('grade', GRADES)
def test_counts_of_lost_messages_in_the_next_one_put_nothing_off(grade):
    unit = GRADES[grade]
    found = fed(DIFFERENCED, unit, find_terms=True).finish().calibration
    whole = fed(World(), unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    # No count is lost: nothing is known less well.
    assert (found.std[:24] < 1.1 * whole.std[:24]).all()
    assert found.parameters[24:] == ()
    said = [f for f in found.findings if f not in whole.findings]
    assert len(said) == 1 and 'differences a counter over lost messages' in said[0]


def test_messages_lost_with_their_counts_are_not_said_to_be_in_the_next():
    lossy = World(damage=Damage(lost=1e-3))
    found = fed(lossy, NAVIGATION).finish().calibration
    assert any('samples are missing' in f for f in found.findings)
    assert not any('differences a counter' in f for f in found.findings)


def passed(
    stamp: Stamps, values: Floats, scale: Floats, cuts: list[int], units: Units = Units.PULSES
) -> tuple[Stamps, Floats, CountsAfterGaps]:
    counts = CountsAfterGaps(units, scale)
    rows = [
        counts.divide(*part)
        for part in zip(np.split(stamp, cuts), np.split(values, cuts), strict=True)
    ]
    rows.append(counts.finish())
    stamps, columns = zip(*rows, strict=True)
    return np.concatenate(stamps), np.concatenate(columns), counts


def of(unit: Unit, world: World) -> tuple[Stamps, Floats, Floats]:
    _, imu = recorded(world, unit, 0)
    scale = np.repeat([unit.gyro_pulse, unit.accel_pulse], 3)
    return imu.stamp, np.hstack([imu.gyro, imu.accel]), scale


def test_counts_are_divided_over_the_lost_ones_and_none_is_lost():
    stamp, values, scale = of(MEDIUM, DIFFERENCED)
    every, _, _ = of(MEDIUM, World())
    stamps, columns, counts = passed(stamp, values, scale, [])
    # Stamps are written in ns.
    assert np.abs(stamps - every).max() <= 1
    assert (columns.sum(axis=0) == values.sum(axis=0)).all()
    assert (columns == np.rint(columns)).all()
    assert counts.found.lost == len(every) - len(stamp)


def test_counts_next_to_the_ends_of_the_stream_are_divided():
    """One among the last eight samples widened K_a of a session nine times."""
    stamp, values, scale = of(NAVIGATION, World())
    for k in (1, 5, len(stamp) - 7, len(stamp) - 1):
        held = values.copy()
        held[k] += held[k - 1]
        for cuts in ([], list(range(1, 40))):
            stamps, _, counts = passed(
                np.delete(stamp, k - 1), np.delete(held, k - 1, axis=0), scale, cuts
            )
            assert counts.found.count == (k > 1)
            assert len(stamps) == len(stamp) - (k == 1)


def test_the_result_does_not_depend_on_how_the_stream_is_cut():
    stamp, values, scale = of(MEDIUM, DIFFERENCED)
    stamp, values = stamp[:9000], values[:9000]
    whole = passed(stamp, values, scale, [])
    rng = np.random.default_rng(1)
    for cuts in (sorted(rng.integers(0, 9000, 40).tolist()), list(range(1, 9000))):
        other = passed(stamp, values, scale, cuts)
        assert (other[0] == whole[0]).all() and (other[1] == whole[1]).all()
        assert other[2].found == whole[2].found


def test_a_count_over_a_longer_silence_is_left_out():
    stamp, values, scale = of(NAVIGATION, World())
    silent = round(3 * LONGEST * NAVIGATION.rate)
    stamp = np.delete(stamp, np.s_[1000 : 1000 + silent])
    counted = values[1000 : 1001 + silent].sum(axis=0)
    values = np.delete(values, np.s_[1000 : 1000 + silent], axis=0)
    values[1000] = counted
    stamps, _, counts = passed(stamp, values, scale, [])
    assert len(stamps) == len(stamp) - 1
    assert (counts.found.lost, counts.found.dropped) == (silent, 1)


@pytest.mark.parametrize('grade', ['navigation', again('coarse')])
def test_rates_that_hold_those_of_lost_messages_put_nothing_off(grade):
    """A K_g was off by 14 deviations, with terms of the gyros named, and one in the hand by 5000.

    Here the driver divides by the interval that the unit states.
    """
    unit = GRADES[grade]
    joints, imu = recorded(DIFFERENCED, unit, 0)
    blocks = joints, in_si(unit, imu)
    found = fed(DIFFERENCED, unit, find_terms=True, blocks=blocks, si=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert found.parameters[24:] == ()
    assert any('differences a counter over lost messages' in f for f in found.findings)


def test_rates_after_messages_that_are_lost_pass_unchanged():
    _, imu = recorded(World(damage=Damage(lost=1e-2)), NAVIGATION, 0)
    block = in_si(NAVIGATION, imu)
    values = np.hstack([block.gyro, block.accel])
    for units in (Units.SI, Units.RATES, Units.COUNTS):
        stamps, columns, counts = passed(block.stamp, values, np.ones(6), [], units)
        assert (stamps == block.stamp).all() and (columns == values).all()
        assert not counts.found.count


def test_what_was_divided_repeats_no_sample():
    rng = np.random.default_rng(8)
    values = rng.normal([0, 0, 0, 0.1, 0, 0], 1e-3, (3000, 6))
    stamp = (np.arange(3000) + 1) * NS // 100
    lost = np.arange(100, 2900, 70)
    values[lost + 1] += values[lost]
    segmenter = Segmenter(load_imu('increments'), None)
    kept = np.delete(np.arange(3000), lost)
    segmenter.add_block(ImuBlock(stamp[kept], values[kept, :3], values[kept, 3:]))
    found = segmenter.finish()
    assert not found.false_samples.count
    assert any('differences a counter' in one for one in found.losses)
