"""Frames on a line: formats read from YAML, streams that are cut and damaged, clocks that err."""

import binascii
import os
import re
import socket
import struct
import threading
import time

import numpy as np
import pytest
from device_frames import NANOSECONDS, NS, SIMULATED, cut, frame, pseudo_terminal
from hypothesis import given, settings
from hypothesis import strategies as st
from loopback import until

from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.stream import ImuBlock
from imu_calib.common.units import STANDARD_GRAVITY
from imu_calib.live.devices.clock import DeviceClock
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.fields import (
    CATALOGUE,
    Checksums,
    DeviceTime,
    FrameCounter,
    Number,
    Sum,
    Xor,
)
from imu_calib.live.devices.format import load_format, read_format
from imu_calib.live.devices.health import Reception
from imu_calib.live.devices.source import Chunk, DeviceReader, ReaderState
from imu_calib.live.rules import Severity
from imu_calib.session.imu import load_imu
from imu_calib.simulation.frames import pack

FASTCRC = {
    'CRC-8/SMBUS': 'crc8.smbus',
    'CRC-8/MAXIM-DOW': 'crc8.maxim_dow',
    'CRC-16/ARC': 'crc16.arc',
    'CRC-16/CCITT-FALSE': 'crc16.ibm_3740',
    'CRC-16/GENIBUS': 'crc16.genibus',
    'CRC-16/IBM-SDLC': 'crc16.ibm_sdlc',
    'CRC-16/KERMIT': 'crc16.kermit',
    'CRC-16/MODBUS': 'crc16.modbus',
    'CRC-16/SPI-FUJITSU': 'crc16.spi_fujitsu',
    'CRC-16/XMODEM': 'crc16.xmodem',
    'CRC-32': 'crc32.iso_hdlc',
    'CRC-32/BZIP2': 'crc32.bzip2',
    'CRC-32/ISCSI': 'crc32.iscsi',
    'CRC-32/MPEG-2': 'crc32.mpeg_2',
}


def frames(count, first=0, seed=24):
    counts = np.random.default_rng(seed).integers(-(2**31), 2**31, (count, 6))
    return [frame(first + k, k * NS // 1000, row) for k, row in enumerate(counts.tolist())]


def decoded(pieces, form=SIMULATED):
    decoder = Decoder(form)
    return decoder, [decoder.decode_bytes(piece) for piece in pieces]


def counters(blocks):
    return [int(c) for block in blocks for c in block.counter]


@settings(max_examples=20)
@given(st.lists(st.binary(min_size=7, max_size=7), min_size=1, max_size=20), st.integers(0, 3))
@pytest.mark.parametrize('name', CATALOGUE)
def test_every_crc_of_the_catalogue_is_that_of_fastcrc(name, messages, padding):
    family, algorithm = FASTCRC[name].split('.')
    crc = getattr(pytest.importorskip(f'fastcrc.{family}'), algorithm)
    rows = np.frombuffer(b''.join(messages), np.uint8).reshape(-1, 7)
    found = Checksums(CATALOGUE[name], 7, padding).of_rows(rows)
    assert found.tolist() == [crc(m + bytes(padding)) for m in messages]


@given(st.lists(st.binary(min_size=7, max_size=7), min_size=1, max_size=20))
def test_sums_of_many_messages_are_those_of_each(messages):
    rows = np.frombuffer(b''.join(messages), np.uint8).reshape(-1, 7)
    assert Checksums(Sum(16), 7).of_rows(rows).tolist() == [sum(m) for m in messages]
    negated = Checksums(Sum(8, negated=True), 7).of_rows(rows)
    assert all((sum(m) + int(n)) % 256 == 0 for m, n in zip(messages, negated, strict=True))
    folded = Checksums(Xor(0x5A), 7).of_rows(rows).tolist()
    assert folded == [int(np.bitwise_xor.reduce([0x5A, *m])) for m in messages]


def test_what_the_simulation_packs_is_what_the_described_format_reads():
    rng = np.random.default_rng(1)
    counts = rng.integers(-(2**31) + 1, 2**31, (500, 6)).astype(float)
    stamps = 1_700_000_000_000_000_000 + np.arange(500) * 250_000
    celsius = rng.uniform(-40, 85, 500)
    status = rng.integers(0, 2, 500).astype(np.uint16)
    line = pack(ImuBlock(stamps, counts[:, :3], counts[:, 3:]), celsius, 2**32 - 100, status)
    decoder, (samples,) = decoded([line])
    assert (samples.gyro == counts[:, :3]).all()
    assert (samples.accel == counts[:, 3:]).all()
    assert (samples.time == stamps).all()
    assert (samples.faults == status).all()
    np.testing.assert_allclose(samples.celsius, celsius, atol=0.005 + 1e-9)
    assert samples.counter[100] == 0
    assert (decoder.counts.frames, decoder.counts.lost, decoder.counts.restarts) == (500, 0, 0)


@settings(max_examples=60)
@given(st.lists(st.integers(0, 10**6), max_size=40), st.binary(max_size=100), st.integers(0, 900))
def test_any_cut_of_the_stream_gives_the_same_samples_and_counts(places, garbage, where):
    line = b''.join(frames(20))
    line = line[:where] + garbage + line[where:]
    whole, (expected,) = decoded([line])
    decoder, blocks = decoded(cut(line, places))
    assert decoder.counts == whole.counts
    for name in ('gyro', 'accel', 'counter', 'time', 'end'):
        parts = np.concatenate([getattr(block, name) for block in blocks])
        assert (parts == getattr(expected, name)).all()


@settings(max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 880), st.binary(min_size=1, max_size=120)), max_size=6),
    st.booleans(),
)
def test_garbage_costs_the_frames_that_it_hits_and_no_other(insertions, with_sync):
    sent = frames(20)
    line = b''.join(sent)
    for where, junk in sorted(insertions, reverse=True):
        content = b'\xaa\x55' + junk if with_sync else junk
        line = line[:where] + content + line[where:]
    hit = {k for k in range(20) if sent[k] not in line}
    garbage = len(line) - 44 * 20
    decoder, blocks = decoded([line, bytes(44)])
    assert counters(blocks) == [k for k in range(20) if k not in hit]
    # What is not a frame is skipped, but for what could still become one.
    skipped = garbage + 44 * len(hit)
    assert skipped <= decoder.counts.skipped <= skipped + 1
    good = [k for k in range(20) if k not in hit]
    assert decoder.counts.lost == sum(good[0] < k < good[-1] for k in hit)


def test_sync_bytes_within_the_payload_are_no_frames():
    line = b''.join(
        frame(k, 0x55AA55AA55AA55AA, [0x55AA55AA] * 6, 0x55AA, 0x55AA) for k in range(9)
    )
    decoder, blocks = decoded([line[30:]])
    assert counters(blocks) == list(range(1, 9))
    assert decoder.counts.skipped == 14


def test_a_damaged_frame_counts_once_though_sync_bytes_stand_within_it():
    sent = [frame(k, k, [0x55AA] * 6) for k in range(5)]
    sent[2] = sent[2][:20] + b'\xff' + sent[2][21:]
    decoder, blocks = decoded([b''.join(sent)])
    assert counters(blocks) == [0, 1, 3, 4]
    assert (decoder.counts.bad, decoder.counts.skipped, decoder.counts.lost) == (1, 44, 1)


def test_what_comes_before_the_first_frame_is_counted_by_itself_too():
    sent = frames(6)
    for k in (0, 3):
        sent[k] = sent[k][:20] + bytes([sent[k][20] ^ 1]) + sent[k][21:]
    line = b'boot' + sent[0] + sent[1] + sent[2] + sent[3] + b'junk' + sent[4]
    for pieces in ([line], [line[k : k + 1] for k in range(len(line))]):
        counts = decoded(pieces)[0].counts
        assert (counts.bad, counts.early_bad, counts.later_bad) == (2, 1, 1)
        assert (counts.skipped, counts.early_skipped, counts.later_skipped) == (96, 48, 48)
    # Without a frame nothing is later than the first.
    counts = decoded([line[:48], bytes(100)])[0].counts
    assert (counts.bad, counts.later_bad, counts.later_skipped) == (1, 0, 0)


@pytest.mark.parametrize(
    ('line', 'said'),
    [
        (b''.join(frames(9)[2:]), 'Frames come in.'),
        (b'boot' + frames(9)[1][5:] + b''.join(frames(9)[2:]), 'Frames come in.'),
        (b''.join([*frames(4), *frames(4, first=5)]), 'Frames are lost on the way.'),
        (b''.join([*frames(4), frames(4)[-1]]), 'Frames come twice.'),
        (
            b''.join([*frames(4), frames(5)[-1][:-1] + b'?', *frames(4, first=5)]),
            'Frames are damaged: check cable and baud rate.',
        ),
        (
            b''.join([*frames(4), b'????', *frames(4, first=4)]),
            'Bytes are received that belong to no frame.',
        ),
    ],
)
def test_damage_is_said_of_a_line_that_was_read_at_once(tmp_path, line, said):
    """As the whole of a file is, before its first report."""
    (tmp_path / 'line').write_bytes(b'')
    state = DeviceReader(str(tmp_path / 'line'), lambda: 0).state
    reception = Reception(SIMULATED, load_imu('fog_medium'), 1000.0, live=False)
    reception.decode_chunks([Chunk(line, NS, NS)], NS, 1.0)
    (stream,) = (s for s in reception.statuses(state, NS, 1.0) if s.part == 'stream')
    assert stream.text.startswith(said)
    assert (stream.severity is Severity.OK) == (said == 'Frames come in.')


def test_a_flipped_bit_never_becomes_a_sample():
    line = bytearray(b''.join(frames(3)))
    for bit in range(44 * 8):
        line[44 + bit // 8] ^= 1 << bit % 8
        _, blocks = decoded([bytes(line)])
        assert counters(blocks) == [0, 2]
        line[44 + bit // 8] ^= 1 << bit % 8


def test_gaps_of_the_counter_are_lost_frames_across_its_wrap():
    numbers = [2**32 - 3, 2**32 - 2, 1, 2, 10]
    decoder, _ = decoded([frame(k, k, [0] * 6) for k in numbers])
    assert (decoder.counts.lost, decoder.counts.restarts) == (2 + 7, 0)


def test_a_frame_that_comes_twice_is_taken_once():
    one, two, three = frames(3)
    decoder, blocks = decoded([one + two, two, three])
    assert counters(blocks) == [0, 1, 2]
    assert (decoder.counts.repeated, decoder.counts.lost) == (1, 0)


def test_a_counter_that_goes_back_is_a_restart_and_no_loss():
    decoder, blocks = decoded([b''.join(frames(5, first=1000) + frames(5))])
    assert len(counters(blocks)) == 10
    assert (decoder.counts.restarts, decoder.counts.lost) == (1, 0)


KVH_LIKE = """
name: big-endian floats, a status of valid bits, a counter of seven bits, CRC-32/MPEG-2
sync: [0xFE, 0x81, 0xFF, 0x55]
length: 36
byte_order: big
fields:
  gyro:          {type: f32, offset: [4, 8, 12]}
  accelerometer: {type: f32, offset: [16, 20, 24], scale: 9.80665}
  status:
    type: u8
    offset: 28
    faults:
      - {mask: 0x07, when: clear, says: a gyro is invalid}
      - {mask: 0x70, when: clear, says: an accelerometer is invalid}
  counter:       {type: u8, offset: 29, modulus: 128}
  temperature:   {type: i16, offset: 30}
checksum: {kind: crc, width: 32, poly: 0x04C11DB7, init: 0xFFFFFFFF, offset: 32}
"""
STIM_LIKE = """
name: 24-bit numbers, a counter that grows by 4, a CRC over padded words
sync: [0x93]
length: 27
byte_order: big
fields:
  gyro:          {type: i24, offset: [1, 4, 7]}
  status:
    - {type: u8, offset: 10, faults: [{bit: 7, says: integrity, when: set}]}
    - {type: u8, offset: 20, faults: [{bit: 6, says: start-up}]}
  accelerometer: {type: i24, offset: [11, 14, 17], scale: [1, -1, 1]}
  counter:       {type: u8, offset: 21, step: 4}
checksum: {kind: CRC-32/MPEG-2, offset: 23, covers: [0, 22], padding: 1}
"""
XSENS_LIKE = """
name: headers between the fields, a sum that comes to zero, time in ticks of 10 kHz
sync: [0xFA, 0xFF, 0x36, 0x2A]
constant: [{offset: 4, bytes: [0x10, 0x20, 0x02]}, {offset: 9, bytes: [0x10, 0x60, 0x04]}]
length: 47
byte_order: big
fields:
  counter:       {type: u16, offset: 7}
  time:          {type: u32, offset: 12, ticks: 10 kHz}
  accelerometer: {type: f32, offset: [19, 23, 27]}
  gyro:          {type: f32, offset: [34, 38, 42]}
checksum: {kind: sum, negated: true, offset: 46, covers: [1, 45]}
"""
ADIS_LIKE = """
name: words of 16 bits, a temperature with a zero, bits of a word, a sum of 16 bits
sync: [0x68, 0x00]
length: 24
byte_order: big
fields:
  status:        {type: u16, offset: 2, faults: [{bit: 1, says: data path overrun}]}
  gyro:          {type: i16, offset: [4, 6, 8]}
  accelerometer: {type: i16, offset: [10, 12, 14]}
  temperature:   {type: i16, offset: 16, scale: 0.1, zero: 25}
  counter:       {type: u16, offset: 18}
  skew:          {type: u16, offset: 20, bits: [4, 11]}
checksum: {kind: sum, width: 16, offset: 22, covers: [2, 21]}
"""


def by_text(text):
    return read_format(Section.parse(text, 'device.yaml'))


def test_a_frame_of_big_endian_floats_with_valid_bits():
    crc = Checksums(CATALOGUE['CRC-32/MPEG-2'], 32)
    line = b''
    for k, status in ((126, 0x77), (127, 0x67), (1, 0x73)):
        body = struct.pack('>I6f2Bh', 0xFE81FF55, 0.5, -0.25, 1e-3, 1, 2, -3, status, k, -7)
        line += body + struct.pack('>I', int(crc.of_rows(np.frombuffer(body, np.uint8)[None])[0]))
    decoder, (samples,) = decoded([line], by_text(KVH_LIKE))
    assert samples.gyro[0].tolist() == [0.5, -0.25, float(np.float32(1e-3))]
    np.testing.assert_allclose(samples.accel[0], [9.80665, 19.6133, -29.41995], rtol=1e-15)
    assert samples.faults.tolist() == [0, 2, 1]
    assert samples.celsius.tolist() == [-7] * 3
    assert decoder.counts.lost == 1


def test_a_channel_that_is_no_number_is_left_out_and_said():
    crc = Checksums(CATALOGUE['CRC-32/MPEG-2'], 32)
    body = struct.pack('>I6f2Bh', 0xFE81FF55, np.nan, 0, 0, 0, 0, 0, 0x77, 1, 20)
    line = body + struct.pack('>I', int(crc.of_rows(np.frombuffer(body, np.uint8)[None])[0]))
    decoder, (samples,) = decoded([line], by_text(KVH_LIKE))
    assert len(samples) == 0
    assert decoder.counts.unusable == 1


def test_a_frame_of_24_bit_numbers_with_a_padded_crc():
    def three(*values):
        return b''.join((v % 2**24).to_bytes(3, 'big') for v in values)

    crc = Checksums(CATALOGUE['CRC-32/MPEG-2'], 24)
    line = b''
    for k in (248, 252, 0, 8):
        body = b'\x93' + three(1, -1, -(2**23)) + b'\x80' + three(5, 6, 2**23 - 1) + b'\x00'
        body += bytes([k, 0x93])
        padded = np.frombuffer(body + b'\x00', np.uint8)[None]
        line += body + struct.pack('>I', int(crc.of_rows(padded)[0]))
    decoder, (samples,) = decoded([line], by_text(STIM_LIKE))
    assert samples.gyro[0].tolist() == [1, -1, -(2**23)]
    assert samples.accel[0].tolist() == [5, -6, 2**23 - 1]
    assert samples.faults.tolist() == [1] * 4
    assert decoder.counts.lost == 1


def test_a_frame_with_headers_between_its_fields_and_a_sum_of_zero():
    line = b''
    for k in range(3):
        body = struct.pack('>I3sH3sI', 0xFAFF362A, b'\x10\x20\x02', k, b'\x10\x60\x04', 100 * k)
        body += b'\x40\x20\x0c' + struct.pack('>3f', 1, 2, 3)
        body += b'\x80\x20\x0c' + struct.pack('>3f', 4, 5, 6)
        line += body + bytes([-sum(body[1:]) % 256])
    form = by_text(XSENS_LIKE)
    _, (samples,) = decoded([b'\xfa\xff' + line], form)
    assert samples.accel[2].tolist() == [1, 2, 3]
    assert samples.gyro[2].tolist() == [4, 5, 6]
    assert (samples.time * form.time.unit).tolist() == [0, 10_000_000, 20_000_000]


def test_frames_of_the_simulated_unit_with_a_skewed_gyro_hold_its_count():
    counts = np.arange(30.0).reshape(5, 6)
    skew = np.array([7.0, -8, 9, -10, 2**30])
    stamps = np.arange(1, 6) * 10_000_000
    line = pack(ImuBlock(stamps, counts[:, :3], counts[:, 3:]), np.full(5, 21.5), skew=skew)
    samples = Decoder(load_format('simulated_skewed')).decode_bytes(line)
    assert np.array_equal(samples.skew, skew)
    assert np.array_equal(np.hstack([samples.gyro, samples.accel]), counts)
    assert samples.celsius == pytest.approx(21.5)
    assert Decoder(SIMULATED).decode_bytes(line).skew is None


def test_a_frame_of_registers_with_a_skewed_channel_in_some_bits():
    body = struct.pack('>2H6hhHH', 0x6800, 2, 1, -2, 3, -4, 5, -6, -50, 9, 0xABCD)
    line = body + struct.pack('>H', sum(body[2:]))
    _, (samples,) = decoded([line], by_text(ADIS_LIKE))
    assert samples.gyro[0].tolist() == [1, -2, 3]
    assert samples.celsius[0] == 20
    assert samples.skew[0] == 0xBC
    assert samples.faults[0] == 1


# --- the clock ---------------------------------------------------------------------------------

COUNTER = FrameCounter(Number('u', 4, 2, '<'), 2**32)


def fed(clock, time_, counter, arrival, batch=10):
    """Feed in batches; return stamps once the clock is settled."""
    parts = [
        clock.elapsed_times(
            None if time_ is None else time_[k : k + batch],
            None if counter is None else counter[k : k + batch],
            arrival[k : k + batch],
        )
        for k in range(0, len(arrival), batch)
    ]
    clock.settle()
    return clock.offset + np.concatenate(parts)


def host(count, rate=100, start=1000 * NS, delay=2_000_000):
    """Host times at which samples are made, and at which they arrive with a jittering delay."""
    made = start + np.arange(count) * NS // rate
    late = np.random.default_rng(3).exponential(1e6, count).astype(np.int64)
    return made, np.maximum.accumulate(made + delay + late)


def test_stamps_run_at_the_devices_rate_and_the_drift_is_said_not_applied():
    made, arrival = host(100 * 120)
    device = 77 * NS + np.rint((made - made[0]) * (1 + 100e-6)).astype(np.int64)
    clock = DeviceClock(NANOSECONDS, COUNTER, 0.01)
    stamps = fed(clock, device, np.arange(len(made)), arrival)
    assert (np.diff(stamps) == np.diff(device)).all()
    # The least delay of the first half second: 2 ms, of which the drift takes 0.05 ms.
    assert 1_950_000 <= stamps[0] - made[0] < 2_200_000
    # 60 windows of 2 s whose least delays scatter by 1 ms / 200: 0.02 ppm.
    assert clock.drift.ppm == pytest.approx(100, abs=0.2)
    assert clock.drift.std < 0.1
    assert clock.jumps == 0


@pytest.mark.parametrize('jump', [1.0, -1.0, 0.03, -3600.0])
def test_a_clock_that_jumps_is_put_right_by_the_counter(jump):
    made, arrival = host(1000)
    device = made - 5 * NS
    device[400:] += round(jump * NS)
    clock = DeviceClock(NANOSECONDS, COUNTER, None)
    stamps = fed(clock, device, np.arange(1000), arrival)
    assert (np.diff(stamps) == NS // 100).all()
    assert clock.jumps == 1
    assert clock.last_jump.seconds == pytest.approx(jump)
    assert clock.last_jump.elapsed == 4 * NS


@pytest.mark.parametrize('jump', [1.0, -1.0])
def test_without_a_counter_the_host_puts_a_jump_right(jump):
    made, arrival = host(1000)
    device = made - 5 * NS
    device[400:] += round(jump * NS)
    clock = DeviceClock(NANOSECONDS, None, None)
    stamps = fed(clock, device, None, arrival)
    assert clock.jumps == 1
    assert (np.diff(stamps) > 0).all()
    # As exact as the delays of one batch of ten: an exponential jitter of 1 ms.
    np.testing.assert_allclose(stamps - made, 2_000_000, atol=3_000_000)


@pytest.mark.parametrize(('late', 'counter'), [(3000, COUNTER), (40, None)])
def test_a_host_that_slept_with_a_counter_or_was_busy_is_no_jump(late, counter):
    count = 2 * late + 1000
    made, arrival = host(count)
    arrival[500 : 500 + late] = arrival[500 + late]
    clock = DeviceClock(NANOSECONDS, counter, None)
    stamps = fed(clock, made, None if counter is None else np.arange(count), arrival)
    assert clock.jumps == 0
    assert (np.diff(stamps) == NS // 100).all()


def test_a_node_that_starts_late_in_a_fast_simulation_delays_no_stamp():
    """What it reads first waited for a minute of simulated time; what it reads then did not."""
    made, arrival = host(8000)
    # A minute of samples is read a second's at a time, in no time.
    arrival[:6000] = arrival[6000]
    clock = DeviceClock(NANOSECONDS, COUNTER, None, tolerance=None)
    stamps = fed(clock, made, np.arange(8000), arrival, batch=100)
    np.testing.assert_allclose(stamps - made, 2_000_000, atol=1_000_000)


def test_clock_and_counter_wrap():
    made, arrival = host(3000)
    ticks = (made // 1000) % 2**16
    clock = DeviceClock(
        DeviceTime(Number('u', 2, 0, '<'), 1000.0, 2**16),
        FrameCounter(Number('u', 1, 2, '<'), 256),
        None,
    )
    stamps = fed(clock, ticks, np.arange(3000) % 256, arrival)
    assert (np.diff(stamps) == NS // 100).all()
    assert clock.jumps == 0


def test_a_gap_of_many_turns_of_the_counter_is_seen_by_the_clock():
    made, arrival = host(3000, rate=1000)
    kept = np.r_[0:1000, 2000:3000]
    clock = DeviceClock(NANOSECONDS, FrameCounter(Number('u', 1, 2, '<'), 128), None)
    stamps = fed(clock, made[kept], kept % 128, arrival[kept])
    assert (stamps - stamps[0] == made[kept] - made[0]).all()
    assert clock.jumps == 0
    # 1000 frames are missing: the counter shows 1000 % 128 of them.
    assert clock.unseen == 1000 - 1000 % 128


def test_a_device_that_starts_anew_goes_on_on_the_hosts_time_line():
    made, arrival = host(1000)
    device, counter = made - 5 * NS, np.arange(1000)
    kept = np.r_[0:400, 600:1000]
    device[600:] -= device[600]
    counter[600:] -= 600
    clock = DeviceClock(NANOSECONDS, COUNTER, None)
    stamps = fed(clock, device[kept], counter[kept], arrival[kept])
    assert clock.jumps == 1
    np.testing.assert_allclose(stamps - made[kept], 2_000_000, atol=3_000_000)
    assert 'restarted' in clock.last_jump.reason


def test_a_counter_alone_gives_the_durations():
    made, arrival = host(1000)
    kept = np.r_[0:300, 310:1000]
    clock = DeviceClock(None, FrameCounter(Number('u', 1, 2, '<'), 256), 0.01)
    stamps = fed(clock, None, kept % 256, arrival[kept])
    assert (stamps - stamps[0] == made[kept] - made[0]).all()


def test_samples_alone_show_their_loss_as_drift():
    _, arrival = host(20_000)
    kept = np.arange(20_000) % 1000 != 999
    clock = DeviceClock(None, None, 0.01)
    stamps = fed(clock, None, None, arrival[kept])
    assert (np.diff(stamps) == NS // 100).all()
    assert clock.drift.ppm == pytest.approx(-1000, rel=0.02)


def test_after_a_silence_a_counter_of_few_bits_is_put_right_by_the_host():
    made, arrival = host(6000, rate=1000)
    kept = np.r_[0:3000, 5000:6000]
    clock = DeviceClock(None, FrameCounter(Number('u', 1, 2, '<'), 128), 0.001)
    stamps = fed(clock, None, kept % 128, arrival[kept])
    # A tenth of a second is needed to tell a silent device from a busy host.
    right = np.r_[0:3000, 3110:4000]
    np.testing.assert_allclose((stamps - made[kept])[right], 2_000_000, atol=3_000_000)
    assert clock.jumps == 1
    assert clock.unseen == 2000 - 2000 % 128


def test_thirds_of_a_nanosecond_do_not_add_up():
    count = 6000
    _, arrival = host(count, rate=300)
    clock = DeviceClock(None, None, 1 / 300)
    stamps = fed(clock, None, None, arrival, batch=1)
    assert stamps[-1] - stamps[0] == round((count - 1) * NS / 300)


def test_without_time_or_rate_there_are_no_stamps():
    with pytest.raises(InputError, match='sample rate'):
        DeviceClock(None, COUNTER, None)


# --- sources -----------------------------------------------------------------------------------


def read_all(source, count):
    got = []
    assert until(lambda: got.extend(source.pop_chunks()) or sum(len(c.data) for c in got) >= count)
    source.stop()
    return b''.join(c.data for c in got)


def test_a_file_is_read_to_its_end(tmp_path):
    (tmp_path / 'frames.bin').write_bytes(content := np.random.default_rng(0).bytes(100_000))
    source = DeviceReader(str(tmp_path / 'frames.bin'), time.time_ns)
    source.start()
    assert read_all(source, 100_000) == content
    assert until(lambda: source.state.ended)


def test_a_full_queue_holds_the_sender_back():
    server = socket.create_server(('127.0.0.1', 0))
    server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)
    source = DeviceReader(
        f'socket://127.0.0.1:{server.getsockname()[1]}', time.time_ns, capacity=1 << 14
    )
    source.start()
    device, _ = server.accept()
    device.setblocking(False)
    sent = 0
    content = np.random.default_rng(1).bytes(1 << 21)

    def stuck():
        nonlocal sent
        try:
            while sent < len(content):
                sent += device.send(content[sent : sent + 65536])
        except BlockingIOError:
            pass
        return False

    until(stuck, 0.5)
    assert sent < len(content)
    device.setblocking(True)
    rest = threading.Thread(target=lambda: device.sendall(content[sent:]))
    rest.start()
    assert read_all(source, len(content)) == content
    rest.join()
    device.close()
    server.close()


def test_a_broken_connection_is_opened_again():
    server = socket.create_server(('127.0.0.1', 0))
    source = DeviceReader(f'socket://127.0.0.1:{server.getsockname()[1]}', time.time_ns)
    source.start()
    device, _ = server.accept()
    assert until(lambda: source.state.open)
    device.close()
    assert until(lambda: 'closed by the other end' in source.state.text)
    device, _ = server.accept()
    device.sendall(b'again')
    assert read_all(source, 5) == b'again'
    device.close()
    server.close()


def test_a_serial_port_is_read_as_it_comes():
    pytest.importorskip('serial')
    with pseudo_terminal() as (ours, _, name):
        source = DeviceReader(name, time.time_ns, 921600)
        source.start()
        assert until(lambda: source.state.open)
        content = b''.join(frames(50))
        threading.Thread(target=lambda: os.write(ours, content)).start()
        assert read_all(source, len(content)) == content


@pytest.mark.parametrize('url', ['', 'socket://here', 'udp://127.0.0.1:port', 'no/such/file.bin'])
def test_a_port_that_cannot_be_is_refused(url):
    with pytest.raises(InputError):
        DeviceReader(url, time.time_ns)


def test_a_port_that_is_not_there_yet_is_said_and_tried_again():
    source = DeviceReader('/dev/ttyNoSuchPort', time.time_ns)
    source.start()
    assert until(lambda: 'does not open' in source.state.text)
    source.stop()


FORMAT = """
name: nav7
sync: [0x47, 0x58]
length: LENGTH
byte_order: ORDER
fields:
  counter: {type: u8, offset: 2}
  time: {type: u32, offset: 4, unit: us}
  gyro: {type: i32, offset: [8, 12, 16]}
  accelerometer: {type: i32, offset: [20, 24, 28]}
checksum: {kind: CRC-16/CCITT-FALSE, offset: 34, covers: [2, 33], byte_order: big}
"""
PULSES = 'fog_medium'


def read_by(length, order):
    """Statuses, by part, of the first seconds of a unit at rest, whose frames have 36 bytes."""
    text = FORMAT.replace('LENGTH', str(length)).replace('ORDER', order)
    reception = Reception(read_format(Section.parse(text, 'nav7.yaml')), load_imu(PULSES))
    up = round(STANDARD_GRAVITY / 100 / load_imu(PULSES).accel.scale_factor)
    seen = []
    for k in range(20):
        data = b''
        for n in range(10 * k, 10 * k + 10):
            body = struct.pack('<BBI6ih', n % 256, 4, 10_000 * n, n % 3, -1, 1, 0, n % 2, up, 0)
            data += b'\x47\x58' + body + struct.pack('>H', binascii.crc_hqx(body, 0xFFFF))
        now = (k + 1) * NS // 10
        reception.decode_chunks([Chunk(data, now, now)], now, now * 1e-9)
        state = ReaderState(open=True, ended=False, text='open')
        seen.append({one.part: one for one in reception.statuses(state, now, now * 1e-9)})
    return seen


def test_a_stream_of_absurd_values_is_a_wrong_byte_order_and_no_clock_that_jumps():
    """The clock was said to jump 23 times, and then the file of the IMU was blamed."""
    seen = read_by(36, 'big')
    assert 'byte order, the type or the offset' in seen[-1]['format'].text
    assert seen[-1]['format'].severity is Severity.ERROR
    assert {one['clock'].severity for one in seen} == {Severity.OK}
    assert read_by(36, 'little')[-1]['format'].severity is Severity.OK


def test_frames_that_are_lost_steadily_from_the_start_are_an_error_of_the_format():
    """A session began with every second frame, after a warning."""
    status = read_by(37, 'little')[-1]['format']
    assert status.severity is Severity.ERROR
    assert re.match(
        r'(49|50|51)% of the frames are lost from the start. Check length \(37', status.text
    )
