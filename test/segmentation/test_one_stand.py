"""A table of one joint with a unit on it, sample by sample: what of it is found, and when."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.stream import (
    NS,
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    SkewBlock,
    Units,
)
from imu_calib.common.units import DEG
from imu_calib.segmentation import segmenter
from imu_calib.segmentation.segmented import Segmented
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.table import Joint, Table

START = 1_700_000_000 * 10**9  # 2023-11-14 22:13:20
BENCH = Table('bench', (Joint('j', (0.0, 0.0, 1.0)),))
IDEAL = ImuSpec('ideal', Units.SI, 100.0, TriadSpec(), TriadSpec())

# When it begins, s; rate, deg/s; how long a ramp takes, s; how long it turns at the rate, s.
MOTIONS = ((5.0, 60.0, 1.0, 13.0), (25.0, -30.0, 0.5, 2.0), (33.0, 30.0, 0.5, 2.0))
SECONDS = 40.0


def angle(time: Floats, motions: Any = MOTIONS) -> Floats:
    """Of the joint, rad."""
    total = np.zeros_like(time)
    for begin, rate, ramp, plateau in motions:
        since = np.clip(time - begin, 0, 2 * ramp + plateau)
        up, level = np.minimum(since, ramp), np.clip(since - ramp, 0, plateau)
        down = np.clip(since - ramp - plateau, 0, ramp)
        total += rate * DEG * (up**2 / (2 * ramp) + level + down - down**2 / (2 * ramp))
    return total


def unit(motions: Any = MOTIONS, ahead: float = 0.0) -> ImuBlock:
    """Z up on the joint, at 100 Hz; rates are means over the sample."""
    time = np.arange(round(SECONDS * 100) + 1) * 0.01
    gyro = np.zeros((len(time) - 1, 3))
    gyro[:, 2] = np.diff(angle(time, motions)) / 0.01
    stamp = START + np.arange(1, len(time)) * 10_000_000 + round(ahead * 1e9)
    return ImuBlock(stamp, gyro, np.tile([0.0, 0.0, 9.8], (len(gyro), 1)))


def joint(motions: Any = MOTIONS) -> JointBlock:
    """The encoder at 50 Hz."""
    time = np.arange(round(SECONDS * 50) + 1) * 0.02
    position = angle(time, motions)[:, None]
    stamp = START + np.arange(len(time)) * 20_000_000
    return JointBlock(stamp, ('j',), position, np.zeros_like(position))


def found(*blocks: Block, spec: ImuSpec = IDEAL, table: Table | None = BENCH) -> Segmented:
    reader = Segmenter(spec, table)
    for block in blocks:
        reader.add_block(block)
    return reader.finish()


def since(stamp: float) -> float:
    return round((stamp - START) * 1e-9, 4)


def rests(session: Segmented) -> list[tuple[float, float]]:
    return [(since(s.start), since(s.end)) for s in session.segments]


def only(block: ImuBlock, kept: Any) -> ImuBlock:
    return ImuBlock(block.stamp[kept], block.gyro[kept], block.accel[kept])


def when(block: ImuBlock) -> Floats:
    return np.asarray((block.stamp - START) * 1e-9)


def gyros(change: Callable[[Floats, Floats], None]) -> ImuBlock:
    """The unit with other rates: they are changed by time."""
    block = unit()
    rates = block.gyro.copy()
    change(rates, when(block))
    return replace(block, gyro=rates)


# Of a motion that begins at 5.00 s: 0.012 deg at 5.02 s are within 0.05 deg/s of the quarter of a
# second before, from 4.76 s on. Of one that ends at 20.00 s what it lasts on the ramp hides a move
# of 0.2 deg until 20.18 s.
RESTS = [(0.01, 4.76), (20.19, 24.76), (28.18, 32.75), (36.18, 39.99)]


@pytest.mark.parametrize('cut', [4000, 700, 33])
def test_rests_turns_and_moves_are_found_however_they_come_in(cut):
    imu, states = unit(), joint()
    blocks: list[Block] = []
    for k in range(0, 4000, cut):
        blocks.append(only(imu, slice(k, k + cut)))
        half = slice(k // 2, (k + cut) // 2 if k + cut < 4000 else None)
        part = states.stamp[half], ('j',), states.position[half], states.velocity[half]
        blocks.append(JointBlock(*part))
    session = found(*blocks)
    assert rests(session) == RESTS
    for rest, degrees in zip(session.segments, [0, 840, 765, 840], strict=True):
        assert rest.angles == pytest.approx([degrees * DEG])
        assert rest.attitude is not None
        assert rest.attitude == pytest.approx(BENCH.attitude(np.array([degrees * DEG])), abs=1e-9)
        assert rest.statistics.mean == pytest.approx([0, 0, 0, 0, 0, 9.8], abs=1e-9)
        assert rest.notes == ()
        assert rest.attitude_error == pytest.approx(0.0, abs=1e-12)
    assert [s.statistics.samples for s in session.segments] == [476, 458, 458, 382]
    (turn,) = session.turns
    # 780 deg at 60 deg/s from 6 to 19 s: two turns in the middle.
    assert (since(turn.start), since(turn.end)) == pytest.approx((6.5, 18.5), abs=1e-3)
    assert turn.angle == pytest.approx(4 * np.pi)
    assert turn.seconds == pytest.approx(12.0)
    assert turn.up.tolist() == [0.0, 0.0, 1.0]
    assert turn.statistics.mean[:3] == pytest.approx([0, 0, 60 * DEG])
    assert turn.each is not None
    assert turn.each == pytest.approx(np.array([[0, 0, 60 * DEG]] * 2))
    assert turn.angles == pytest.approx([(30 + 390) * DEG], abs=0.7 * DEG)
    assert (turn.joint, turn.skewed) == (0, None)
    moves = [(since(m.start), since(m.end)) for m in session.moves]
    assert moves == [(4.76, 20.19), (24.76, 28.18), (32.75, 36.18)]
    turned = [m.turned.sum(axis=0) / DEG for m in session.moves]
    assert np.array(turned) == pytest.approx(np.array([[0, 0, 840], [0, 0, -75], [0, 0, 75]]))
    assert [m.duration for m in session.moves] == pytest.approx([15.42, 3.41, 3.42], abs=0.011)
    assert session.moves[0].velocity_steps is not None
    assert session.clock.motions == 3
    assert session.clock.offset == pytest.approx(0.0, abs=1e-5)
    assert (session.samples, session.duration) == (4000, pytest.approx(39.99))
    assert session.start == START + 10_000_000
    assert (session.rejected, session.losses, session.mount_shifts) == ((), (), ())
    assert (session.temperature, session.foreign_joints) == (None, '')


def test_a_clock_that_is_ahead_shifts_all_and_what_came_before_its_first_motion():
    session = found(unit(ahead=0.03), joint())
    assert session.clock.offset == pytest.approx(0.03, abs=1e-5)
    assert rests(session)[0] == (0.04, 4.79)
    assert rests(session)[1:] == [(20.22, 24.79), (28.21, 32.78), (36.21, 40.02)]
    (turn,) = session.turns
    assert since(turn.start) == pytest.approx(6.53, abs=1e-3)


# Samples that are missing


def test_a_few_lost_samples_are_read_from_those_around_them():
    imu = unit()
    time = when(imu)
    session = found(only(imu, (time < 10) | (time > 10.055)), joint())
    assert session.losses == (
        '6 IMU samples are missing (0.15 %), a few at a time: their values are interpolated '
        'from those around them',
    )
    assert len(session.turns) == 1
    assert session.turns[0].statistics.mean[2] == pytest.approx(60 * DEG)
    assert session.moves[0].turned.sum(axis=0) == pytest.approx([0, 0, 840 * DEG])
    resting = found(only(imu, abs(time - 2) > 0.001), joint())
    assert resting.losses[0].startswith('1 IMU sample is missing (0.025 %)')
    assert resting.segments[0].statistics.missing == 1
    # Samples beside a motion are counted once.
    beside = found(only(imu, (abs(time - 4.5) > 0.001) & (abs(time - 20.5) > 0.001)), joint())
    assert beside.losses[0].startswith('2 IMU samples are missing')


def test_many_lost_samples_end_a_turn_and_a_move():
    imu = unit()
    time = when(imu)
    session = found(only(imu, (time < 10) | (time > 10.2)), joint())
    assert session.turns == ()
    (gone,) = session.rejected
    assert (since(gone.start), since(gone.end)) == pytest.approx((6.5, 18.5), abs=1e-3)
    assert gone.reason == 'IMU samples are missing within it'
    assert gone.turn
    assert len(session.moves) == 2


def test_a_second_without_samples_is_an_interruption():
    imu = unit()
    time = when(imu)
    session = found(only(imu, (time < 22.005) | (time > 23.995)), joint())
    assert session.losses == (
        'The IMU stream was interrupted: 2.0 s are missing, from 2023-11-14 22:13:42.000 UTC',
    )
    assert session.segments[1].notes == ('199 samples missing in 1 gap',)
    assert len(session.moves) == 3
    for gap, said in ((1.0, 0), (1.01, 1)):
        brief = found(only(imu, (time < 22.005) | (time > 21.995 + gap)), joint())
        assert len(brief.losses) == said
    # Between two blocks as well.
    parts = only(imu, time < 22.005), only(imu, time > 23.995)
    assert found(parts[0], parts[1], joint()).losses == session.losses


def test_a_silence_after_the_table_was_stopped_is_no_fault_of_the_stream():
    imu = unit()
    time = when(imu)
    silent = only(imu, (time < 22.005) | (time > 23.995))

    def losses(*modes):
        stated = [
            Setpoint(START + seconds * NS, 'p', 0, '1', mode, ('j',), (0.0,), (0.0,), 0.0, 1.0)
            for seconds, mode in modes
        ]
        return found(silent, joint(), SetpointBlock(tuple(stated))).losses

    hold, go = Mode.HOLD, Mode.POSITION
    assert losses((0, hold), (1, go), (21, hold), (60, go)) == (
        'The session was stopped and resumed: 2.0 s are missing, from 2023-11-14 22:13:42.000 UTC',
    )
    for modes in ([(0, hold)], [(0, hold), (1, go)], [(1, go), (24, hold)]):
        (text,) = losses(*modes)
        assert text.startswith('The IMU stream was interrupted: 2.0 s')


@pytest.mark.parametrize('count', [3, 4])
def test_many_interruptions_are_counted(count):
    imu = unit()
    time = when(imu)
    lost = np.zeros(len(time), bool)
    for k in range(count):
        lost |= (time > 3.005 + 5 * k) & (time < 4.995 + 5 * k)
    losses = found(only(imu, ~lost), joint()).losses
    if count == 3:
        assert [one.partition(':')[0] for one in losses] == ['The IMU stream was interrupted'] * 3
        return
    assert losses == (
        'The IMU stream has 4 interruptions, 8.0 s in all, the first at 2023-11-14 22:13:23.000 '
        'UTC',
    )


def test_a_clock_that_was_set_parts_a_rest():
    imu = unit()
    later = imu.stamp + 4_000_000 * (when(imu) > 22)
    session = found(replace(imu, stamp=later), joint())
    assert rests(session)[1:3] == [(20.19, 22.0), (22.014, 24.754)]
    assert session.losses == (
        'The stamps of the IMU are offset from the sampling grid 1 time, first at 2023-11-14 '
        '22:13:42.014 UTC: its clock was set, or it restarted sampling; the data before and after '
        'are used separately',
    )
    turning = found(replace(imu, stamp=imu.stamp + 4_000_000 * (when(imu) > 10)), joint())
    assert 'first at 2023-11-14 22:13:30.014 UTC' in turning.losses[0]
    assert turning.rejected[0].reason == 'IMU samples are missing within it'


def test_what_is_no_sample_is_counted():
    imu = unit()
    broken = imu.gyro.copy()
    broken[[100, 101]] = np.nan
    session = found(replace(imu, gyro=broken), joint())
    assert session.losses[0] == (
        '2 samples left out for values that are not numbers (NaN or infinite), the first at '
        '2023-11-14 22:13:21.010 UTC'
    )
    twice = only(imu, np.sort(np.append(np.arange(4000), [100, 300])))
    assert found(twice, joint()).losses == (
        '2 samples dropped as duplicates, the first at 2023-11-14 22:13:21.010 UTC',
    )
    back = imu.stamp.copy()
    back[200] -= 10**9
    assert found(replace(imu, stamp=back), joint()).losses[0] == (
        '1 sample left out for stamps that jump or stand still, the first at '
        '2023-11-14 22:13:21.010 UTC'
    )
    states = joint()
    silent = states.position.copy()
    silent[50] = np.nan
    assert found(imu, replace(states, position=silent)).losses == (
        '1 sample left out for joint positions that are not numbers, the first at 2023-11-14 '
        '22:13:21.000 UTC',
    )


# Turns that do not count


def test_ramps_alone_are_no_turn():
    motions = ((5.0, 60.0, 5.0, 4.0),)
    session = found(unit(motions), joint(motions))
    assert session.turns == ()
    (gone,) = session.rejected
    # Four seconds: ramps of round numbers are no steps of the encoder, in which they could hide.
    assert gone.reason == (
        'the joint states show 60 deg/s for 240 deg, less than a whole turn: the rest is ramps '
        '(run more turns, a slower rate or faster ramps)'
    )
    assert gone.turn
    # Less than a turn and a quarter was none to begin with.
    small = ((5.0, 60.0, 3.0, 4.4),)
    assert found(unit(small), joint(small)).rejected == ()


def test_rests_beside_a_motion_that_gyros_do_not_see_are_left_out():
    def blind(rates, time):
        within = (time > 24) & (time < 29)
        # Noise below what is looked for: a unit that repeats one sample is frozen, not blind.
        rates[within] = 1e-9 * (np.arange(within.sum()) % 2)[:, None]

    session = found(gyros(blind), joint())
    assert rests(session) == [RESTS[0], (36.18, 39.99)]
    assert [since(r.start) for r in session.rejected] == [20.19, 28.19]
    assert {r.reason for r in session.rejected} == {
        'the gyros do not show the motion next to it that the joint states show (clocks that jump, '
        'or are about a second apart)'
    }

    def dull(rates, time):
        rates[:] = rates / 3

    # Where all motions are smaller, it is the scale factor.
    assert len(found(gyros(dull), joint()).segments) == 4


# Shocks


def test_a_shock_that_leaves_the_unit_turned_parts_a_rest():
    def struck(rates, time):
        # Noise of one sign and the other: the smallest step between values is taken for a code.
        rates[::2, 2] += 1e-6
        rates[(time > 22.005) & (time < 22.105), 2] += 5 * DEG

    session = found(gyros(struck), joint())
    (shift,) = session.mount_shifts
    assert shift.angle == pytest.approx(0.5 * DEG, rel=1e-6)
    # Windows of half a second from 20.19 s on: the fourth, from 21.69 s on, holds the shock.
    assert since(shift.instant) == pytest.approx(21.69, abs=0.51)
    assert len(session.segments) == 5
    assert session.segments[1].end < shift.instant <= session.segments[2].start


# The unit alone


def test_without_a_table_gyros_tell_rests_from_motions():
    session = found(unit(), table=None)
    # Windows of a tenth of a second: the second still one begins a rest.
    assert rests(session) == [(0.12, 5.0), (20.12, 25.0), (28.12, 33.0), (36.12, 40.0)]
    assert [s.attitude for s in session.segments] == [None] * 4
    whole, back, there = session.motions
    assert (since(whole.start), since(whole.end)) == (5.0, 20.11)
    assert whole.turned == pytest.approx([0, 0, 840 * DEG])
    assert back.turned == pytest.approx([0, 0, -75 * DEG])
    assert there.turned == pytest.approx([0, 0, 75 * DEG])
    time = np.linspace(25.0, 28.11, 30001)
    phase = np.exp(-1j * (angle(time) - angle(time)[0])).mean()
    assert back.mean_phase == pytest.approx(phase, abs=1e-3)
    assert back.statistics.mean[2] == pytest.approx(-75 * DEG / 3.11)
    assert [m.velocity_steps for m in session.moves] == [None] * 3
    assert [(since(m.start), since(m.end)) for m in session.moves] == [
        (5.0, 20.12),
        (25.0, 28.12),
        (33.0, 36.12),
    ]


def test_how_still_it_stands_is_known_as_it_comes_in():
    reader = Segmenter(IDEAL, None)
    assert (reader.still, reader.quietest) == (None, None)
    imu = unit(())
    reader.add_block(only(imu, slice(0, 255)))
    assert reader.quietest is None
    reader.add_block(only(imu, slice(255, 4000)))
    # The last samples wait for those that show them sound, 0.7 s, and half a minute ahead is
    # looked at.
    assert reader.still == (START + 110_000_000, START + 9_200_000_000)
    assert reader.quietest.rate == pytest.approx(0.0, abs=1e-12)
    assert Segmenter(IDEAL, BENCH).still is None


def test_a_long_rest_is_cut_so_that_memory_stays_bounded(monkeypatch):
    monkeypatch.setattr(segmenter, '_LONGEST_REST', 1500)
    for table, blocks in ((BENCH, [unit(()), joint(())]), (None, [unit(())])):
        session = found(*blocks, table=table)
        begin = 0.01 if table else 0.12
        assert rests(session)[0][0] == begin
        assert [s.statistics.samples for s in session.segments] == [
            1500,
            1500,
            4000 - 3000 - (0 if table else 11),
        ]
        for one, other in zip(session.segments, session.segments[1:], strict=False):
            assert other.start - one.end == 10_000_000


# A skewed gyro

SKEWED = replace(IDEAL, skewed=TriadSpec())


def skew(scale: float = 0.5) -> SkewBlock:
    imu = unit()
    return SkewBlock(imu.stamp, scale * imu.gyro[:, 2])


def test_a_skewed_gyro_is_read_in_turns():
    session = found(unit(), skew(), joint(), spec=SKEWED)
    (turn,) = session.turns
    assert turn.skewed.mean[0] == pytest.approx(30 * DEG)
    assert turn.each is not None
    assert turn.each == pytest.approx(np.array([[0, 0, 60 * DEG, 30 * DEG]] * 2))
    whole = skew()
    for kept in (
        (whole.stamp < START + 10 * 10**9) | (whole.stamp > START + 10.2 * 10**9),
        whole.stamp > START + 9 * 10**9,
        whole.stamp < START + 15 * 10**9,
    ):
        part = SkewBlock(whole.stamp[kept], whole.gyro[kept])
        (turn,) = found(unit(), part, joint(), spec=SKEWED).turns
        assert turn.skewed is None
        assert turn.each.shape == (2, 3)
    narrow = replace(SKEWED, skewed=TriadSpec(range=29 * DEG))
    assert found(unit(), skew(), joint(), spec=narrow).turns[0].skewed is None
