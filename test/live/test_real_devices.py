"""The shipped formats of devices that can be bought, on bytes written by the makers' documents."""

import re
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

# Frames that a unit sent, from the tests of the driver ros_kvh1750 (TRECVT, 2015): gyros and one
# accelerometer not valid yet; all valid; one whose CRC is wrong.
KVH_EARLY = 'FE81FF55 3B041F78 B9B96613 BA234B38 BB7C0410 B8DEF480 3F7F4B7B 70 1F 001D F12FB6EE'
KVH_VALID = 'FE81FF55 B3D0BBE7 32193EF4 30AC19A5 BA8F78D6 3A290594 3F7ECBD4 77 68 001D ADC5F651'
KVH_BAD = 'FE81FF55 B46B86C6 B44F5B83 B4106D09 BB713CB7 BBABD914 3F7E319A 77 69 001D 95BBDB4F'


DEVICES = {
    'kvh_1750': kvh,
    'stim300': lambda k, **faults: stim(4 * k, **faults),
    'xsens_mti': lambda k, **faults: mti(k, 25 * k, **faults),
}
IMUS = {'kvh_1750': 'kvh_1750', 'stim300': 'stim300', 'xsens_mti': 'xsens_mti_300'}


# Hundreds of lines are decoded.
format_of = cache(load_format)


def decoded(name, *pieces):
    decoder = Decoder(format_of(name))
    return decoder.counts, [decoder.decode_bytes(piece) for piece in pieces]


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


@pytest.mark.parametrize('name', DEVICES)
def test_lost_and_damaged_frames_are_counted_over_the_turn_of_the_counter(name):
    make = DEVICES[name]
    sent = [make(k) for k in range(300) if k not in {50, 260, 261}]
    sent[100] = sent[100][:22] + bytes([sent[100][22] ^ 0x10]) + sent[100][23:]
    line = b''.join(sent)
    counts, blocks = decoded(name, b'\x00\xfe\xfa\x01' + line[: 5000 + 7], line[5000 + 7 :])
    assert sum(map(len, blocks)) == 296
    assert (counts.frames, counts.bad, counts.lost) == (296, 1, 4)
    assert counts.skipped == 4 + len(sent[100])


@pytest.mark.parametrize('name', DEVICES)
def test_the_stamps_of_a_real_device_have_its_nominal_rate(name):
    form, imu = load_format(name), load_imu(IMUS[name])
    period = NS / imu.sample_rate
    clock = DeviceClock(form.time, form.counter, 1 / imu.sample_rate)
    _, (samples,) = decoded(name, b''.join(DEVICES[name](k) for k in range(1000)))
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
    form, make = load_format(name), DEVICES[name]
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


def test_the_device_that_the_documentation_writes_down_reads_the_frame_beside_it():
    text = (CHECKOUT / 'docs' / 'devices.md').read_text()

    def block(name):
        found = re.search(rf'<!-- {name} -->\n```yaml\n(.*?)```', text, re.DOTALL)
        return Section.parse(found[1], name)

    form, imu = read_format(block('device')), read_imu(block('imu'))
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
