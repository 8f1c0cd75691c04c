"""Parameters that change during a session: with time, while it warms up, with the temperature."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from extent import again
from other_sessions import EPOCH, NAVIGATION, fed, true_vector
from other_world import DEG, World
from sessions import SITE, gathered, quick_plan, session, stand, truth
from sessions import fed as fed_blocks

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.thermal import ThermalCalibration, by_temperature, load_calibration
from imu_calib.cli.main import main
from imu_calib.common.budget import ErrorSource
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, ImuBlock, TemperatureBlock
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import Estimate, estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.joint import solve
from imu_calib.estimation.methods import method
from imu_calib.estimation.modulation import instant_of, rates, spans
from imu_calib.estimation.score import families
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.term_tests import TermState, summary
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS
from imu_calib.model.session_terms import Course, split_terms
from imu_calib.model.terms import named_terms
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.segmentation.course import Temperature
from imu_calib.session.imu import load_imu
from imu_calib.session.table import ASSUMED, load_table, read_table
from imu_calib.simulation.options import BiasStep, StandOptions, WarmUp
from imu_calib.simulation.stand import SimulatedStand

DEG_H, MICRO_G, PPM = DEG / 3600, 9.80665e-6, 1e-6
RISE = 10 / 3600
"""K/s."""

UNIT = replace(
    NAVIGATION,
    gyro_drift=tuple(v * DEG_H * RISE for v in (0.02, -0.01, 0.015)),
    accel_drift=tuple(v * MICRO_G * RISE for v in (5.0, -8.0, 6.0)),
    gyro_growth=3 * PPM * RISE,
    accel_growth=6 * PPM * RISE,
)
WORLD = World(dwell=40.0)
FAR = 4.5
"""Deviations: chance passes them in one of 6000 sessions of 24 parameters."""


def warmed(calibrator: Calibrator) -> Calibrator:
    """Feed what a thermometer shows once a second, in blocks of its own."""
    last = calibrator._segmenter._intake.last_stamp
    assert last is not None
    seconds = np.arange(last // 10**9 - EPOCH + 1)
    stamps = (EPOCH + seconds) * 10**9
    for part in np.array_split(seconds, 7):
        calibrator.add_block(TemperatureBlock(stamps[part], 20.0 + RISE * part))
    return calibrator


@pytest.fixture(scope='module')
def drifting() -> Evidence:
    """A navigation-grade session of the plain loops in which everything follows the time."""
    return gathered(warmed(fed(WORLD, UNIT)))


def ends(evidence: Evidence) -> tuple[float, float]:
    """First and last instant that counts, s since the session began."""
    parts = [*evidence.segments, *evidence.turns]
    first, last = min(p.start for p in parts), max(p.end for p in parts)
    return first * 1e-9 - EPOCH, last * 1e-9 - EPOCH


def truth_at(seconds: float) -> Floats:
    """What the unit is at an instant."""
    steps = {
        'gyro_m': (UNIT.gyro_m, UNIT.gyro_growth),
        'accel_m': (UNIT.accel_m, UNIT.accel_growth),
    }
    grown = {
        key: tuple(
            tuple((m[i][j] + (i == j)) * (1 + rate * seconds) - (i == j) for j in range(3))
            for i in range(3)
        )
        for key, (m, rate) in steps.items()
    }
    biases = {
        'gyro_d': tuple(d + s * seconds for d, s in zip(UNIT.gyro_d, UNIT.gyro_drift, strict=True)),
        'accel_d': tuple(
            d + s * seconds for d, s in zip(UNIT.accel_d, UNIT.accel_drift, strict=True)
        ),
    }
    return true_vector(replace(UNIT, **grown, **biases))  # type: ignore[arg-type]


def off(found: Estimate, wanted: Floats) -> Floats:
    std = np.sqrt(np.diag(found.covariance)[:24])
    return np.asarray((found.state[:24] - wanted) / std)


@pytest.fixture(scope='module')
def constant(drifting: Evidence) -> Estimate:
    return estimate(drifting)


@pytest.fixture(scope='module')
def trend(drifting: Evidence) -> Estimate:
    return estimate(drifting, changes=split_terms('trend')[1])


@pytest.fixture(scope='module')
def thermal(drifting: Evidence) -> Estimate:
    return estimate(drifting, changes=split_terms('thermal')[1])


def middle(evidence: Evidence) -> float:
    first, last = ends(evidence)
    return (first + last) / 2


def test_without_a_term_a_drift_of_scale_factors_is_in_the_scale_factors(
    drifting: Evidence, constant: Estimate
) -> None:
    wrong = off(constant, truth_at(middle(drifting)))
    assert np.abs(wrong).max() > FAR, 'the session is too tame to test anything'
    assert PARAMETER_NAMES[int(np.abs(wrong).argmax())].startswith('K_')


def test_a_trend_gives_the_parameters_of_the_middle_and_its_slopes(
    drifting: Evidence, constant: Estimate, trend: Estimate
) -> None:
    right = off(trend, truth_at(middle(drifting)))
    assert np.abs(right).max() < FAR, np.round(right, 1)
    # Chi-square of 24 is below 4.3 with a probability of 1e-6.
    assert (right**2).sum() > 4.3
    equations = trend.equations
    slopes = [*UNIT.gyro_drift, *UNIT.accel_drift, UNIT.gyro_growth, UNIT.accel_growth]
    std = np.sqrt(np.diag(trend.covariance)[equations.change_slice])
    far = (trend.state[equations.change_slice] - slopes) / std
    # Eight coefficients: chance passes 4.5 deviations once in 18 000 times.
    assert np.abs(far).max() < FAR, np.round(far, 1)
    # Those of the accelerometers are seen, not merely allowed for.
    assert (np.array(slopes)[3:6] ** 2 > (5 * std[3:6]) ** 2).all()
    # A drift that is known is no wander: biases come out sharper than when it was taken for one.
    biases = [k for k, name in enumerate(PARAMETER_NAMES) if name.startswith('D_a')]
    ratio = np.diag(trend.covariance)[biases] / np.diag(constant.covariance)[biases]
    assert ratio.max() < 0.25


def test_a_course_of_temperature_is_a_trend_where_it_rises_evenly(
    drifting: Evidence, trend: Estimate, thermal: Estimate
) -> None:
    shift = (thermal.state[:24] - trend.state[:24]) / np.sqrt(np.diag(trend.covariance)[:24])
    # The same columns, but that the session's mean lies a minute before the middle of what counts:
    # biases that change by so much more than they are known move with it.
    fixed = [k for k, name in enumerate(PARAMETER_NAMES) if not name.startswith('D_a')]
    assert np.abs(shift[fixed]).max() < 1.0
    mean = drifting.temperature
    assert mean is not None
    right = off(thermal, truth_at((mean.mean - 20.0) / RISE))
    assert np.abs(right).max() < FAR, np.round(right, 1)
    slopes = np.array([*UNIT.gyro_drift, *UNIT.accel_drift, UNIT.gyro_growth, UNIT.accel_growth])
    own = thermal.equations.change_slice
    std = np.sqrt(np.diag(thermal.covariance)[own])
    assert np.abs((thermal.state[own] - slopes / RISE) / std).max() < FAR


def test_the_outputs_change_as_parameters_of_each_stretch_would(drifting: Evidence) -> None:
    changes = split_terms('trend:D_gx+D_az+E_gxy+K_a')[1]
    equations = Equations(drifting, changes=changes)
    state = equations.nominal()
    rng = np.random.default_rng(3)
    state[:24] = 1e-3 * rng.standard_normal(24)
    first, last = ends(drifting)
    half = (last - first) / 2
    # Changes of a thousandth of the parameters by the ends of the session.
    size = np.array([1e-6, 1e-6, 1e-6, 1e-6]) / half
    state[equations.change_slice] = size
    predicted = equations.predict(state)
    plain = Equations(drifting)
    moves = [link.move for link in drifting.used_moves.linked]
    parts = [*drifting.segments, *drifting.turns, *moves]
    for k, part in enumerate(parts):
        when = (part.start + part.end) / 2e9 - EPOCH - (first + last) / 2
        there = state[: equations.change_slice.start].copy()
        for change, slope in zip(changes, size, strict=True):
            for parameter in change.parameters:
                there[PARAMETERS.index(parameter)] += slope * when
        rows = drifting.layout.segment == k
        off = np.abs(predicted - plain.predict(there))[rows].reshape(-1, 3).max(axis=1)
        # In moves, which are not linear, 1e-3 and 1e-6 of some radians are multiplied, and of some
        # forty m/s.
        within = [1e-8, 40e-8] if k >= len(parts) - len(moves) else 1e-13
        assert np.all(off < within)


def test_derivatives_are_those_of_the_prediction(drifting: Evidence) -> None:
    for text in ('trend', 'warm_up', 'step', 'thermal'):
        equations = Equations(drifting, changes=split_terms(text)[1], shape=0.25)
        state = equations.nominal()
        found = equations.jacobian(state)[:, equations.change_slice]
        for k in range(len(equations.changes)):
            step = 1e-6 / np.abs(found[:, k]).max()
            moved = state.copy()
            moved[equations.change_slice.start + k] += step
            slope = (equations.predict(moved) - equations.predict(state)) / step
            assert slope == pytest.approx(found[:, k], abs=1e-6 * np.abs(found[:, k]).max())


def test_what_is_kept_for_the_file_is_applied_at_every_temperature(drifting: Evidence) -> None:
    solution = solve(drifting, changes=split_terms('thermal')[1])
    assert drifting.temperature is not None
    temperature = drifting.temperature
    calibration = Calibration(
        load_imu('fog_navigation'),
        solution.model,
        solution.covariance,
        provenance={
            'temperature': {
                'mean': temperature.mean,
                'lowest': temperature.lowest,
                'highest': temperature.highest,
            }
        },
        changes=solution.changes,
    )
    read = Calibration.from_yaml(calibration.to_yaml(), 'calibration.yaml')
    ready = by_temperature(read, 'calibration.yaml')
    assert isinstance(ready, ThermalCalibration)
    first, last = ends(drifting)
    for seconds in (first + 5.0, last - 5.0):
        at = ready.at(20.0 + RISE * seconds)
        far = (at.values[:24] - truth_at(seconds)) / at.std[:24]
        assert np.abs(far).max() < FAR, np.round(far, 1)
    # At the mean they are those of the file.
    assert ready.at(temperature.mean).values == pytest.approx(read.values, abs=1e-15)
    # Beyond the session nothing is known, and the last holds.
    hot, hotter = ready.at(temperature.highest), ready.at(temperature.highest + 20.0)
    assert (hot.values == hotter.values).all()


def test_a_session_that_warms_says_what_that_means(drifting: Evidence, constant: Estimate) -> None:
    findings = [f for f in solve(drifting).findings if 'The temperature moved' in f]
    assert len(findings) == 1
    assert 'use the terms thermal or trend' in findings[0]
    assert 'K_a' in findings[0]
    # What a data sheet states is in the deviations, and takes the error in.
    sheet = replace(drifting, thermal=np.array([[3 * PPM, 0.02 * DEG_H], [6 * PPM, 8 * MICRO_G]]))
    stated = estimate(sheet)
    wanted = truth_at(middle(drifting))
    assert np.abs(off(stated, wanted)).max() < FAR
    assert '6 ppm/K' in ' '.join(solve(sheet).findings)
    assert off(constant, wanted).max() > off(stated, wanted).max()


@pytest.fixture(scope='module')
def warming() -> tuple[Evidence, Floats]:
    """A navigation-grade session whose biases fade with 241 s, and the mean of what they add."""
    spec = load_imu('fog_navigation')
    fading = WarmUp((0.3 * DEG_H, -0.2 * DEG_H, 0.1 * DEG_H), 100 * MICRO_G, 241.0)
    options = stand(warm_up=fading)
    plan = quick_plan('twelve_position', 40.0)
    setup = Setup(spec, plan, load_table('three_axis'), SITE)
    blocks = session(plan, options, seed=2, spec=spec)
    evidence = gathered(fed_blocks(blocks, setup))
    first, last = ends(evidence)
    start = options.start_time * 1e-9 - EPOCH
    tau = fading.time_constant
    mean = tau * (np.exp(-(first - start) / tau) - np.exp(-(last - start) / tau)) / (last - first)
    wanted = truth().model.vector().copy()
    wanted[9:12] += mean * np.array(fading.gyro_bias)
    wanted[21:24] += mean * 100 * MICRO_G
    return evidence, wanted


def test_a_warm_up_fades_at_a_rate_that_is_found(warming: tuple[Evidence, Floats]) -> None:
    evidence, wanted = warming
    found = estimate(evidence, changes=split_terms('warm_up')[1])
    assert np.abs(off(found, wanted)).max() < FAR
    first, last = ends(evidence)
    # The next two of the grid, factors of the square root of two.
    assert found.equations.shape * (last - first) == pytest.approx(241.0, rel=0.5)
    # What the grid leaves of its doubt is a source of the budget, which adds up.
    shares = found.shares()
    total = sum(share.covariance for share in shares.values())
    kept = found.covariance[:24, :24]
    scale = np.sqrt(np.outer(np.diag(kept), np.diag(kept)))
    assert np.abs((total - kept) / scale).max() < 1e-6
    assert np.diag(shares[ErrorSource.TIME_CONSTANT].covariance)[21] > 0


BLAMED = ('drift by', 'scatter', 'given less weight', 'elsewhere')
"""Words of the findings that blame something else."""


def test_a_drift_that_nobody_asked_for_is_found_and_named(drifting: Evidence) -> None:
    found = solve(replace(drifting, temperature=None), find_terms=True)
    assert found.changes is not None
    assert {c.course for c in found.changes.changes} == {Course.TREND}
    findings = [f for f in found.findings if 'The session shows' in f]
    assert len(findings) == 1
    assert 'parameters that drift evenly with time (trend' in findings[0]
    assert not [f for f in found.findings if any(word in f for word in BLAMED)]
    std = np.sqrt(np.diag(found.covariance)[:24])
    wrong = (found.model.values(PARAMETERS) - truth_at(middle(drifting))) / std
    assert np.abs(wrong).max() < FAR, np.round(wrong, 1)
    states = {test.name: test for test in found.tests}
    assert states['trend'].state is TermState.FOUND
    assert states['trend'].document()['state'] == 'found'


def test_what_follows_a_recorded_temperature_is_found_and_holds_beyond_the_session(
    drifting: Evidence,
) -> None:
    """A drift with time would do as well where the temperature rises evenly: it is its rival."""
    found = solve(drifting, find_terms=True)
    assert found.changes is not None
    assert {c.course for c in found.changes.changes} == {Course.THERMAL}
    findings = [f for f in found.findings if 'The session shows' in f]
    assert len(findings) == 1
    assert 'parameters that follow the temperature (thermal' in findings[0]
    assert 'trend' in findings[0]
    assert 'let the temperature rise and fall' in findings[0]
    assert not [f for f in found.findings if 'K and D are taken as constant' in f]
    assert drifting.temperature is not None
    std = np.sqrt(np.diag(found.covariance)[:24])
    wanted = truth_at((drifting.temperature.mean - 20.0) / RISE)
    wrong = (found.model.values(PARAMETERS) - wanted) / std
    assert np.abs(wrong).max() < FAR, np.round(wrong, 1)
    assert {test.name: test for test in found.tests}['thermal'].state is TermState.FOUND


def test_a_temperature_that_stays_is_no_candidate(drifting: Evidence) -> None:
    """Half a kelvin is what thermometers resolve."""
    assert drifting.temperature is not None
    course = drifting.temperature.course
    for rise, there in ((0.7, True), (0.3, False)):
        celsius = np.linspace(20.0, 20.0 + rise, len(course))
        temperature = Temperature(
            20.0 + rise / 2, 20.0, 20.0 + rise, np.column_stack([course[:, 0], celsius])
        )
        equations = Equations(replace(drifting, temperature=temperature))
        names = {family.name for family in families(equations)}
        assert ('thermal' in names) is there


def test_a_warm_up_that_nobody_asked_for_is_told_from_a_drift(
    warming: tuple[Evidence, Floats],
) -> None:
    evidence, wanted = warming
    found = solve(evidence, find_terms=True)
    assert found.changes is not None
    assert {c.course for c in found.changes.changes} == {Course.WARM_UP}
    findings = [f for f in found.findings if 'The session shows' in f]
    assert len(findings) == 1
    assert 'settle as the unit warms up (warm_up' in findings[0]
    # It fades with a fifth of the session: no drift would do.
    assert 'trend' not in findings[0]
    std = np.sqrt(np.diag(found.covariance)[:24])
    wrong = (found.model.values(PARAMETERS) - wanted) / std
    assert np.abs(wrong).max() < FAR, np.round(wrong, 1)


def test_what_was_asked_for_is_on_the_screen(drifting: Evidence) -> None:
    asked = split_terms('trend:D_a+K_a')[1]
    found = solve(drifting, changes=asked)
    states = {test.name: test for test in found.tests}
    assert states['trend'].state is TermState.ASKED
    assert states['trend'].changes == asked
    assert summary(found.tests)[0] == 'terms: trend'


def test_outputs_rise_within_a_stretch_as_their_course_does(drifting: Evidence) -> None:
    starts, ends = spans(drifting)
    whole = ends.max()
    tau = 0.25 * whole
    courses = {
        Course.TREND: lambda t: t,
        Course.WARM_UP: lambda t: np.exp(-t / tau),
        Course.THERMAL: lambda t: RISE * t,
    }
    for course, at in courses.items():
        exact = (at(ends) - at(starts)) / (ends - starts)
        # A thermometer is read every second and kept in cells of some: a tenth.
        within = 0.1 if course is Course.THERMAL else 1e-9
        assert rates(drifting, course, 0.25) == pytest.approx(exact, rel=within)


def test_terms_that_the_session_cannot_tell_are_refused(drifting: Evidence) -> None:
    changes = split_terms('thermal')[1]
    with pytest.raises(NotObservable, match='no temperature'):
        estimate(replace(drifting, temperature=None), changes=changes)
    temperature = drifting.temperature
    assert temperature is not None
    still = replace(temperature, course=temperature.course * [1.0, 0.0] + [0.0, 20.0])
    with pytest.raises(NotObservable, match=r'moves by 0\.00 K.*expected 0\.5 K'):
        estimate(replace(drifting, temperature=still), changes=changes)
    one = replace(drifting, segments=drifting.segments, turns=drifting.turns, moves=())
    with pytest.raises(NotObservable, match='do not determine trend'):
        estimate(one, changes=split_terms('trend:E_gxy+E_gxz+E_gyx+K_g+K_gx+K_gy+K_gz')[1])


def test_names_of_terms() -> None:
    rest, changes = split_terms('g_sensitivity, trend')
    assert (rest, [c.name for c in changes][-2:]) == ('g_sensitivity', ['K_g', 'K_a'])
    assert len(changes) == 8
    assert split_terms('auto')[0] == 'auto'
    assert [c.name for c in split_terms('thermal:K_ax+D_g')[1]] == ['K_ax', 'D_gx', 'D_gy', 'D_gz']
    with pytest.raises(InputError, match='found trend and warm_up, expected one'):
        split_terms('trend,warm_up')
    with pytest.raises(InputError, match="found 'K_b', expected D_g, D_a"):
        split_terms('thermal:K_b')
    with pytest.raises(InputError, match='trend, warm_up, step, thermal'):
        named_terms('trends')
    with pytest.raises(InputError, match='twelve_position estimates its own'):
        method('twelve_position', (), split_terms('trend')[1])


def test_commands_carry_them_from_the_recording_to_compensation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    plan = Path(str(named_file('plans', 'twelve_position'))).read_text()
    brief = plan.replace('[10 deg/s, -10 deg/s, 30 deg/s, -30 deg/s, ', '[')
    Path('short.yaml').write_text(brief.replace('dwell: 120 s', 'dwell: 15 s'))
    Path('warm.yaml').write_text(
        'temperature: {ramp: 60 K/h, gyro: {bias: 1 (deg/h)/K, scale_factor: 50 ppm/K}, '
        'accelerometer: {bias: 100 ug/K, scale_factor: 100 ppm/K}}'
    )
    place = ['--latitude', '34.65', '--gravity', '9.797']
    simulated = ['--imperfections', 'warm.yaml', '--imu', 'fog_navigation', '--seed', '3', *place]
    assert main(['simulate', 'short.yaml', '-o', 'bag', *simulated]) == 0
    assert main(['calibrate', 'bag', '--terms', 'trend,warm_up']) == 2
    assert 'expected one of them' in capsys.readouterr().err
    assert main(['calibrate', 'bag', '--terms', 'thermal', '-o', 'c.yaml', '--verbose']) == 0
    shown = capsys.readouterr().out
    assert re.search(r'thermal +K_a +[0-9.]+ +[0-9.]+ +ppm per K', shown)
    assert 'compensation adds what follows the temperature' in ' '.join(shown.split())
    calibration = Calibration.load(Path('c.yaml'))
    assert calibration.provenance['terms'] == ['thermal']
    found = calibration.changes
    assert found is not None
    given = [1 * DEG_H] * 3 + [100 * MICRO_G] * 3 + [50 * PPM, 100 * PPM]
    assert np.abs((found.values - given) / found.std).max() < FAR
    # At rest the compensated force is gravity at the beginning as at the end, where the
    # accelerometers answer by some 700 ppm more.
    assert main(['compensate', 'bag', '--calibration', 'c.yaml', '-o', 'si']) == 0
    assert calibration.provenance['tests_of_terms']['thermal'] == {'state': 'asked for'}
    assert main(['report', 'c.yaml', 'bag', '-o', 'report.html']) == 3
    assert 'Terms of the session' in Path('report.html').read_text()
    capsys.readouterr()
    assert main(['export', 'c.yaml', '--format', 'c', '-o', 'c.h']) == 0
    assert 'The dependence on temperature (term thermal) is left out' in capsys.readouterr().out
    with open_recording('si') as recording:
        topic = next(t.name for t in recording.topics if t.type == Kind.IMU.type_name)
        blocks = [b for _, b in recording.read({topic: Kind.IMU})]
    force = np.concatenate([b.accel for b in blocks])
    ready, seen = load_calibration(Path('c.yaml')), calibration.provenance['temperature']
    assert isinstance(ready, ThermalCalibration)
    noise = calibration.provenance['random_walk'][3] / np.sqrt(10.0)
    pulse = load_imu('fog_navigation').accel.scale_factor / 10.0
    for span, end in ((force[500:1500], 'lowest'), (force[-1500:-500], 'highest')):
        there = ready.at(seen[end])
        known = 9.797 * there.std[12:15].max()
        size = float(np.linalg.norm(span.mean(axis=0)))
        assert size == pytest.approx(9.797, abs=4 * np.hypot(known, noise + pulse))
        # What the term takes off is five times that.
        assert known < 0.2 * 9.797 * np.abs(there.values - calibration.values)[12:15].max()


def test_a_drift_is_asked_of_no_plan_as_what_it_tells_of_it_is_shown_anyway(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = ['plans', 'twelve_position', '--imu', 'fog_navigation', '--terms', 'trend']
    assert main(asked) == 2
    assert 'trend, warm_up and step are predicted without being named' in capsys.readouterr().err


def stepped_session(
    grade: str, step: BiasStep, seed: int, silent: tuple[float, float] | None = None
) -> tuple[Evidence, Floats]:
    """Twelve positions on a table of which nothing is stated, and the mean unit of the session.

    No samples are recorded in the `silent` seconds, as of a unit that is switched off and on.
    """
    known = yaml.safe_load(named_file('tables', 'three_axis').read_text(encoding='utf-8'))
    left = {key: value for key, value in known.items() if key not in ASSUMED}
    table, spec = read_table(Section(left, 'three_axis')), load_imu(grade)
    plan, unit = quick_plan('twelve_position', 40.0), truth().model
    options = StandOptions(positioning_error=0.0, bias_step=step)
    run = SimulatedStand(plan, table, spec, unit, SITE, options, seed)
    calibrator = Calibrator(Setup(spec, plan, table, SITE))
    begin = options.start_time
    for _, block in run.blocks():
        if isinstance(block, ImuBlock) and silent is not None:
            seconds = (block.stamp - begin) * 1e-9
            for kept in (seconds < silent[0], seconds > silent[1]):
                parts = (block.stamp[kept], block.gyro[kept], block.accel[kept])
                calibrator.add_block(ImuBlock(*parts, block.frame_id))
        else:
            calibrator.add_block(block)
    evidence = gathered(calibrator)
    starts, stops = spans(evidence)
    last = (instant_of(evidence, 1.0) - begin) * 1e-9
    after = (last - step.time) / (stops.max() - starts.min())
    wanted = unit.vector().copy()
    wanted[9:12] += after * np.asarray(step.gyro_bias)
    wanted[21:24] += after * np.asarray(step.accel_bias)
    return evidence, wanted


@pytest.mark.parametrize(
    ('time', 'gyro', 'accel', 'seed'), [(497.0, 3.0, 500.0, 1), again(840.0, 10.0, 1000.0, 2)]
)
def test_a_large_step_is_found(time: float, gyro: float, accel: float, seed: int) -> None:
    signs = np.array([1.0, -0.7, 1.2])
    step = BiasStep(time, tuple(gyro * DEG_H * signs), tuple(accel * MICRO_G * signs))
    evidence, wanted = stepped_session('fog_navigation', step, seed)
    found = solve(evidence, find_terms=True)
    assert found.changes is not None
    assert {c.course for c in found.changes.changes} == {Course.STEP}
    assert [f for f in found.findings if 'biases that step at one instant (step,' in f]
    std = np.sqrt(np.diag(found.covariance)[:24])
    wrong = (found.model.values(PARAMETERS) - wanted) / std
    assert np.abs(wrong).max() < FAR, np.round(wrong, 1)


def test_a_step_is_found_though_a_dwell_beside_it_looks_like_an_outlier() -> None:
    """Six coefficients and an instant explain more than an accelerometer triad that is left out."""
    gyro = tuple(v * DEG_H for v in (-0.030, -0.333, -0.280))
    accel = tuple(v * MICRO_G for v in (46.3, 4.2, -52.9))
    evidence, wanted = stepped_session('fog_medium', BiasStep(347.7, gyro, accel), 1546476769)
    assert [one.name for one in estimate(evidence).outliers] == ['the accelerometers at position 3']
    found = solve(evidence, find_terms=True)
    assert found.search is not None
    assert [one.family.name for one in found.search.found] == ['step']
    assert not found.search.estimate.outliers
    std = np.sqrt(np.diag(found.covariance)[:24])
    wrong = (found.model.values(PARAMETERS) - wanted) / std
    assert np.abs(wrong).max() < FAR, np.round(wrong, 1)


def test_a_step_is_likelier_where_the_stream_was_interrupted() -> None:
    gyro = tuple(0.1 * v * DEG_H for v in (1.0, -0.7, 1.2))
    accel = tuple(20 * v * MICRO_G for v in (1.0, -0.7, 1.2))

    def silent(step: BiasStep) -> Evidence:
        evidence, _ = stepped_session('fog_medium', step, 5, (600.0, 606.0))
        ((last, begins),) = evidence.interruptions
        assert (begins - last) * 1e-9 == pytest.approx(6.0, abs=0.1)
        return evidence

    def searched(evidence: Evidence) -> tuple[list[str], float]:
        found = solve(evidence, find_terms=True).search
        assert found is not None
        likely = {family.course: p for family, p in found.probability.items()}
        return [one.family.name for one in found.found], likely.get(Course.STEP, 1.0)

    stepping = silent(BiasStep(603.0, gyro, accel))
    assert searched(stepping)[0] == ['step']
    # Among all instants it is not significant, and one in a thousand beforehand.
    names, likely = searched(replace(stepping, interruptions=()))
    assert names == []
    assert likely < 0.5
    # Nothing is said of a unit that went on as it was.
    names, likely = searched(silent(BiasStep(603.0)))
    assert names == []
    assert likely < 0.5
