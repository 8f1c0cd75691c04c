"""Whole turns at constant rate, found from encoders of all kinds on ramps of all kinds."""

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from extent import again
from sessions import SITE, Named, beside_exactness, calibrate, paper_imu, quick_plan, stand, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.results import Result
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, JointBlock, Setpoint
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.model.sensors import SensorModel
from imu_calib.segmentation.plateaus import find_turns, no_turn_reason
from imu_calib.segmentation.table_motion import Motion
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import Plan
from imu_calib.session.table import TURN, load_table
from imu_calib.simulation.motion import Track, trapezoid
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import simulate
from imu_calib.simulation.table import SimulatedTable

RAMPS = 20.0
"""Of a slow table, deg/s^2: at 90 deg/s and a plateau of 385 deg more time goes to the ramps."""

PLATEAU = 385.0
"""deg: just above a turn."""

RESOLUTION = TURN / 2**22


def turned(time: Floats, rate: float, ramps: float, plateau: float) -> Floats:
    """Angle at (n,) times of a motion from rest to rest that begins at zero; degrees."""
    up, level = rate / ramps, plateau / rate
    ramp = np.clip(time, 0, up)
    back = np.clip(time - up - level, 0, up)
    steady = np.clip(time - up, 0, level)
    return np.asarray(ramps * ramp**2 / 2 + rate * steady + rate * back - ramps * back**2 / 2)


def motion(
    rate: float,
    ramps: float,
    plateau: float,
    *,
    hz: float = 100.0,
    noise: float = 0.0,
    jitter: float = 0.0,
    resolution: float = RESOLUTION,
) -> Motion:
    """What an encoder says of it, two seconds at rest before and after; noise in arcsec."""
    rng = np.random.default_rng(1)
    time = np.arange(-2.0, 2 * rate / ramps + plateau / rate + 2.0, 1 / hz)
    angle = turned(time, rate, ramps, plateau) * DEG
    angle = angle + noise * ARCSEC * rng.standard_normal(len(time))
    angle = np.rint(angle / resolution) * resolution
    stamp = time + np.clip(jitter * rng.standard_normal(len(time)), -0.45 / hz, 0.45 / hz)
    stamp = np.rint((stamp + 2) * 1e9).astype(np.int64)
    return Motion(0, int(stamp[-1]), stamp, np.column_stack([np.zeros_like(angle), angle]))


@pytest.mark.parametrize('rate', [90.0, 100.0])
@pytest.mark.parametrize(
    'encoder',
    [
        {},
        {'hz': 50.0},
        {'hz': 1000.0},
        {'hz': 50.0, 'noise': 7.0},
        {'hz': 1000.0, 'noise': 7.0},
        {'noise': 7.0, 'jitter': 0.0005},
        {'jitter': 0.002},
        {'resolution': 20 * ARCSEC},
    ],
)
def test_a_plateau_shorter_than_its_ramps_is_found_alone(rate, encoder):
    (turns,) = find_turns(motion(rate, RAMPS, PLATEAU, **encoder))
    assert turns.angle == pytest.approx(TURN)
    assert turns.joint == 1
    # Wherever it is cut, the table truly turned at the rate that the line has.
    begin = turns.start * 1e-9 - 2
    truly = np.ptp(turned(np.array([begin, begin + turns.seconds]), rate, RAMPS, PLATEAU))
    assert truly * DEG == pytest.approx(turns.angle, rel=4.5 * turns.rate_error + 1e-8)
    # A line through the samples of a turn or more: white scatter over the square root of them.
    hz = encoder.get('hz', 100.0)
    scatter = np.hypot(encoder.get('noise', 0.0) / 3600, encoder.get('jitter', 0.0) * rate)
    scatter = np.hypot(scatter, encoder.get('resolution', RESOLUTION) / DEG / np.sqrt(12))
    expected = scatter * np.sqrt(12 / (hz * PLATEAU / rate)) / PLATEAU
    # Ends that may be ramps already are left out, which a line pays for with the power 3/2 of its
    # length; what hides in them counts too. Readings that come in time with the encoder's steps
    # (0.9 deg are 162 of 20 arcsec) leave one of these uncertain over the whole line.
    in_time = encoder.get('resolution', RESOLUTION) / DEG / PLATEAU
    assert 0.5 * expected < turns.rate_error < 3 * expected + scatter / 360 + 1.2 * in_time


@pytest.mark.parametrize('ramps', [2.0, 5.0, 200.0, 1e4])
@pytest.mark.parametrize('plateau', [375.0, 3650.0])
def test_ramps_may_be_as_slow_or_as_fast_as_they_like(ramps, plateau):
    (turns,) = find_turns(motion(90.0, ramps, plateau, noise=1.0))
    assert turns.angle == pytest.approx(TURN * (plateau // 360))
    assert turns.seconds == pytest.approx(plateau // 360 * 4.0, rel=4.5 * turns.rate_error)
    assert turns.rate_error < 2e-6


def test_a_line_that_rests_on_the_ends_of_a_gap_alone_is_no_plateau():
    # Joint states fail from 20 % to 80 % of the plateau: 114 deg, which no whole turn hides in.
    whole = motion(18.0, 0.2, 190.0, hz=1.0)
    since = (whole.stamp - whole.stamp[0]) * 1e-9 - 2 - 18.0 / 0.2
    heard = (since < 0.2 * 190 / 18) | (since > 0.8 * 190 / 18)
    seen = replace(whole, stamp=whole.stamp[heard], position=whole.position[heard])
    assert find_turns(seen) == []
    assert no_turn_reason(seen) == 'the joint states show no constant rate'


def test_one_motion_may_hold_several_rates():
    # 60 deg/s for two turns and a bit, then, without a stop, 30 deg/s back for one and a bit.
    there, back = motion(60.0, RAMPS, 750.0), motion(30.0, RAMPS, 400.0)
    stamp = np.concatenate([there.stamp[:-400], back.stamp + there.stamp[-400]])
    position = np.vstack([there.position[:-400], there.position[-1] - back.position])
    first, second = find_turns(Motion(0, int(stamp[-1]), stamp, position))
    assert first.angle == pytest.approx(2 * TURN)
    assert second.angle == pytest.approx(-TURN)
    assert [first.seconds, second.seconds] == pytest.approx([12.0, 12.0], rel=1e-6)


@pytest.mark.parametrize('noise', [0.0, 7.0])
@pytest.mark.parametrize('plateau', [0.0, 100.0, 315.0, 350.0])
def test_ramps_are_no_turns(plateau, noise):
    seen = motion(90.0, RAMPS, plateau, noise=noise)
    assert find_turns(seen) == []
    if plateau < 180:
        assert no_turn_reason(seen) == 'the joint states show no constant rate'
    else:
        said = re.search(
            r'show 90 deg/s for (\d+) deg, less than a whole turn', no_turn_reason(seen)
        )
        assert said is not None
        # 7 arcsec do not show what a ramp of 20 deg/s^2 does within 0.05 s: 4.5 deg at either end.
        assert float(said[1]) == pytest.approx(plateau, abs=9.0)


NAVIGATION = replace(
    Calibration.load(named_file('truths', 'fog_navigation_33')).model,
    g_sensitivity=np.zeros((3, 3)),
)


def grade(name: str) -> tuple[ImuSpec, SensorModel]:
    """A unit without bias instability, and its truth."""
    if name == 'medium':
        return paper_imu(), truth().model
    spec = load_imu('fog_navigation')
    gyro, accel = replace(spec.gyro, bias_instability=0.0), spec.accel
    return replace(spec, gyro=gyro, accel=replace(accel, bias_instability=0.0)), NAVIGATION


def plan_at(rates: tuple[float, ...]) -> Plan:
    """Twelve positions with these rates in both senses, deg/s."""
    plan = quick_plan('twelve_position', 40.0)
    both = tuple(sign * rate * DEG for rate in rates for sign in (1, -1))
    tests = [p.rate_test and replace(p.rate_test, rates=both) for p in plan.positions]
    positions = [replace(p, rate_test=test) for p, test in zip(plan.positions, tests, strict=True)]
    return replace(plan, positions=tuple(positions))


def run(
    unit: tuple[ImuSpec, SensorModel],
    plan: Plan,
    options: StandOptions,
    seed: int,
    *,
    noise: float = 0.0,
) -> tuple[Result, Floats]:
    """A whole session, encoder noise in arcsec; the errors in standard deviations."""
    spec, model = unit
    rng = np.random.default_rng(seed)

    def blocks() -> Iterator[Named]:
        table = load_table('three_axis')
        for topic, block in simulate(plan, table, spec, model, SITE, options, seed):
            if isinstance(block, JointBlock) and noise:
                error = noise * ARCSEC * rng.standard_normal(block.position.shape)
                yield topic, replace(block, position=block.position + error)
            else:
                yield topic, block

    result = calibrate(blocks(), plan, spec=spec)
    return result, (result.solution.model.vector() - model.vector()) / result.solution.std


class SlowTable(SimulatedTable):
    """Ramps at `RAMPS`, and turns as far as it takes to hold each rate for `plateau` deg."""

    plateau = PLATEAU

    def _aim_turn(self, setpoint: Setpoint, *args: Any) -> Any:
        order, rate = super()._aim_turn(setpoint, *args), np.abs(args[1]).max() / DEG
        further = (self.plateau + rate**2 / RAMPS) * DEG - TURN * (setpoint.turns + 1)
        moved = np.sign(args[1]) * further
        ends = {name: getattr(order, name) + moved for name in ('goal', 'encoder', 'true')}
        return replace(order, **ends)


@pytest.fixture
def slow_table(monkeypatch):
    """Have the stand simulated with slow ramps."""

    def slowly(*args: Any) -> Track:
        return trapezoid(*args[:4], min(args[4], RAMPS * DEG))

    monkeypatch.setattr('imu_calib.simulation.table.trapezoid', slowly)
    monkeypatch.setattr('imu_calib.simulation.stand.SimulatedTable', SlowTable)
    return SlowTable


@pytest.mark.usefixtures('slow_table')
@pytest.mark.parametrize('name', [again('medium'), 'navigation'])
@pytest.mark.parametrize(
    ('rates', 'joint_state_rate', 'noise'),
    [
        again((90.0,), 100.0, 0.0),
        ((100.0,), 50.0, 0.0),
        ((40.0, 80.0, 120.0), 50.0, 0.0),
        ((20.0, 50.0, 90.0), 25.0, 7.0),
        again((20.0, 50.0, 90.0), 200.0, 7.0),
    ],
)
def test_sessions_on_slow_ramps_are_as_good_as_they_say(name, rates, joint_state_rate, noise):
    options = stand(azimuth=0.5, joint_state_rate=joint_state_rate)
    result, error = run(grade(name), plan_at(rates), options, 1, noise=noise)
    assert len(result.labelled.turns) == 6 * len(rates)
    assert np.abs(error).max() < 4.5
    # A turn of 4 s at 90 deg/s: 0.05 deg/sqrt(h) is 1.7 mdeg of 360 deg, 5 ppm in each of two.
    limit = {'medium': 6e-6, 'navigation': 1.5e-6}[name]
    assert result.solution.std[:3].max() < limit
    assert beside_exactness(result.calibration.findings) == []


def test_a_session_that_is_all_ramp_is_refused_and_says_why(slow_table):
    slow_table.plateau = 315.0
    try:
        with pytest.raises(NotObservable) as refused:
            run(grade('medium'), plan_at((90.0,)), stand(azimuth=0.5), 1)
    finally:
        slow_table.plateau = PLATEAU
    assert 'K_gx, E_gyx, E_gzx not observable' in str(refused.value)
    assert re.search(r'for 31\d deg, less than a whole turn: the rest is ramps', str(refused.value))
