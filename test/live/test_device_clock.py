"""Stamps over lost frames, busy hosts and clocks that are set, at a USB adapter's latencies."""

import re
from functools import cache

import numpy as np
import pytest
from device_frames import NANOSECONDS, frame, kvh, stim

from imu_calib.live.devices.clock import DeviceClock
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.fields import FrameCounter, Number
from imu_calib.live.devices.format import load_format
from imu_calib.live.devices.health import Health
from imu_calib.live.devices.source import DeviceReader
from imu_calib.live.rules import Severity

NS = 1_000_000_000
MS = 1_000_000
BUNCH = 16 * MS
"""An FTDI adapter holds bytes back for so long."""
CATCH_UP = 100 * MS + 2 * BUNCH
"""A tenth of a second tells missing frames from a busy host; a bunch ends it, and one begins it."""
START = 1_000 * NS
COUNTER = FrameCounter(Number('u', 4, 2, '<'), 2**32)
SHORT = FrameCounter(Number('u', 1, 29, '>'), 128)
SET_BACK = r"The host's clock was set; stamps follow it \(by -20 s, (\S+) s after the first"
SENT = {
    # No frame is that of a turn before: noise sees to that.
    'kvh_1750': (1000, lambda k: kvh(k, rates=(k, 0.0, 0.0))),
    'stim300': (500, lambda k: stim(4 * k, angles=(k, -k, 0))),
}


def times(seconds, rate):
    """Steady times, ns, at which samples are made."""
    return START + np.arange(round(seconds * rate)) * NS // rate


def bunched(made, seed=5):
    """Steady times at which they are read: 16 ms together, late by 1 ms and what the host takes."""
    ends = -(-(made + 1) // BUNCH) * BUNCH
    numbers = np.unique(ends, return_inverse=True)[1]
    late = np.random.default_rng(seed).exponential(0.3 * MS, numbers.max() + 1).astype(np.int64)
    return np.maximum.accumulate(ends + MS + late[numbers])


def delivered(arrival):
    """Slices of what is read together."""
    places = np.flatnonzero(np.diff(arrival, prepend=arrival[0] - 1))
    return [slice(*ends) for ends in zip(places, [*places[1:], len(arrival)], strict=True)]


def stamped(clock, made, arrival, *, time=None, counter=None, set_by=None):
    """Stamps of samples fed as they are read; with `set_by` the host's clock is not the steady one.

    Args:
        clock: Under test.
        made: (n,) unused but for its length.
        arrival: (n,) steady times.
        time: (n,) device time.
        counter: (n,) frame counter.
        set_by: (n,) how far the host's clock is ahead of the steady one at the arrival, ns.
    """
    parts = []
    for part in delivered(arrival):
        steady = arrival[part]
        columns = [None if column is None else column[part] for column in (time, counter)]
        if set_by is None:
            parts.append(clock.elapsed_times(*columns, steady))
        else:
            elapsed = clock.elapsed_times(*columns, steady + set_by[part], steady)
            parts.append(elapsed + clock.set_by)
    clock.settle()
    return clock.offset + np.concatenate(parts)


# --- frames that are lost ----------------------------------------------------------------------


@cache
def sent(name, k):
    return SENT[name][1](k)


def received(name, numbers, rate):
    """Decode hand-made frames of a device whose counter is short; return stamps and the rest."""
    made = START + numbers * NS // rate
    arrival = bunched(made)
    form = load_format(name)
    decoder, clock = Decoder(form), DeviceClock(form.time, form.counter, 1 / rate)
    frames = [sent(name, k) for k in numbers.tolist()]
    parts = []
    for part in delivered(arrival):
        samples = decoder.decode_bytes(b''.join(frames[part]))
        parts.append(
            clock.elapsed_times(samples.time, samples.counter, arrival[part], arrival[part])
        )
    clock.settle()
    return made, clock.offset + np.concatenate(parts), clock, decoder.counts


@pytest.mark.parametrize('name', SENT)
@pytest.mark.parametrize(
    'milliseconds', [2, 60, 66, 100, 126, 128, 130, 150, 190, 192, 194, 240, 256, 258, 1000, 5000]
)
def test_lost_frames_are_counted_and_stamps_are_exact_again(name, milliseconds):
    rate = SENT[name][0]
    lost = milliseconds * rate // 1000
    # A window of delays before the gap, and after it five times what the clock needs to be sure.
    first = 2 * rate + 107
    numbers = np.r_[0:first, first + lost : first + lost + 7 * rate // 10]
    made, stamps, clock, counts = received(name, numbers, rate)
    assert counts.lost + clock.unseen == lost
    right = made - made[first] >= CATCH_UP
    right[:first] = True
    # One delay for all, to the nanosecond: whole frames and no estimate.
    assert np.ptp((stamps - made)[right]) == 0
    # The millisecond of the way, the least of thirty jitters, and what the last of a bunch waits.
    assert MS <= (stamps - made)[0] < 2 * MS + NS // rate
    assert (np.diff(stamps) > 0).all()


@pytest.mark.parametrize('name', SENT)
def test_gaps_in_sequence_are_all_counted(name):
    rate = SENT[name][0]
    lengths = [190, 130, 240, 128, 200, 150]
    numbers, begin = [], 0
    for gap in lengths:
        numbers.append(np.arange(begin, begin + rate))
        begin += rate + gap * rate // 1000
    numbers = np.concatenate([*numbers, np.arange(begin, begin + rate)])
    made, stamps, clock, counts = received(name, numbers, rate)
    assert counts.lost + clock.unseen == sum(lengths) * rate // 1000
    assert np.ptp((stamps - made)[np.r_[: rate // 2, -rate // 2 : 0]]) == 0


@pytest.mark.parametrize('name', SENT)
@pytest.mark.parametrize('milliseconds', [70, 130, 200, 256, 500, 2000])
def test_a_busy_host_loses_nothing_and_nothing_jumps(name, milliseconds):
    rate = SENT[name][0]
    made = times(5, rate)
    arrival = bunched(made)
    since = arrival[2 * rate]
    waiting = (arrival >= since) & (arrival < since + milliseconds * MS)
    arrival[waiting] = since + milliseconds * MS
    arrival = np.maximum.accumulate(arrival)
    form = load_format(name)
    clock = DeviceClock(None, form.counter, 1 / rate)
    numbers = np.arange(len(made)) * form.counter.step % form.counter.modulus
    stamps = stamped(clock, made, arrival, counter=numbers, set_by=np.zeros_like(made))
    assert (clock.jumps, clock.unseen) == (0, 0)
    assert np.ptp(stamps - made) == 0


def test_two_late_reads_are_no_missing_turn():
    # The host stalls, reads a part of what waits, stalls again; the newest of each is a turn late.
    made = times(4, 1000)
    arrival = bunched(made)
    arrival[2000:2173] = made[2300]
    arrival[2173:2303] = made[2430]
    arrival[2303:] = np.maximum(arrival[2303:], made[2431])
    clock = DeviceClock(None, SHORT, 1e-3)
    numbers = np.arange(len(made)) % 128
    stamps = stamped(clock, made, arrival, counter=numbers, set_by=np.zeros_like(made))
    assert (clock.jumps, clock.unseen) == (0, 0)
    assert np.ptp(stamps - made) == 0


@pytest.mark.parametrize('kind', ['clock', 'short counter', 'long counter', 'neither'])
def test_a_line_that_holds_back_for_half_a_second_is_no_jump(kind):
    # By 80 ms: more than the tolerance, and no whole turn of the short counter.
    made = times(5, RATE)
    arrival = bunched(made)
    arrival[2000:2500] += 80 * MS
    arrival = np.maximum.accumulate(arrival)
    clock = DeviceClock(*KINDS[kind], 1 / RATE)
    stamps = stamped(clock, made, arrival, **columns(kind, made), set_by=np.zeros_like(made))
    assert clock.jumps == 0
    assert np.ptp(stamps - made) == 0


def test_a_gap_that_the_counter_cannot_tell_is_said_and_stamps_begin_anew():
    # Ten minutes without a frame; the device is 100 ppm slow: 60 ms, half a turn of the counter.
    rate = 1000
    numbers = np.r_[0:3000, 603_000:607_000]
    made = START + (numbers * NS / rate * (1 + 1e-4)).astype(np.int64)
    arrival = bunched(made)
    clock = DeviceClock(None, SHORT, 1 / rate)
    stamps = stamped(clock, made, arrival, counter=numbers % 128, set_by=np.zeros_like(made))
    assert 'the counter does not show by how much' in clock.last_jump.reason
    assert clock.jumps == 1
    right = np.r_[0:3000, 4100:7000]
    # The least delay of a second of bunches; 100 ppm of four seconds.
    assert abs(stamps - made - 2 * MS)[right].max() < 2 * MS


def test_frames_lost_for_a_whole_turn_are_counted_once_where_a_clock_tells_the_time():
    made = times(4, 1000)
    # 127 are missing: the same count again, in another frame, which the decoder counts.
    kept = np.r_[0:2000, 2127:4000]
    clock = DeviceClock(NANOSECONDS, SHORT, None)
    stamps = stamped(clock, made[kept], bunched(made)[kept], time=made[kept], counter=kept % 128)
    assert np.ptp(stamps - made[kept]) == 0
    assert (clock.jumps, clock.unseen) == (0, 0)


# --- the host's clock is set -------------------------------------------------------------------

KINDS = {
    'clock and counter': (NANOSECONDS, COUNTER),
    'clock': (NANOSECONDS, None),
    'short counter': (None, SHORT),
    'long counter': (None, COUNTER),
    'neither': (None, None),
}
SETTINGS = {
    '20 s back': [-20.0],
    '20 s forth': [20.0],
    'an hour back and forth': [-3600.0, 3600.0],
    'NTP steps': [0.2, -0.2, 0.13, -0.3],
    'a turn of the counter': [0.128, -0.128],
    'again and again': [-20.0, -20.0, 0.2, 3600.0, -0.2, 20.0],
}
RATE = 1000
APART = 2


def setting(steps, rate=RATE):
    """Samples, their arrival, how far the host's clock is set then, and where it is set."""
    made = times(APART * (len(steps) + 1), rate)
    arrival = bunched(made)
    set_by = np.zeros(len(made), np.int64)
    for k, step in enumerate(steps):
        set_by[arrival >= START + (k + 1) * APART * NS] += round(step * NS)
    return made, arrival, set_by, (np.flatnonzero(np.diff(set_by)) + 1).tolist()


def columns(kind, made):
    form, counter = KINDS[kind]
    numbers = np.arange(len(made))
    return {
        'time': None if form is None else made - 77 * NS,
        'counter': None if counter is None else numbers % counter.modulus,
    }


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('steps', SETTINGS.values(), ids=SETTINGS)
def test_stamps_follow_the_hosts_clock_at_once_where_a_steady_one_shows_its_steps(kind, steps):
    made, arrival, set_by, places = setting(steps)
    clock = DeviceClock(*KINDS[kind], 1 / RATE)
    stamps = stamped(clock, made, arrival, **columns(kind, made), set_by=set_by)
    # To the nanosecond, from the first sample that arrived after each step.
    assert np.ptp(stamps - made - set_by) == 0
    back = [k - 1 for k, step in zip(places, steps, strict=True) if step < 0]
    assert np.flatnonzero(np.diff(stamps) <= 0).tolist() == back
    assert clock.jumps == len(steps)
    assert clock.last_jump.seconds == pytest.approx(steps[-1])
    assert "host's clock was set" in clock.last_jump.reason
    assert clock.unseen == 0


@pytest.mark.parametrize('kind', ['clock and counter', 'clock', 'long counter', 'neither'])
@pytest.mark.parametrize('steps', SETTINGS.values(), ids=SETTINGS)
def test_without_a_steady_clock_stamps_follow_after_a_second(kind, steps):
    made, arrival, set_by, places = setting(steps)
    clock = DeviceClock(*KINDS[kind], 1 / RATE)
    stamps = stamped(clock, made, arrival + set_by, **columns(kind, made))
    error = abs(stamps - made - set_by)
    open_ = np.zeros(len(made), bool)
    for place in places:
        open_ |= (arrival >= arrival[place]) & (arrival < arrival[place] + NS + 2 * BUNCH)
    # A millisecond of the way, and the last of a bunch; begun anew within a bunch.
    assert error[~open_].max() < 2 * MS + BUNCH
    back = [k - 1 for k, step in zip(places, steps, strict=True) if step < 0]
    assert set(np.flatnonzero(np.diff(stamps) <= 0).tolist()) <= set(back)
    assert clock.jumps == len(steps)


def test_lost_frames_and_a_step_at_once_are_both_right():
    made, arrival, set_by, (place,) = setting([-20.0])
    kept = np.r_[0:place, place + 190 : len(made)]
    clock = DeviceClock(None, SHORT, 1 / RATE)
    stamps = stamped(clock, made[kept], arrival[kept], counter=kept % 128, set_by=set_by[kept])
    assert clock.unseen == 128
    right = np.r_[0:place, place + 140 : len(kept)]
    assert np.ptp((stamps - made[kept] - set_by[kept])[right]) == 0


@pytest.mark.parametrize('kind', KINDS)
def test_a_clock_that_is_slewed_is_a_drift_and_no_step(kind):
    # NTP takes 0.2 s back at 500 ppm: the steady clock of the host runs slower with the other.
    made = times(60, 100)
    arrival = bunched(made)
    slewed = arrival - ((arrival - START) * 500e-6).astype(np.int64)
    clock = DeviceClock(*KINDS[kind], 1 / 100)
    ahead = np.full(len(made), 10**18, np.int64)
    stamps = stamped(clock, made, slewed, **columns(kind, made), set_by=ahead)
    assert clock.jumps == 0
    assert (np.diff(stamps) == NS // 100).all()
    # 28 windows of 2 s; the least of 125 bunches scatters by a few microseconds.
    assert clock.drift.ppm == pytest.approx(500, abs=5)


def test_a_reading_that_is_interrupted_is_no_step():
    made, arrival, set_by, _ = setting([])
    set_by[1000:1016] += 5 * MS
    clock = DeviceClock(NANOSECONDS, COUNTER, None)
    stamps = stamped(clock, made, arrival, **columns('clock and counter', made), set_by=set_by)
    assert clock.jumps == 0
    assert np.ptp(stamps - made) == 0


def test_a_clock_that_is_set_is_an_error_for_ten_seconds_and_then_a_warning(tmp_path):
    made, arrival, set_by, _ = setting([-20.0])
    form = load_format('simulated')
    clock = DeviceClock(form.time, form.counter, 1 / RATE)
    health = Health(form, RATE, 0.5)
    (tmp_path / 'line').write_bytes(b'')
    state = DeviceReader(str(tmp_path / 'line'), lambda: 0).state

    def clock_status(seconds):
        words = health.statuses(state, Decoder(form).counts, clock, START, seconds)
        return next(word for word in words if word.part == 'clock')

    half = len(made) // 3
    data = columns('clock and counter', made)
    for part in (slice(0, half), slice(half, None)):
        before = clock_status(0.0)
        clock.elapsed_times(
            data['time'][part],
            data['counter'][part],
            (arrival + set_by)[part],
            arrival[part],
        )
    assert before.severity is Severity.OK
    assert clock_status(1.0).severity is Severity.ERROR
    # The first sample that was read after the step was made up to a bunch before.
    said_at = re.match(SET_BACK, clock_status(1.0).text)
    assert APART - (BUNCH + 2 * MS) / NS <= float(said_at[1]) <= APART
    assert clock_status(12.0).severity is Severity.WARN


def test_a_device_that_falls_silent_is_found_though_the_hosts_clock_was_set_back():
    form = load_format('simulated')
    health = Health(form, RATE, 0.5)
    samples = Decoder(form).decode_bytes(b'')
    assert not health.silent(START, 0.0)
    samples = Decoder(form).decode_bytes(frame(0, 0, [0] * 6))
    health.add_received(samples, np.array([0]), 44, START, 0.0)
    assert not health.silent(START - 20 * NS, 0.4)
    assert health.silent(START - 20 * NS, 0.6)
