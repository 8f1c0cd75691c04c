"""Readings of a joint that jump: its encoder is homed anew, or slips by degrees."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import other_sessions
import pytest
from extent import again
from other_sessions import EPOCH, MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import DEG, World, schedule

from imu_calib.common.stream import Floats, Stamps
from imu_calib.segmentation.reading_jumps import ReadingJumps
from imu_calib.session.table import load_table

WORLD = World(dwell=12.0)
MOTIONS = [motion for motion in schedule(WORLD) if motion.way]
INSTANT = MOTIONS[14].start + 0.5  #: In a move between two dwells.
TABLE = load_table('three_axis')


@pytest.mark.parametrize('joint', [0, 1, again(2)])
@pytest.mark.parametrize(
    'unit', [replace(MEDIUM, counts=True), again(MEDIUM), NAVIGATION], ids=['rates', 'm', 'n']
)
def test_an_encoder_that_is_homed_anew_is_named_and_puts_nothing_off(joint, unit, monkeypatch):
    """Parameters were off by hundreds of deviations, or the least squares did not converge."""

    def blocks(world, unit, seed):
        of_table, of_imu = recorded(world, unit, seed)
        position = of_table.position.copy()
        position[(of_table.stamp - EPOCH * 10**9) * 1e-9 > INSTANT, joint] += 5 * DEG
        return replace(of_table, position=position), of_imu

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    found = fed(WORLD, unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    words = f'Warning: The readings of joint {TABLE.names[joint]} jump by 5 deg at .* homed anew'
    assert any(re.match(words, one) for one in found.findings)


def taken_out(
    stamp: Stamps, position: Floats, cut: int = 10**6
) -> tuple[Stamps, Floats, list[str]]:
    jumps = ReadingJumps(TABLE)
    parts = [
        jumps.take_out(stamp[a:b], position[a:b], last=b == len(stamp))
        for a, b in pairwise([*range(0, len(stamp), cut), len(stamp)])
    ]
    stamps, positions = (np.concatenate(part) for part in zip(*parts, strict=True))
    return stamps, positions, jumps.sentences


def course(rate: float) -> tuple[Stamps, Floats]:
    """A rest, turns at 400 deg/s from and to rest, and a rest, in readings within one turn."""
    time = np.arange(round(20 * rate)) / rate
    speed = np.clip(np.minimum(200 * (time - 5), 200 * (15 - time)), 0, 400)
    outer = np.cumsum(speed) / rate * DEG
    position = np.stack([outer, np.zeros_like(outer), 0.1 * outer], axis=1)
    return np.rint(time * 1e9).astype(np.int64), (position + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize('rate', [10.0, 50.0, 100.0, 1000.0])
def test_fast_turns_and_readings_within_one_turn_have_no_jumps(rate):
    stamp, position = course(rate)
    rng = np.random.default_rng(1)
    kept = np.sort(rng.choice(len(stamp), len(stamp) * 9 // 10, replace=False))
    bunched = np.maximum(stamp, stamp // 200_000_000 * 200_000_000 + np.arange(len(stamp)) % 7)
    for some, when in ((np.arange(len(stamp)), stamp), (kept, stamp)):
        _, found, sentences = taken_out(when[some], position[some])
        assert not sentences
        assert (found == position[some]).all()
    assert not taken_out(np.maximum.accumulate(bunched), position)[2]


def test_a_jump_is_taken_out_however_the_stream_is_cut():
    stamp, true = course(100.0)
    for at in (300, 700, 1000):
        position = true.copy()
        position[at:, 0] += 7 * DEG
        position[at + 50, 1] -= 90 * DEG
        right = np.delete(true, at + 50, axis=0)
        for cut in (10**6, 1, 13):
            stamps, found, sentences = taken_out(stamp, position, cut)
            assert (stamps == np.delete(stamp, at + 50)).all()
            off = np.angle(np.exp(1j * (found - right)))
            # By the change of the rate within one step: 200 deg/s^2 over a hundredth of a second.
            assert np.abs(off).max() <= 0.04 * DEG
            assert len(sentences) == 2
            assert 'joint outer jump by 7' in sentences[0]
            assert '1 reading of joint middle came late or false, off by up to 90' in sentences[1]


@pytest.mark.parametrize('speed', [5.0, 40.0, 400.0])
@pytest.mark.parametrize('lag', [1, 4])
def test_readings_that_come_late_are_left_out_and_are_no_jump(lag, speed):
    """A reading 40 ms old was a jump and back: of 60, no turn was left with a constant rate."""
    rng = np.random.default_rng(7)
    time = np.arange(3000) / 100
    stamp = np.rint(time * 1e9).astype(np.int64)
    outer = speed * DEG * time + rng.normal(0, 1e-5 * DEG, len(time))
    true = np.stack([outer, np.zeros_like(outer), np.zeros_like(outer)], axis=1)
    late = np.sort(rng.choice(np.arange(20, 2980, 20), 60, replace=False))
    position = true.copy()
    position[late] = true[late - lag]
    stamps, found, sentences = taken_out(stamp, position)
    assert (stamps == np.delete(stamp, late)).all()
    assert (found == np.delete(true, late, axis=0)).all()
    (said,) = sentences
    assert '60 readings of joint outer came late or false' in said
