"""Shipped formats of VectorNav, SBG, MicroStrain, Xsens, Epson, Analog Devices, on frames that
writers of this test make, number by number as the makers' protocols have them."""

import itertools
import re
import struct
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from device_frames import kvh, mti, stim
from loopback import CHECKOUT

from imu_calib.common.config import Section
from imu_calib.common.stream import Units
from imu_calib.live.devices.clock import DeviceClock
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.format import load_format, read_format
from imu_calib.live.devices.health import Health
from imu_calib.live.devices.source import DeviceReader
from imu_calib.live.rules import Severity
from imu_calib.session.imu import load_imu, read_imu

NS = 1_000_000_000
RATE = (Fraction(1, 8), Fraction(-3, 4), Fraction(5, 64))
"""rad/s, or counts where a device sends those: numbers that every format holds exactly."""
FORCE = (Fraction(-9, 2), Fraction(1, 16), Fraction(39, 4))


def crc16(data, poly, reflected):
    """A CRC of 16 bits from zero, bit by bit."""
    register = 0
    for byte in data:
        for k in range(8):
            bit = byte >> (k if reflected else 7 - k) & 1
            if reflected:
                register = register >> 1 ^ (poly if (register ^ bit) & 1 else 0)
            else:
                top = register >> 15 ^ bit
                register = (register << 1 & 0xFFFF) ^ (poly if top else 0)
    return register


def fletcher(data):
    """As MIP's document adds: each byte to the first sum, that to the second."""
    first = second = 0
    for byte in data:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes([first, second])


def floats(numbers, order='<'):
    return struct.pack(f'{order}3f', *map(float, numbers))


def vectornav(k, rate=RATE, force=FORCE, celsius=25.5):
    body = bytes([1]) + struct.pack('<H', 1 << 0 | 1 << 9 | 1 << 10)
    body += struct.pack('<Q', k * NS // 400) + floats(force) + floats(rate)
    body += floats((0.25, 0, 0.5)) + struct.pack('<ff', celsius, 101.325)
    return b'\xfa' + body + struct.pack('>H', crc16(body, 0x1021, reflected=False))


def sbg(k, rate=RATE, force=FORCE, celsius=25.5, status=0x3FF, message=44):
    data = struct.pack('<IH', k * 5000 % 2**32, status)
    data += struct.pack('<3i', *(int(f * 2**20) for f in force))
    data += struct.pack('<3i', *(int(w * 2**26) for w in rate))
    data += struct.pack('<h', round(celsius * 256))
    body = bytes([message, 0]) + struct.pack('<H', len(data)) + data
    return b'\xff\x5a' + body + struct.pack('<H', crc16(body, 0x8408, reflected=True)) + b'\x33'


def mip(descriptors, *fields):
    payload = b''.join(bytes([len(data) + 2, kind]) + data for kind, data in fields)
    packet = b'\x75\x65' + bytes([descriptors, len(payload)]) + payload
    return packet + fletcher(packet)


def microstrain(k, rate=RATE, force=FORCE, celsius=25.5, overrange=0):
    return mip(
        0x80,
        (0xD5, struct.pack('>Q', k * 2_000_000)),
        (0x04, floats(force, '>')),
        (0x05, floats(rate, '>')),
        (0x14, struct.pack('>3f', celsius - 1, celsius + 1, celsius)),
        (0x18, struct.pack('>H', overrange)),
    )


def fp1632(numbers):
    """32 bits of fraction, then 16 before the point, both with the highest byte first."""
    parts = [divmod(int(x * 2**32), 2**32) for x in numbers]
    return b''.join(struct.pack('>Ih', fraction, whole) for whole, fraction in parts)


def xsens_message(message, data):
    body = bytes([0xFF, message, len(data)]) + data
    return b'\xfa' + body + bytes([-sum(body) % 256])


def xsens(k, rate=RATE, force=FORCE, status=3):
    data = struct.pack('>HBH', 0x1020, 2, k % 2**16) + struct.pack('>HBI', 0x1060, 4, 25 * k)
    data += struct.pack('>HB', 0x4022, 18) + fp1632(force)
    data += struct.pack('>HB', 0x8022, 18) + fp1632(rate)
    return xsens_message(0x36, data + struct.pack('>HBI', 0xE020, 4, status))


def epson(k, rate=(70000, -1, 2**31 - 1), force=(-(2**31), 65536, 3), celsius=25, flags=0xFE00):
    temperature = round((celsius - 25) / -0.0037918 * 65536) + 2634 * 65536
    words = struct.pack('>Hi6iH', flags, temperature, *rate, *force, k % 2**16)
    total = sum(high << 8 | low for high, low in zip(words[::2], words[1::2], strict=True))
    return b'\x80' + words + struct.pack('>H', total % 2**16) + b'\r'


def register_pair(number):
    """The low word, as the lower address, then the high one; each with the high byte first."""
    return struct.pack('>HH', number & 0xFFFF, number >> 16 & 0xFFFF)


def bridged(registers):
    return b'\xa5\x5a' + registers + struct.pack('>H', sum(registers) % 2**16)


def adis(k, rate=(70000, -70000, 2**31 - 1), force=(-(2**31), 65536, -1), celsius=25.5, status=0):
    registers = struct.pack('>H', status)
    registers += b''.join(register_pair(x) for x in (*rate, *force))
    return bridged(registers + struct.pack('>hH', round(10 * celsius), k % 2**16))


def adis_burst(k, rate=(-32768, 32767, 1), force=(-1, 800, 7), celsius=25.5, status=0):
    return bridged(struct.pack('>H7hH', status, *rate, *force, round(10 * celsius), k % 2**16))


@dataclass
class Shipped:
    write: object
    imu: str
    fault: dict
    says: str
    other: bytes = b''
    si: bool = True


DEVICES = {
    'vectornav': Shipped(vectornav, 'vectornav_vn100', {}, ''),
    'sbg_ecom': Shipped(
        sbg, 'sbg_ellipse', {'status': 0x1FF}, 'a gyro is out of range', sbg(0, message=3)
    ),
    'microstrain_mip': Shipped(
        microstrain,
        'microstrain_cv7',
        {'overrange': 0x20},
        'a gyro is at its limit',
        mip(0x0C, (0xF1, b'\x0f\x00')),
    ),
    'xsens_mti_600': Shipped(
        xsens,
        'xsens_mti_600',
        {'status': 0x103},
        'an accelerometer is at its limit',
        xsens_message(0x11, b''),
    ),
    'epson_g370': Shipped(
        epson,
        'epson_g370',
        {'flags': 0xFE01},
        'the unit found an error of its own (EA)',
        si=False,
    ),
    'adis16470': Shipped(
        adis, 'adis16470', {'status': 1 << 5}, 'a sensor did not pass its test', si=False
    ),
    'adis16470_burst': Shipped(
        adis_burst,
        'adis16470_burst',
        {'status': 1 << 7},
        'the clock is not in step',
        si=False,
    ),
}
each_device = pytest.mark.parametrize('name', DEVICES)


def line_of(name, count=300, **keys):
    return [DEVICES[name].write(k, **keys) for k in range(count)]


# Thousands of lines are decoded.
format_of = cache(load_format)


def decoded(name, *pieces):
    decoder = Decoder(format_of(name))
    return decoder.counts, [decoder.decode_bytes(piece) for piece in pieces]


@pytest.mark.parametrize('name', [name for name, device in DEVICES.items() if device.si])
def test_rates_and_forces_are_those_that_were_written(name):
    imu = load_imu(DEVICES[name].imu)
    _, (samples,) = decoded(name, DEVICES[name].write(7))
    rate, force = samples.gyro * imu.gyro.scale_factor, samples.accel * imu.accel.scale_factor
    np.testing.assert_array_equal(rate[0], [float(w) for w in RATE])
    # MIP sends g: one multiplication is rounded.
    unit = 9.80665 if name == 'microstrain_mip' else 1.0
    np.testing.assert_allclose(force[0], [unit * float(f) for f in FORCE], rtol=1e-15)


@pytest.mark.parametrize(
    ('name', 'deg_s', 'mg'),
    [
        ('epson_g370', 1 / 66 / 2**16, 0.4 / 2**16),
        ('adis16470', 0.1 / 2**16, 1.25 / 2**16),
        ('adis16470_burst', 0.1, 1.25),
    ],
)
def test_counts_are_those_that_were_written_and_their_scale_is_the_makers(name, deg_s, mg):
    rate, force = DEVICES[name].write.__defaults__[:2]
    _, (samples,) = decoded(name, DEVICES[name].write(7))
    assert samples.gyro[0].tolist() == list(rate)
    assert samples.accel[0].tolist() == list(force)
    imu = load_imu(DEVICES[name].imu)
    assert np.degrees(imu.gyro.scale_factor) == pytest.approx(deg_s, rel=1e-12)
    assert imu.accel.scale_factor == pytest.approx(mg * 9.80665e-3, rel=1e-12)


@pytest.mark.parametrize('name', [name for name in DEVICES if name != 'xsens_mti_600'])
def test_temperatures_are_read(name):
    _, (samples,) = decoded(name, DEVICES[name].write(0, celsius=31.5))
    assert samples.celsius[0] == pytest.approx(31.5, abs=1e-6)


@each_device
def test_any_cut_gives_the_same_and_damage_costs_the_frames_that_it_hits(name):
    sent = line_of(name)
    length = len(sent[0])
    # Damage behind the sync bytes, a frame that was cut short, and noise with a sync in it.
    sent[100] = (
        sent[100][: length // 2]
        + bytes([sent[100][length // 2] ^ 8])
        + sent[100][length // 2 + 1 :]
    )
    sent[200] = sent[200][:-3]
    noise = np.random.default_rng(6).bytes(50) + sent[0][:4] + bytes(3)
    line = noise + b''.join(sent)
    whole, (expected,) = decoded(name, line)
    assert len(expected) == 298
    assert whole.frames == 298
    assert whole.bad >= 1
    # A few bytes at the very end may still become a frame.
    assert whole.skipped == len(noise) + 2 * length - 3
    if load_format(name).counter is not None:
        assert whole.lost == 2
    places = np.sort(np.random.default_rng(5).integers(0, len(line), 400)).tolist()
    pieces = [line[a:b] for a, b in itertools.pairwise([0, *places, len(line)])]
    cut, blocks = decoded(name, *pieces)
    assert cut == whole
    for column in ('gyro', 'accel', 'end', 'faults'):
        found = np.concatenate([getattr(block, column) for block in blocks])
        np.testing.assert_array_equal(found, getattr(expected, column))


@each_device
def test_no_flipped_bit_becomes_a_sample(name):
    # Sums of bytes or words miss no single bit, and CRCs none either.
    first, hit, last = line_of(name, 3)
    for bit in range(8 * len(hit)):
        spoiled = bytearray(hit)
        spoiled[bit // 8] ^= 1 << bit % 8
        counts, (samples,) = decoded(name, first + bytes(spoiled) + last)
        assert len(samples) == 2, f'bit {bit}'
        assert counts.frames == 2


@pytest.mark.parametrize('name', [name for name, device in DEVICES.items() if device.says])
def test_what_a_device_says_of_itself_is_read(name):
    device = DEVICES[name]
    _, (samples,) = decoded(name, device.write(0) + device.write(1, **device.fault))
    faults = load_format(name).faults
    said = [fault.words for bit, fault in enumerate(faults) if samples.faults[1] >> bit & 1]
    assert samples.faults[0] == 0
    assert said == [device.says]


@pytest.mark.parametrize('name', [name for name, device in DEVICES.items() if device.other])
def test_other_messages_of_the_protocol_are_known_and_no_damage(name):
    first, last = line_of(name, 2)
    other = DEVICES[name].other
    spoiled = other[:-2] + bytes([other[-2] ^ 1]) + other[-1:]
    counts, _ = decoded(name, first + other + last + spoiled + line_of(name, 1)[0])
    assert (counts.frames, counts.others, counts.bad) == (3, 1, 0)
    assert counts.skipped == len(spoiled)


@each_device
def test_stamps_have_the_rate_that_the_start_commands_ask_for(name):
    form, imu = load_format(name), load_imu(DEVICES[name].imu)
    period = NS / imu.sample_rate
    clock = DeviceClock(form.time, form.counter, 1 / imu.sample_rate)
    _, (samples,) = decoded(name, b''.join(line_of(name)))
    arrival = np.rint((1 + np.arange(300)) * period).astype(np.int64)
    elapsed = clock.elapsed_times(samples.time, samples.counter, arrival)
    assert (np.diff(elapsed) == period).all()
    assert form.bits_per_second(imu.sample_rate) <= form.baud


def test_the_commands_of_mip_and_xsens_are_whole_messages():
    for command in load_format('microstrain_mip').commands.start:
        assert command.data[:2] == b'\x75\x65'
        assert len(command.data) == 6 + command.data[3]
        assert fletcher(command.data[:-2]) == command.data[-2:]
    for command in load_format('xsens_mti_600').commands.start:
        assert command.data[:2] == b'\xfa\xff'
        assert len(command.data) == 5 + command.data[3]
        assert sum(command.data[1:]) % 256 == 0


def test_the_commands_of_mip_and_xsens_ask_for_the_items_of_the_frame():
    frame = load_format('microstrain_mip')
    asked = frame.commands.start[1].data
    items = [asked[9 + 3 * k] for k in range(asked[8])]
    constant = dict(frame.constant)
    assert items == [constant[offset] for offset in (5, 15, 29, 43, 57)]
    frame = load_format('xsens_mti_600')
    asked = frame.commands.start[1].data[4:-1]
    constant = dict(frame.constant)
    for k, offset in enumerate((4, 9, 16, 37, 58)):
        assert asked[4 * k : 4 * k + 2] == bytes([constant[offset], constant[offset + 1]])


def test_the_commands_of_a_vectornav_carry_the_checksum_of_their_text():
    for command in load_format('vectornav').commands.start:
        text, checksum = command.data[1:-2].split(b'*')
        total = 0
        for character in text:
            total ^= character
        assert int(checksum, 16) == total
        assert command.data.endswith(b'\r\n')


def test_the_commands_of_an_epson_write_registers_and_end_where_they_began():
    commands = load_format('epson_g370').commands
    for command in (*commands.start, *commands.stop):
        address, _, end = command.data
        assert address & 0x80
        assert end == 0x0D
    # At 460800 bit/s a command takes 66 us and the unit 200 us (M-G362 data sheet, table 6.8).
    assert all(command.wait >= 2e-4 for command in commands.start[:-1])
    assert [c.data for c in commands.start[:2]] == [c.data for c in commands.stop]


# The shipped formats of devices that can be bought, on bytes written by the makers' documents


# Frames that a unit sent, from the tests of the driver ros_kvh1750 (TRECVT, 2015): gyros and one
# accelerometer not valid yet; all valid; one whose CRC is wrong.
KVH_EARLY = 'FE81FF55 3B041F78 B9B96613 BA234B38 BB7C0410 B8DEF480 3F7F4B7B 70 1F 001D F12FB6EE'
KVH_VALID = 'FE81FF55 B3D0BBE7 32193EF4 30AC19A5 BA8F78D6 3A290594 3F7ECBD4 77 68 001D ADC5F651'
KVH_BAD = 'FE81FF55 B46B86C6 B44F5B83 B4106D09 BB713CB7 BBABD914 3F7E319A 77 69 001D 95BBDB4F'


MAKERS = {
    'kvh_1750': kvh,
    'stim300': lambda k, **faults: stim(4 * k, **faults),
    'xsens_mti': lambda k, **faults: mti(k, 25 * k, **faults),
}
IMUS = {'kvh_1750': 'kvh_1750', 'stim300': 'stim300', 'xsens_mti': 'xsens_mti_300'}


# Hundreds of lines are decoded.


def test_frames_that_a_kvh_1750_sent_are_read_and_the_damaged_one_is_not():
    line = bytes.fromhex(KVH_EARLY + KVH_VALID + KVH_BAD)
    counts, (samples,) = decoded('kvh_1750', line)
    assert samples.counter.tolist() == [0x1F, 0x68]
    # At rest, z up: 0.995 g. All three gyros are not valid yet in the first.
    np.testing.assert_allclose(samples.accel[1, 2], 0.99530 * 9.80665, rtol=1e-5)
    assert samples.celsius.tolist() == [29, 29]
    assert samples.faults.tolist() == [0b000111, 0]
    assert counts.bad == 1


def test_the_floats_of_a_kvh_1750_are_rates_and_g():
    _, (samples,) = decoded('kvh_1750', kvh(5))
    assert samples.gyro[0].tolist() == [0.5, -0.25, 2.0]
    np.testing.assert_allclose(samples.accel[0], [0, 4.903325, -9.80665], rtol=1e-12)


def test_a_stim300_counts_increments_of_24_bits_and_warms_up():
    _, (samples,) = decoded('stim300', stim(7, (2**23 - 1, -(2**23), 1), (-1, 2**22, 0)))
    assert samples.gyro[0].tolist() == [2**23 - 1, -(2**23), 1]
    assert samples.accel[0].tolist() == [-1, 2**22, 0]
    assert samples.celsius[0] == 35.5
    imu = load_imu('stim300')
    assert imu.gyro.scale_factor * 2**21 == pytest.approx(np.pi / 180)
    assert imu.accel.scale_factor * 2**22 == pytest.approx(1)


def test_an_mti_sends_si_and_its_clock():
    _, (samples,) = decoded('xsens_mti', mti(65535, 10_000) + mti(0, 10_025))
    assert samples.accel[1].tolist() == [0.0, 9.75, -0.5]
    assert samples.gyro[1].tolist() == [0.125, 0.0, -1.0]
    assert (np.diff(samples.time) * load_format('xsens_mti').time.unit).tolist() == [2.5e6]


def test_a_message_that_an_mti_630_sent_is_read_once_its_items_are_written_down(tmp_path):
    # Published with a driver: clock, quaternion, rate, acceleration, magnetic field, status.
    message = bytes.fromhex(
        'FAFF364E 106004025335CB 2010103F7FFA66BB4034B83C49962D3B5A1F82'
        '80200C39FF9101BAECDD81BA865380 40200CBE64DB99BCE7FF83411DC2CF'
        'C0200CBE9048803F673204BF548904 E0200400000003C9'
    )
    text = """
    name: mti_630
    sync: [0xFA, 0xFF, 0x36, 0x4E, 0x10, 0x60, 0x04]
    constant: [{offset: 30, bytes: [0x80, 0x20, 0x0C]}, {offset: 45, bytes: [0x40, 0x20, 0x0C]}]
    length: 83
    byte_order: big
    fields:
      time:          {type: u32, offset: 7, ticks: 10 kHz}
      gyro:          {type: f32, offset: [33, 37, 41]}
      accelerometer: {type: f32, offset: [48, 52, 56]}
    checksum: {kind: sum, negated: true, offset: 82, covers: [1, 81]}
    """
    (tmp_path / 'mti_630.yaml').write_text(text)
    (samples,) = decoded(tmp_path / 'mti_630.yaml', message)[1]
    assert samples.time[0] == 0x025335CB
    # It lies on a table: gravity up, and no rate above 0.2 deg/s.
    assert np.linalg.norm(samples.accel[0]) == pytest.approx(9.86, abs=0.01)
    assert abs(samples.gyro[0]).max() < 0.2 * np.pi / 180


@pytest.mark.parametrize('name', MAKERS)
def test_lost_and_damaged_frames_are_counted_over_the_turn_of_the_counter(name):
    make = MAKERS[name]
    sent = [make(k) for k in range(300) if k not in {50, 260, 261}]
    sent[100] = sent[100][:22] + bytes([sent[100][22] ^ 0x10]) + sent[100][23:]
    line = b''.join(sent)
    counts, blocks = decoded(name, b'\x00\xfe\xfa\x01' + line[: 5000 + 7], line[5000 + 7 :])
    assert sum(map(len, blocks)) == 296
    assert (counts.frames, counts.bad, counts.lost) == (296, 1, 4)
    assert counts.skipped == 4 + len(sent[100])


@pytest.mark.parametrize('name', MAKERS)
def test_the_stamps_of_a_real_device_have_its_nominal_rate(name):
    form, imu = load_format(name), load_imu(IMUS[name])
    period = NS / imu.sample_rate
    clock = DeviceClock(form.time, form.counter, 1 / imu.sample_rate)
    _, (samples,) = decoded(name, b''.join(MAKERS[name](k) for k in range(1000)))
    arrival = np.rint((1 + np.arange(1000)) * period).astype(np.int64)
    elapsed = clock.elapsed_times(samples.time, samples.counter, arrival)
    assert (np.diff(elapsed) == period).all()
    assert clock.jumps == 0


@pytest.mark.parametrize(
    ('name', 'fault', 'severity', 'words'),
    [
        ('kvh_1750', {'status': 0x73}, Severity.ERROR, 'gyro z is not valid'),
        ('stim300', {'gyro': 0x40}, Severity.ERROR, 'gyros start up'),
        ('stim300', {'accelerometer': 0x12}, Severity.ERROR, 'an accelerometer is overloaded'),
        ('xsens_mti', {'status': 0x1003}, Severity.ERROR, 'a gyro is at its limit'),
    ],
)
def test_what_a_device_says_of_itself_reaches_the_diagnostics(
    name, fault, severity, words, tmp_path
):
    form, make = load_format(name), MAKERS[name]
    clock = DeviceClock(form.time, form.counter, 1e-3)
    health = Health(form, None, 0.5)
    counts, (samples,) = decoded(name, make(1) + make(2, **fault))
    health.add_received(samples, np.array([0, 1_000_000]), 100, NS, 0.0)
    (tmp_path / 'line').write_bytes(b'')
    state = DeviceReader(str(tmp_path / 'line'), lambda: 0).state
    status = {word.part: word for word in health.statuses(state, counts, clock, NS, 0.0)}['status']
    assert (status.severity, status.text) == (severity, f'The device reports: {words}.')
    assert status.figures == {words: '1 frames'}


def test_every_real_device_has_an_imu_that_says_what_its_numbers_are():
    units = {name: load_imu(imu).units for name, imu in IMUS.items()}
    assert units == {'kvh_1750': Units.SI, 'stim300': Units.PULSES, 'xsens_mti': Units.SI}


def documented(page):
    """Text of a page, and the format and the IMU that it writes down."""
    text = (CHECKOUT / 'docs' / page).read_text()

    def block(name):
        found = re.search(rf'<!-- {name} -->\n```yaml\n(.*?)```', text, re.DOTALL)
        return Section.parse(found[1], name)

    return text, read_format(block('device')), read_imu(block('imu'))


def test_the_device_at_home_reads_what_its_sketch_sends():
    _, form, imu = documented('at_home.md')
    # Little-endian micros() of the board, then the registers from 0x3B on, high byte first.
    body = struct.pack('<I', 5000) + struct.pack('>7h', 0, 0, 16384, -2218, 655, 0, -6550)
    samples = Decoder(form).decode_bytes(b'\xaa\x55' + body + bytes([sum(body) & 255]))
    assert samples.time[0] * form.time.unit == 5_000_000
    assert samples.celsius[0] == pytest.approx(30.0, abs=0.01)
    rate = np.degrees(samples.gyro[0] * imu.gyro.scale_factor)
    np.testing.assert_allclose(rate, [10, 0, -100], rtol=1e-9)
    np.testing.assert_allclose(samples.accel[0] * imu.accel.scale_factor, [0, 0, 9.80665])


def test_the_device_that_the_documentation_writes_down_reads_the_frame_beside_it():
    text, form, imu = documented('devices.md')
    frame = bytes.fromhex(re.search(r'<!-- frame -->\n +([0-9A-F ]+)\n', text)[1])
    samples = Decoder(form).decode_bytes(frame)
    assert len(samples) == 1
    assert samples.counter[0] == 1
    assert samples.time[0] * form.time.unit == 5_000_000
    assert samples.celsius[0] == 30
    assert samples.faults[0] == 0
    # 5000 arcsec in a two-hundredth of a second, and gravity to a pulse of 0.4 mm/s^2.
    rate = samples.gyro[0] * imu.gyro.scale_factor * imu.sample_rate * 180 / np.pi
    np.testing.assert_allclose(rate, [0, -0.05 / 18, 5000 / 18], rtol=1e-9)
    force = samples.accel[0] * imu.accel.scale_factor * imu.sample_rate
    np.testing.assert_allclose(force, [0, 0, 9.80665], atol=4e-4)
