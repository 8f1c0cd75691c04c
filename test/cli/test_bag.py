"""I have a bag: an Imu topic of somebody's driver in the hand, and nobody says anything of it."""

import re
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from extent import again
from hand_sessions import spread_holds

import imu_calib
from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.verify import Verdict
from imu_calib.cli.displays import reached
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.hand import FREE, in_frame_of_accelerometers
from imu_calib.model.earth import Site
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import read_imu

TRUTH = Calibration.load(named_file('truths', 'mems_counts'))
LATITUDE, HEIGHT = 48.1, 520.0
UNIT = """
id: mpu9250
units: si
sample_rate: 100 Hz
gyro: {angle_random_walk: 0.01 (deg/s)/sqrt(Hz)}
accelerometer: {velocity_random_walk: 300 ug/sqrt(Hz)}
"""


def recorded(
    folder: Path,
    topic: str,
    holds: int = 24,
    scale: tuple[float, float | Floats] = (1, 1),
    seed: int = 1,
) -> str:
    """A recording of a driver that publishes SI, times something where it does not."""
    unit = read_imu(Section.parse(UNIT, 'the unit'))
    session = spread_holds(holds, 1)
    site = Site.at(LATITUDE * DEG, HEIGHT)
    with RecordingWriter(folder) as writer:
        for block in session.blocks(unit, TRUTH.model, site, seed=seed):
            stamp = block.stamp + (seed - 1) * 24 * 3600 * 10**9  # Another day for each.
            read = ImuBlock(stamp, block.gyro * scale[0], block.accel * scale[1], 'imu')
            kind, messages, stamps = serialised(read)
            writer.write(topic, kind.type_name, messages, stamps)
    return str(folder)


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp('bag') / 'hand', '/imu/data_raw')


@pytest.fixture(scope='module')
def made(bag):
    file = str(Path(bag).parent / 'calibration.yaml')
    words = ['--latitude', str(LATITUDE), '--height', str(HEIGHT), '-o', file]
    assert main(['calibrate', bag, *words]) == 0
    return file


def test_latitude_is_all_that_has_to_be_said(made):
    found = Calibration.load(made)
    assert found.provenance['method'] == 'free_positions'
    true = in_frame_of_accelerometers(TRUTH.model)
    error = (found.values - true.vector())[FREE] / found.std[FREE]
    # 21 errors of one deviation: beyond four in one of 750 such units.
    assert np.abs(error).max() < 4
    findings = ' '.join(found.findings)
    assert (
        'rad/s and m/s^2 (REP 145) are assumed' in findings
        and 'free positions (a unit in the hand) are' in findings
    )


def test_a_report_has_the_site_of_its_calibration(made, bag, tmp_path):
    imu_calib.report(made, tmp_path / 'report.html', bag=bag)
    text = (tmp_path / 'report.html').read_text(encoding='utf-8')
    # The course shows the turns from hold to hold.
    assert 'Course of the session' in text and 'class="block turn"' in text
    assert re.search(r'<title>1 to 2: up to [\d.]+ deg/s, ', text)
    # One that was made with a gravity alone, too.
    words = ['--gravity', '9.81', '-o', str(tmp_path / 'c.yaml')]
    assert main(['calibrate', bag, *words]) == 0
    assert main(['report', str(tmp_path / 'c.yaml'), bag, '-o', str(tmp_path / 'r.html')]) == 0


def test_verify_says_where_the_calibration_was_made(made, bag, capsys):
    # Gravity alone will do, as it does for a calibration.
    assert main(['verify', bag, '--calibration', made, '--gravity', '9.81']) in {0, 1}
    capsys.readouterr()
    assert main(['verify', bag, '--calibration', made]) == 2
    errors = capsys.readouterr().err.replace('\n', ' ')
    assert f'calibration.yaml was made at latitude {LATITUDE:g}.' in errors


def test_a_dead_accelerometer_is_named(tmp_path):
    hand = recorded(tmp_path / 'hand', '/imu', 12, (1, np.array([1.0, 1.0, 0.0])))
    with pytest.raises(NotObservable, match='The accelerometer z reads 0 in every static dwell'):
        imu_calib.calibrate(hand, imu='si', plan='free_positions', latitude=LATITUDE)


def test_holds_too_short_for_an_allan_deviation_have_no_picture_of_it(made):
    with pytest.raises(InputError, match=r'carries no Allan deviation.*Lay the unit down'):
        Calibration.load(made).plot_noise()


def test_latitude_is_asked_for_with_why_and_what_else_would_do(bag, tmp_path, capsys):
    assert main(['calibrate', bag, '--verbose']) == 2
    text = capsys.readouterr().err.replace('\n', ' ')
    assert re.search(
        'give --latitude .* Gravity follows from it, .* --gravity with the measured value', text
    )
    gravity = str(Site.at(LATITUDE * DEG, HEIGHT).gravity)
    words = ['--gravity', gravity, '-o', str(tmp_path / 'c.yaml'), '--verbose']
    assert main(['calibrate', bag, *words]) == 0
    assert re.search('latitude +not stated', capsys.readouterr().out)
    found = Calibration.load(tmp_path / 'c.yaml')
    error = (found.values - in_frame_of_accelerometers(TRUTH.model).vector())[FREE]
    # Nobody said a latitude that gravity could contradict.
    assert not any('off normal gravity' in finding for finding in found.findings)
    # The Earth rate about up is then wrong by 11 deg/h, which spreads over the attitudes.
    assert np.abs(error / found.std[FREE]).max() < 5


@pytest.mark.parametrize(
    ('scale', 'sentence'),
    [
        ((1, 1 / STANDARD_GRAVITY), 'length of the acceleration is .* 1 would be g'),
        ((1, 1000 / STANDARD_GRAVITY), 'length of the acceleration is'),
        ((1 / DEG, 1), 'the gyros read up to .* deg/s is possible'),
    ],
)
def test_what_is_not_in_si_is_not_taken_for_it(tmp_path, capsys, scale, sentence):
    hand = recorded(tmp_path / 'hand', '/imu', 4, scale)
    assert main(['calibrate', hand, '--latitude', '48', '-o', str(tmp_path / 'c.yaml')]) == 2
    text = capsys.readouterr().err.replace('\n', ' ')
    assert re.search(f'the numbers of the IMU are not rad/s and m/s.2: .*{sentence}', text), text
    assert 'vectornav' not in text and 'more sentence: --verbose' in text


@pytest.mark.parametrize(
    ('topic', 'target'),
    [
        ('/imu/data_raw', '/imu/data_calibrated'),
        ('/mavros/imu/data', '/mavros/imu/data_calibrated'),
        ('/camera/imu', '/camera/imu/data_raw'),
        ('/imu/pulses', '/imu/data_raw'),
    ],
)
def test_a_topic_is_called_what_it_is(tmp_path, made, topic, target):
    hand = recorded(tmp_path / 'hand', topic, 2)
    done = imu_calib.compensate(hand, made, tmp_path / 'out')
    assert done.target == target
    with open_recording(tmp_path / 'out') as recording:
        assert [t.name for t in recording.topics] == [target]
        (_, block), *_ = recording.read({target: Kind.IMU})
        assert isinstance(block, ImuBlock)


def test_a_session_is_not_faster_than_itself(bag, made, tmp_path):
    done = imu_calib.compensate(bag, made, tmp_path / 'out')
    assert done.marked == {}
    words = ['--imu', 'mems_counts', '--truth', 'mems_counts']
    assert main(['simulate', 'six_position_by_hand', '-o', str(tmp_path / 'six'), *words]) == 0
    result = imu_calib.calibrate(tmp_path / 'six')
    assert imu_calib.compensate(tmp_path / 'six', result, tmp_path / 'six_out').marked == {}
    # Twice as fast as in the session is still said.
    slow = {**result.calibration.provenance}
    slow['highest_rate'] /= 2
    known = replace(result.calibration, provenance=slow)
    assert imu_calib.compensate(tmp_path / 'six', known, tmp_path / 'slow_out').marked


@pytest.fixture(scope='module')
def by_latitude(bag):
    return imu_calib.calibrate(bag, latitude=LATITUDE).calibration


@pytest.mark.parametrize('off', [0.02, again(0.5), 3.0])
def test_lengths_find_biases_that_moved_without_a_bias_instability(bag, by_latitude, off):
    # Weights of squares follow the state: in 30 steps the search did not converge.
    made = by_latitude
    biases = [p.name.startswith('D_g') for p in made.parameters]
    moved = made.values + np.where(biases, off * DEG, 0.0)
    other = replace(made, model=made.model.with_values(made.parameters, moved))
    found = imu_calib.verify(bag, other, latitude=LATITUDE)
    gyros = found.triads[0]
    assert gyros.verdict is Verdict.FAIL and gyros.diagnosis is not None
    assert 'vanish when the biases are others' in gyros.diagnosis.symptom
    assert not any('did not converge' in text for text in found.findings)


def test_of_biases_that_moved_alone_the_verdict_says_so(by_latitude, tmp_path, capsys):
    made, bag = by_latitude, recorded(tmp_path / 'hand', '/imu', seed=2)
    moved = [{'g': 0.05 * DEG, 'a': 0.03}[p.triad] * (p.name[0] == 'D') for p in made.parameters]
    other = replace(made, model=made.model.with_values(made.parameters, made.values + moved))
    found = imu_calib.verify(bag, other, latitude=LATITUDE)
    assert found.verdict is Verdict.FAIL
    assert found.outcome.startswith('FAIL: the biases moved (gyros by 0.05')
    assert 'deg/s, accelerometers by 3' in found.outcome
    # Lengths do not show scale factors and angles of gyros: nothing is said of these.
    assert 'Scale factors and angles of the accelerometers agree; those of the gyros' in str(found)
    other.save(tmp_path / 'other.yaml')
    words = ['--calibration', str(tmp_path / 'other.yaml'), '--latitude', str(LATITUDE)]
    assert main(['verify', bag, *words]) == 1
    # One table for both, on a screen of 40 lines with what standard error has.
    shown = capsys.readouterr()
    assert len((shown.out + shown.err).splitlines()) <= 40 and 'D_az' in shown.out
    scaled = made.values + moved + [0.01 * (p.name == 'K_ax') for p in made.parameters]
    other = replace(made, model=made.model.with_values(made.parameters, scaled))
    found = imu_calib.verify(bag, other, latitude=LATITUDE)
    assert found.outcome == 'FAIL: the recording contradicts the calibration.'


@pytest.mark.parametrize(
    ('scale', 'sensors', 'words'),
    [
        ((1 / DEG, 1.0), 0, 'Rates in deg/s, stated as rad/s'),
        ((1.0, 1 / STANDARD_GRAVITY), 1, 'not 9.8; 1 would be g'),
    ],
)
def test_numbers_in_other_units_than_those_of_the_calibration_are_named(
    made, scale, sensors, words, tmp_path, capsys
):
    other = recorded(tmp_path / 'other', '/imu/data_raw', scale=scale, seed=2)
    found = imu_calib.verify(other, made, latitude=LATITUDE).triads[sensors]
    assert found.verdict is Verdict.FAIL and words in found.diagnosis.symptom
    assert 'another unit' not in found.diagnosis.symptom
    assert main(['compensate', other, '--calibration', made, '-o', str(tmp_path / 'out')]) == 2
    shown = capsys.readouterr().out
    assert 'written to' in shown and 'as /imu/data_calibrated' in ' '.join(shown.split())
    assert 'Warnings' in shown and 'not in the units of the calibration' in ' '.join(shown.split())


def test_a_number_that_an_option_states_is_not_called_that_of_the_recording(
    made, bag, tmp_path, capsys
):
    other = tmp_path / 'a0.yaml'
    replace(Calibration.load(made), serial_number='A0').save(other)
    assert main(['verify', str(bag), '--serial', 'A1', '--calibration', str(other)]) == 2
    shown = ' '.join(capsys.readouterr().err.split())
    assert 'serial_number: found A0, expected A1 as in --serial.' in shown


def test_one_hold_is_no_plural():
    progress = SimpleNamespace(step=1, standard_deviations=[], parameter_names=[])
    assert reached(progress).startswith('1 hold, ')


def test_few_holds_are_said_on_the_screen_with_what_to_do(tmp_path, capsys):
    few, fewer = (recorded(tmp_path / f'{k}', '/imu', holds=k) for k in (12, 6))
    words = ['--latitude', str(LATITUDE), '-o', str(tmp_path / 'c.yaml')]
    assert main(['calibrate', few, *words]) == 0
    assert '12 holds are few' in capsys.readouterr().out
    assert main(['calibrate', fewer, *words]) == 1
    shown = ' '.join(capsys.readouterr().err.split())
    assert '6 holds were found' in shown
    assert 'Hold the unit still for 3 s in each attitude' in shown


def test_a_file_of_an_si_unit_is_that_of_a_calibration_without_a_name(made, bag, tmp_path):
    file = tmp_path / 'my_imu.yaml'
    file.write_text(UNIT)
    imu_calib.verify(bag, made, latitude=LATITUDE, imu=file)
    imu_calib.compensate(bag, made, tmp_path / 'out', imu=file)
    with pytest.raises(InputError, match='imu: found si, expected mems_counts'):
        imu_calib.verify(bag, made, latitude=LATITUDE, imu='mems_counts')


def test_info_ends_with_2_where_a_topic_is_not_there(bag, capsys):
    assert main(['info', bag, '--imu-topic', '/nothing']) == 2
    assert 'no such topic' in capsys.readouterr().err


def test_info_needs_no_latitude_and_says_that_calibrate_does(bag, capsys):
    assert main(['info', bag]) == 0
    shown = ' '.join(capsys.readouterr().out.split())
    assert 'does not say where it was taken: give --latitude in degrees' in shown
    found, known = imu_calib.inspect(bag), imu_calib.inspect(bag, latitude=LATITUDE)
    assert found.streams == known.streams
    assert 'give `latitude`' in found.missing_input and not known.missing_input


@pytest.mark.parametrize('size', [1000.0, 1e308])
def test_a_false_sample_is_no_other_unit(bag, size, tmp_path):
    """A unit that nobody stated is judged by what most samples show."""
    with open_recording(bag) as recording:
        blocks = [block for _, block in recording.read({'/imu/data_raw': Kind.IMU})]
    with RecordingWriter(tmp_path / 'bag') as writer:
        for block in blocks:
            gyro = block.gyro.copy()
            gyro[len(gyro) // 2, 1] = size
            spoilt = replace(block, gyro=gyro)
            writer.write('/imu', Kind.IMU.type_name, encode_imu(spoilt), block.stamp)
    found = imu_calib.calibrate(tmp_path / 'bag', latitude=LATITUDE, height=HEIGHT).calibration
    true = in_frame_of_accelerometers(TRUTH.model)
    error = (found.values - true.vector())[FREE] / found.std[FREE]
    # As of the sound recording.
    assert np.abs(error).max() < 4


def test_info_tells_times_from_the_start_and_attitudes_in_the_hand(bag):
    looked = imu_calib.inspect(bag, latitude=LATITUDE)
    session = spread_holds(24, 1)
    holds = session.holds
    assert len(looked.streams.dwells) == pytest.approx(24, abs=1)
    for dwell in looked.streams.dwells:
        middle = dwell.at + dwell.seconds / 2
        mine = np.flatnonzero((holds[:, 0] < middle) & (middle < holds[:, 1]))
        assert len(mine) == 1
        assert dwell.heading is None
    assert looked.streams.contradictions == ()


def test_all_commands_speak_of_a_unit_in_the_hand_in_the_same_units(made, bag, capsys):
    assert main(['info', bag, '--latitude', str(LATITUDE), '--verbose']) == 0
    assert 'wz, deg/s' in capsys.readouterr().out
    main(['verify', bag, '--calibration', made, '--latitude', str(LATITUDE)])
    words = ' '.join(capsys.readouterr().out.split())
    assert '|f| - g, mg std' in words
    assert 'deg/h' not in words and ' ug ' not in words
    found = Calibration.load(made)
    frame, shown = found.to_dataframe(), found._repr_html_()
    units = {'K_gx': ('%', 1e-2), 'E_azx': ('deg', DEG), 'D_gy': ('deg/s', DEG)}
    units['D_az'] = 'mg', 1e-3 * STANDARD_GRAVITY
    for k, parameter in enumerate(found.parameters):
        if parameter.name in units:
            unit, scale = units[parameter.name]
            assert frame['unit'][parameter.name] == unit
            assert frame['value'][parameter.name] == pytest.approx(found.values[k] / scale)
    assert 'ppm' not in shown and '>%<' in shown
    compared = imu_calib.compare(found, found).to_dataframe()
    # Zeros by choice of the axes are compared, and are no estimates of the frame.
    both = frame.index.intersection(compared.index)
    assert compared['unit'][both].equals(frame['unit'][both])


def test_all_that_a_recording_does_not_state_is_asked_for_at_once(capsys):
    session = Path(__file__).parents[1] / 'data' / 'hand_session'
    assert main(['calibrate', str(session)]) == 2
    message = ' '.join(capsys.readouterr().err.split())
    assert all(option in message for option in ('--imu,', '--latitude', '--plan'))


def test_info_says_that_another_latitude_is_contradicted(tmp_path, capsys):
    folder = str(tmp_path / 'six')
    assert main(['simulate', 'static_six', '-o', folder, '--seed', '1']) == 0
    seen = imu_calib.inspect(folder).streams
    assert seen is not None and seen.latitude is not None
    latitude, std = seen.latitude
    assert abs(latitude - 34.65) < 4 * std < 10
    assert not any('Earth turn' in sentence for sentence in seen.contradictions)
    capsys.readouterr()
    assert main(['info', folder, '--latitude', '-34.65']) == 0
    out = ' '.join(capsys.readouterr().out.split())
    assert re.search(
        r'The gyros measure a vertical Earth rate of .* show a latitude of 3\d\.\d', out
    )


def test_a_simulated_session_has_the_date_and_the_temperature_that_are_stated(tmp_path):
    words = ['--imu', 'mems_counts', '--truth', 'mems_counts']
    when = ['--start', '2026-01-31T12:00:00Z', '--temperature', '40']
    assert main(['simulate', 'free_positions', '-o', str(tmp_path / 'a'), *words, *when]) == 0
    found = imu_calib.calibrate(tmp_path / 'a').calibration.provenance
    assert found['recorded'] == '2026-01-31T12:00:00Z'
    assert found['temperature']['mean'] == pytest.approx(40.0)
    start = datetime(2026, 1, 31, 12, tzinfo=timezone.utc)
    with open_recording(tmp_path / 'a') as recording:
        assert recording.start_ns is not None
        # The first sample is ready one interval of 10 ms after the start.
        assert recording.start_ns * 1e-9 == pytest.approx(start.timestamp(), abs=0.02)
    for option, value in (('--start', 'yesterday'), ('--start', '1931-01-31')):
        assert main(['simulate', 'free_positions', '-o', str(tmp_path / 'b'), option, value]) == 2
    assert not (tmp_path / 'b').exists()


def test_several_simulated_units_differ(tmp_path, capsys):
    words = ['simulate', 'free_positions', '-o', str(tmp_path / 'a'), '--units', '2']
    assert main(words) == 0
    made = sorted((tmp_path / 'a').iterdir())
    assert [folder.name for folder in made] == ['unit_1', 'unit_2']
    first, second = (Calibration.load(folder / 'truth.yaml').values for folder in made)
    assert np.any(np.abs(first - second) > 0.01 * np.abs(first))
    assert imu_calib.calibrate(made[1]).calibration.serial_number == 'unit_2'
    for other in (['--serial', '7'], ['--imus', 'units.yaml'], ['--units', '0']):
        assert main([*words[:3], str(tmp_path / 'b'), *words[4:], *other]) == 2
    capsys.readouterr()
    assert not (tmp_path / 'b').exists()


def test_an_interrupted_simulation_leaves_nothing_behind(tmp_path, monkeypatch):
    written = RecordingWriter.write
    calls = []

    def interrupted(self, *rest, **named):
        calls.append(self.path.exists())
        if len(calls) > 3:
            raise KeyboardInterrupt
        written(self, *rest, **named)

    monkeypatch.setattr(RecordingWriter, 'write', interrupted)
    words = ['--imu', 'mems_counts', '--truth', 'mems_counts']
    assert main(['simulate', 'free_positions', '-o', str(tmp_path / 'a'), *words]) == 130
    assert calls == [True] * 4
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    'words',
    [
        ('simulate', 'free_positions', '-o', 'none/a'),
        ('report', '{made}', '-o', 'none/r.html'),
        ('montecarlo', 'free_positions', '-o', 'none/p.png'),
        ('calibrate', '{bag}', '-o', 'none/c.yaml'),
    ],
)
def test_a_folder_that_is_not_there_is_refused_alike(
    words, made, bag, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main([word.format(made=made, bag=bag) for word in words]) == 2
    assert 'the folder none does not exist.' in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_exists_is_not_overwritten(tmp_path):
    (tmp_path / 'a').mkdir()
    (tmp_path / 'a' / 'mine').touch()
    with pytest.raises(InputError, match='exists already'):
        imu_calib.simulate('free_positions', tmp_path / 'a')
    assert (tmp_path / 'a' / 'mine').exists()
