"""Stamps of a clock that advances in steps as long as a sample interval: 15.6 ms on Windows."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import other_sessions
import pytest
from extent import again
from other_faults import GRADES as FAULT_GRADES
from other_faults import TICK, fed_with, slewed
from other_sessions import MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import Damage, Unit, World
from sessions import recut

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, JointBlock, Stamps, Units
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.segmentation.clock import ClockSample, slewed_alone
from imu_calib.segmentation.stamp_faults import SharedStamps
from imu_calib.segmentation.stamps import read_grid, sampling_times
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.hand import as_planned
from imu_calib.simulation.options import ImuOptions

IN_STEPS = World(damage=Damage(tick=TICK))
GRADES = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}


def set_apart(stamp: Stamps) -> Stamps:
    """Return stamps, ns, with samples of one stamp a nanosecond apart, as the intake has them."""
    number = np.arange(len(stamp))
    first = np.diff(stamp, prepend=-1) != 0
    return np.asarray(stamp + number - np.maximum.accumulate(np.where(first, number, 0)))


@pytest.mark.parametrize('grade', GRADES)
def test_a_session_is_as_good_as_with_stamps_that_do_not_step(grade):
    unit = GRADES[grade]
    found = fed(IN_STEPS, unit, find_terms=True).finish().calibration
    whole = fed(World(), unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    # Of a hundred samples a second, 15.6 ms spread over each turn: 0.1 ppm of its rate, and more.
    assert (found.std[:24] < 2 * whole.std[:24]).all()
    assert found.parameters[24:] == whole.parameters[24:]
    assert any('stamps of the IMU come in steps of 15.6 ms' in f for f in found.findings)


@pytest.mark.parametrize('lost', [0.1, 0.4])
def test_samples_missing_between_such_stamps_are_not_guessed(lost):
    """With 40 % missing all scale factors were off by 35 %."""
    world = World(damage=Damage(tick=TICK, lost=lost))
    words = r'^\d+ of \d+ .* left out: .* stamps in steps of .* ms do not show how many'
    with pytest.raises(NotObservable, match=words):
        fed(world, MEDIUM).finish()


@pytest.mark.parametrize('rate', [50.0, 64.5, 100.0, 200.0, 400.0])
@pytest.mark.parametrize('digits', [9, 3])
def test_the_line_through_them_has_the_interval_of_the_samples(rate, digits):
    made = np.arange(round(60 * rate)) / rate + 0.0123
    came = np.floor(np.floor(made / TICK) * TICK * 10**digits) * 10 ** (9 - digits)
    stamp = set_apart(came.astype(np.int64))
    grid = read_grid(stamp)
    assert grid.tick == pytest.approx(TICK, rel=0.05)
    assert (grid.index == np.arange(len(stamp))).all()
    assert grid.period == pytest.approx(1 / rate, abs=4 * grid.period_std)
    assert grid.period_std * rate < 2e-5
    assert sampling_times(stamp)[0] is stamp


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
@pytest.mark.parametrize('lost', [0.02, 0.05, 0.1, 0.2, 0.4])
def test_no_count_is_read_from_them_however_many_are_missing(rate, lost):
    kept = np.flatnonzero(np.random.default_rng(2).random(round(60 * rate)) >= lost)
    came = np.rint(np.floor((kept / rate + 0.0123) / TICK) * TICK * 1e9).astype(np.int64)
    assert not read_grid(set_apart(came)).is_counted


@pytest.mark.parametrize('rate', [100.0, 200.0, 400.0])
@pytest.mark.parametrize('tick', [TICK, 0.04])
def test_a_reader_that_misses_some_polls_misses_no_samples(rate, tick):
    rng = np.random.default_rng(1)
    made = np.arange(round(60 * rate)) / rate + 0.0123
    polls = np.arange(1, 60 / tick + 20) * tick
    polls = polls[rng.random(len(polls)) > 0.05]
    came = np.rint(polls[np.searchsorted(polls, made)] * 1e9).astype(np.int64)
    grid = read_grid(set_apart(came))
    assert grid.is_counted
    assert (grid.index == np.arange(len(came))).all()
    assert grid.period * rate == pytest.approx(1, abs=1e-5)


def test_stamps_that_are_late_one_by_one_are_no_steps():
    rng = np.random.default_rng(3)
    stamp = np.arange(12_000) * 10_000_000 + np.rint(rng.normal(size=12_000) * 2e5).astype(int)
    stamp[rng.choice(12_000, 40, replace=False)] += rng.integers(4_000_000, 9_000_000, 40)
    grid = read_grid(np.sort(stamp))
    assert grid.tick == 0
    assert grid.is_counted
    assert (grid.index == np.arange(12_000)).all()


def test_lost_samples_of_regular_stamps_are_no_steps():
    rng = np.random.default_rng(1)
    for share in (0.02, 0.05, 0.1, 0.3):
        kept = np.flatnonzero(rng.random(3000) >= share)
        grid = read_grid(kept * 10_000_000)
        assert grid.tick == 0
        assert (grid.index == kept - kept[0]).all()


# A clock that stamps samples is slewed for some minutes: brought up to time by running fast


UNITS = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}
MIDDLE = (0.4, 0.6)  #: Shares of the session between which it runs fast.


@pytest.fixture
def slew(monkeypatch):
    """Slew the clock of the IMU, or of both streams, in the sessions that `fed` feeds."""

    def apply(ppm: float, span: tuple[float, float], *, joints: bool, jitter: float = 0.0) -> None:
        def blocks(world: World, unit: Unit, seed: int) -> tuple[JointBlock, ImuBlock]:
            of_table, of_imu = recorded(world, unit, seed)
            if joints:
                of_table = replace(of_table, stamp=slewed(of_table.stamp, ppm, span))
            late = jitter * 1e9 * np.abs(np.random.default_rng(seed).normal(size=len(of_imu.stamp)))
            stamp = slewed(of_imu.stamp, ppm, span) + late.astype(int)
            return of_table, replace(of_imu, stamp=stamp)

        monkeypatch.setattr(other_sessions, 'recorded', blocks)

    return apply


@pytest.mark.parametrize('joints', [False, True])
@pytest.mark.parametrize(
    ('grade', 'ppm'), [('medium', 50), ('rates', 50), ('navigation', 50), ('navigation', 4)]
)
def test_what_it_stamps_meanwhile_is_timed_by_its_samples(grade, ppm, joints, slew):
    even = fed(World(), UNITS[grade], find_terms=True).finish().calibration
    slew(ppm, MIDDLE, joints=joints)
    found = fed(World(), UNITS[grade], find_terms=True).finish().calibration
    off = errors(found, UNITS[grade])
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    widened = np.sqrt(np.diag(found.covariance) / np.diag(even.covariance))
    # A turn in which the clock of the table changes its pace is left out.
    assert widened.max() < (1.4 if joints else 1.1), np.round(widened, 2)
    assert any(f'by up to {ppm} ppm: their clock was slewed' in f for f in found.findings)


@pytest.mark.parametrize('joints', [False, True])
def test_jitter_does_not_hide_it(joints, slew):
    slew(50, MIDDLE, joints=joints, jitter=2e-4)
    found = fed(World(), NAVIGATION, find_terms=True).finish().calibration
    off = errors(found, NAVIGATION)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert any('ppm: their clock was slewed' in f for f in found.findings)


@pytest.mark.parametrize(
    ('share', 'noise', 'alone'),
    [(1, 1e-4, True), (0, 1e-4, False), (0.5, 1e-4, None), (1, 1e-2, None)],
)
def test_offsets_show_whether_the_clock_stamps_the_imu_alone(share, noise, alone):
    seconds = np.linspace(0, 500, 30)
    gained = 50e-6 * np.clip(seconds - 200, 0, 100)
    offset = 0.1 + 1e-6 * seconds + share * gained + np.tile([noise, -noise], 15)
    samples = [ClockSample(t * 1e9, o) for t, o in zip(seconds, offset, strict=True)]
    assert slewed_alone(samples, gained) is alone


def test_where_no_pace_prevails_long_enough_the_session_is_refused(slew):
    slew(50, (0.5, 1.0), joints=True)
    words = r'^\d+ of \d+ static dwells and turns are left out: the stamps run at another pace'
    with pytest.raises(NotObservable, match=words):
        fed(World(), NAVIGATION, find_terms=True).finish()


@pytest.mark.parametrize('percent', [1, again(-30)])
def test_a_sample_rate_that_changes_is_named_and_puts_nothing_off(percent, monkeypatch):
    """Nothing was said, and moves were timed by the mean interval, half a percent off."""

    def blocks(world, unit, seed):
        of_table, of_imu = recorded(world, unit, seed)
        count = len(of_imu.stamp)
        change = round(0.62 * count)
        later = np.arange(change, count, 1 + percent / 100)
        number = np.concatenate([np.arange(change), later])
        stamp = np.rint(of_imu.stamp[0] + 1e9 / unit.rate * number).astype(np.int64)
        total = np.cumsum(np.hstack([of_imu.gyro, of_imu.accel]), axis=0)
        # Between samples only a coarser unit may be read so: the arcs of forces that turn are cut.
        read = np.stack([np.interp(number, np.arange(count), one) for one in total.T], axis=1)
        pulses = np.diff(np.rint(read), axis=0, prepend=0)
        return of_table, ImuBlock(stamp, pulses[:, :3], pulses[:, 3:])

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    found = fed(World(dwell=20.0), MEDIUM, find_terms=True).finish().calibration
    off = errors(found, MEDIUM)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    later = f'{100 / (1 + percent / 100):.4g}'
    assert any(f'sample rate changes from 100 to {later} Hz' in one for one in found.findings)


@pytest.mark.parametrize(('grade', 'seed'), [('medium', 3), ('navigation', 1), ('navigation', 3)])
def test_a_sample_rate_that_changes_within_a_dwell_or_a_turn_widens_nothing(grade, seed):
    """K_a was known to 300 ppm alone, and places of accelerometers were found."""
    name, of = 'sample rate changes by 1 %', (grade, seed, load_table('three_axis'))
    found, sound = (fed_with(one, *of)[0].finish().calibration for one in (name, 'nothing'))
    off = errors(found, FAULT_GRADES[grade])
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert found.parameters[24:] == sound.parameters[24:] == ()
    assert (found.std[:24] < 2 * sound.std[:24]).all()
    assert not any('Outlier' in one for one in found.findings)
    assert any('sample rate changes from 100 to 101 Hz' in one for one in found.findings)


# Samples that share a stamp, as drivers give them that stamp what one transfer brings


START = 1_700_000_000 * 10**9


def stamps(seconds: Floats) -> Stamps:
    return START + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


def taken(
    stamp: Stamps, values: Floats, rate: float | None = 100.0, cuts: tuple[int, ...] = ()
) -> tuple[Stamps, Floats, Stamps, SharedStamps]:
    """What becomes of a stream that comes in pieces."""
    shared = SharedStamps(rate)
    edges = [0, *cuts, len(stamp)]
    pieces = [shared.separate(stamp[a:b], values[a:b]) for a, b in pairwise(edges)]
    one, two, three = (np.concatenate(part) for part in zip(*pieces, strict=True))
    return one, two, three, shared


def transfers(count: int, size: int, rate: float, wait: float = 0.0) -> Floats:
    """When samples come so many at a time; all of half a second at once if one waits so long."""
    made = np.arange(1, count + 1) / rate
    came = made[np.minimum((np.arange(count) // size + 1) * size, count) - 1]
    held = came[count // 2] + wait
    return np.where((came >= came[count // 2]) & (came < held), held, came)


NOISE = np.random.default_rng(1).standard_normal((2000, 6))
PULSES = np.random.default_rng(2).poisson(0.2, (2000, 6)).astype(float)


@pytest.mark.parametrize('stated', [True, False])
@pytest.mark.parametrize('values', [NOISE, PULSES])
@pytest.mark.parametrize(('size', 'rate'), [(2, 100.0), (10, 100.0), (10, 1000.0), (50, 400.0)])
def test_samples_of_one_transfer_are_set_apart(size, rate, values, stated):
    """Also where coarse values of neighbours are often alike."""
    stamp = stamps(transfers(2000, size, rate, 0.3))
    apart, kept, repeats, shared = taken(stamp, values, rate if stated else None)
    # Before the first transfers have ended nothing tells how often neighbours are alike.
    assert len(repeats) <= (0 if values is NOISE else 2)
    assert len(apart) == 2000 - len(repeats)
    assert np.diff(apart).min() >= 1
    assert (apart - stamp[np.isin(values, kept).all(axis=1)][: len(apart)] >= 0).all()
    assert ' samples came with the stamp of the previous one, up to ' in shared.words()[0]


def test_what_comes_twice_is_dropped_and_what_is_too_much_is_not_set_apart():
    made = stamps(0.01 * np.arange(2000))
    for values in (NOISE, PULSES, np.zeros((2000, 6))):
        twice = np.sort(np.append(np.arange(2000), [7, 300, 301, 1500]))
        apart, _, repeats, shared = taken(made[twice], values[twice])
        assert apart.tolist() == made.tolist()
        assert repeats.tolist() == made[[7, 300, 301, 1500]].tolist()
        assert shared.words() == []
    # Two devices on one topic, and a sample too many: as far as the rate tells.
    both = np.repeat(np.arange(1000), 2)
    apart, _, repeats, shared = taken(made[both], NOISE)
    assert len(repeats) == 0
    assert shared.count <= 1
    one = np.sort(np.append(np.arange(1999), 900))
    assert taken(made[one], NOISE)[3].count == 0


def test_how_a_stream_was_cut_does_not_matter():
    rng = np.random.default_rng(3)
    for trial in range(60):
        rate = float(rng.choice([50, 100, 400, 1000]))
        size = int(rng.choice([1, 2, 5, 20, 50]))
        came = transfers(2000, size, rate, 0.3 * (trial % 2))
        if trial % 3 == 0:
            came = np.floor(came / 0.0156) * 0.0156
        kept = np.sort(np.append(np.flatnonzero(rng.random(2000) > 0.01), rng.choice(2000, 20)))
        stamp, values = stamps(came[kept]), (NOISE, PULSES)[trial % 2][kept]
        whole = taken(stamp, values, rate)
        cuts = tuple(np.sort(rng.choice(len(stamp), 50, replace=False)).tolist())
        for one, other in zip(whole[:3], taken(stamp, values, rate, cuts)[:3], strict=True):
            assert (one == other).all()


# Sessions


def sharing(block: ImuBlock, size: int) -> ImuBlock:
    """What one transfer brings has the stamp of its last sample."""
    last = np.minimum((np.arange(len(block)) // size + 1) * size, len(block)) - 1
    return replace(block, stamp=block.stamp[last])


@pytest.mark.parametrize('size', [5, 20])
def test_a_session_of_a_second_simulation_is_as_good_as_without(monkeypatch, size):
    feed = Calibrator.add_block

    def share(self, block):
        feed(self, sharing(block, size) if isinstance(block, ImuBlock) else block)

    monkeypatch.setattr(Calibrator, 'add_block', share)
    found = fed(World(), MEDIUM).finish().calibration
    off = errors(found, MEDIUM)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert len([f for f in found.findings if 'came with the stamp' in f]) == 1
    assert not [f for f in found.findings if 'left out' in f or 'missing' in f]


def by_hand(size: int) -> Iterator[ImuBlock]:
    """A unit that is turned by hand; how many samples share a stamp."""
    held = as_planned(load_plan('six_position_by_hand'), np.random.default_rng([5, 1]))
    blocks = list(held.blocks(HELD, TRUTH, SITE, ImuOptions(bias_instability=False), 5))
    whole = ImuBlock(
        np.concatenate([b.stamp for b in blocks]),
        np.concatenate([b.gyro for b in blocks]),
        np.concatenate([b.accel for b in blocks]),
    )
    yield sharing(whole, size)


SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
WALKS = TriadSpec(random_walk=0.1 * DEG / 60), TriadSpec(random_walk=0.03 / 60)
HELD = ImuSpec('held', Units.SI, 100.0, *WALKS)
TRUTH = Calibration.load(named_file('truths', 'mems_counts')).model


def test_a_session_in_the_hand_is_as_good_as_without():
    def solved(blocks):
        calibrator = Calibrator(Setup(HELD, load_plan('six_position_by_hand'), None, SITE))
        for block in blocks:
            calibrator.add_block(block)
        return calibrator.finish().calibration

    alone, shared = solved(list(by_hand(1))), solved(list(by_hand(10)))
    assert len([f for f in shared.findings if 'up to 10 with one stamp' in f]) == 1
    assert len(shared.findings) == len(alone.findings) + 1
    assert np.abs((shared.values - alone.values) / alone.std)[:24].max() < 0.5
    # Live samples come a few at a time.
    pieces = [b for _, b in recut([('imu', b) for b in by_hand(10)], 3)]
    assert solved(pieces).to_yaml() == shared.to_yaml()
