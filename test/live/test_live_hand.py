"""A unit in the hand, live: the calibrator says what to do next, and the hand does it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from live import EMBEDDED, Stand
from rich.console import Console
from sessions import SITE, Alone, ended

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.hand import HandCalibrator, Stage, direction
from imu_calib.cli.displays import reached, view_hand
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock
from imu_calib.common.units import ARCMIN, DEG, PPM
from imu_calib.estimation.hand import FREE
from imu_calib.estimation.setup import Setup
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.format import load_format
from imu_calib.live.nodes import hand_node
from imu_calib.live.nodes.live_session import SessionPhase
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import PARAMETER_NAMES, ParameterKind
from imu_calib.recordings.cdr_codec import Kind, encode_imu
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.simulation.hand import HeldHardware
from imu_calib.simulation.options import ImuOptions

SPEC = load_imu('mems_counts')
TRUTH = Calibration.load(named_file('truths', 'mems_counts'))
NODES = ('hand_node', 'imu_node', 'calibrator_node')


def held(seed=0, model=TRUTH.model):
    return HeldHardware(SPEC, model, SITE, ImuOptions(bias_instability=False), seed=seed)


class Session:
    """A hand and a calibrator that hear each other at once."""

    def __init__(self, seed=0, model=TRUTH.model):
        self.hand = held(seed, model)
        self.decoder = Decoder(load_format('simulated'))
        self.calibrator = HandCalibrator(Setup(SPEC, load_plan('free_positions'), None, SITE))
        self.advice = []

    def goes_on(self, seconds):
        samples = self.decoder.decode_bytes(self.hand.advance(seconds))
        self.calibrator.add_block(ImuBlock(samples.time, samples.gyro, samples.accel))

    def advises(self):
        review = self.calibrator.snapshot().review()
        guidance = review.guidance
        self.advice.append(guidance)
        self.hand.advise(guidance.holds, direction(guidance.candidates[0].words))
        return review


def test_a_hand_that_does_what_it_is_told_is_soon_told_that_it_is_enough():
    session = Session()
    for _ in range(120):
        session.goes_on(1.0)
        if session.hand.waits:
            review = session.advises()
            if review.guidance.stage is Stage.ENOUGH:
                break
    assert review.guidance.stage is Stage.ENOUGH
    assert review.guidance.holds == session.hand.holds <= 20
    found = review.result.calibration
    errors = (found.values - TRUTH.values)[FREE] / found.std[FREE]
    assert np.sqrt(np.mean(errors**2)) < 1.6
    scales = [p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in review.parameters]
    assert review.std[scales].max() < 300 * PPM
    # Live is offline: the last review is what the end of the session gives.
    assert np.array_equal(session.calibrator.finish().calibration.values, found.values)


def test_a_session_that_begins_in_a_turn_is_guided_whatever_the_gyros_read_at_rest():
    bias = np.array([3.0, -4.0, 1.0]) * DEG
    session = Session(model=replace(TRUTH.model, gyro=replace(TRUTH.model.gyro, bias=bias)))
    # The second turn goes on when the recording begins: nobody waits for two quiet seconds.
    session.hand.advise(1, direction('Y down'))
    session.hand.advance(4.5)
    session.hand.advance(0.3)
    known = []
    for _ in range(25):
        session.goes_on(1.0)
        if session.hand.waits:
            guidance = session.calibrator.snapshot().review().guidance
            known.append((guidance.holds + 1, session.hand.holds))
            session.hand.advise(guidance.holds + 1, direction(guidance.candidates[0].words))
    assert [held for _, held in known] == list(range(2, 2 + len(known)))
    assert len(known) >= 4
    assert all(counted == held for counted, held in known)


def test_the_countdown_runs_while_the_unit_is_held_and_the_hold_counts_at_its_end():
    session = Session()
    messages = []
    for _ in range(36):
        session.goes_on(0.1)
        messages.append(session.calibrator.snapshot().review().guidance)
    stages = [guidance.stage for guidance in messages]
    assert stages[10] is Stage.HOLD
    assert messages[10].text == 'Hold still: 2 s more.'
    assert messages[10].holds == 0
    assert stages[-1] is Stage.TURN
    assert messages[-1].holds == 1
    assert 'Hold still' not in messages[-1].text


def test_the_hand_goes_where_it_is_told_and_nowhere_while_it_waits():
    hand = held()
    for _ in range(45):
        hand.advance(0.1)
    assert hand.waits
    assert hand.holds == 1
    hand.advise(1, direction('Y down'))
    line = b''.join(hand.advance(0.1) for _ in range(40))
    assert hand.holds == 2
    accel = Decoder(load_format('simulated')).decode_bytes(line).accel[-50:].mean(axis=0)
    force = TRUTH.model.compensate(np.zeros(3), accel * SPEC.accel.scale_factor)[1]
    # A hand aims to within a few degrees.
    assert force @ [0, -1, 0] > SITE.gravity * np.cos(15 * DEG)
    for _ in range(120):
        hand.advance(0.1)
    assert hand.holds == 3


@pytest.mark.parametrize(('speed', 'expected'), [(0.0, 1.0), (0.5, 0.5), (10.0, 1.0)])
def test_a_hand_that_waits_for_advice_keeps_to_the_wall_clock(monkeypatch, speed, expected):
    wall = [1000.0]
    monkeypatch.setattr(hand_node.time, 'monotonic', lambda: wall[0])
    hand = SimpleNamespace(
        _line=SimpleNamespace(idle=True, connected=True),
        _hardware=SimpleNamespace(waits=True, time=0.0),
        _speed=speed,
        _anchor=None,
    )
    while wall[0] < 1010.0:
        if rest := hand_node.HandNode._rest(hand):
            wall[0] += rest
        else:
            hand._hardware.time += 0.1
    # To within a step.
    assert hand._hardware.time == pytest.approx(10.0 * expected, abs=0.2)


def progress(**changed):
    std = np.full(21, np.nan)
    free = [name for name, kept in zip(PARAMETER_NAMES, FREE, strict=True) if kept]
    return SimpleNamespace(
        **{
            'text': '5 holds so far. Turn to Z down, and hold still.',
            'step': 5,
            'parameter_names': free,
            'standard_deviations': std.tolist(),
            'next_attitudes': ['Z down', 'half X up, half Z down'],
            'next_gains': [4.0, 1.0],
            **changed,
        }
    )


def test_a_person_sees_what_to_do_and_what_each_next_hold_gains():
    console = Console(width=100)
    with console.capture() as capture:
        console.print(view_hand(progress(), 'too few holds'))
    lines = capture.get().splitlines()
    assert 'Turn to Z down' in lines[0]
    assert lines[1].startswith('5 holds, scale factors open')
    first, second = (next(x for x in lines[2:] if w in x) for w in ('4.00', '1.00'))
    assert first.count('#') == 4 * second.count('#')
    assert any('Not yet: too few holds' in line for line in lines)
    known = np.full(21, 2 * ARCMIN)
    known[:3] = 90 * PPM
    # K_a, like the angles, to 5.82e-4.
    shown = reached(progress(standard_deviations=known))
    assert 'scale factors to 0.0582 %, misalignments to 0.0333 deg' in shown


def test_a_session_of_nodes_ends_when_it_is_enough_in_what_its_journal_gives(tmp_path):
    # Slow enough that too few holds are done when a busy machine has asked for the end.
    options = ('--speed', '10')
    with Stand(tmp_path, *options, plan='free_positions', nodes=NODES, embedded=EMBEDDED) as stand:
        assert stand.wait(lambda: any(p.next_attitudes for p in stand.progress))
        agreed, why = stand.call('/calibrator_node/solve')
        assert not agreed
        assert 'hold' in why
        final = stand.ended()
        assert final.status == final.VALID
        assert final.method == 'free_positions'
        guided = [p for p in stand.progress if p.next_gains]
        assert guided[-1].step >= 18
        # A review takes its time: a busy machine skips the guidance of a hold here and there.
        steps = [p.step for p in guided]
        assert steps == sorted(steps)
        assert len(set(steps) & set(range(1, 18))) > 9
        found = stand.check_reprocessing().live
        errors = (found.values - TRUTH.values)[FREE] / found.std[FREE]
        assert np.abs(errors).max() < 5
        assert set(stand.recorded_samples()) == {'/imu/pulses', '/imu/temperature'}


def test_plans_for_a_hand_that_nobody_simulates_need_a_port(tmp_path, capsys):
    assert main(['stand', 'six_position_by_hand', '-o', str(tmp_path / 'x')]) == 2
    assert '--port' in capsys.readouterr().err


@pytest.mark.parametrize('words', ['X up', 'half X down, half Y up, half Z down'])
def test_the_words_for_an_attitude_name_one(words):
    up = direction(words)
    assert np.linalg.norm(up) == pytest.approx(1)
    assert direction('sideways') is None


def test_six_holds_and_three_turns_by_hand_live_are_those_of_the_recording(tmp_path):
    recording = Path(__file__).parents[1] / 'data' / 'hand_session'
    setup = Setup(
        SPEC,
        load_plan('six_position_by_hand'),
        None,
        Site.at(49.6 * DEG, gravity=normal_gravity(49.6 * DEG)),
    )
    topics = {Kind.IMU: '/imu/pulses'}
    session = Alone(setup, tmp_path / 'journal', {}, topics)
    offline = Calibrator(setup)
    with open_recording(recording) as held:
        for _, block in held.read({'/imu/raw': Kind.IMU}):
            offline.add_block(block)
            session.add_messages(Kind.IMU, encode_imu(block).payloads(), int(block.stamp[-1]))
    assert session.guidance is None
    ended(session)
    assert session.phase is SessionPhase.FINISHED, session.failure
    assert np.array_equal(session.calibration.values, offline.finish().calibration.values)


@pytest.mark.parametrize('plan', ['free_positions', 'twelve_position'])
def test_a_unit_that_sends_si_values_is_not_simulated_live(tmp_path, capsys, plan):
    # The frames hold whole numbers: the node of the hardware stopped, and the stand waited.
    folder = tmp_path / 'stand'
    assert main(['stand', plan, '--imu', 'si', '-o', str(folder)]) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert 'units: found si, expected pulses or counts' in said
    assert not folder.exists()
    spec = load_imu('si')
    with pytest.raises(InputError, match='units: found si'):
        HeldHardware(spec, TRUTH.model, SITE, ImuOptions())


def test_a_unit_of_other_units_is_told_so_and_not_to_hold_still():
    # Counts taken for m/s^2: no hold is ever found.
    session = Session()
    other = Setup(load_imu('si'), load_plan('free_positions'), None, SITE)
    session.calibrator = HandCalibrator(other)
    for _ in range(20):
        session.goes_on(1.0)
    review = session.calibrator.snapshot().review()
    for text in (review.guidance.text, review.refusal):
        assert 'in the quietest two seconds read 2' in text
        assert 'units or the scale factor' in text
