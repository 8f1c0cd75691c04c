"""A recording compensated: right numbers, all else untouched, and words for what does not fit."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pandas
import pytest
from bag_files import IMU, STORE, TEMPERATURES, session, timeline, write_with_rosbags
from calibrations import point
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
from sessions import brief_plan, truth

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.thermal import combine
from imu_calib.cli.main import main
from imu_calib.common.stream import ImuBlock, Units
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind, encode_imu, encode_rates
from imu_calib.recordings.metadata_yaml import dump, qos_profile
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.storage import Described, Topic
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.metadata import SERIAL_NUMBER

GRAVITY = 9.8 / 200 / truth().imu.accel.scale_factor  #: Pulses per sample at 200 Hz.
SESSION = session(seconds=12, rate=200)
# As at rest: samples without gravity end with exit code 2.
AT_REST = np.rint([0.0, 0.0, GRAVITY]) + np.sign(SESSION[IMU].accel)
SESSION[IMU] = replace(SESSION[IMU], accel=AT_REST)
ROWS = timeline(SESSION)
OUT = '/stand/imu/data_raw'


@pytest.fixture(scope='module')
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp('calibration') / 'unit.yaml'
    truth().save(path)
    return str(path)


def rows(path):
    """(topic, log time, payload) of all messages, by another reader."""
    with Reader(path) as reader:
        found = {}
        for connection, time, payload in reader.messages():
            found.setdefault(connection.topic, []).append((time, bytes(payload)))
        return found


def expected(block=SESSION[IMU]):
    compensator = Compensator(truth())
    readings = [*compensator.compensate_block(block), *compensator.finish()]
    payloads = []
    for r in readings:
        si = ImuBlock(r.stamp, r.values.rate, r.values.force, r.frame_id)
        encoded = encode_rates(si, r.values.rate_covariance, r.values.force_covariance)
        payloads += encoded.payloads()
    return payloads


@pytest.mark.parametrize(
    ('plugin', 'mode'),
    [
        *((plugin, CompressionMode.NONE) for plugin in StoragePlugin),
        # mcap compresses chunks.
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_the_stream_is_compensated_and_the_rest_is_as_it_was(tmp_path, calibration, plugin, mode):
    bag = write_with_rosbags(tmp_path / 'bag', ROWS, plugin, mode)
    target = tmp_path / 'out'
    arguments = ['compensate', str(bag), '--calibration', calibration, '-o', str(target)]
    assert main(arguments) == 0
    before, after = rows(bag), rows(target)
    assert set(after) == {*before, OUT} - {IMU}
    for topic in set(before) - {IMU}:
        if mode is CompressionMode.NONE:
            assert after[topic] == before[topic]
        assert [t for t, _ in after[topic]] == [t for t, _ in before[topic]]
    assert [t for t, _ in after[OUT]] == [t for t, _ in before[IMU]]
    assert [p for _, p in after[OUT]] == expected()
    message = STORE.deserialize_cdr(after[OUT][100][1], Kind.IMU.type_name)
    assert message.orientation_covariance[0] == -1
    assert message.angular_velocity_covariance[0] > 0
    assert message.header.frame_id == 'imu_link'


def test_a_csv_holds_what_the_recording_does(tmp_path, calibration):
    bag = write_with_rosbags(tmp_path / 'bag', ROWS)
    for name in ('out', 'out.csv'):
        imu_calib.compensate(bag, calibration, tmp_path / name)
    frame = pandas.read_csv(tmp_path / 'out.csv', index_col='stamp')
    recorded = imu_calib.read(tmp_path / 'out', OUT)
    stamps = frame.index.to_numpy()
    assert stamps == pytest.approx(recorded.stamp / 1e9, abs=np.spacing(stamps[-1]))
    for name in recorded.columns:
        assert frame[name].to_numpy() == pytest.approx(recorded[name], rel=1e-9)


def test_types_that_nobody_knows_pass_byte_by_byte_with_their_description(tmp_path, calibration):
    text = 'uint8 a\nfloat32[3] b\n'
    payloads = [b'\x00\x01\x00\x00' + bytes([k]) * (4 + k) for k in range(50)]
    profile = dump([{**qos_profile(), 'history': 'keep_last', 'depth': 7}])
    path = tmp_path / 'bag'
    with RecordingWriter(path, {'mine': 'yes'}) as writer:
        described = Described(text, 'ros2msg', profile)
        writer.copy_topic(Topic('/odd', 'my_msgs/msg/Odd', None, described=described))
        log = 1_700_000_000 * 10**9 + np.arange(50) * 10**7
        writer.write('/odd', 'my_msgs/msg/Odd', Messages.join(payloads), log, log - 5)
        writer.write(IMU, Kind.IMU.type_name, encode_imu(SESSION[IMU]), SESSION[IMU].stamp)
    target = tmp_path / 'out'
    words = ['compensate', str(path), '--calibration', calibration, '-o', str(target), '--keep']
    assert main([*words, '--frame-id', 'base_imu']) == 0
    with open_recording(target) as recording:
        assert recording.custom_data['mine'] == 'yes'
        odd = {t.name: t for t in recording.topics}['/odd']
        assert (odd.type, odd.described.definition) == ('my_msgs/msg/Odd', text)
        assert odd.described.profiles == profile
        found = {t.name: (m.payloads(), times) for t, m, times in recording.messages()}
        assert found['/odd'][0] == payloads
        assert np.array_equal(found['/odd'][1].log, log)
        assert np.array_equal(found['/odd'][1].publish, log - 5)
    after = rows(target)
    assert [p for _, p in after[IMU]] == encode_imu(SESSION[IMU]).payloads()
    frame = STORE.deserialize_cdr(after[OUT][0][1], Kind.IMU.type_name).header.frame_id
    assert frame == 'base_imu'


def test_a_type_that_a_sqlite3_file_does_not_describe_passes_too(tmp_path, calibration):
    bag = write_with_rosbags(tmp_path / 'bag', ROWS, StoragePlugin.SQLITE3)
    (file,) = bag.glob('*.db3')
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE topics SET type = 'my_msgs/msg/Odd' WHERE name LIKE '%joint%'")
    (bag / 'metadata.yaml').unlink()
    target = tmp_path / 'out'
    assert main(['compensate', str(bag), '--calibration', calibration, '-o', str(target)]) == 0
    joints = [p for _, topic, p in ROWS if topic.endswith('joint_states')]
    with open_recording(target) as recording:
        found = [p for t, m, _ in recording.messages() if 'joint' in t.name for p in m.payloads()]
        assert found == joints


def test_a_malformed_message_is_left_out_and_said(tmp_path, calibration, capsys):
    path, payloads = tmp_path / 'bag', encode_imu(SESSION[IMU]).payloads()
    payloads[700] = payloads[700][:50]
    with RecordingWriter(path) as writer:
        writer.write(IMU, Kind.IMU.type_name, Messages.join(payloads), SESSION[IMU].stamp)
    target = tmp_path / 'out'
    assert main(['compensate', str(path), '--calibration', calibration, '-o', str(target)]) == 0
    assert '1 malformed' in ' '.join(capsys.readouterr().out.split())
    times = [t for t, _ in rows(target)[OUT]]
    assert times == np.delete(SESSION[IMU].stamp, 700).tolist()


@pytest.mark.parametrize('gravity', [True, False])
def test_samples_without_gravity_are_named(tmp_path, calibration, capsys, gravity):
    up = [0.0, 0.0, GRAVITY * gravity]
    samples = replace(SESSION[IMU], accel=np.tile(up, (len(SESSION[IMU]), 1)))
    with RecordingWriter(tmp_path / 'bag') as writer:
        writer.write(IMU, Kind.IMU.type_name, encode_imu(samples), samples.stamp)
    words = ['compensate', str(tmp_path / 'bag'), '--calibration', calibration]
    assert main([*words, '-o', str(tmp_path / 'out')]) == (0 if gravity else 2)
    assert ('expected gravity' in ' '.join(capsys.readouterr().out.split())) is not gravity


def test_a_combined_calibration_follows_the_recorded_temperature(tmp_path):
    both = combine([point(-40.0, 0.0), point(60.0, 1e-3)], ['a', 'b'])
    both.save(tmp_path / 'both.yaml')
    bag = write_with_rosbags(tmp_path / 'bag', ROWS)
    target = tmp_path / 'out'
    words = ['--calibration', str(tmp_path / 'both.yaml'), '-o', str(target)]
    assert main(['compensate', str(bag), *words]) == 0
    out = np.array(
        [
            STORE.deserialize_cdr(p, Kind.IMU.type_name).angular_velocity.x
            for _, p in rows(target)[OUT]
        ]
    )
    celsius, block = SESSION[TEMPERATURES].celsius, SESSION[IMU]
    scale = truth().imu.gyro.scale_factor / 0.005
    bias = block.gyro[:, 0] * scale - out
    # A temperature counts from half a second after its stamp.
    second = np.maximum((np.arange(len(block)) - 100) // 200, 0)
    assert bias == pytest.approx(1e-3 * (celsius[second] + 40) / 100, abs=1e-12)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        (['--imu', 'fog_navigation'], ['imu: found fog_medium, expected fog_navigation']),
        (['--output-topic', IMU], ['has a topic', '--output-topic']),
        (['--output-topic', 'imu raw'], ['--output-topic: found', 'expected the name of a topic']),
        (['--imu-topic', 'nobody'], ['no such topic']),
        (['-o', 'out.csv', '--keep'], ['out.csv', 'compensated samples alone', '--keep']),
        (
            ['-o', 'out.mcap'],
            ['out.mcap: a recording is a folder', 'leave out .mcap, or write .csv'],
        ),
        (['--calibration', 'both.yaml'], ['no topic of type sensor_msgs/msg/Temperature']),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(
    tmp_path, calibration, capsys, monkeypatch, options, words
):
    monkeypatch.chdir(tmp_path)
    combine([point(0.0, 0.0), point(9.0, 1.0)], ['a', 'b']).save(tmp_path / 'both.yaml')
    imu_only = [row for row in ROWS[:500] if row[1] == IMU]
    bag = write_with_rosbags(tmp_path / 'bag', imu_only)
    arguments = ['compensate', str(bag), '--calibration', calibration, '-o', 'out', *options]
    assert main(arguments) == 2
    errors = ' '.join(capsys.readouterr().err.split())
    assert all(word in errors for word in words), errors
    assert not [*tmp_path.glob('out*')]


def test_the_recordings_own_imu_is_held_against_the_calibration(tmp_path, calibration, capsys):
    text = 'id: another\nunits: si\n'
    bag = write_with_rosbags(tmp_path / 'bag', ROWS[:500], custom={'imu_calib.imu': text})
    assert main(['compensate', str(bag), '--calibration', calibration, '-o', 'out']) == 2
    assert 'imu: found fog_medium, expected another' in ' '.join(capsys.readouterr().err.split())


def test_a_scale_factor_may_be_written_in_other_digits(tmp_path, calibration):
    # 7.8 arcsec in radians: the file of the truth and that of the IMU differ in the last bit.
    bag = write_with_rosbags(tmp_path / 'bag', ROWS[:500])
    words = ['compensate', str(bag), '--calibration', calibration, '--imu', 'fog_medium']
    assert main([*words, '-o', str(tmp_path / 'out')]) == 0


def test_the_calibration_of_another_serial_number_is_refused(tmp_path, capsys):
    file = tmp_path / 'unit.yaml'
    replace(truth(), serial_number='B2').save(file)
    bag = tmp_path / 'bag'
    with RecordingWriter(bag, {SERIAL_NUMBER: 'A1'}) as writer:
        block = SESSION[IMU]
        writer.write(IMU, Kind.IMU.type_name, encode_imu(block), block.stamp)
    words = ['compensate', str(bag), '--calibration', str(file), '-o', str(tmp_path / 'out')]
    assert main(words) == 2
    assert 'serial_number: found B2, expected A1' in capsys.readouterr().err
    assert main([*words, '--serial', 'B2']) == 2
    assert 'is of unit A1' in capsys.readouterr().err
    replace(truth(), serial_number='A1').save(file)
    assert main(words) == 0


def test_a_compensated_recording_is_read_as_what_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    brief_plan(tmp_path / 'short.yaml', 5.0)
    site = ['--latitude', '34.65', '--gravity', '9.797']
    assert main(['simulate', './short.yaml', '-o', 'bag', '--seed', '3', *site]) == 0
    assert main(['compensate', 'bag', '--calibration', 'bag/truth.yaml', '-o', 'out']) == 0
    assert main(['calibrate', 'out', '-o', 'left.yaml']) == 0
    left = Calibration.load(tmp_path / 'left.yaml')
    assert (left.imu.id, left.imu.units) == ('fog_medium', Units.SI)
    # The truth took out all there was.
    assert (np.abs(left.values) < 4.5 * left.std).all()
    capsys.readouterr()
    assert main(['calibrate', 'out', '-o', 'no.yaml', '--imu', 'fog_medium']) == 2
    assert 'units: found pulses, but /imu/data_raw of out was computed' in capsys.readouterr().err
    words = ['compensate', 'bag', '--calibration', 'bag/truth.yaml', '-o', 'both', '--keep']
    assert main(words) == 0
    assert main(['calibrate', 'both', '-o', 'raw.yaml', '--imu-topic', 'imu/pulses']) == 0
    raw = Calibration.load(tmp_path / 'raw.yaml')
    assert (np.abs(raw.values - truth().values) < 4.5 * raw.std).all()
    # What was compensated is said wherever samples are taken for raw ones, and of those alone.
    said = 'are compensated already (by truth.yaml). A calibration of the raw samples does not'
    assert said in ' '.join(left.findings)
    assert said not in ' '.join(raw.findings)
    assert said in imu_calib.verify('out', left).findings[-1]
    assert (
        imu_calib.compensate('out', left, 'again')
        .findings[0]
        .endswith('nor does one of these to the raw samples.')
    )
