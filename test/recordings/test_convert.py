"""What others record: text files, bags of ROS 1, gyros and accelerometers on two topics."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from bag_files import T0, bag_of_ros_1, imu_recording
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from sessions import brief_plan

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.metadata import interpolated_from

ROW = 't,wx,wy,wz,ax,ay,az\n'


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding='utf-8')
    return path


WORDS = {'gyro': 'wx,wy,wz:deg/s', 'accel': 'ax,ay,az:g', 'stamp': 't:s'}


def converted(path: Path, **stated: str) -> imu_calib.Columns:
    out = path.with_suffix('.out')
    imu_calib.convert(path, out, **WORDS | stated)
    return imu_calib.read(out, '/imu/data_raw')


def test_a_session_as_a_text_file_gives_what_its_recording_gives(tmp_path):
    words = {'imu': 'si', 'truth': 'mems_counts', 'seed': 5, 'latitude': 34.65}
    imu_calib.simulate(brief_plan(tmp_path / 'brief.yaml'), tmp_path / 'bag', **words)
    topics = imu_calib.read(tmp_path / 'bag')
    imu = next(t for t in topics.values() if 'angular_velocity.x' in t.columns)
    joints = topics['/turntable/joint_states']
    with (tmp_path / 'log.csv').open('w', encoding='utf-8') as file:
        file.write('time;gx;gy;gz;ax;ay;az;outer;middle;inner\n')
        angles = np.column_stack(
            [
                np.interp(imu.stamp, joints.stamp, joints[f'position.{j}'])
                for j in ('outer', 'middle', 'inner')
            ]
        )
        for k, stamp in enumerate(imu.stamp.tolist()):
            rates = [imu[f'angular_velocity.{a}'][k] / DEG for a in 'xyz']
            forces = [imu[f'linear_acceleration.{a}'][k] / STANDARD_GRAVITY for a in 'xyz']
            row = [f'{v!r}' for v in map(float, (*rates, *forces, *(angles[k] / DEG)))]
            file.write(';'.join([str(stamp // 1000), *row]).replace('.', ',') + '\n')
    command = ['convert', str(tmp_path / 'log.csv'), '-o', str(tmp_path / 'again')]
    command += ['--stamp', 'time:us', '--gyro', 'gx,gy,gz:deg/s', '--accel', '5,6,7:g']
    assert main([*command, '--joints', 'outer,middle,inner:deg']) == 0
    one = imu_calib.calibrate(tmp_path / 'bag', plan='none', terms='none').calibration
    other = imu_calib.calibrate(tmp_path / 'again', latitude=34.65, terms='none').calibration
    assert np.abs((other.values - one.values) / one.std).max() < 0.5
    # Encoders are read at other instants: what little they scatter here differs.
    assert other.std == pytest.approx(one.std, rel=0.5)


@pytest.mark.parametrize(
    'text',
    [
        ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n',
        '# made by a logger\n% of ours\n\n' + ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n',
        ROW.replace(',', '\t') + '1.5\t90\t0\t0\t0\t0\t1\n1.6\t90\t0\t0\t0\t0\t1\n',
        ROW.replace(',', ' ') + ' 1.5 90  0 0 0 0 1\n1.6 90 0 0 0 0 1\n',
        ROW.replace(',', ';') + '1,5;90;0;0;0;0;1\n1,6;90;0;0;0;0;1\n',
        '\ufeff"t","wx","wy","wz","ax","ay","az"\n1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n',
        ROW.replace('az', 'az,note') + '1.5,90,0,0,0,0,1,up\n1.6,90,0,0,0,0,1,\n',
        '# ' + ROW.replace(',', ' ') + '1.5 90 0 0 0 0 1\n1.6 90 0 0 0 0 1\n',
        'Fs,10\nLogger of ours\n' + ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n',
        ROW.replace(',', '\t') + '1,5\t90\t0\t0\t0\t0\t1\n1,6\t90\t0\t0\t0\t0\t1\n',
        '# ' + ROW.replace(',', ' ') + ' 1.5 90 0 0\t 0 0 1\n 1.6 90 0 0\t 0 0 1\n',
        ROW + '1.5,90,0,0,0,0,1,\n1.6,90,0,0,0,0,1,\n',
        't:1.5,wx:90,wy:0,wz:0,ax:0,ay:0,az:1\nt:1.6,wx:90,wy:0,wz:0,ax:0,ay:0,az:1\n',
        't=1.5 wx=90 wy=0 wz=0 ax=0 ay=-.0 az= 1\nt=1.6 wx=90 wy=0 wz=0 ax=0 ay=0 az= 1\n',
    ],
)
def test_tables_are_read_as_people_write_them(text, tmp_path):
    columns = converted(write(tmp_path / 'log.csv', text))
    assert columns.stamp.tolist() == [1_500_000_000, 1_600_000_000]
    assert columns['angular_velocity.x'] == pytest.approx([np.pi / 2] * 2)
    assert columns['linear_acceleration.z'] == pytest.approx([9.80665] * 2)
    assert columns.units['angular_velocity.x'] == 'rad/s'


def test_labels_before_several_numbers_are_no_names_of_columns(tmp_path):
    path = write(tmp_path / 'log.csv', 'T: 1.5 G: 90 0 0 A: 0 0 1\nT: 1.6 G: 90 0 0 A: 0 0 1\n')
    columns = converted(path, stamp='1:s', gyro='2,3,4:deg/s', accel='5,6,7:g')
    assert columns['angular_velocity.x'] == pytest.approx([np.pi / 2] * 2)
    assert columns['linear_acceleration.z'] == pytest.approx([9.80665] * 2)


def test_a_labelled_line_that_is_cut_off_is_counted(tmp_path):
    row = 't={} wx=90 wy=0 wz=0 ax=0 ay=0 az=1\n'
    rows = [row.format(1.5 + 0.1 * k) for k in range(20)]
    path = write(
        tmp_path / 'log.txt', ''.join(['MPU6050 OK\n', *rows[:9], 't=2.3 wx=9\n', *rows[9:]])
    )
    done = imu_calib.convert(path, tmp_path / 'bag', **WORDS)
    assert '2 lines of log.txt are not rows of numbers; left out.' in done.findings


def test_a_time_before_a_trigger_is_shifted_to_begin_at_0(tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '-0.1,90,0,0,0,0,1\n0.0,90,0,0,0,0,1\n')
    done = imu_calib.convert(path, tmp_path / 'bag', **WORDS)
    assert imu_calib.read(done.path, '/imu/data_raw').stamp.tolist() == [0, 100_000_000]
    assert any('begins at -0.1 s' in text for text in done.findings)


def test_a_heading_in_the_code_page_of_windows_is_read(tmp_path):
    text = ROW.replace('wx', 'wx (°/s)') + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n'
    (tmp_path / 'log.csv').write_bytes(text.encode('cp1252'))
    assert len(converted(tmp_path / 'log.csv', gyro='wx (°/s),wy,wz:deg/s')) == 2


def test_a_recording_that_cannot_be_completed_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = write(tmp_path / 'log.csv', ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n')
    imu_calib.convert(path, tmp_path / 'bag', **WORDS)
    monkeypatch.setattr(RecordingWriter, 'write', full)
    topics = {'gyro_topic': '/imu/data_raw', 'accel_topic': '/imu/data_raw'}
    for source, words in ((path, WORDS), (tmp_path / 'bag', topics)):
        with pytest.raises(OSError, match='No space left'):
            imu_calib.convert(source, tmp_path / 'out', **words)
        assert not (tmp_path / 'out').exists()


def test_a_table_in_utf_16_is_read_and_a_file_of_matlab_is_named(tmp_path):
    text = ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n'
    (tmp_path / 'log.csv').write_text(text, encoding='utf-16')
    assert len(converted(tmp_path / 'log.csv')) == 2
    (tmp_path / 'data.mat').write_bytes(b'MATLAB 5.0 MAT-file' + bytes(100) + b'\x9b\xff')
    with pytest.raises(InputError, match=r'is a file of MATLAB: writematrix there'):
        converted(tmp_path / 'data.mat')


def test_a_log_of_novatel_is_read_by_its_raw_samples_and_a_minus_negates(tmp_path):
    rows = [
        f'%RAWIMUSA,2387,{k / 100:.3f};2387,{k / 100:.9f},00000077,414,-262,6,{k},-3,2*c2ce6f44'
        for k in range(3)
    ]
    path = write(tmp_path / 'log.asc', '\n'.join(['#BESTPOSA,COM1,0;SOL_COMPUTED*1', *rows, '']))
    words = {'gyro': '12,-11,10:count', 'accel': '9,-8,7:count', 'imu': 'mems_counts'}
    imu_calib.convert(path, tmp_path / 'out', stamp='5:s', **words)
    found = imu_calib.read(tmp_path / 'out', '/imu/pulses')
    assert [found[f'angular_velocity.{a}'].tolist() for a in 'xyz'] == [[2] * 3, [3] * 3, [0, 1, 2]]
    assert [found[f'linear_acceleration.{a}'][0] for a in 'xyz'] == [6, 262, 414]


def test_columns_without_a_heading_have_places_and_rows_may_have_a_rate(tmp_path):
    path = write(tmp_path / 'log.txt', '1 2 3 4 5 6\n7 8 9 10 11 12\n')
    out = tmp_path / 'out'
    words = ['--rate', '50', '--gyro', '4,5,6:rad/s', '--accel', '1,2,3:m/s^2']
    assert main(['convert', str(path), '-o', str(out), *words]) == 0
    columns = imu_calib.read(out, '/imu/data_raw')
    assert columns.stamp.tolist() == [0, 20_000_000]
    assert columns['angular_velocity.z'].tolist() == [6.0, 12.0]
    assert columns['linear_acceleration.x'].tolist() == [1.0, 7.0]


def test_broken_rows_are_left_out_and_counted(tmp_path):
    rows = '.1,9,0,0,0,0,1\n.2,9,0,0\n.3,,0,0,0,0,1\nend of file\n.4,9,0,0,0,0,1\n'
    path = write(tmp_path / 'log.csv', ROW + rows)
    done = imu_calib.convert(
        path, tmp_path / 'out', stamp='t:s', gyro='wx,wy,wz:deg/s', accel='ax,ay,az:g'
    )
    assert done.counts == {'/imu/data_raw': 2}
    assert done.findings == (
        '2 lines of log.csv are not rows of numbers; left out.',
        '1 row holds no number in a column that is needed; left out.',
    )


def test_rows_of_joints_alone_are_used_and_not_said_to_be_left_out(tmp_path):
    rows = (
        '.1,9,0,0,0,0,1,\n.15,,,,,,,3\n.2,9,0,0,0,0,1,\n.25,,,,,,,4\n.3,,0,0,0,0,1,\n.35,,,,,,,\n'
    )
    path = write(tmp_path / 'log.csv', ROW.replace('\n', ',yaw\n') + rows)
    words = {'gyro': 'wx,wy,wz:deg/s', 'accel': 'ax,ay,az:g', 'joints': 'yaw:deg'}
    done = imu_calib.convert(path, tmp_path / 'out', stamp='t:s', **words)
    assert done.counts == {'/imu/data_raw': 2, '/turntable/joint_states': 2}
    said = '2 rows hold no number in a column that is needed; left out.'
    assert done.findings == (said,)


def logged(times: list[str]) -> str:
    return ROW + ''.join(f'{time},9,0,0,0,0,1\n' for time in times)


@pytest.mark.parametrize(
    ('times', 'stamp', 'sentence'),
    [
        # Six digits of a time since 1970.
        (
            [f'{1.7e9 + k / 100:.6g}' for k in range(200)],
            't:s',
            r'log.csv: `stamp` t:s: the time does not increase in 199 of 199 intervals, first from '
            r'1700000000.000000 to 1700000000.000000 s. '
            r'Name the column of the time, with all its digits \(two columns: sec:s,nanosec:ns\), '
            r'or give `rate`',
        ),
        (
            [f'{2 - k / 100:.2f}' for k in range(100)],
            't:s',
            'does not increase in 99 of 99 intervals',
        ),
        # Three of 199 of a time that else grows: 1.5 %.
        (
            [f'{0.5 if k in (60, 90, 120) else k / 100:.2f}' for k in range(200)],
            't:s',
            'does not increase in 3 of 199 intervals',
        ),
        (
            [str(10_000 * k) for k in range(100)],
            't:ns',
            r'log.csv: `stamp` t:ns: found 1e\+05 Hz by the median interval, '
            r'expected 2 Hz to 40 kHz, the rates of IMUs. In another unit, us would be 100 Hz.',
        ),
        ([str(10 * k) for k in range(100)], 't:s', 'found 0.1 Hz.*, ms would be 100 Hz.'),
        ([str(10**10 * k) for k in range(100)], 't:ns', 'found 0.1 Hz.*Name the column of the'),
    ],
)
def test_what_is_no_time_of_an_imu_is_refused(times, stamp, sentence, tmp_path):
    with pytest.raises(InputError, match=sentence):
        converted(write(tmp_path / 'log.csv', logged(times)), stamp=stamp)
    assert not (tmp_path / 'log.out').exists()


@pytest.mark.parametrize(('unit', 'ticks'), [('us', 10_000), ('ms', 10)])
def test_a_counter_that_begins_anew_goes_on(unit, ticks, tmp_path):
    times = [str((2**32 - 500 * ticks + k * ticks) % 2**32) for k in range(1000)]
    path = write(tmp_path / 'log.csv', logged(times))
    done = imu_calib.convert(path, tmp_path / 'out', **WORDS | {'stamp': f't:{unit}'})
    stamps = imu_calib.read(tmp_path / 'out', '/imu/data_raw').stamp
    assert np.diff(stamps) == pytest.approx(10_000_000, abs=1000)
    (said,) = done.findings
    assert 'wraps once, as a 32-bit counter of m' in said
    with pytest.raises(InputError, match='does not increase in 3 of'):
        backwards = [0.3 if k in (60, 90, 120) else k / 100 for k in range(200)]
        converted(write(tmp_path / 'back.csv', logged([f'{t:.2f}' for t in backwards])))


def test_a_time_in_two_columns_is_their_sum(tmp_path):
    rows = [f'{k // 100},{k % 100 * 10_000_000},9,0,0,0,0,1\n' for k in range(300)]
    path = write(tmp_path / 'log.csv', ROW.replace('t,', 'sec,nanosec,') + ''.join(rows))
    stamps = converted(path, stamp='sec:s,nanosec:ns').stamp
    assert (np.diff(stamps) == 10_000_000).all()
    with pytest.raises(InputError, match='two columns: sec:s,nanosec:ns'):
        imu_calib.convert(path, tmp_path / 'no', **WORDS | {'stamp': 'sec:s'})


def test_rows_with_labels_of_two_kinds_are_no_table(tmp_path):
    rows = 'G: 1.0, 2.0, 3.0\nA: 1.0, 2.0, 3.0\n' * 20
    words = {'rate': '100 Hz', 'gyro': '1,2,3:deg/s', 'accel': '1,2,3:g'}
    with pytest.raises(InputError, match=r'column 1 of .* holds no number'):
        imu_calib.convert(write(tmp_path / 'log.csv', rows), tmp_path / 'out', **words)


def test_temperatures_in_thousandths_of_a_degree_have_a_unit(tmp_path):
    text = ROW.replace('\n', ',T\n') + '1.5,9,0,0,0,0,1,25000\n1.6,9,0,0,0,0,1,25000\n'
    path = write(tmp_path / 'log.csv', text)
    with pytest.raises(InputError, match=r'median is 25000 degrees.*\(25.0 degC\): mdegC'):
        converted(path, temperature='T:degC')
    converted(path, temperature='T:mdegC')
    readings = imu_calib.read(path.with_suffix('.out'), '/imu/temperature')
    assert readings['temperature'].tolist() == [25.0, 25.0]


def test_a_row_that_was_written_twice_is_no_reason(tmp_path):
    times = [f'{(k - (k == 50)) / 100:.2f}' for k in range(200)]
    assert len(converted(write(tmp_path / 'log.csv', logged(times))).stamp) == 200


def test_rate_and_duration_of_what_was_written_are_printed(tmp_path, capsys):
    path = write(tmp_path / 'log.csv', logged([f'{k / 100:.2f}' for k in range(1001)]))
    columns = ['--stamp', 't:s', '--gyro', 'wx,wy,wz:deg/s', '--accel', 'ax,ay,az:g']
    out = tmp_path / 'out'
    assert main(['convert', str(path), '-o', str(out), *columns]) == 0
    text = '1001 messages on /imu/data_raw in 10.0 s, 100 Hz, written to'
    assert text in capsys.readouterr().out
    columns[:2] = ['--rate', '0.1 Hz']
    assert main(['convert', str(path), '-o', str(tmp_path / 'other'), *columns]) == 2
    assert (
        '--rate: found 0.1, expected samples per second: 2 Hz to 40 kHz' in capsys.readouterr().err
    )


def test_pulses_stay_pulses_and_need_a_description(tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '1,3,0,-1,0,0,9\n1.01,4,0,-1,0,0,8\n')
    words = {'stamp': 't:s', 'gyro': 'wx,wy,wz:pulse', 'accel': 'ax,ay,az:pulse'}
    with pytest.raises(InputError, match='in pulses: give `imu`'):
        imu_calib.convert(path, tmp_path / 'out', **words)
    imu_calib.convert(path, tmp_path / 'out', imu='fog_medium', **words)
    columns = imu_calib.read(tmp_path / 'out', '/imu/pulses')
    assert columns['angular_velocity.x'].tolist() == [3.0, 4.0]
    assert columns.units['linear_acceleration.x'] == 'pulse'


@pytest.mark.parametrize(
    ('text', 'stated', 'sentence'),
    [
        ('', {}, 'holds no lines: expected'),
        ('%1,2\n', {}, 'holds no lines but comments, # % // first: expected'),
        (ROW, {}, 'log.csv: no row of numbers found'),
        (ROW + '1,2,3,4,5,6,7\n', {'gyro': 'wx,wy:deg/s'}, r'expected NAME,NAME,NAME:UNIT'),
        (ROW + '1,2,3,4,5,6,7\n', {'gyro': 'wx,wx,wz:deg/s'}, '`gyro`: .* names column wx twice'),
        (ROW + '1,2,3,4,5,6,7\n', {'joints': 'ax,ax:deg'}, '`joints`: .* names column ax twice'),
        (ROW + '1,2,3,4,5,6,7\n', {'gyro': 'wx,wy,wz:furlong'}, 'the unit one of rad/s'),
        (ROW + '1,2,3,4,5,6,7\n', {'accel': 'a,b,c:g'}, "no column 'a'; it has: t, wx, wy"),
        (ROW + '1,2,3,4,5,6,7\n', {'rate': '9 Hz'}, 'both give the times of the rows'),
        (ROW + '1,2,3,4,5,6,7\n', {'accel_stamp': 't:s'}, '`accel_file`, which is not given'),
        (ROW + '1,2,3,4,5,6,7\n', {'accel': 'ax,ay,az:pulse'}, 'found deg/s and pulse, expected'),
        (ROW + '1,2,3,4,5,6,7\n', {'delimiter': '::'}, "`delimiter`: found '::', expected one"),
        (ROW + '1.7e18,2,3,4,5,6,7\n', {}, r'a row is 1.7e\+18 s from 1970.*its unit \(s, ms'),
        ('a,a,b\n1,2,3\n', {}, 'its heading has a more than once'),
        # Decimal commas between commas; names of the rows that the heading does not have.
        (
            ROW + '1,5,2,5,3,5,4,5,5,5,6,5,7,5\n' * 3,
            {},
            'its heading has 7 names, its rows have 14 fields.*write decimal points',
        ),
        (ROW + '1,1,2,3,4,5,6,7\n' * 3, {}, 'its heading has 7 names, its rows have 8 fields'),
        (ROW + '10:11:12.5,2,3,4,5,6,7\n' * 3, {}, 'column t of .* holds no number. Dates'),
        (ROW + '1|2|3|4|5|6|7\n', {}, "no row of numbers found; a line of it is '1|2|3|4|5|6|7'"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(text, stated, sentence, tmp_path):
    with pytest.raises(InputError, match=sentence):
        converted(write(tmp_path / 'log.csv', text), **stated)
    assert not (tmp_path / 'log.out').exists()


def test_other_commands_name_the_way(tmp_path, capsys):
    for name, word in (('b.bag', 'bag of ROS 1'), ('c.ulg', 'PX4')):
        path = write(tmp_path / name, 'x')
        assert main(['calibrate', str(path)]) == 2
        errors = ' '.join(capsys.readouterr().err.split())
        assert word in errors
        assert 'imu-calib convert' in errors


@pytest.mark.parametrize(
    ('stated', 'sentence'),
    [
        (
            {'accel': 'ax,ay,az:m/s^2'},
            'length of the acceleration is 1, not 9.8; 1 w',
        ),
        (
            {'gyro': 'wx,wy,wz:rad/s'},
            'up to 90, faster than any IMU turns in rad/s; deg/s is possible.',
        ),
        # What was stated is not offered: 180000 of a log in deg/h.
        (
            {'gyro': 'vx,wy,wz:deg/s'},
            'up to 1.8e+05, faster than any IMU turns in deg/s; deg/h or mdps is possible.',
        ),
        ({'accel': 'ax,ay,az:mg'}, 'is 1, not 1000 mg; g is possible.'),
    ],
)
def test_numbers_of_other_units_than_stated_are_said(stated, sentence, tmp_path):
    path = write(
        tmp_path / 'log.csv',
        't,wx,wy,wz,ax,ay,az,vx\n1.5,90,0,0,0,0,1,180000\n1.6,90,0,0,0,0,1,180000\n',
    )
    words = {'gyro': 'wx,wy,wz:deg/s', 'accel': 'ax,ay,az:g', 'stamp': 't:s'} | stated
    (finding,) = imu_calib.convert(path, tmp_path / 'out', **words).findings
    assert finding.startswith('Warning: The stated units may be wrong: ') and sentence in finding


def test_gyros_and_accelerometers_in_two_files_become_one_recording(tmp_path, capsys):
    rates = ''.join(f'{k / 100:.2f},{k},0,0\n' for k in range(101))
    forces = ''.join(f'{20 * k} 0 0 {k}\n' for k in range(40))
    gyro = write(tmp_path / 'gyro.csv', 't,wx,wy,wz\n' + rates)
    accel = write(tmp_path / 'accel.txt', forces)
    command = ['convert', str(gyro), '-o', str(tmp_path / 'out'), '--stamp', 't:s']
    command += ['--gyro', 'wx,wy,wz:rad/s', '--accel', '2,3,4:m/s^2']
    assert main(command[:-2]) == 2
    errors = capsys.readouterr().err
    assert 'State --accel NAME,NAME,NAME:UNIT (' in errors and 'own: --accel-file).' in errors
    command += ['--accel-file', str(accel)]
    assert main([*command, '--accel-stamp', '1:us']) == 2
    assert 'in another unit, ms would be 50 Hz' in capsys.readouterr().err.lower().replace(
        'hz', 'Hz'
    )
    assert main([*command, '--accel-stamp', '1:ms']) == 0
    assert 'The accelerometers (50 Hz)' in capsys.readouterr().out.replace('\n', ' ')
    with open_recording(tmp_path / 'out') as made:
        assert interpolated_from(made.custom_data, '/imu/data_raw') == pytest.approx(50)
        assert interpolated_from(made.custom_data, '/other') is None
    columns = imu_calib.read(tmp_path / 'out', '/imu/data_raw')
    assert columns.stamp.tolist() == [10_000_000 * k for k in range(79)]
    assert columns['angular_velocity.x'].tolist() == list(range(79))
    assert columns['linear_acceleration.z'] == pytest.approx(np.arange(79) / 2)


def test_a_calibration_says_that_its_accelerometers_were_interpolated(tmp_path):
    imu_calib.simulate('free_positions', tmp_path / 'hand', imu='si', truth='mems_counts', seed=1)
    seen = imu_calib.read(tmp_path / 'hand', '/imu/pulses')
    stamp = (seen.stamp - seen.stamp[0]) * 1e-9
    rates = np.column_stack([stamp, *(seen[f'angular_velocity.{a}'] for a in 'xyz')])
    forces = np.column_stack([stamp, *(seen[f'linear_acceleration.{a}'] for a in 'xyz')])
    np.savetxt(tmp_path / 'gyro.txt', rates)
    np.savetxt(tmp_path / 'accel.txt', forces[::4])
    imu_calib.convert(
        tmp_path / 'gyro.txt',
        tmp_path / 'out',
        stamp='1:s',
        gyro='2,3,4:rad/s',
        accel='2,3,4:m/s^2',
        accel_file=tmp_path / 'accel.txt',
    )
    found = imu_calib.calibrate(tmp_path / 'out', latitude=34.65).calibration
    assert found.provenance['accel_interpolated_from_hz'] == pytest.approx(25)
    (finding,) = [text for text in found.findings if 'interpolated' in text]
    assert 'recorded at 25 Hz' in finding and 'over less than 0.08 s' in finding
    imu_calib.report(found, tmp_path / 'report.html')
    assert 'interpolated from 25' in (tmp_path / 'report.html').read_text(encoding='utf-8')


def test_counts_in_two_files_are_joined_at_shared_times_alone(tmp_path):
    gyro = write(tmp_path / 'gyro.txt', '0.00 1 2 3\n0.01 4 5 6\n0.02 7 8 9\n')
    write(tmp_path / 'same.txt', '0.00 10 20 30\n0.01 40 50 60\n0.02 70 80 90\n')
    write(tmp_path / 'other.txt', '0.00 10 20 30\n0.02 40 50 60\n0.04 70 80 90\n')
    write(tmp_path / 'later.txt', '7.00 10 20 30\n7.02 40 50 60\n7.04 70 80 90\n')
    words = {'stamp': '1:s', 'gyro': '2,3,4:count', 'accel': '2,3,4:count', 'imu': 'mems_counts'}
    done = imu_calib.convert(
        gyro,
        tmp_path / 'out',
        accel_file=tmp_path / 'same.txt',
        **words,
    )
    assert done.counts == {'/imu/pulses': 3} and done.findings == ()
    columns = imu_calib.read(tmp_path / 'out', '/imu/pulses')
    assert columns['linear_acceleration.y'].tolist() == [20, 50, 80]
    with pytest.raises(InputError, match='1 of 3 rows of the gyros have no row'):
        imu_calib.convert(
            gyro,
            tmp_path / 'no',
            accel_file=tmp_path / 'other.txt',
            **words,
        )
    words |= {'gyro': '2,3,4:rad/s', 'accel': '2,3,4:g', 'imu': 'si'}
    with pytest.raises(InputError, match='do not overlap'):
        imu_calib.convert(
            gyro,
            tmp_path / 'no',
            accel_file=tmp_path / 'later.txt',
            **words,
        )
    assert not (tmp_path / 'no').exists()


def test_gyros_and_accelerometers_on_two_topics_become_one(tmp_path):
    gyro_at = T0 + np.arange(400) * 5_000_000
    accel_at = T0 + 2_000_000 + np.delete(np.arange(200), [50, 51, 52]) * 10_000_000
    rates = np.column_stack([np.arange(400.0), np.zeros(400), np.ones(400)])
    # A line in time is read exactly, whatever the stamps.
    seconds = (accel_at - T0) * 1e-9
    forces = np.column_stack([2 * seconds, 1 - seconds, 9.8 + 0 * seconds])
    bag = imu_recording(
        tmp_path / 'bag',
        {
            '/gyro/sample': (gyro_at, rates, np.zeros((400, 3))),
            '/accel/sample': (accel_at, np.zeros((len(accel_at), 3)), forces),
        },
    )
    words = ['--gyro-topic', '/gyro/sample', '--accel-topic', '/accel/sample']
    assert main(['convert', str(bag), '-o', str(tmp_path / 'out'), *words]) == 0
    columns = imu_calib.read(tmp_path / 'out', '/imu/data_raw')
    at = (columns.stamp - T0) * 1e-9
    assert columns['linear_acceleration.x'] == pytest.approx(2 * at, abs=1e-9)
    assert columns['linear_acceleration.y'] == pytest.approx(1 - at, abs=1e-9)
    assert columns['angular_velocity.x'] == pytest.approx(at / 0.005)
    # None is made up before the first, in the gap of 40 ms, or after the last.
    left_out = sorted(set(gyro_at.tolist()) - set(columns.stamp.tolist()))
    gap = [s for s in gyro_at.tolist() if accel_at[49] < s < accel_at[50]]
    ends = [s for s in gyro_at.tolist() if s < accel_at[0] or s > accel_at[-1]]
    assert left_out == sorted(gap + ends)
    assert len(gap) == 8


def test_two_topics_say_at_which_rates_they_come(tmp_path):
    stamp = T0 + np.arange(100) * 5_000_000
    zeros = np.zeros((100, 3))
    later = stamp + 1_000_000
    topics = {'/g': (stamp, zeros, zeros), '/a': (later, zeros, zeros)}
    bag = imu_recording(tmp_path / 'bag', {**topics, '/same': (stamp, zeros, zeros)})
    done = imu_calib.convert(bag, tmp_path / 'same', gyro_topic='/g', accel_topic='/same')
    assert done.findings == ()
    done = imu_calib.convert(bag, tmp_path / 'out', gyro_topic='/g', accel_topic='/a')
    assert '(200 Hz) are interpolated linearly at the stamps of the gyros' in done.findings[0]
    with pytest.raises(InputError, match='recording of rosbag2 already'):
        imu_calib.convert(bag, tmp_path / 'other')
    (tmp_path / 'none').mkdir()
    with pytest.raises(InputError, match='none is a folder without a recording'):
        imu_calib.convert(tmp_path / 'none', tmp_path / 'other')
    with pytest.raises(InputError, match='no topic /none'):
        imu_calib.convert(bag, tmp_path / 'other', gyro_topic='/none', accel_topic='/a')
    with pytest.raises(InputError, match='exists already'):
        imu_calib.convert(bag, tmp_path / 'out', gyro_topic='/g', accel_topic='/a')


def test_a_bag_of_ros_1_becomes_a_recording(tmp_path):
    bag_of_ros_1(tmp_path / 'old.bag')
    assert main(['convert', str(tmp_path / 'old.bag'), '-o', str(tmp_path / 'new')]) == 0
    topics = imu_calib.read(tmp_path / 'new')
    assert list(topics) == ['/imu/data']
    assert topics['/imu/data'].stamp.tolist() == [T0 + k * 10_000_000 for k in range(5)]
    assert topics['/imu/data']['angular_velocity.y'] == pytest.approx([0.2] * 5)
    broken = write(tmp_path / 'broken.bag', 'no bag')
    with pytest.raises(InputError, match='cannot be converted'):
        imu_calib.convert(broken, tmp_path / 'other')


def test_a_bag_of_ros_1_asks_for_the_library(tmp_path, monkeypatch):
    monkeypatch.setattr('imu_calib.common.files.find_spec', lambda _: None)
    with pytest.raises(InputError, match=r"needs rosbags.*'\.\[ros1\]'"):
        imu_calib.convert(write(tmp_path / 'old.bag', 'x'), tmp_path / 'new')


@pytest.mark.parametrize(
    ('stated', 'sentence'),
    [
        ({'joints': 'outer,inner:deg'}, "`joints`: .* no column 'outer'"),
        ({'temperature': 'celsius:degC'}, "`temperature`: .* no column 'celsius'"),
        ({'imu': 'fog_medium'}, '`imu` fog_medium: units: found pulses, but the numbers are rates'),
    ],
)
def test_a_wrong_option_leaves_nothing_behind(stated, sentence, tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '1,2,3,4,5,6,7\n')
    with pytest.raises(InputError, match=sentence):
        converted(path, **stated)
    assert [p.name for p in tmp_path.iterdir()] == ['log.csv']


def test_rates_that_are_not_si_are_not_said_to_lie_on_no_line(tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '1,3,0,-1,0,0,1\n1.01,4,0,-1,0,0,1\n')
    imu_calib.convert(path, tmp_path / 'bag', imu='rates', **WORDS)
    topics = {'gyro_topic': '/imu/pulses', 'accel_topic': '/imu/pulses'}
    with pytest.raises(InputError, match='holds rates, in other units: expected rad/s and m/s'):
        imu_calib.convert(tmp_path / 'bag', tmp_path / 'out', **topics)


def test_names_of_joints_may_stand_apart(tmp_path):
    text = ROW.replace('az', 'az,outer,inner') + '1,2,3,4,5,6,7,90,180\n1.1,2,3,4,5,6,7,90,180\n'
    converted(write(tmp_path / 'log.csv', text), joints='outer, inner : deg')
    joints = imu_calib.read(tmp_path / 'log.out', '/turntable/joint_states')
    assert joints['position.inner'] == pytest.approx([np.pi] * 2)


def test_pulses_on_two_topics_lie_on_no_line(tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '1,3,0,-1,0,0,9\n1.01,4,0,-1,0,0,8\n')
    words = {'stamp': 't:s', 'gyro': 'wx,wy,wz:pulse', 'accel': 'ax,ay,az:pulse'}
    imu_calib.convert(path, tmp_path / 'bag', imu='fog_medium', **words)
    topics = {'gyro_topic': '/imu/pulses', 'accel_topic': '/imu/pulses'}
    with pytest.raises(InputError, match='/imu/pulses holds pulses, which cannot be interpolated'):
        imu_calib.convert(tmp_path / 'bag', tmp_path / 'out', **topics)
    assert not (tmp_path / 'out').exists()


def test_a_bag_of_ros_1_that_cannot_be_read_is_called_by_its_own_name(tmp_path, capsys):
    (tmp_path / 'empty.bag').touch()
    assert main(['convert', str(tmp_path / 'empty.bag'), '-o', str(tmp_path / 'out')]) == 2
    said = capsys.readouterr().err.replace('\n', '')
    assert 'empty.bag' in said
    assert 'bag.bag' not in said


def test_a_bag_of_ros_1_without_an_imu_leaves_nothing_behind(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / 'talk.bag') as writer:
        at = writer.add_connection('/chatter', 'std_msgs/msg/String', typestore=store)
        text = store.types['std_msgs/msg/String']('x')
        writer.write(at, T0, store.serialize_ros1(text, 'std_msgs/msg/String'))
    whole = (tmp_path / 'talk.bag').read_bytes()
    (tmp_path / 'torn.bag').write_bytes(whole[: len(whole) // 2])
    for name in ('talk.bag', 'torn.bag'):
        assert main(['convert', str(tmp_path / name), '-o', str(tmp_path / 'out')]) == 2
        assert not (tmp_path / 'out').exists()


def test_degrees_may_be_written_by_their_sign(tmp_path):
    path = write(tmp_path / 'log.csv', ROW + '1.5,90,0,0,0,0,1\n1.6,90,0,0,0,0,1\n')
    words = {'gyro': 'wx,wy,wz:°/s', 'accel': 'ax,ay,az:g', 'stamp': 't:s'}
    assert imu_calib.convert(path, tmp_path / 'out', **words).findings == ()
