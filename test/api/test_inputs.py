"""Frames and arrays in place of recordings: the same bits, and refusals that say what to do."""

import hashlib
import platform
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sessions import brief_plan

import imu_calib
from imu_calib.api.recorded import recording_at
from imu_calib.api.session import contradicted_site, site_of
from imu_calib.api.streams import temperature_topic
from imu_calib.cli.main import main
from imu_calib.common.files import named_file
from imu_calib.common.finding import is_warning
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.session.keywords import Stated
from imu_calib.session.metadata import PREFIX, serial_key

NAMES = [f'{name}.{a}' for name in ('angular_velocity', 'linear_acceleration') for a in 'xyz']


@pytest.fixture(scope='module')
def hand(tmp_path_factory):
    """A session in the hand, in whole counts."""
    bag = tmp_path_factory.mktemp('hand') / 'bag'
    imu_calib.simulate('free_positions', bag, imu='mems_counts', latitude=48.1, seed=2)
    return bag


@pytest.fixture(scope='module')
def frame(hand):
    (topic,) = (t for t, c in imu_calib.read(hand).items() if c.type == 'sensor_msgs/msg/Imu')
    return imu_calib.read(hand, topic).to_dataframe()


@pytest.fixture(scope='module')
def expected(hand):
    return imu_calib.calibrate(hand).calibration


STATED: dict[str, Any] = {'imu': 'mems_counts', 'latitude': 48.1, 'plan': 'free_positions'}


def same_bits(one: imu_calib.Calibration, other: imu_calib.Calibration) -> bool:
    values = np.array_equal(one.values, other.values)
    return values and np.array_equal(one.covariance, other.covariance, equal_nan=True)


def test_a_frame_gives_the_bits_of_its_recording(frame, expected):
    found = imu_calib.calibrate(frame, **STATED).calibration
    assert same_bits(found, expected)
    assert found.provenance['recording'] == 'data frame'


@pytest.mark.parametrize('index', ['dates of a zone', 'durations', 'seconds'])
def test_the_index_may_be_dates_durations_or_seconds(frame, index):
    other = frame.copy()
    since = frame.index - frame.index[0]
    if index == 'dates of a zone':
        other.index = frame.index.tz_localize('UTC').tz_convert('Asia/Kolkata')
    elif index == 'durations':
        other.index = since.as_unit('us')
    else:
        other.index = pd.Index(since.total_seconds())
    stamps = imu_stamps(other)
    first = stamps[0] if index != 'dates of a zone' else 0
    wanted = frame.index.to_numpy().astype('datetime64[ns]').astype(np.int64)
    # Seconds as floats and microseconds are rounded.
    assert np.abs(stamps - first - (wanted - (wanted[0] if first == stamps[0] else 0))).max() < 2000


def imu_stamps(bag: Any, rate: float | None = None) -> np.ndarray[Any, Any]:
    from imu_calib.recordings.cdr_codec import Kind

    blocks = recording_at(bag, Stated(rate=rate)).read({'/imu/data_raw': Kind.IMU})
    return np.concatenate([block.stamp for _, block in blocks])


def test_arrays_give_the_bits_of_a_frame_of_their_rate(frame):
    values = frame[NAMES].to_numpy()
    by_rate = imu_calib.calibrate(frame.reset_index(drop=True), rate=100.0, **STATED).calibration
    one = imu_calib.calibrate(values, rate=100.0, **STATED).calibration
    two = imu_calib.calibrate((values[:, :3], values[:, 3:]), rate=100, **STATED).calibration
    assert any('K_g is only as good as `rate` 100' in text for text in two.findings)
    assert same_bits(one, by_rate)
    assert same_bits(two, by_rate)
    assert imu_stamps(values, 100.0)[:2].tolist() == [10_000_000, 20_000_000]


def test_a_calibration_states_the_hashes_of_the_files_it_used(hand, frame, tmp_path):
    """Of the recording's own texts, or of the file that is stated in their place."""
    mine = tmp_path / 'mine.yaml'
    mine.write_bytes(named_file('imus', 'mems_counts').read_bytes() + b'# Mine.\r\n')
    shipped = hashlib.sha256(named_file('imus', 'mems_counts').read_bytes()).hexdigest()
    assert imu_calib.calibrate(hand).calibration.provenance['imu_sha256'] == shipped
    stated = imu_calib.calibrate(hand, imu=mine).calibration.provenance
    assert stated['imu_sha256'] == hashlib.sha256(mine.read_bytes()).hexdigest()
    # Held in a hand, without a table; a value has no file.
    assert 'table_sha256' not in stated
    by_value = imu_calib.calibrate(frame, **{**STATED, 'imu': imu_calib.load_imu('mems_counts')})
    assert 'imu_sha256' not in by_value.calibration.provenance
    assert stated['versions']['python'] == platform.python_version()


def warned(samples: Any, rate: float | None, imu: str = 'mems_counts') -> list[str]:
    """Return the warnings of a calibration from samples with a stated rate."""
    session = {**STATED, 'imu': imu, 'rate': rate}
    return [text for text in imu_calib.calibrate(samples, **session).findings if is_warning(text)]


def test_a_wrong_rate_that_moves_all_scale_factors_alike_is_a_warning(frame, tmp_path):
    """Of values of rates K_g, of values over an interval K_a; stamps show the rate themselves."""
    counts = frame[NAMES].to_numpy()
    (said,) = warned(counts, 104.0)
    assert 'K_gx, K_gy, K_gz are all near -3.' in said
    # The K_g of the unit itself have a mean of 0.15 %.
    assert 'by 100.2 Hz in place of 104 Hz' in said
    assert warned(counts, 100.0) == []
    faster = frame.index[0] + (frame.index - frame.index[0]) / 1.04
    assert warned(frame.set_index(faster), None) == []
    mine = {'imu': 'increments', 'truth': 'mems_counts', 'latitude': 48.1}
    imu_calib.simulate('free_positions', tmp_path / 'bag', **mine)
    gained = imu_calib.read(tmp_path / 'bag', '/imu/pulses').to_dataframe()[NAMES].to_numpy()
    (said,) = warned(gained, 105.0, 'increments')
    assert 'K_ax, K_ay, K_az are all near +5.' in said
    assert 'by 99.8' in said


def test_degrees_and_g_are_named_and_compare_with_si(frame):
    imu = imu_calib.load_imu('mems_counts')
    si = frame[NAMES] * ([imu.gyro.scale_factor] * 3 + [imu.accel.scale_factor] * 3)
    other = si / ([DEG] * 3 + [STANDARD_GRAVITY] * 3)
    with pytest.raises(imu_calib.InputError, match="for deg/s and g imu='rates'"):
        imu_calib.calibrate(other, latitude=48.1)
    by_si = imu_calib.calibrate(si, latitude=48.1)
    by_degrees = imu_calib.calibrate(other, latitude=48.1, imu='rates')
    compared = imu_calib.compare(by_si, by_degrees)
    assert np.abs(compared.difference).max() < 1e-9
    for samples, words, made in ((other, 'rates', by_si), (si, 'si', by_degrees)):
        found = imu_calib.verify(samples, made, latitude=48.1, imu=words)
        assert {t.verdict.name for t in found.triads} == {'PASS'} and found.own_recording
    # Read by the calibration's own description they are of another scale; NumPy warns of nothing.
    assert imu_calib.verify(other, by_si, latitude=48.1).verdict.name == 'FAIL'


def test_a_restart_and_a_wrapped_counter_are_said_first(frame):
    seconds = 0.01 * np.arange(len(frame))
    columns = {
        'gyro': f'{",".join(NAMES[:3])}:count',
        'accel': f'{",".join(NAMES[3:])}:count',
        'stamp': 't:us',
    }
    restarted = np.rint(1e6 * np.where(seconds < 55, seconds, seconds - 54))
    found = imu_calib.calibrate(frame.assign(t=restarted), **columns, **STATED).calibration
    assert 'go back by 54.00 s to 1.000 s, 55.0 s after the first sample' in found.findings[0]
    wrapped = (2**32 - 55e6 + 1e6 * seconds) % 2**32
    found = imu_calib.calibrate(frame.assign(t=wrapped), **columns, **STATED).calibration
    assert 'wraps once' in found.findings[0]


def every(frame: Any, interval: float) -> Any:
    """Return a frame with an index of whole intervals."""
    return frame.set_index(interval * np.arange(1, len(frame) + 1))


def test_a_part_of_a_frame_has_the_stamps_of_its_rate(frame):
    part = frame.reset_index(drop=True)[9:]
    assert imu_stamps(part, 100.0)[:2].tolist() == [10_000_000, 20_000_000]


def test_what_a_mask_hides_is_missing():
    from imu_calib.recordings.cdr_codec import Kind

    values = np.ma.masked_array(np.ones((3, 6)), mask=np.eye(3, 6, dtype=bool))
    ((_, block),) = recording_at(values, Stated(rate=100.0)).read({'/imu/data_raw': Kind.IMU})
    assert np.isnan(block.gyro).tolist() == np.eye(3, dtype=bool).tolist()


def test_a_latitude_that_the_recording_contradicts_is_a_warning(hand, expected):
    text = 'The recording states latitude 48.1, and 50 is used'
    off = imu_calib.calibrate(hand, plan='free_positions', latitude=50.0)
    assert text in ' '.join(off.calibration.findings)
    assert text in ' '.join(imu_calib.verify(hand, expected, latitude=50.0).findings)
    same = imu_calib.calibrate(hand, plan='free_positions', latitude=48.14)
    assert 'states latitude' not in ' '.join(same.calibration.findings)


def test_limits_of_another_type_than_the_recordings_are_a_warning(hand, tmp_path):
    def findings(imu):
        return ' '.join(imu_calib.calibrate(hand, imu=imu).calibration.findings)

    own = imu_calib.load_imu('mems_counts')
    said = 'The recording is of a mems_counts, and `imu` states a '
    assert f'{said}wider: the noise, and the limits' in findings(replace(own, id='wider'))
    assert said not in findings(replace(own, sample_rate=90.0))


@pytest.mark.parametrize(
    ('stated', 'expected', 'height'),
    [
        ({'height': 5200.0}, 'states height 520 m, and 5200 m is used', 5200),
        ({'height': 530.0}, '', 530),
        ({'gravity': 9.8}, 'states gravity 9.8073 m/s^2, and 9.8 m/s^2 is used', 520),
        # The height stays where the latitude alone is corrected.
        ({'latitude': 50.1}, 'states latitude 48.1, and 50.1 is used', 520),
        ({'latitude': 50.1, 'height': 5200.0}, 'states height 520 m', 5200),
    ],
)
def test_a_site_that_the_recording_contradicts_is_a_warning(stated, expected, height):
    texts = {'latitude_deg': 48.1, 'height': 520.0, 'gravity': 9.8073, 'gravity_std': 1e-5}
    data = {f'{PREFIX}{name}': str(value) for name, value in texts.items()}
    recording = SimpleNamespace(custom_data=data, path='rec')
    said = ' '.join(contradicted_site(Stated(**stated), recording))
    assert expected in said if expected else not said
    assert site_of(Stated(**stated), recording).height == height


def test_a_frame_is_verified_and_compensated_as_its_recording(hand, frame, expected, tmp_path):
    found = imu_calib.verify(frame, expected, latitude=48.1, imu='mems_counts')
    wanted = imu_calib.verify(hand, expected, latitude=48.1)
    assert [str(t) for t in found.triads] == [str(t) for t in wanted.triads]
    assert found.own_recording and wanted.own_recording
    mine = imu_calib.compensate(frame, expected, tmp_path / 'mine', imu='mems_counts')
    theirs = imu_calib.compensate(hand, expected, tmp_path / 'theirs')
    one = imu_calib.read(mine.path, mine.target).to_dataframe()
    other = imu_calib.read(theirs.path, theirs.target).to_dataframe()
    pd.testing.assert_frame_equal(one, other, check_exact=True)


def test_a_calibration_knows_the_frame_it_was_made_of(frame):
    calibration = imu_calib.calibrate(frame, **STATED).calibration
    assert imu_calib.verify(frame.copy(), calibration, latitude=48.1).own_recording
    part = frame.iloc[: len(frame) * 9 // 10]
    assert imu_calib.verify(part, calibration, latitude=48.1).own_recording
    other = frame.set_axis(frame.index + pd.Timedelta(days=1))
    assert not imu_calib.verify(other, calibration, latitude=48.1).own_recording


def test_a_part_of_a_log_without_dates_is_known_wherever_it_begins(frame, expected, tmp_path):
    values = frame[NAMES].to_numpy()
    made = imu_calib.calibrate(values, rate=100.0, **STATED).calibration
    made.save(tmp_path / 'made.yaml')
    part = values[len(values) // 3 + 1 : len(values) * 2 // 3]
    again = imu_calib.verify(part, tmp_path / 'made.yaml', rate=100.0, latitude=48.1)
    assert again.own_recording and again.verdict.name == 'NOT_TESTED'
    imu_calib.simulate('free_positions', tmp_path / 'bag', imu='mems_counts', latitude=48.1, seed=4)
    (other,) = (c for c in imu_calib.read(tmp_path / 'bag').values() if c.topic.endswith('pulses'))
    samples = other.to_dataframe()[NAMES].to_numpy()
    assert not imu_calib.verify(samples, made, rate=100.0, latitude=48.1).own_recording
    assert 'marks' not in expected.provenance


def test_a_frame_joined_of_several_topics_gives_the_bits_of_a_table(tmp_path):
    imu_calib.simulate(
        brief_plan(tmp_path / 'brief.yaml'), tmp_path / 'bag', seed=3, latitude=34.65
    )
    held = {name: topic.to_dataframe() for name, topic in imu_calib.read(tmp_path / 'bag').items()}
    joined = held['/imu/pulses'].join(held['/turntable/joint_states'], how='outer')
    found = imu_calib.calibrate(joined, imu='fog_medium', latitude=34.65)
    wanted = imu_calib.calibrate(tmp_path / 'bag', plan='none', latitude=34.65)
    assert same_bits(found.calibration, wanted.calibration)


OWN = {'gyro': 'gx,gy,gz:deg/s', 'accel': 'ax,ay,az:g'}


@pytest.fixture(scope='module')
def named(frame):
    """The session in degrees per second and g, in columns as a person calls them."""
    imu = imu_calib.load_imu('mems_counts')
    units = [imu.gyro.scale_factor / DEG] * 3 + [imu.accel.scale_factor / STANDARD_GRAVITY] * 3
    own = (frame[NAMES] * units).set_axis(['gx', 'gy', 'gz', 'ax', 'ay', 'az'], axis=1)
    seconds = (frame.index - frame.index[0]).total_seconds()
    return own.assign(t=np.round(seconds, 6)).reset_index(drop=True)


@pytest.mark.parametrize('written', [False, True])
def test_columns_of_other_names_are_read_by_every_function(named, written, tmp_path):
    bag, columns = named, {'stamp': 't:s', **OWN}
    named.to_csv(tmp_path / 'log.csv', index=False)
    if written:
        bag = tmp_path / 'log.csv'
    imu_calib.convert(tmp_path / 'log.csv', tmp_path / 'bag', **columns)
    found = imu_calib.calibrate(bag, latitude=48.1, **columns).calibration
    wanted = imu_calib.calibrate(tmp_path / 'bag', latitude=48.1).calibration
    assert same_bits(found, wanted)
    assert found.provenance['recording'] == ('log.csv' if written else 'data frame')
    if written:
        content = hashlib.sha256(bag.read_bytes()).hexdigest()
        assert found.provenance['sha256'] == content
    for own in (wanted, found):
        assert imu_calib.verify(bag, own, latitude=48.1, **columns).own_recording
    mine = imu_calib.compensate(bag, wanted, tmp_path / 'mine', **columns)
    theirs = imu_calib.compensate(tmp_path / 'bag', wanted, tmp_path / 'theirs')
    one, other = (imu_calib.read(c.path, c.target).to_dataframe() for c in (mine, theirs))
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    seen = imu_calib.inspect(bag, latitude=48.1, **columns)
    assert seen.topics[0].messages == len(named) and len(seen.streams.dwells) > 10


def test_the_index_is_the_time_of_columns_of_other_names(named):
    indexed = named.set_index(pd.to_timedelta(named['t'], 's'))
    found = imu_calib.calibrate(indexed, latitude=48.1, **OWN).calibration
    wanted = imu_calib.calibrate(named, latitude=48.1, stamp='t:s', **OWN).calibration
    assert same_bits(found, wanted)


def test_a_refusal_states_the_columns_with_the_units_that_the_numbers_allow(named, tmp_path):
    named.to_csv(tmp_path / 'log.csv', index=False)
    words = r'State `stamp` t:s `gyro` gx,gy,gz:deg/s `accel` ax,ay,az:g, if these are the units'
    with pytest.raises(imu_calib.InputError, match=words):
        imu_calib.calibrate(tmp_path / 'log.csv')
    with pytest.raises(imu_calib.InputError, match="stamp='t:s', gyro='gx,gy,gz:deg/s', accel"):
        imu_calib.calibrate(named)
    with pytest.raises(imu_calib.InputError, match="units: gyro='gx,gy,gz:deg/s', accel='ax,ay"):
        imu_calib.calibrate(named.set_index('t'))
    slow = named.assign(gx=0.0, gy=0.0, gz=0.0, ax=named['ax'] * 1000, ay=named['ay'] * 1000)
    slow.assign(az=named['az'] * 1000, t=named['t'] * 1e6).to_csv(tmp_path / 'log.csv')
    with pytest.raises(imu_calib.InputError, match=r't:us `gyro` gx,gy,gz:UNIT `accel` .*:mg'):
        imu_calib.calibrate(tmp_path / 'log.csv')
    counts = (named.drop(columns='t') * 16384).round()
    with pytest.raises(
        imu_calib.InputError, match=r"gyro='gx,gy,gz:count', accel='ax,ay,az:count'"
    ):
        imu_calib.calibrate(counts)


def test_units_that_the_numbers_contradict_are_refused(named, expected):
    columns = {'stamp': 't:s', 'accel': OWN['accel'], 'gyro': 'gx,gy,gz:rad/s'}
    message = 'data frame: The stated units may be wrong: the gyros read up to'
    with pytest.raises(imu_calib.InputError, match=message):
        imu_calib.calibrate(named, latitude=48.1, **columns)
    with pytest.raises(imu_calib.InputError, match=message):
        imu_calib.verify(named, expected, latitude=48.1, imu='si', **columns)
    with pytest.raises(imu_calib.InputError, match=message):
        imu_calib.verify(named, expected, latitude=48.1, **columns)


def test_columns_in_other_units_than_the_calibration_are_read_by_their_own(named, expected):
    """An `imu` that nobody gave was said to contradict the columns."""
    columns = {**OWN, 'stamp': 't:s'}
    for imu in (None, 'si'):
        found = imu_calib.verify(named, expected, latitude=48.1, imu=imu, **columns)
        assert {t.verdict.name for t in found.triads} == {'PASS'}
    made = imu_calib.calibrate(named, latitude=48.1, **columns)
    whole = {'gyro': 'gx,gy,gz:count', 'accel': 'ax,ay,az:count', 'stamp': 't:s'}
    with pytest.raises(imu_calib.InputError, match='in counts, and the calibration is of si: give'):
        imu_calib.verify(named, made, latitude=48.1, **whole)


@pytest.mark.parametrize(
    ('change', 'rate', 'message'),
    [
        (lambda f: f.rename(columns={NAMES[0]: 'gx'}), None, 'no column angular_velocity.x; it'),
        (lambda f: f.reset_index(drop=True), None, 'is no time: set a DatetimeIndex'),
        (lambda f: f.reset_index(drop=True)[9:], None, 'is no time: set a DatetimeIndex'),
        (lambda f: f, 100.0, '`rate`: the index of the data frame is a time already'),
        (lambda f: f.set_index(f.index.astype('int64')), None, 'beyond all dates in seconds'),
        (lambda f: f.assign(**{NAMES[1]: 'a'}), None, 'Column angular_velocity.y.*expected numb'),
        (lambda f: f[NAMES].to_numpy(), None, '`rate` is missing'),
        (lambda f: f[NAMES[:5]].to_numpy(), 100.0, r'shape \(\d+, 5\), expected gyro and acc'),
        (lambda f: f[NAMES].to_numpy(), 0.0, '`rate`: found 0, expected samples per second'),
        (lambda f: f[NAMES].to_numpy(), 0.1, '`rate`: found 0.1, .*: 2 Hz to 40 kHz, the rates'),
        (lambda f: every(f, 10), None, 'counts 0.1 .* in ms it would be 100 Hz: divide it by 1000'),
        (lambda f: every(f, 10.0), None, 'counts 0.1 samples per second; in ms it would be 100 Hz'),
        (lambda f: every(f, 10_000), None, ' in us it would be 100 Hz: divide it by 1000000'),
        (lambda f: f.sample(frac=1.0, random_state=1), None, r'not sorted: give `frame.sort_index'),
        (lambda f: 'bag', 100.0, '`rate` is that of arrays'),
        (lambda f: 7, None, '`bag`: found 7, expected a text, a path, a DataFrame, an array or'),
    ],
)
def test_what_is_no_samples_is_refused(frame, change, rate, message):
    with pytest.raises(imu_calib.InputError, match=message):
        imu_calib.calibrate(change(frame), rate=rate, **STATED)


def test_each_of_several_units_has_its_own_thermometer():
    """Without it the temperature of a session was lost when its journal was calibrated again."""
    kind = Kind.TEMPERATURES.type_name
    serials = {'/unit_A1/imu/pulses': 'A1', '/my/topic': 'B-2', '/third': 'C3'}
    names = ['/unit_A1/imu/temperature', '/stand/unit_B_2/imu/temperature']
    recording: Any = SimpleNamespace(
        topics=[SimpleNamespace(name=name, message_type=kind, count=9) for name in names],
        custom_data={serial_key(topic): serial for topic, serial in serials.items()},
    )
    assert [temperature_topic(recording, imu) for imu in serials] == [*names, None]


@pytest.mark.parametrize('name', ['mems_counts', 'mine'])
def test_the_imu_is_stated_once(frame, tmp_path, name):
    """A log in counts needs it for `calibrate`; other commands find it in the calibration."""
    log, mine = tmp_path / 'log.csv', tmp_path / 'mine.yaml'
    frame[NAMES].set_axis(['gx', 'gy', 'gz', 'ax', 'ay', 'az'], axis=1).set_index(
        frame.index.astype('int64')
    ).to_csv(log, index_label='t')
    text = named_file('imus', 'mems_counts').read_text()
    mine.write_text(re.sub('^id: .*', f'id: {name}', text, flags=re.M))
    words = ['--stamp=t:ns', '--gyro=gx,gy,gz:count', '--accel=ax,ay,az:count']
    made = tmp_path / 'c.yaml'
    stated = [f'--imu={mine}', '--latitude=48.1', '-o', str(made)]
    assert main(['calibrate', str(log), *words, *stated]) == 0
    # With the data sheet of a type that is not shipped, which a calibration does not hold, a
    # report needs its file.
    again = [] if name == 'mems_counts' else stated[:1]
    for command, code in (
        (['verify', str(log), '--calibration', str(made), '--latitude=48.1'], 1),
        (['compensate', str(log), '--calibration', str(made), '-o', str(tmp_path / 'o')], 0),
        (['report', str(made), str(log), *again, '-o', str(tmp_path / 'r.html')], 0),
    ):
        assert main([*command, *words]) == code, command


@pytest.mark.parametrize(
    ('heading', 'scale', 'stated'),
    [
        # As STMicro, Bosch and phyphox write them: the heading's unit, and places for the names
        # that a command line takes only in quotes.
        (
            'timestamp[us],a_x[mg],a_y[mg],a_z[mg],g_x[mdps],g_y[mdps],g_z[mdps]',
            (1e6, 1e3, 1e3),
            ('`stamp` 1:us `gyro` 5,6,7:mdps `accel` 2,3,4:mg'),
        ),
        (
            'Time_(s);ACC_X_(g);ACC_Y_(g);ACC_Z_(g);GYRO_X_(dps);GYRO_Y_(dps);GYRO_Z_(dps)',
            (1, 1, 1),
            ('`stamp` 1:s `gyro` 5,6,7:dps `accel` 2,3,4:g'),
        ),
        (
            '"Time (s)","Acceleration x (g)","Acceleration y (g)","Acceleration z (g)",'
            '"Gyroscope x (°/s)","Gyroscope y (°/s)","Gyroscope z (°/s)"',
            (1, 1, 1),
            ('`stamp` 1:s `gyro` 5,6,7:deg/s `accel` 2,3,4:g'),
        ),
        (
            'Zeit_ms,ax,ay,az,gx,gy,gz',
            (1e3, 1, 1),
            ('`stamp` Zeit_ms:ms `gyro` gx,gy,gz:count `accel` ax,ay,az:g'),
        ),
        (
            'us,ax,ay,az,gx,gy,gz',
            (1e6, 1, 1),
            ('`stamp` us:us `gyro` gx,gy,gz:count `accel` ax,ay,az:g'),
        ),
        # Of ulog2csv, and of mavlogdump with a temperature T.
        (
            'timestamp,accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2],'
            'gyro_rad[0],gyro_rad[1],gyro_rad[2]',
            (1e6, STANDARD_GRAVITY, 0.01),
            ('`stamp` timestamp:us `gyro` 5,6,7:UNIT `accel` 2,3,4:m/s^2'),
        ),
        (
            'timestamp,AccX,AccY,AccZ,GyrX,GyrY,GyrZ,T',
            (1, STANDARD_GRAVITY, 0.01),
            ('`stamp` timestamp:s `gyro` GyrX,GyrY,GyrZ:UNIT `accel` AccX,AccY,AccZ:m/s^2'),
        ),
    ],
)
def test_the_layouts_of_other_loggers_are_suggested_with_their_units(
    heading, scale, stated, tmp_path
):
    """Unit and column of the rows that a person is told to state: none is taken in silence."""
    at, force, rate = scale
    parts = ';' if ';' in heading else ','
    rows = [[k * 0.02 * at, 0, 0, force, rate * k, 0, 0, 35.5] for k in range(100)]
    count = heading.count(parts) + 1
    text = '\n'.join(parts.join(f'{v:.6f}' for v in row[:count]) for row in rows)
    (tmp_path / 'log.csv').write_text(f'{heading}\n{text}\n', encoding='utf-8')
    with pytest.raises(imu_calib.InputError) as refused:
        imu_calib.calibrate(tmp_path / 'log.csv')
    assert f'State {stated}, if these are the units' in str(refused.value)
