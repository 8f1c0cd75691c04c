"""Input that cannot work, through the command line: a sentence, an exit code, and no wrong number.

One good session is simulated; each test damages it and says what must come of it. Where a result
comes out, it is held to the truth: a damage that is not stated must not show in the numbers.
"""

import os
import re
import shutil
import struct
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from extent import again
from loopback import completed
from sessions import SITE, paper_imu, stand, truth

from imu_calib.api.calibrate import _unfinished_first
from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.files import named_file
from imu_calib.common.stream import (
    Block,
    Floats,
    ImuBlock,
    JointBlock,
    Mode,
    SetpointBlock,
    Stamps,
    TemperatureBlock,
)
from imu_calib.common.units import DEG
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import ImuSpec
from imu_calib.session.plan import Plan, read_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import Shock
from imu_calib.simulation.stand import SimulatedStand

NS = 1_000_000_000
IMU, JOINTS, SETPOINTS = '/imu/pulses', '/turntable/joint_states', '/turntable/setpoint'
Columns = dict[str, Block]
Outcome = tuple[int, str]


def text_of(kind: str, name: str) -> str:
    return named_file(kind, name).read_text(encoding='utf-8')


ALL_RATES = '[10 deg/s, -10 deg/s, 30 deg/s, -30 deg/s, 60 deg/s, -60 deg/s]'
PLAN_TEXT = (
    text_of('plans', 'twelve_position')
    .replace('dwell: 120 s', 'dwell: 20 s')
    .replace(ALL_RATES, '[60 deg/s, -60 deg/s]')
)
WITH_SLOW_TURNS = PLAN_TEXT.replace('[60 deg/s', '[30 deg/s, -30 deg/s, 60 deg/s')
DATA = {
    'imu_calib.plan': PLAN_TEXT,
    'imu_calib.imu': text_of('imus', 'fog_medium'),
    'imu_calib.table': text_of('tables', 'three_axis'),
    'imu_calib.latitude_deg': '34.65',
    'imu_calib.gravity': repr(SITE.gravity),
    'imu_calib.gravity_source': 'measured',
}


@dataclass(frozen=True)
class Session:
    """A session as whole columns, and when its steps were run (s since its start)."""

    columns: Columns
    dwells: dict[str, tuple[float, float]]
    turns: list[tuple[float, float]]

    @property
    def imu(self) -> ImuBlock:
        block = self.columns[IMU]
        assert isinstance(block, ImuBlock)
        return block

    @property
    def joints(self) -> JointBlock:
        block = self.columns[JOINTS]
        assert isinstance(block, JointBlock)
        return block

    def row(self, second: float, topic: str = IMU) -> int:
        stamp = self.imu.stamp if topic == IMU else self.joints.stamp
        return int(np.searchsorted(stamp, start_of(self.imu) + round(second * NS)))

    def with_imu(
        self,
        change: Callable[[Floats, Floats], object] | None = None,
        *,
        stamp: Stamps | None = None,
        rows: np.ndarray | slice = slice(None),
    ) -> Columns:
        """The session with its IMU samples changed in place, stamped anew, or some left out."""
        imu = self.imu
        gyro, accel = imu.gyro.copy(), imu.accel.copy()
        if change is not None:
            change(gyro, accel)
        stamp = imu.stamp if stamp is None else stamp
        block = ImuBlock(stamp[rows], gyro[rows], accel[rows], imu.frame_id)
        return {**self.columns, IMU: block}

    def with_joint_stamps(self, stamp: Stamps) -> Columns:
        j = self.joints
        return {**self.columns, JOINTS: JointBlock(stamp, j.names, j.position, j.velocity)}


def start_of(imu: ImuBlock) -> int:
    return int(imu.stamp[0]) // NS * NS


def run_stand(
    plan: Plan | None = None, spec: ImuSpec | None = None, shock: Shock | None = None
) -> Session:
    plan = plan or read_plan(Section.parse(PLAN_TEXT, 'the plan'))
    options = stand(azimuth=0.3, shock=shock)
    simulated = SimulatedStand(
        plan, load_table('three_axis'), spec or paper_imu(), truth().model, SITE, options, seed=3
    )
    parts: dict[str, list[Block]] = {}
    for topic, block in simulated.blocks():
        parts.setdefault(f'/{topic}', []).append(block)
    imu = [b for b in parts[IMU] if isinstance(b, ImuBlock)]
    joints = [b for b in parts[JOINTS] if isinstance(b, JointBlock)]
    setpoints = [b for b in parts[SETPOINTS] if isinstance(b, SetpointBlock)]
    columns: Columns = {
        IMU: ImuBlock(
            np.concatenate([b.stamp for b in imu]),
            np.concatenate([b.gyro for b in imu]),
            np.concatenate([b.accel for b in imu]),
            'imu_link',
        ),
        JOINTS: JointBlock(
            np.concatenate([b.stamp for b in joints]),
            joints[0].names,
            np.concatenate([b.position for b in joints]),
            np.concatenate([b.velocity for b in joints]),
        ),
        SETPOINTS: SetpointBlock(tuple(s for b in setpoints for s in b.setpoints)),
    }
    visits = simulated.visits
    return Session(
        columns,
        {v.step.position: (v.rest, v.end) for v in visits if v.step.dwell > 0},
        [(v.begin, v.rest) for v in visits if v.step.mode is Mode.RATE],
    )


@cache
def good() -> Session:
    return run_stand()


@cache
def messages_of_good() -> dict[str, tuple[Kind, Messages, Stamps]]:
    """Its messages by topic: each test changes one topic, and records the others as they are."""
    return {topic: serialised(block) for topic, block in good().columns.items()}


@cache
def slow_too() -> Plan:
    return read_plan(Section.parse(WITH_SLOW_TURNS, 'the plan'))


@cache
def dwells_of_slow_too() -> dict[str, tuple[float, float]]:
    return run_stand(slow_too()).dwells


@cache
def middle_of_7() -> int:
    """Index of an IMU sample in the middle of the dwell at position 7."""
    return good().row(sum(good().dwells['7']) / 2)


def write(path: Path, columns: Columns, data: Mapping[str, str] = DATA) -> Path:
    """Record columns, all topics in step, in chunks of two seconds or so."""
    with RecordingWriter(path, data, chunk_bytes=1 << 16) as writer:
        sound = messages_of_good()
        # A plus behind a topic: a second publisher on it.
        rows = [
            (t.rstrip('+'), *(sound[t] if b is good().columns.get(t) else serialised(b)))
            for t, b in columns.items()
        ]
        # Received when they were made, whatever their stamps have become.
        made = {t: stamp for t, (*_, stamp) in sound.items()}
        rows = [
            (t, kind, m, made[t] if t in made and len(made[t]) == len(m) else stamp)
            for t, kind, m, stamp in rows
        ]
        first = min(int(s[0]) for *_, s in rows)
        last = max(int(s[-1]) for *_, s in rows)
        for edge in range(first, last + 1, 5 * NS):
            for topic, kind, messages, stamp in rows:
                a, b = np.searchsorted(stamp, [edge, edge + 5 * NS]).tolist()
                if b > a:
                    some = messages.select(slice(a, b))
                    writer.write(topic, kind.type_name, some, stamp[a:b])
    return path


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    """The good session as a recording, not to be changed."""
    return write(tmp_path_factory.mktemp('good') / 'bag', good().columns)


@pytest.fixture(scope='module')
def of_good(recorded):
    """What the good session gives."""
    output = recorded.parent / 'calibration.yaml'
    assert main(['calibrate', str(recorded), '-o', str(output)]) == 0
    return Calibration.load(output)


class CommandLine:
    """Runs `imu-calib` in this process and keeps what it prints apart."""

    def __init__(self, capsys: pytest.CaptureFixture[str], folder: Path) -> None:
        self._capsys = capsys
        self.folder = folder
        self.output = folder / 'calibration.yaml'

    def __call__(self, *arguments: object) -> Outcome:
        self._capsys.readouterr()
        code = main([str(a) for a in arguments])
        out, err = self._capsys.readouterr()
        assert 'Traceback' not in out + err
        return code, (out if code == 0 else err)

    def calibrate(
        self, recording: Path | Columns, *options: object, data: Mapping[str, str] = DATA
    ) -> Outcome:
        if isinstance(recording, dict):
            recording = write(self.folder / 'bag', recording, data)
        return self('calibrate', recording, '-o', self.output, '--verbose', *options)

    def refuses(
        self,
        code: int,
        sentence: str,
        recording: Path | Columns,
        *options: object,
        data: Mapping[str, str] = DATA,
    ) -> None:
        """The command ends with `code`, says the sentence (a pattern), and writes nothing."""
        found, text = self.calibrate(recording, *options, data=data)
        assert re.search(sentence, text), text
        assert text.startswith('imu-calib calibrate: ')
        assert text.count('\n') == 1
        assert found == code
        assert not self.output.exists()

    def uses_the_rest(
        self,
        sentence: str,
        recording: Path | Columns,
        *options: object,
        data: Mapping[str, str] = DATA,
    ) -> Calibration:
        """The command succeeds, states the loss in print and in the file, and is not wrong."""
        found, text = self.calibrate(recording, *options, data=data)
        assert found == 0, text
        calibration = Calibration.load(self.output)
        assert re.search(sentence, ' '.join(calibration.findings)), calibration.findings
        assert re.search(sentence, ' '.join(text.split())), text
        assert_true(calibration)
        return calibration


def assert_true(calibration: Calibration) -> None:
    """Within 4.5 standard deviations of the truth, and those no wider than a spoilt dwell makes."""
    errors = calibration.model.vector() - truth().model.vector()
    assert np.abs(errors / calibration.std).max() < 4.5
    # Twice what the walk alone leaves of twelve dwells of 20 s: 0.05 deg/sqrt(h) / sqrt(240 s).
    assert calibration.std[9:12].max() < 2 * 0.05 * 60 / np.sqrt(240) * DEG / 3600
    assert calibration.std[:3].max() < 20e-6


@pytest.fixture
def cli(capsys, tmp_path):
    return CommandLine(capsys, tmp_path)


def test_the_good_session_is_good(cli, recorded):
    code, text = cli.calibrate(recorded)
    assert code == 0
    found = Calibration.load(cli.output)
    # Gravity and table of the simulation are exact: two findings say what that does, no other.
    gravity, table = found.findings
    assert 'is taken as exact: no K_a has an uncertainty of it' in gravity
    assert 'better than any real one' in table
    assert table in ' '.join(text.split())
    assert_true(found)


# What is no recording, and what lacks its topics.


def test_an_empty_bag(cli, tmp_path):
    with RecordingWriter(tmp_path / 'empty', DATA):
        pass
    cli.refuses(2, 'empty holds no topics', tmp_path / 'empty')


def test_topics_without_messages(cli, tmp_path):
    with RecordingWriter(tmp_path / 'silent', DATA) as writer:
        writer.add_topic(IMU, 'sensor_msgs/msg/Imu')
    cli.refuses(2, f'silent: no message on {IMU}', tmp_path / 'silent')


def test_an_imu_topic_without_messages_beside_full_ones(cli, tmp_path):
    with RecordingWriter(tmp_path / 'bag', DATA) as writer:
        writer.add_topic(IMU, 'sensor_msgs/msg/Imu')
        kind, messages, stamp = serialised(good().joints)
        writer.write(JOINTS, kind.type_name, messages, stamp)
    cli.refuses(1, 'The IMU stream is empty', tmp_path / 'bag')


def test_no_imu_topic(cli):
    columns = {t: b for t, b in good().columns.items() if t != IMU}
    cli.refuses(2, rf'no topic of type sensor_msgs/msg/Imu; its topics: {JOINTS} \(', columns)


def test_two_imu_topics_are_listed_and_can_be_chosen_from(cli):
    columns = {**good().columns, '/other/imu': good().with_imu(halve)[IMU]}
    sentence = r'2 topics of type sensor_msgs/msg/Imu, /imu/pulses, /other/imu: choose with --imu-t'
    cli.refuses(2, sentence, columns)
    bag = cli.folder / 'bag'
    cli.refuses(2, f'topic {JOINTS}: found sensor_msgs/msg/Joint', bag, '--imu-topic', JOINTS)
    cli.refuses(2, 'no such topic; .* are: /imu/pulses, /other', bag, '--imu-topic', '/absent')
    code, _ = cli.calibrate(bag, '--imu-topic', IMU)
    assert code == 0
    assert_true(Calibration.load(cli.output))


def halve(gyro: Floats, accel: Floats) -> None:
    gyro //= 2
    accel //= 2


def copied(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / 'bag'))


def storage(bag: Path) -> Path:
    return next(bag.glob('*.mcap'))


def test_an_mcap_cut_early(cli, recorded, tmp_path):
    bag = copied(recorded, tmp_path)
    os.truncate(storage(bag), int(storage(bag).stat().st_size * 0.3))
    sentence = 'bag_0.mcap is cut off at byte .* Missing .* position 5, 6, 7, .* No position turns'
    cli.refuses(1, sentence, bag)
    cli.refuses(1, sentence, storage(bag))


def test_messages_of_what_was_cut_off_are_counted(cli, recorded, tmp_path):
    whole = storage(recorded).read_bytes()
    # The footer says where the summary begins. Before it are 13 bytes that end the data and the
    # index of the last chunk: without them all messages are there, uncounted.
    (summary,) = struct.unpack('<Q', whole[-28:-20])
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: summary - 20])

    def shown(bag):
        code, text = cli('info', '--topics', bag)
        assert code == 0
        topics, _, lost = text.partition('Lost')
        return [row.split()[:3] for row in topics.splitlines() if row.startswith('/')], lost

    rows, lost = shown(recorded)
    assert all(int(count) > 0 for _, _, count in rows)
    assert not lost
    rows_of_cut, lost = shown(cut)
    assert rows_of_cut == rows
    assert 'its recorder did not finish' in lost


@pytest.mark.parametrize(('seconds', 'told'), [(10.0, False), (100.0, True)])
def test_the_effect_of_a_cut_is_not_told_as_another_fault(recorded, seconds, told):
    cut = 'a.mcap is cut off: its recorder did not finish.'
    gap = f'The joint states go on for {seconds} s after the last IMU sample, 9 s: it stopped.'
    opened = SimpleNamespace(recording=SimpleNamespace(path=recorded, unfinished=cut))
    said = _unfinished_first(opened, ('Too short.', gap, cut))
    assert said == (f'{cut} Too short.', *([gap] if told else []))


def test_an_mcap_cut_late(cli, recorded, tmp_path):
    bag = copied(recorded, tmp_path)
    os.truncate(storage(bag), int(storage(bag).stat().st_size * 0.92))
    sentence = r'bag_0.mcap is cut off at byte \d+ of \d+: its recorder did not finish'
    found = cli.uses_the_rest(sentence, bag)
    assert 'Missing from the recording: position 12.' in found.findings
    cli.uses_the_rest(sentence, storage(bag))


# A chunk like any other.
@pytest.mark.parametrize('share', [again(0.3), 0.5, again(0.9)])
def test_a_corrupt_chunk(cli, recorded, tmp_path, share):
    bag = copied(recorded, tmp_path)
    content = bytearray(storage(bag).read_bytes())
    first = int(len(content) * share)
    content[first : first + 64] = bytes(b ^ 0xFF for b in content[first : first + 64])
    storage(bag).write_bytes(content)
    sentence = r'the chunk at byte \d+ .* is corrupt .*; its messages \(\d+ of .*\) are left out'
    found = cli.uses_the_rest(sentence, bag)
    # A gap is no step: nobody moved the unit.
    assert not re.search('moved|disturbed|turned', ' '.join(found.findings))


def test_a_folder_that_does_not_exist(cli, tmp_path):
    cli.refuses(2, 'nowhere: no such recording; expected a rosbag2 folder', tmp_path / 'nowhere')


def test_the_metadata_in_place_of_the_recording(cli, recorded):
    sentence = r'metadata.yaml describes a recording: give the folder that holds it'
    cli.refuses(2, sentence, recorded / 'metadata.yaml')


def test_a_device_in_place_of_a_file(cli, recorded):
    cli.refuses(
        2, '/dev/null: a device or a pipe, expected a file', recorded, '--plan', '/dev/null'
    )
    cli.refuses(2, '/dev/null: found a device or a pipe; expected a rosbag2', Path('/dev/null'))


def test_an_output_folder_that_does_not_exist(cli, recorded):
    code, text = cli('calibrate', recorded, '-o', cli.folder / 'no' / 'c.yaml')
    assert (code, 'no/c.yaml: the folder' in text, 'does not exist' in text) == (2, True, True)
    code, text = cli('calibrate', recorded, '-o', cli.folder)
    assert (code, 'is a folder, expected the name of a file' in text) == (2, True)


def test_a_recording_is_not_written_over(cli, recorded, tmp_path):
    bag = copied(recorded, tmp_path)
    kept = storage(bag).read_bytes()
    (tmp_path / 'link.yaml').symlink_to(storage(bag))
    for given in (bag, storage(bag)):
        for output in (storage(bag), tmp_path / 'link.yaml'):
            assert cli('calibrate', given, '-o', output)[0] == 2
            assert storage(bag).read_bytes() == kept
    described = (bag / 'metadata.yaml').read_bytes()
    assert cli('calibrate', bag, '-o', bag / 'metadata.yaml')[0] == 2
    assert (bag / 'metadata.yaml').read_bytes() == described


def test_an_input_is_not_written_over(cli, of_good, tmp_path):
    file, link = tmp_path / 'mine.yaml', tmp_path / 'link.yaml'
    of_good.save(file)
    kept = file.read_bytes()
    link.symlink_to(file)
    for output in (file, link):
        for words in (['report', file], ['export', file, '--format', 'c']):
            code, text = cli(*words, '-o', output)
            assert (code, 'is an input of the command' in text) == (2, True)
            assert file.read_bytes() == kept
    imu = tmp_path / 'imu.yaml'
    imu.write_text(text_of('imus', 'fog_medium'))
    assert cli('plans', '--optimise', 30, '--imu', imu, '-o', imu)[0] == 2
    assert imu.read_text() == text_of('imus', 'fog_medium')


@pytest.mark.parametrize(
    ('content', 'sentence'),
    [
        (None, r'calibration.yaml: cannot be read|no such file'),
        ('- 1\n- 2\n', 'calibration.yaml: found a list, expected keys'),
        ('format: 1\nunits: pulses\nimu: [', 'calibration.yaml: not YAML'),
    ],
)
def test_comparing_what_is_no_calibration(cli, content, sentence):
    if content is not None:
        cli.output.write_text(content)
    code, text = cli('compare', named_file('truths', 'cao2022_table1'), cli.output)
    assert re.search(sentence, text), text
    assert code == 2


def test_wrong_usage_ends_with_2():
    # In a process of its own: what a shell sees.
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'calibrate']
    done = completed(command, cwd=Path(__file__).parents[2])
    assert done.returncode == 2
    assert 'BAG is missing: imu-calib calibrate BAG [options]' in done.stderr
    assert 'Traceback' not in done.stderr


def test_verify_without_calibration_names_the_option(cli: CommandLine) -> None:
    code, text = cli('verify', 'bag', 'calibration.yaml')
    assert code == 2
    assert '--calibration is missing: imu-calib verify BAG --calibration FILE [options]' in text
    assert len(text.splitlines()) <= 2


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        ('--latitude 59,9', "--latitude: found '59,9', expected a number without its unit. The "
         'decimal sign is a point: write 59.9.'),
        ('--latitude -33,45', 'write -33.45.'),
        ('--height=1,5', "--height: found '1,5', expected a number .* write 1.5."),
        ('--azimuth 12deg', "--azimuth: found '12deg', expected a number without its unit"),
    ],
)  # fmt: skip
def test_a_number_option_says_what_to_write(cli, words, said):
    code, text = cli('calibrate', 'x', *words.split())
    assert re.search(said, text), text
    assert 'usage' not in text
    assert code == 2


def test_a_whole_number_is_asked_for(cli):
    code, text = cli('simulate', 'twelve_position', '-o', 'x', '--seed', '1.5')
    assert "--seed: found '1.5', expected a whole number." in text
    assert code == 2


# Samples that cannot be used.


def test_values_that_are_no_numbers(cli):
    def spoil(gyro, accel):
        gyro[middle_of_7() : middle_of_7() + 3, 1] = np.nan
        accel[middle_of_7() + 500, 2] = np.inf

    cli.uses_the_rest(r'4 samples left out for values that are not num', good().with_imu(spoil))


def test_a_channel_that_is_never_a_number(cli):
    def spoil(gyro, accel):
        gyro[:, 2] = np.nan

    sentence = r'None of \d+ IMU samples can be used. \d+ samples left out for values that are no'
    cli.refuses(1, sentence, good().with_imu(spoil))


@pytest.mark.parametrize(
    ('change', 'sentence'),
    [
        (lambda _, accel: accel.__setitem__((slice(None), 2), 9.0), 'accelerometer z reads 9 in'),
        (lambda gyro, _: gyro.__setitem__((slice(None), 1), 0.0), 'gyro y reads 0 in every'),
        (
            lambda _, accel: accel.__setitem__((slice(None), 1), accel[:, 0]),
            'accelerometers x and y read the same in every',
        ),
    ],
)
def test_a_channel_that_is_dead_or_named_twice(cli, change, sentence):
    cli.refuses(1, sentence, good().with_imu(change))


def test_a_second_of_saturation_in_a_dwell(cli):
    def saturate(gyro, accel):
        accel[middle_of_7() : middle_of_7() + 100, 1] = 98.0  # 10 g in pulses per sample

    cli.uses_the_rest('Position 7: 100 samples are saturated', good().with_imu(saturate))


def test_a_dwell_that_is_saturated(cli):
    begin, end = good().dwells['7']

    def saturate(gyro, accel):
        accel[good().row(begin - 1) : good().row(end) + 1, 1] = 98.0

    found = cli.uses_the_rest(
        'Position 7: left out, the sensor is saturated', good().with_imu(saturate)
    )
    assert 'Missing from the recording: position 7.' in found.findings


def test_a_turn_that_is_saturated(cli):
    middle = good().row(sum(good().turns[0]) / 2)

    def saturate(gyro, accel):
        gyro[middle : middle + 20, 0] = 32767.0

    sentence = 'Position 1: a turn is left out, the sensor is saturated during it'
    cli.uses_the_rest(sentence, good().with_imu(saturate))


def test_an_imu_in_whose_units_all_turns_are_beyond_the_range(cli):
    sentence = 'the gyros read [0-9]+ times the rate of the table, beyond the range that the IMU'
    cli.refuses(
        1,
        sentence,
        good().columns,
        data={
            **DATA,
            'imu_calib.imu': 'id: other\nunits: si\n'
            'sample_rate: 100 Hz\ngyro: {range: 2000 deg/s}\naccelerometer: {range: 10 g}\n',
        },
    )


def test_turns_beyond_the_range(cli):
    narrow = replace(paper_imu(), gyro=replace(paper_imu().gyro, range=50 * DEG))
    columns = run_stand(slow_too(), narrow).columns
    stated = DATA['imu_calib.imu'].replace('range: 300 deg/s', 'range: 50 deg/s')
    data = {**DATA, 'imu_calib.imu': stated, 'imu_calib.plan': WITH_SLOW_TURNS}
    sentence = 'Position 1, 5, 9: a turn is left out, the sensor is saturated during it'
    cli.uses_the_rest(sentence, columns, data=data)
    # A range that nobody stated shows in what the gyros make of the Earth.
    cli.output.unlink()
    sentence = 'contradicts itself: .* in all, where the Earth turns at 15.04'
    cli.refuses(1, sentence, cli.folder / 'bag', '--imu', 'fog_medium')
    # A joint estimate could weigh down what tells against it.
    cli.refuses(1, sentence, cli.folder / 'bag', '--imu', 'fog_medium', '--method', 'joint')


def test_a_second_is_missing_in_a_dwell(cli):
    rows = np.r_[0 : middle_of_7(), middle_of_7() + 100 : len(good().imu)]
    cli.uses_the_rest(r'Position 7: 100 samples missing in 1 gap', good().with_imu(rows=rows))


def test_a_second_is_missing_in_a_turn(cli):
    middle = good().row(sum(good().turns[0]) / 2)
    rows = np.r_[0:middle, middle + 100 : len(good().imu)]
    sentence = 'Position 1: a turn is left out, IMU samples are missing within it'
    cli.uses_the_rest(sentence, good().with_imu(rows=rows))


# Stamps.


@pytest.mark.parametrize('jump', [-5, again(5), 500_000])
def test_one_wild_stamp_costs_one_sample(cli, jump):
    stamp = good().imu.stamp.copy()
    stamp[middle_of_7()] += jump * NS
    found = cli.uses_the_rest(
        '1 sample left out for stamps that jump', good().with_imu(stamp=stamp)
    )
    assert any(f.startswith('1 IMU sample is missing') for f in found.findings)


APART = r'Position 7, 8, .*: left out, the gyros do not show the motion next to it .*clocks that j'


def test_an_imu_clock_that_jumps_on_for_good(cli):
    stamp = good().imu.stamp.copy()
    stamp[middle_of_7() :] += 5 * NS
    sentence = (
        r'The clock of the IMU was set forward by 5\.0 s at .*: the motions of the table show that'
    )
    found = cli.uses_the_rest(sentence, good().with_imu(stamp=stamp))
    assert not [f for f in found.findings if 'interrupted' in f]


def test_an_imu_clock_that_jumps_back_for_good(cli):
    stamp = good().imu.stamp.copy()
    stamp[middle_of_7() :] -= 5 * NS
    sentence = r'The stamps of the IMU go back by 5\.00 s to'
    cli.uses_the_rest(sentence, good().with_imu(stamp=stamp))


def test_joint_stamps_that_jump_back_for_good(cli):
    stamp = good().joints.stamp.copy()
    stamp[good().row(sum(good().dwells['7']) / 2, JOINTS) :] -= 5 * NS
    sentence = r'The stamps of the joint states go back by 5\.00 s to'
    cli.uses_the_rest(sentence, good().with_joint_stamps(stamp))


def test_joint_stamps_that_jump_back_and_return(cli):
    stamp = good().joints.stamp.copy()
    first = good().row(sum(good().dwells['7']) / 2, JOINTS)
    stamp[first : first + 50] -= 5 * NS
    sentence = r'The stamps of the joint states go back by 5\.00 s to .*, and on again 1 time'
    cli.uses_the_rest(sentence, good().with_joint_stamps(stamp))


@pytest.mark.parametrize('jump', [-0.3, 0.3])
def test_a_small_jump_of_the_clocks_is_found_and_bridged(cli, jump):
    stamp = good().imu.stamp.copy()
    stamp[middle_of_7() :] += round(jump * NS)
    sentence = {
        -0.3: r'The stamps of the IMU go back by 0\.30 s to',
        0.3: r'The clocks of IMU and table jump by \+0.(3|29)',
    }[jump]
    cli.uses_the_rest(sentence, good().with_imu(stamp=stamp))


def test_clocks_that_are_apart(cli):
    stamp = good().imu.stamp + 100 * NS
    cli.refuses(1, 'the gyros do not show the motion next to it', good().with_imu(stamp=stamp))


@pytest.mark.parametrize(('offset', 'where'), [(5, 'ahead of'), (-25, 'behind')])
def test_clocks_within_a_minute_are_compared_by_the_pattern_of_motions(cli, offset, where):
    stamp = good().imu.stamp + offset * NS
    sentence = f'The clock of the IMU is {abs(offset)}.0 s {where} that of the table'
    cli.uses_the_rest(sentence, good().with_imu(stamp=stamp))


# What the session lacks, or what does not belong to it.


def without(*positions: str) -> Columns:
    plan = read_plan(Section.parse(PLAN_TEXT, 'the plan'))
    kept = tuple(p for p in plan.positions if p.id not in positions)
    return run_stand(replace(plan, positions=kept)).columns


def test_a_position_is_missing(cli):
    sentence = 'Missing from the recording: position 7'
    cli.uses_the_rest(sentence, without('7'))
    found = cli.uses_the_rest(sentence, cli.folder / 'bag', '--method', 'twelve_position')
    assert any('taken from 2 of 3 groups' in finding for finding in found.findings)


def test_the_imu_is_missing_during_a_position(cli):
    begin, end = good().dwells['7']
    rows = np.r_[0 : good().row(begin - 1), good().row(end + 1) : len(good().imu)]
    sentence = 'Missing from the recording: position 7'
    cli.uses_the_rest(sentence, good().with_imu(rows=rows))


def test_an_axis_that_was_never_down(cli):
    # The biases are known from the other axes: it takes the joint estimate to use that.
    cli.uses_the_rest('Missing from the recording: position 3, 4', without('3', '4'))
    cli.output.unlink()
    sentence = r'No position with X down .*missing: 3, 4\): K_ax'
    cli.refuses(1, sentence, cli.folder / 'bag', '--method', 'twelve_position')


def test_an_axis_that_nothing_turned_about(cli):
    cli.refuses(1, r'No position turns Y: K_gy, .* Missing .* position 5\.', without('5'))


@pytest.mark.parametrize('latitude', [44.65, again(24.65), -34.65])
def test_a_wrong_latitude(cli, recorded, latitude):
    sentence = rf'contradicts the latitude {latitude} deg.*fits a latitude of 3[345]\.\d+ \+-'
    cli.refuses(1, sentence, recorded, '--latitude', latitude)


def test_six_positions_at_a_wrong_latitude(cli, tmp_path):
    """On them g-sensitivity of one size along all axes is the Earth rate up; 15 deg north of where
    it was no estimate converged."""
    bag = tmp_path / 'six'
    assert main(['simulate', 'six_position', '--seed', '4', '-o', str(bag)]) == 0
    for latitude in (-34.65, 49.65):
        sentence = rf'contradicts the latitude {latitude} deg.*fits a latitude of 3[345]\.\d+ \+-'
        cli.refuses(1, sentence, bag, '--latitude', latitude)


@pytest.mark.parametrize(('latitude', 'found'), [(95, '95'), ('nan', 'nan')])
def test_no_latitude_at_all(cli, recorded, latitude, found):
    cli.refuses(2, f'latitude: found {found} deg, exp', recorded, '--latitude', latitude)


def swap(gyro: Floats, accel: Floats) -> None:
    gyro[:], accel[:] = gyro[:, [1, 0, 2]], accel[:, [1, 0, 2]]


def swap_accelerometers(gyro: Floats, accel: Floats) -> None:
    accel[:] = accel[:, [1, 2, 0]]


def mirror(gyro: Floats, accel: Floats) -> None:
    gyro[:, 2] *= -1


def turn_by_40_deg(gyro: Floats, accel: Floats) -> None:
    c, s = np.cos(40 * DEG), np.sin(40 * DEG)
    gyro[:] = np.rint(gyro @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


@pytest.mark.parametrize(
    ('change', 'sentence'),
    [
        (swap, 'axes of the gyros are mirrored .*: x answers to Y, y answers to X'),
        (swap_accelerometers, 'axes of the accelerometers are swapped .*: x answers to Y, y ans'),
        (mirror, 'axes of the gyros are mirrored against the attitudes: z answers to -Z'),
        (turn_by_40_deg, r'axes of the gyros are turned .*\[\[0.77, 0.64'),
    ],
)
def test_axes_that_are_not_the_plans(cli, change, sentence):
    cli.refuses(1, sentence, good().with_imu(change))


@pytest.mark.parametrize(
    ('reading', 'sentence'),
    [
        (298.15, 'The temperature is 298.1.? degrees Celsius, hotter than any unit .25.0 if it is'),
        (
            25_000.0,
            'temperatures of the unit are not in degrees Celsius and are left out, the first '
            '25000: in thousandths of a degree it is 25.0',
        ),
    ],
)
def test_a_temperature_in_another_unit(cli, reading, sentence):
    stamp = good().imu.stamp[::100]
    readings = TemperatureBlock(stamp, np.full(len(stamp), reading))
    cli.uses_the_rest(sentence, {**good().columns, '/imu/temperature': readings})


@pytest.mark.parametrize('speeds', [1.0, 1 / DEG])
def test_joint_states_in_degrees(cli, speeds):
    joints = good().joints
    changed = replace(joints, position=joints.position / DEG, velocity=joints.velocity * speeds)
    sentence = 'the joint states change by 57 times the angle .*: they are in degrees. Expected rad'
    cli.refuses(1, sentence, {**good().columns, JOINTS: changed})


@pytest.mark.parametrize('imu', ['si', 'mems_counts'])
def test_units_of_another_imu(cli, recorded, imu):
    sentence = r'The gyros read [\d.]+ times what they should of whole turns: check the units and'
    cli.refuses(2, sentence, recorded, '--imu', imu)


def test_a_result_that_every_reader_would_refuse(cli, recorded, monkeypatch):
    # Accelerometers that saturate below their stated range gave a file that `report` refused.
    monkeypatch.setattr('imu_calib.calibration.provenance._SCALE', (0.99, 1.01))
    sentence = 'The result is not that of a strapdown IMU: accelerometer X answers 0.909.* times'
    cli.refuses(1, sentence, recorded)


def test_a_scale_factor_of_another_imu(cli, recorded, tmp_path):
    (tmp_path / 'imu.yaml').write_text(DATA['imu_calib.imu'].replace('7.8 arcsec', '5.2 arcsec'))
    code, text = cli.calibrate(recorded, '--imu', tmp_path / 'imu.yaml')
    assert code == 0
    assert 'The gyros read 0.667 times what their description states' in ' '.join(text.split())


def test_the_plan_of_another_session(cli, recorded):
    sentence = r'setpoints .* of plan twelve_position with positions 1, .*; plan six_position has x'
    cli.refuses(2, sentence, recorded, '--plan', 'six_position')
    # Without setpoints nothing says so but the session itself: a closed form finds none of its
    # positions, and to the joint estimate a rest is a rest wherever it is.
    columns = {t: b for t, b in good().columns.items() if t != SETPOINTS}
    silent = write(cli.folder / 'silent', columns)
    options = ('--plan', 'six_position')
    sentence = 'Missing .*x_up.* Static dwells that count as no position .* leaves them out'
    cli.refuses(1, sentence, silent, *options, '--method', 'six_position')
    sentence = 'Static dwells that count as no position of plan six_position: X up, heading'
    cli.uses_the_rest(sentence, silent, *options)


def test_a_broken_plan(cli, recorded, tmp_path):
    (tmp_path / 'plan.yaml').write_text(PLAN_TEXT.replace('dwell: 20 s', 'dwell: 20 m'))
    cli.refuses(2, 'plan.yaml: dwell: ', recorded, '--plan', tmp_path / 'plan.yaml')


@pytest.mark.parametrize('table', ['one_axis', 'two_axis'])
def test_another_table(cli, recorded, table):
    # Its joints are among those of the recording; the motions of the others contradict it.
    sentence = rf'further joints \(.*middle\), which are not of table {table}: they are ignored'
    cli.refuses(1, sentence, recorded, '--table', table)


def others(columns: Columns, names: tuple[str, ...], every: int = 50) -> Columns:
    """Put joint states of something else between those of the table."""
    joints = columns[JOINTS]
    stamp = joints.stamp[::every] + 1_000_000
    nonsense = np.full((len(stamp), len(names)), 7.0)
    return {**columns, f'{JOINTS}+': JointBlock(stamp, names, nonsense, nonsense)}


@pytest.mark.parametrize(
    'names', [('outer', 'middle'), again(('wheel', 'gripper')), ('outer',) * 3]
)
def test_joint_states_of_others_on_the_tables_topic(cli, of_good, names):
    sentence = rf'\d+ joint states left out: they name {", ".join(names)}, not all joints of table'
    found = cli.uses_the_rest(sentence, others(good().columns, names))
    assert found.values.tobytes() == of_good.values.tobytes()


def test_further_joints_in_another_order(cli, of_good):
    joints = good().columns[JOINTS]
    names = ('gripper', *reversed(joints.names))
    columns = [
        np.column_stack([np.full(len(joints), 3.0), part[:, ::-1]])
        for part in (joints.position, joints.velocity)
    ]
    mixed = {**good().columns, JOINTS: JointBlock(joints.stamp, names, *columns)}
    found = cli.uses_the_rest(r'name further joints \(gripper\)', mixed)
    assert found.values.tobytes() == of_good.values.tobytes()


def test_a_table_with_other_names(cli, recorded, tmp_path):
    (tmp_path / 'table.yaml').write_text(DATA['imu_calib.table'].replace('outer', 'yaw'))
    sentence = 'joint states name outer, middle, inner; table three_axis has yaw, middle, inner'
    cli.refuses(2, sentence, recorded, '--table', tmp_path / 'table.yaml')


@pytest.mark.parametrize(
    ('key', 'sentence'),
    [
        (
            'imu_calib.plan',
            r'not say which plan was run, .*: give --plan, a name of those that imu-calib plans',
        ),
        (
            'imu_calib.imu',
            r'numbers of the IMU are not rad/s and m/s\^2: .*\. Say what they are: give --imu, the',
        ),
        ('imu_calib.latitude_deg', 'does not say where it was taken: give --latitude'),
    ],
)
def test_a_recording_that_does_not_say(cli, key, sentence):
    data = {k: v for k, v in DATA.items() if k != key}
    # Joint states would do without a plan.
    cli.refuses(2, sentence, {IMU: good().imu}, data=data)


# Shocks.

SHOCK = Shock(0.0, (1.0, 0.0, 0.0), 0.05 * DEG)
SHOCKED = {**DATA, 'imu_calib.plan': WITH_SLOW_TURNS}


def shocked(position: str, after: float, axis: tuple[float, float, float]) -> Columns:
    time = dwells_of_slow_too()[position][0] + after
    return run_stand(slow_too(), shock=replace(SHOCK, time=time, axis=axis)).columns


@pytest.mark.parametrize('axis', [(1.0, 0, 0), (0, 1.0, 0), again((0, 0, 1.0))])
def test_a_shock_amid_the_session(cli, axis):
    # About Y, which is vertical at position 7, no accelerometer sees it: the gyros must.
    sentence = (
        r'No position turns Z: K_gz, .* The unit shifted in its mount \(by 0.05\d deg at '
        r'position 7\): .* only what lies before it is used'
    )
    cli.refuses(1, sentence, shocked('7', 11.0, axis), data=SHOCKED)


def test_a_shock_at_the_end_of_the_session(cli):
    sentence = r'The unit shifted .* at position 12\): .* only what lies before it is used'
    columns = shocked('12', 11.0, (1.0, 0.0, 0.0))
    found = cli.uses_the_rest(sentence, columns, data=SHOCKED)
    assert not any('Missing' in finding for finding in found.findings)


def test_a_bump_that_comes_back(cli):
    def bump(gyro, accel):
        first = middle_of_7()
        gyro[first : first + 10, 0] += 9
        gyro[first + 40 : first + 50, 0] -= 9
        accel[first : first + 50, 1] += np.rint(3 * np.sin(np.arange(50)))

    sentence = r'Position 7: disturbed \d+\.\d s after it came to rest; (0.5|1.0) s left out'
    cli.uses_the_rest(sentence, good().with_imu(bump))


# Which unit it is.


def test_the_serial_number_of_the_recording_or_of_the_command_line(cli, recorded):
    assert cli.calibrate(recorded, '--serial', '0042')[0] == 0
    assert Calibration.load(cli.output).serial_number == '0042'
    cli.output.unlink()
    data = {**DATA, 'imu_calib.serial_number': 'A1'}
    sentence = '--serial: found B2, but .*bag is of unit A1.*state that one as --recorded-serial'
    cli.refuses(2, sentence, good().columns, '--serial', 'B2', data=data)
    sentence = '--recorded-serial: found A2, but .*bag states A1; expected that number'
    wrong = '--serial', 'B2', '--recorded-serial'
    cli.refuses(2, sentence, cli.folder / 'bag', *wrong, 'A2')
    assert cli.calibrate(cli.folder / 'bag', *wrong, 'A1')[0] == 0
    replaced = Calibration.load(cli.output)
    assert replaced.serial_number == 'B2'
    assert 'states the serial number A1; B2 was stated to replace' in ' '.join(replaced.findings)
    cli.output.unlink()
    assert cli.calibrate(cli.folder / 'bag')[0] == 0
    assert Calibration.load(cli.output).serial_number == 'A1'
