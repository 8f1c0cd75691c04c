"""What comes between samples, what a device says of itself: on bytes by the makers' documents."""

import struct

import numpy as np
import pytest
from device_frames import crc32, cut, described, kvh, mti

from imu_calib.live.devices.clock import DeviceClock
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.format import load_format, read_format
from imu_calib.live.devices.health import Health
from imu_calib.live.devices.source import DeviceReader
from imu_calib.live.rules import Severity

NS = 1_000_000_000
DAY = 864_000_000
"""Ticks of 10 kHz."""


def xbus(identifier, data):
    """A message: preamble, bus, identifier, length, data, and what makes the sum of these zero."""
    message = bytes([0xFF, identifier, len(data)]) + data
    return b'\xfa' + message + bytes([-sum(message) % 256])


def baro(counter):
    """An MTData2 with packet counter and BaroPressure (0x3010), whose rate is another."""
    return xbus(0x36, struct.pack('>HBHHBI', 0x1020, 2, counter % 2**16, 0x3010, 4, 101325))


def status_of(name, *frames):
    """What is said of the status of some frames."""
    form = load_format(name)
    health = Health(form, None, 0.5)
    decoder = Decoder(form)
    samples = decoder.decode_bytes(b''.join(frames))
    assert len(samples) == len(frames)
    health.add_received(samples, np.arange(len(frames)) * 1_000_000, 100, NS, 0.0)
    clock = DeviceClock(form.time, form.counter, 1e-3)
    state = DeviceReader('socket://127.0.0.1:1', lambda: 0).state
    words = health.statuses(state, decoder.counts, clock, NS, 0.0)
    (status,) = (word for word in words if word.part == 'status')
    return status.severity, status.text


def stim(counter, gyro=0, accelerometer=0, gyro_temperature=0, accelerometer_temperature=0):
    """Table 5-20: each cluster of values is followed by its own status byte."""
    body = b'\xa5' + bytes(9) + bytes([gyro]) + bytes(9) + bytes([accelerometer])
    body += bytes(6) + bytes([gyro_temperature]) + bytes(6) + bytes([accelerometer_temperature])
    body += bytes([counter % 256, 0, 0])
    return body + crc32(body + bytes(2))


@pytest.mark.parametrize(
    ('cluster', 'whose'),
    [
        ('gyro', 'gyros start up'),
        ('accelerometer', 'accelerometers start up'),
        ('gyro_temperature', "the gyros' temperatures start up"),
        ('accelerometer_temperature', "the accelerometers' temperatures start up"),
    ],
)
def test_a_stim300_that_starts_up_sends_no_valid_data(cluster, whose):
    assert status_of('stim300', stim(0), stim(4, **{cluster: 1 << 6})) == (
        Severity.ERROR,
        f'The device reports: {whose}.',
    )


@pytest.mark.parametrize('bit', range(8))
@pytest.mark.parametrize('cluster', ['gyro_temperature', 'accelerometer_temperature'])
def test_the_temperatures_of_a_stim300_have_a_status_of_their_own(cluster, bit):
    severity, text = status_of('stim300', stim(0, **{cluster: 1 << bit}))
    # Bits 0 to 2 name the axis of an overload or an error, and say nothing alone.
    assert severity == (Severity.OK if bit < 3 else Severity.ERROR)
    assert bit < 3 or f"{cluster.split('_')[0]}s' temperatures" in text


def test_an_mti_that_did_not_pass_its_self_test_is_said():
    assert status_of('xsens_mti', mti(0, 0, status=3))[0] is Severity.OK
    severity, text = status_of('xsens_mti', mti(0, 0, status=2))
    assert severity is Severity.ERROR
    assert text == 'The device reports: the self-test was not passed.'


# --- the clock of an MTi -----------------------------------------------------------------------


def stamped(lines, arrival, sample_rate=400):
    form = load_format('xsens_mti')
    decoder, clock = Decoder(form), DeviceClock(form.time, form.counter, 1 / sample_rate)
    samples = decoder.decode_bytes(b''.join(lines))
    elapsed = clock.elapsed_times(samples.time, samples.counter, arrival)
    return clock, decoder.counts, elapsed


@pytest.mark.parametrize('turn', [DAY, 2**32])
def test_the_clock_of_an_mti_starts_anew_after_a_day_or_after_32_bits(turn):
    ticks = (turn - 25 * 500 + 25 * np.arange(1000)) % turn
    arrival = np.arange(1000) * 2_500_000
    clock, _, elapsed = stamped([mti(k, t) for k, t in enumerate(ticks.tolist())], arrival)
    assert (elapsed == arrival).all()
    assert clock.jumps == 0


def test_frames_lost_over_midnight_are_a_gap_and_no_jump():
    kept = np.r_[0:400, 600:1000]
    ticks = (DAY - 25 * 500 + 25 * kept) % DAY
    arrival = kept * 2_500_000
    lines = [mti(k, t) for k, t in zip(kept.tolist(), ticks.tolist(), strict=True)]
    clock, counts, elapsed = stamped(lines, arrival)
    assert (elapsed == arrival).all()
    assert (clock.jumps, counts.lost) == (0, 200)


def test_a_clock_of_an_mti_that_is_set_back_is_still_a_jump():
    ticks = 25 * np.arange(1000) + 10_000 * 10
    ticks[500:] -= 10_000
    arrival = np.arange(1000) * 2_500_000
    clock, _, elapsed = stamped([mti(k, t) for k, t in enumerate(ticks.tolist())], arrival)
    assert (elapsed == arrival).all()
    assert clock.jumps == 1
    assert clock.last_jump.seconds == pytest.approx(-1)


# --- messages that are no samples --------------------------------------------------------------


def test_other_messages_of_an_mti_are_no_lost_frames_and_no_damage():
    # Every tenth message tells the pressure; the packet counter counts all of them.
    lines = [baro(k) if k % 10 == 3 else mti(k, 25 * k) for k in range(1000)]
    wake_up, error = xbus(0x3E, b''), xbus(0x42, b'\x29')
    line = b''.join([wake_up, *lines[:500], error, *lines[500:]])
    decoder = Decoder(load_format('xsens_mti'))
    samples = decoder.decode_bytes(line)
    counts = decoder.counts
    assert (counts.frames, counts.others) == (900, 102)
    assert (counts.lost, counts.bad, counts.skipped, counts.restarts) == (0, 0, 0, 0)
    assert (np.diff(samples.counter) == 1).all()


def test_frames_that_are_lost_between_other_messages_are_counted():
    lines = {k: baro(k) if k % 10 == 3 else mti(k, 25 * k) for k in range(65_500, 65_700)}
    for missing in (65_511, 65_512, 65_540, 65_623, 65_624):
        del lines[missing]
    decoder = Decoder(load_format('xsens_mti'))
    decoder.decode_bytes(b''.join(lines.values()))
    # 65 623 is a pressure: nobody can know that from here, and a count is missing all the same.
    assert decoder.counts.lost == 5


def test_a_jump_is_not_made_of_many_other_messages_in_a_row():
    order = [mti(k, 25 * k) for k in range(100)] + [baro(k) for k in range(100, 140)]
    order += [mti(k, 25 * (k - 40)) for k in range(140, 400)]
    decoder = Decoder(load_format('xsens_mti'))
    samples = decoder.decode_bytes(b''.join(order))
    form = load_format('xsens_mti')
    clock = DeviceClock(form.time, form.counter, 1 / 400)
    elapsed = clock.elapsed_times(samples.time, samples.counter, np.arange(360) * 2_500_000)
    assert (np.diff(elapsed) == 2_500_000).all()
    assert clock.jumps == 0


@pytest.mark.parametrize('seed', range(5))
def test_how_the_line_is_cut_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    lines = [baro(k) if rng.random() < 0.3 else mti(k, 25 * k) for k in range(300)]
    # Damage, and the beginning of a message that never ends.
    lines[100] = lines[100][:9] + b'\xff' + lines[100][10:]
    lines.insert(200, b'\xfa\xff\x36\xf0')
    line = b''.join(lines)
    whole = Decoder(load_format('xsens_mti'))
    expected = whole.decode_bytes(line)
    decoder = Decoder(load_format('xsens_mti'))
    parts = [decoder.decode_bytes(p) for p in cut(line, rng.integers(0, len(line), 60).tolist())]
    assert np.array_equal(np.concatenate([p.counter for p in parts]), expected.counter)
    assert decoder.counts == whole.counts


def test_a_message_that_is_damaged_is_skipped_bytes():
    bad = baro(1)[:-1] + bytes([baro(1)[-1] ^ 1])
    decoder = Decoder(load_format('xsens_mti'))
    decoder.decode_bytes(mti(0, 0) + bad + mti(2, 50))
    assert (decoder.counts.others, decoder.counts.skipped) == (0, len(bad))
    assert decoder.counts.lost == 1


def test_without_others_in_its_file_a_device_has_none():
    decoder = Decoder(load_format('kvh_1750'))
    decoder.decode_bytes(kvh(0) + baro(1) + kvh(2))
    assert (decoder.counts.others, decoder.counts.lost) == (0, 1)
    assert decoder.counts.skipped == len(baro(1))


def test_messages_of_a_fixed_length_with_a_crc_are_known():
    others = [
        {
            'sync': [0xAA, 0x66],
            'length': 8,
            'checksum': {'kind': 'CRC-16/CCITT-FALSE', 'byte_order': 'big'},
        }
    ]
    import binascii

    from device_frames import frame

    body = b'\xaa\x66info'
    message = body + struct.pack('>H', binascii.crc_hqx(body, 0xFFFF))
    decoder = Decoder(read_format(described(others=others)))
    decoder.decode_bytes(frame(0, 0, [0] * 6) + message + frame(1, 1, [0] * 6))
    counts = decoder.counts
    assert (counts.frames, counts.others, counts.skipped, counts.lost) == (2, 1, 0, 0)
