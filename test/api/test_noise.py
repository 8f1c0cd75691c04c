"""`imu_calib.noise` and `imu-calib noise`: inputs, files, and the way there from `calibrate`."""

import csv
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import imu_calib
from imu_calib import InputError, NotObservable
from imu_calib.cli.main import main
from imu_calib.common.stream import Floats, ImuBlock, TemperatureBlock
from imu_calib.recordings.cdr_codec import RATES, Kind, encode_imu, encode_temperatures
from imu_calib.recordings.writer import RecordingWriter

RATE, WALK = 100.0, np.repeat([2e-4, 2e-3], 3)
MEAN = np.array([0.01, -0.02, 0.005, 0.1, -0.2, 9.79])
START = 1_700_000_000_000_000_000


def at_rest(seconds: float, seed: int = 1) -> Floats:
    count = round(seconds * RATE)
    values = np.random.default_rng(seed).normal(size=(count, 6)) * WALK * np.sqrt(RATE)
    return np.asarray(values + MEAN)


def stamps_of(values: Floats) -> Any:
    return START + np.arange(len(values)) * round(1e9 / RATE)


def recorded(path: Path, values: Floats, celsius: Floats | None = None) -> Path:
    stamp = stamps_of(values)
    with RecordingWriter(path) as writer:
        for k in range(0, len(values), 10_000):
            rows = slice(k, k + 10_000)
            block = ImuBlock(stamp[rows], values[rows, :3], values[rows, 3:], 'imu')
            writer.write('/imu/raw', Kind.IMU.type_name, encode_imu(block, RATES), stamp[rows])
        if celsius is not None:
            some = TemperatureBlock(stamp[:: len(stamp) // len(celsius)][: len(celsius)], celsius)
            name = Kind.TEMPERATURES.type_name
            writer.write('/imu/temperature', name, encode_temperatures(some), some.stamp)
    return path


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('rest')
    return recorded(folder / 'still', at_rest(300.0), np.linspace(20.0, 26.0, 100))


def test_a_recording_arrays_and_a_frame_give_the_same(bag):
    values = at_rest(300.0)
    first = imu_calib.noise(bag)
    arrays = imu_calib.noise((values[:, :3], values[:, 3:]), rate=RATE)
    for name, one in first.channels.items():
        assert arrays.channels[name].deviation == pytest.approx(one.deviation, rel=1e-9)
        walk = one.noise.random_walk
        assert walk.value is not None and walk.std is not None
        assert abs(walk.value - WALK[0 if name[0] == 'g' else 3]) < 4.5 * walk.std
    pytest.importorskip('pandas')
    frame = imu_calib.read(bag, '/imu/raw').to_dataframe()
    assert imu_calib.noise(frame).to_dict()['channels'] == first.to_dict()['channels']
    table = first.to_dataframe()
    assert table.loc[('gx', 'random_walk'), 'unit'] == 'deg/sqrt(h)'
    assert table['value'].isna()['gx', 'rate_random_walk']
    assert list(first.curves()) == list(first.channels)


def test_full_overlap_takes_every_second_difference():
    values = at_rest(100.0)
    usual = imu_calib.noise(values, rate=RATE).channels['gx']
    full = imu_calib.noise(values, rate=RATE, full_overlap=True).channels['gx']
    assert np.array_equal(usual.tau, full.tau)
    assert full.deviation[:15] == pytest.approx(usual.deviation[:15], rel=1e-9)
    assert not np.array_equal(usual.deviation, full.deviation)


def test_what_changed_during_the_record_is_said(bag):
    findings = ' '.join(imu_calib.noise(bag).findings)
    assert 'rad/s and m/s^2 (REP 145) are assumed' in findings
    assert 'The temperature ranged from 20.0 to 26.0 degC' in findings
    values = at_rest(200.0)
    values[12_000:, 4] += 0.5
    moved = imu_calib.noise(values, rate=RATE).findings
    assert any('moved or shaken once at 1' in one and 'turned by 2.9 deg' in one for one in moved)


def test_counts_are_read_by_the_file_of_the_unit(tmp_path):
    file = tmp_path / 'unit.yaml'
    file.write_text(
        'id: counts\nunits: counts\n'
        'gyro: {scale_factor: 1.0e-4 rad/s/count}\n'
        'accelerometer: {scale_factor: 1.0e-3 m/s^2/count}\n',
        encoding='utf-8',
    )
    counts = np.rint(at_rest(200.0) / np.repeat([1e-4, 1e-3], 3))
    found = imu_calib.noise(counts, rate=RATE, imu=file)
    assert found.imu == 'counts'
    for name, one in found.channels.items():
        walk = one.noise.random_walk
        assert walk.value == pytest.approx(WALK[0 if name[0] == 'g' else 3], rel=0.05)


def test_a_text_file_is_read_by_its_columns(tmp_path):
    values = at_rest(60.0)
    file = tmp_path / 'log.csv'
    time_ = np.arange(len(values)) / RATE
    rows = np.column_stack([time_, np.degrees(values[:, :3]), values[:, 3:] / 9.80665])
    np.savetxt(file, rows, '%.9g', ',', header='t,wx,wy,wz,ax,ay,az', comments='')
    gyro, accel = 'wx,wy,wz:deg/s', 'ax,ay,az:g'
    found = imu_calib.noise(file, stamp='t:s', gyro=gyro, accel=accel)
    assert found.rate == pytest.approx(RATE)
    assert found.imu == 'log.csv'
    assert found.channels['az'].deviation[0] == pytest.approx(2e-2, rel=0.05)
    assert imu_calib.noise(file, rate=50.0, gyro=gyro, accel=accel).rate == pytest.approx(50.0)
    wrong = imu_calib.noise(file, stamp='t:s', gyro=gyro, accel='ax,ay,az:m/s^2')
    assert wrong.findings[0].startswith(
        'Warning: The stated units may be wrong: the median length of'
    )
    assert '1 would be g' in wrong.findings[0]
    assert not any('units stated' in finding for finding in found.findings)
    with pytest.raises(InputError, match='names columns of a text file'):
        imu_calib.noise(values, rate=RATE, stamp='t:s')


def test_a_unit_at_rest_in_several_attitudes_reads_gravity_in_each():
    values = at_rest(240.0)
    values[len(values) // 2 :, 3:] *= -1.0
    found = imu_calib.noise(values, rate=RATE)
    assert not any('units may be wrong' in finding for finding in found.findings)
    assert any('turned by 1.8e+02 deg' in finding for finding in found.findings)
    assert 0.9 < found.still < 1.0


def test_a_unit_in_motion_is_refused_with_the_facts_of_the_stream():
    values = at_rest(100.0)
    values[:, 2] += np.sin(np.arange(len(values)) / RATE * 3)
    with pytest.raises(NotObservable, match=r'does not lie still.*The stream: 10000 samples'):
        imu_calib.noise(values, rate=RATE)


def test_the_command_prints_and_writes(bag, tmp_path, capsys):
    names = ('html', 'csv', 'kalibr', 'openvins', 'vins', 'robot-localization')
    files = {name: tmp_path / f'{name}.{"csv" if name == "csv" else "out"}' for name in names}
    options = [text for name, path in files.items() for text in (f'--{name}', str(path))]
    assert main(['noise', str(bag), '--topic', '/my/imu', *options]) == 0
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 40
    for words in ('random walk N', 'deg/sqrt(h)', '95 % limit', 'still: 5 min at rest'):
        assert words in shown
    page = files['html'].read_text(encoding='utf-8')
    assert page.count('<svg') == 2 and 'Noise of still' in page and '<script' not in page
    with files['csv'].open(encoding='utf-8') as file:
        rows = list(csv.DictReader(file))
    one = imu_calib.noise(bag).channels['gx']
    seen = [float(row['deviation']) for row in rows if row['channel'] == 'gx']
    assert seen == pytest.approx(one.deviation)
    kalibr = yaml.safe_load(files['kalibr'].read_text(encoding='utf-8'))
    assert kalibr['rostopic'] == '/my/imu'
    assert 'rostopic: /imu/raw' in imu_calib.export(imu_calib.noise(bag), 'kalibr').text
    assert kalibr['gyroscope_noise_density'] == pytest.approx(2e-4, rel=0.05)


def test_the_command_has_a_document(bag, capsys):
    assert main(['noise', str(bag), '--json']) == 0
    document = json.loads(capsys.readouterr().out)
    channel = document['result']['channels']['ax']
    assert channel['coefficients']['random_walk']['value'] == pytest.approx(2e-3, rel=0.05)
    assert channel['coefficients']['rate_random_walk']['value'] is None


def test_a_picture_is_drawn(bag, tmp_path):
    pytest.importorskip('matplotlib')
    assert main(['noise', str(bag), '--plot', str(tmp_path / 'allan.png')]) == 0
    assert (tmp_path / 'allan.png').read_bytes().startswith(b'\x89PNG')
    assert main(['noise', str(bag), '--plot', str(tmp_path / 'allan.doc')]) == 2


@pytest.mark.parametrize('end', [2000.0, 200.0])
def test_calibrate_names_the_command_without_a_search(tmp_path, end, capsys):
    path = recorded(tmp_path / 'still', at_rest(end))
    main(['calibrate', str(tmp_path / 'none')])
    capsys.readouterr()
    # Seconds of the processor: other programs on the machine do not count.
    before = time.process_time()
    assert main(['calibrate', str(path), '-o', str(tmp_path / 'c.yaml')]) == 2
    assert time.process_time() - before < 2.0
    said = capsys.readouterr().err
    assert f'imu-calib noise {path} estimates its noise' in ' '.join(said.split())
    assert not (tmp_path / 'c.yaml').exists()


def test_a_description_of_another_scale_is_not_taken_for_rest(tmp_path):
    path = recorded(tmp_path / 'turned', at_rest(200.0) * (1 + np.arange(20_000)[:, None] % 2))
    with pytest.raises(InputError, match=r'mems_counts.* times gravity.*whose units'):
        imu_calib.calibrate(path, imu='mems_counts', latitude=50.0)


def test_calibrate_reads_on_where_a_long_rest_comes_first(tmp_path):
    values = at_rest(300.0)
    values[28_000:28_400, 1] += 1.0
    with pytest.raises((InputError, NotObservable)) as caught:
        imu_calib.calibrate(recorded(tmp_path / 'later', values), latitude=50.0)
    assert 'imu-calib noise' not in str(caught.value)
