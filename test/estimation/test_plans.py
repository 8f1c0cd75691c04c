"""The plan for all terms of the model, and that whose moves turn each axis while it is level."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from sessions import SITE, at_one_rate, fed, gathered, paper_imu, quick_plan, stand, truth
from sessions import session as session_of

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, Mode
from imu_calib.common.units import ARCSEC, DEG, PPM
from imu_calib.estimation import forecast as each_term
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import Estimate, estimate
from imu_calib.estimation.forecast import forecast, forecast_changes, forecast_terms, information
from imu_calib.estimation.predict import duration, expected
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.solve import check_observable
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.model.sensors import SensorModel, parameters_of
from imu_calib.model.session_terms import Course
from imu_calib.model.terms import TERMS, Term, term
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Position, load_plan
from imu_calib.session.table import Table, load_table
from imu_calib.simulation.options import Warming
from imu_calib.simulation.repetition import economical
from imu_calib.simulation.stand import simulate

TOO_FAR = 4.5
"""Standard deviations that one of 66 normal numbers exceeds once in 2000 sessions."""

UNIT = Calibration.load(named_file('truths', 'fog_navigation_terms'))
LINEAR = SensorModel(UNIT.model.gyro, UNIT.model.accel)
IMU = replace(load_imu('fog_navigation'), sample_rate=50.0)
ODD = ('gyro_rate_dependence', 'gyro_cubic')
FULL, NINETEEN = load_plan('full_model'), load_plan('nineteen_position')
THREE, LEVEL = load_table('three_axis'), load_table('two_axis_level')


@cache
def foreseen(*names: str) -> dict[ParameterKind, Floats]:
    """Standard deviations of the plan for all terms, by kind: gyros' and accelerometers' alike."""
    terms = tuple(term(name) for name in names)
    found = forecast(Setup(IMU, FULL, THREE, SITE, terms=terms), UNIT.model)
    assert found.refusal == ''
    kinds = {p.kind for p in found.parameters}
    return {
        kind: np.array(
            [s for p, s in zip(found.parameters, found.std, strict=True) if p.kind is kind]
        )
        for kind in kinds
    }


def times(kind: ParameterKind, few: tuple[str, ...], many: tuple[str, ...], triad: str) -> float:
    """By how many times a kind of parameter is known worse with more terms, its worst channel."""
    part = slice(None)
    if kind in (ParameterKind.SCALE_FACTOR_ERROR, ParameterKind.BIAS):
        part = slice(3) if triad == 'g' else slice(3, 6)
    return float((foreseen(*many)[kind][part] / foreseen(*few)[kind][part]).max())


def test_one_session_tells_all_twelve_terms_together() -> None:
    every = tuple(t.name for t in TERMS)
    assert len(every) == 12
    found = foreseen(*every)
    assert sum(len(s) for s in found.values()) == 73
    # Each to a hundredth of what data sheets of such units state: 10 ppm, 10 ug/g^2, 0.1 (deg/h)/g;
    # places to a tenth of a millimetre and the delay to a hundredth of a millisecond.
    sizes = {t: p.unit.scale for t in TERMS for p in t.parameters[:1]}
    for t in TERMS:
        shown = found[t.kind] / sizes[t]
        sharp = {'g_sensitivity': 0.03, 'gyro_g2': 0.05, 'size_effect': 0.1, 'delay': 0.01}
        assert shown.max() < sharp.get(t.name, 2.0), t.name


@pytest.mark.parametrize(
    ('pair', 'kind', 'triad', 'low', 'high'),
    [
        # docs/methods.md states these, K_g, K_a and D_a against none of the pair. Accelerometers in
        # turns count in both: by a tenth for K_a and D_a alone, 7 % for K_a with the cubic term,
        # 14 to 18 % for D_a with the pair.
        ('gyro_rate_dependence,gyro_cubic', ParameterKind.SCALE_FACTOR_ERROR, 'g', 5.0, 5.6),
        ('gyro_rate_dependence', ParameterKind.SCALE_FACTOR_ERROR, 'g', 2.6, 3.0),
        ('gyro_cubic', ParameterKind.SCALE_FACTOR_ERROR, 'g', 1.8, 2.1),
        ('gyro_asymmetry,gyro_quadratic', ParameterKind.SCALE_FACTOR_ERROR, 'g', 1.0, 1.01),
        ('accel_cubic', ParameterKind.SCALE_FACTOR_ERROR, 'a', 3.0, 3.2),
        ('accel_quadratic,accel_asymmetry', ParameterKind.BIAS, 'a', 1.4, 1.6),
    ],
)
def test_what_terms_cost_the_24_is_what_the_page_says(pair, kind, triad, low, high) -> None:
    assert low < times(kind, (), tuple(pair.split(',')), triad) < high


@pytest.mark.parametrize(
    ('one', 'other', 'low', 'high'),
    [
        ('gyro_rate_dependence', 'gyro_cubic', 4.5, 5.4),
        ('gyro_asymmetry', 'gyro_quadratic', 2.6, 3.0),
        ('accel_quadratic', 'accel_asymmetry', 4.1, 4.5),
    ],
)
def test_what_terms_cost_each_other_is_what_the_page_says(one, other, low, high) -> None:
    for first, second in ((one, other), (other, one)):
        assert low < times(term(first).kind, (first,), (first, second), '') < high


def test_one_rate_would_leave_the_odd_terms_to_the_moves() -> None:
    """What five rates are for: of one, K_g and both odd terms take all that turns tell."""
    terms = tuple(term(name) for name in ODD)
    few = replace(FULL, positions=tuple(_at_one_rate(p) for p in FULL.positions))
    known = forecast(Setup(IMU, few, THREE, SITE, terms=terms), UNIT.model).std
    assert known[0] > 3 * foreseen(*ODD)[ParameterKind.SCALE_FACTOR_ERROR][0]


def _at_one_rate(position: Position) -> Position:
    test = position.rate_test
    return (
        position
        if test is None
        else replace(position, rate_test=replace(test, rates=test.rates[:2]))
    )


def test_attitudes_are_upright_and_at_45_degrees_in_all_quadrants() -> None:
    ups = {tuple(np.round(p.up * np.sqrt(2), 6) + 0.0) for p in FULL.positions}
    root = round(float(np.sqrt(2)), 6)
    upright = {tuple(s * root * axis) for axis in np.eye(3) for s in (1, -1)}
    slanted = {
        tuple(a * np.eye(3)[i] + b * np.eye(3)[j])
        for i, j in ((0, 1), (1, 2), (0, 2))
        for a in (1, -1)
        for b in (1, -1)
    }
    assert ups == {tuple(float(x) for x in up) for up in upright | slanted}
    rates = [p.rate_test.rates for p in FULL.positions if p.rate_test is not None]
    assert len(rates) == 3
    assert all(
        len({abs(r) for r in each}) == 5 and {-r for r in each} == set(each) for each in rates
    )


@cache
def session(name: str, terms: tuple[Term, ...], positioning: float, seed: int) -> Result:
    """A session with short dwells, samples at 20 Hz: the plan's own attitudes, rates and moves."""
    plan = quick_plan(name, 30.0)
    table = THREE if name == 'full_model' else LEVEL
    imu = replace(IMU, sample_rate=20.0)
    options = replace(stand(azimuth=0.7), positioning_error=positioning)
    stated_table = replace(table, positioning=positioning / np.sqrt(3))
    model = UNIT.model if terms else LINEAR
    blocks = simulate(plan, table, imu, model, SITE, options, seed)
    return fed(blocks, Setup(imu, plan, stated_table, SITE, terms=terms)).finish()


def test_what_moves_tell_of_the_terms_of_motion_is_foreseen_on_average() -> None:
    """Before a session nobody knows with which fraction of a pulse a move ends."""
    spec = replace(IMU, sample_rate=100.0)
    setup = Setup(spec, quick_plan('full_model', 30.0), THREE, SITE, terms=TERMS)
    found = forecast(setup, UNIT.model, 0.7)
    moving = [k for k, p in enumerate(found.parameters) if p.kind.value.symbol in {'P', 'T'}]
    assert len(moving) == 7
    # Another heading and another gravity are other fractions.
    other = replace(setup, site=replace(SITE, gravity=SITE.gravity * (1 + 1e-4)))
    again = forecast(other, UNIT.model, 2.6)
    assert again.std[moving] == pytest.approx(found.std[moving], rel=0.03)
    options = economical(stand(azimuth=0.7))
    blocks = simulate(setup.plan, THREE, spec, UNIT.model, SITE, options, 1)
    stated = fed(blocks, setup).finish().calibration
    # One session has its own: deviations of 1000 scatter by 3 to 8 %.
    assert stated.std[moving] == pytest.approx(found.std[moving], rel=0.25)
    off = (stated.values - UNIT.model.values(stated.parameters)) / stated.std
    assert np.abs(off).max() < TOO_FAR


def test_a_simulated_session_gives_back_all_66() -> None:
    # At 20 Hz joints turn further within a sample than moves may, which alone tell of the others.
    terms = tuple(t for t in TERMS if not t.moving)
    found = session('full_model', terms, 0.0, 1).calibration
    assert found.parameters == parameters_of(terms)
    off = (found.values - UNIT.model.values(found.parameters)) / found.std
    assert np.abs(off).max() < TOO_FAR
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.3


def turns() -> list[tuple[Floats, Floats, Floats]]:
    """Of each move: the body axis that it turns about, by what angle, and up before it."""
    steps = NINETEEN.steps(LEVEL)
    found = []
    for before, after in pairwise(steps):
        first, second = LEVEL.attitude(before.angles), LEVEL.attitude(after.angles)
        turned = np.flatnonzero(~np.isclose(before.angles, after.angles))
        assert len(turned) == 1
        axis = LEVEL.joint_axis(int(turned[0]), before.angles)
        found.append((axis, (after.angles - before.angles)[turned], first[2]))
        assert second @ axis == pytest.approx(first @ axis)
    return found


def test_every_axis_is_turned_while_level_in_both_senses_and_stands_up_and_down() -> None:
    assert len(NINETEEN.positions) == 19
    assert all(step.mode is Mode.POSITION for step in NINETEEN.steps(LEVEL))
    calls = []
    for axis, angle, up in turns():
        assert abs(axis @ up) < 1e-9
        assert abs(angle[0]) == pytest.approx(90 * DEG)
        body = int(np.argmax(np.abs(axis)))
        calls.append((body, float(np.sign(axis[body] * angle[0]))))
    counts = {which: calls.count(which) for which in set(calls)}
    assert set(counts) == {(k, s) for k in range(3) for s in (1.0, -1.0)}
    assert min(counts.values()) >= 2
    ups = {tuple(np.round(p.up) + 0.0) for p in NINETEEN.positions}
    assert len(ups) == 6


def free_of_the_frame() -> Floats:
    """K_g, then angles between axes, (12, 24): what the frame of the table has no part in.

    The frame turns gyros and accelerometers alike: free of it are the angles within each triad,
    E_ij + E_ji, and those of one triad against the other.
    """
    index = {p.name: k for k, p in enumerate(PARAMETERS)}
    pairs = ('xy', 'yz', 'zx')
    names = [{f'K_g{a}': 1.0} for a in 'xyz']
    names += [{f'E_{t}{i}{j}': 1.0, f'E_{t}{j}{i}': 1.0} for t in 'ga' for i, j in pairs]
    for i, j in pairs:
        of_gyros = {f'E_g{i}{j}': 0.5, f'E_g{j}{i}': -0.5}
        names.append({**of_gyros, f'E_a{i}{j}': -0.5, f'E_a{j}{i}': 0.5})
    rows = np.zeros((len(names), len(PARAMETERS)))
    for row, factors in zip(rows, names, strict=True):
        for name, factor in factors.items():
            row[index[name]] = factor
    return rows


def known_by(table: Table, *, moves: bool) -> Floats:
    """Deviations of `free_of_the_frame` that the nineteen positions allow, (12,)."""
    evidence = expected(Setup(IMU, NINETEEN, table, SITE), LINEAR)
    if not moves:
        evidence = replace(evidence, moves=())
    covariance = information(evidence, LINEAR).covariance[:24, :24]
    rows = free_of_the_frame()
    return np.sqrt(np.einsum('ri,ij,rj->r', rows, covariance, rows))


def test_moves_while_level_need_no_table_that_arrives() -> None:
    """Gravity says by how much a level axis was turned: an encoder need not."""
    exact, poor = (known_by(replace(LEVEL, positioning=p), moves=True) for p in (0.0, 60 * ARCSEC))
    # Random walk over some 3 s for each of five right angles at least.
    walk = IMU.gyro.random_walk * np.sqrt(3.2) / (np.pi / 2 * np.sqrt(5))
    assert poor[:3].max() < 1.2 * walk < 2 * PPM
    assert (poor[:3] < 1.1 * exact[:3]).all()
    assert poor[3:].max() < 1.0 * ARCSEC
    # Rests alone know neither: the Earth rate is the gyros' input, the table the only measure.
    alone = known_by(replace(LEVEL, positioning=60 * ARCSEC), moves=False)
    assert alone[:3].min() > 100 * PPM
    of_xy, of_z = alone[6], alone[7:9]
    assert min(alone[3:6].min(), of_xy, alone[9:].min()) > 10 * ARCSEC
    # But for how the accelerometers X and Y are to Z, which no arrival touches: the outer joint
    # stands while X and Y go up and down, and Z goes up and down about X or Y.
    assert of_z.max() < 0.1 * ARCSEC


def test_a_session_on_a_table_that_misses_by_a_minute_gives_them() -> None:
    found = session('nineteen_position', (), 60 * ARCSEC, 2).calibration
    assert found.parameters == PARAMETERS
    off, rows = found.values - LINEAR.vector(), free_of_the_frame()
    known = np.sqrt(np.einsum('ri,ij,rj->r', rows, found.covariance, rows))
    assert np.abs(rows @ off / known).max() < TOO_FAR
    assert known[:3].max() < 2 * PPM
    assert known[3:].max() < 1.5 * ARCSEC
    # The frame is the table's. A joint is off until it moves again: about Z, the axis of the inner
    # joint, the frame is a mean over the eight places where that stands, each off by 35 arcsec.
    stands = 1 + sum(b.angles[1] != a.angles[1] for a, b in pairwise(NINETEEN.steps(LEVEL)))
    about_z = np.isin([p.name for p in PARAMETERS], ('E_gxy', 'E_gyx', 'E_axy', 'E_ayx'))
    assert stands == 8
    assert found.std[about_z] == pytest.approx(60 * ARCSEC / np.sqrt(3 * stands), rel=0.01)
    # About the other axes the outer joint's errors go round with the inner one.
    others = np.array([p.name.startswith('E_') for p in PARAMETERS]) & ~about_z
    assert found.std[others].max() < 0.5 * ARCSEC
    assert np.abs(off / found.std).max() < TOO_FAR


def test_the_nineteen_are_observable_at_any_heading() -> None:
    check_observable(Equations(expected(Setup(IMU, NINETEEN, LEVEL, SITE), UNIT.model)))


def test_what_a_plan_tells_of_each_term_is_what_it_tells_when_asked() -> None:
    setup = Setup(IMU, NINETEEN, LEVEL, SITE)
    bare = forecast(setup, LINEAR)
    found = {one.term.name: one for one in forecast_terms(bare, setup, LINEAR)}
    assert [*found] == [t.name for t in TERMS]
    assert {n for n, one in found.items() if not one.determined} == {
        *ODD,
        'accel_cubic',
        'accel_cross',
    }
    asked = forecast(replace(setup, terms=(term('gyro_g2'),)), LINEAR)
    assert found['gyro_g2'].std.tolist() == asked.std[24:].tolist()
    (worst,) = {round(t, 2) for p, t in found['gyro_g2'].worsened if p.name == 'D_gx'}
    assert worst == round(asked.std[9] / bare.std[9], 2) > 1.1
    rest = forecast_terms(asked, replace(setup, terms=(term('gyro_g2'),)), LINEAR)
    assert 'gyro_g2' not in {one.term.name for one in rest}


def test_what_a_plan_tells_of_a_trend_is_what_its_session_states() -> None:
    plan, unit = at_one_rate(quick_plan('twelve_position', 30.0)), truth().model
    setup = Setup(paper_imu(), plan, THREE, SITE)
    evidence = gathered(fed(session_of(plan, stand(azimuth=0.3)), setup))
    bare, alone = forecast(setup, unit), estimate(evidence)
    found = forecast_changes(bare, setup, unit)
    names = [f'{one.changes[0].course.value}:{one.changes[0].name}' for one in found]
    kinds = ('D_gx', 'D_ax', 'K_g', 'K_a')
    wanted = [f'{course}:{kind}' for course in ('trend', 'warm_up') for kind in kinds]
    assert names == [*wanted, 'step:D_gx', 'step:D_ax']

    def std(of: Estimate) -> Floats:
        return np.sqrt(np.diag(of.covariance))

    for one in found[:4]:
        stated = estimate(evidence, changes=one.changes)
        own = [PARAMETERS.index(c.parameters[0]) for c in one.changes]
        # Beside its parameter's own: what the session shows of the noise, to 13 %, is in both.
        found_std = std(stated)[stated.equations.change_slice] / std(alone)[own]
        assert one.std / bare.std[own] == pytest.approx(found_std, rel=0.1)
        dearer = np.array([dict(one.worsened).get(p, 1.0) for p in PARAMETERS])
        times = std(stated)[:24] / std(alone)[:24]
        # What is dearer by less than a tenth is not named.
        assert dearer == pytest.approx(np.where(dearer > 1, times, 1.0), rel=0.1)
        assert (times[dearer == 1] < 1.2).all()
        assert (dearer > 1).any() or not one.changes[0].of_scale_factor


def test_what_a_plan_tells_of_the_temperature_is_what_its_session_states() -> None:
    plan, unit, rise = at_one_rate(quick_plan('twelve_position', 30.0)), truth().model, 6.0
    setup = Setup(paper_imu(), plan, THREE, SITE)
    ahead = forecast(setup, unit, rise=rise)
    options = stand(azimuth=0.3, warming=Warming(ramp=rise / duration(plan.steps(THREE), THREE)))
    evidence = gathered(fed(session_of(plan, options), setup))
    alone = np.sqrt(np.diag(estimate(evidence).covariance))
    found = forecast_changes(ahead, setup, unit)[-4:]
    assert [one.changes[0].name for one in found] == ['D_gx', 'D_ax', 'K_g', 'K_a']
    for one in found:
        assert one.changes[0].course is Course.THERMAL
        stated = estimate(evidence, changes=one.changes)
        own = [PARAMETERS.index(c.parameters[0]) for c in one.changes]
        std = np.sqrt(np.diag(stated.covariance))[stated.equations.change_slice]
        # Beside its parameter's own, as above; the stand's last dwell goes on, and warms further.
        assert one.std / ahead.std[own] == pytest.approx(std / alone[own], rel=0.1)
    # What rises twice as far tells twice as much.
    further = forecast_changes(forecast(setup, unit, rise=-2 * rise), setup, unit)[-4:]
    for one, twice in zip(found, further, strict=True):
        assert twice.std == pytest.approx(one.std / 2, rel=1e-6)


def test_coefficients_that_a_data_sheet_states_are_in_a_prediction_that_warms() -> None:
    spec = paper_imu()
    warm = replace(spec, gyro=replace(spec.gyro, scale_factor_temperature=10 * PPM))
    setup = Setup(warm, at_one_rate(quick_plan('twelve_position', 30.0)), THREE, SITE)
    cold, rising = (forecast(setup, truth().model, rise=rise).std for rise in (0.0, 10.0))
    # Each axis is turned in a third of the session of its own.
    assert (rising[:3] > 1.1 * cold[:3]).all()
    assert rising[12:] == pytest.approx(cold[12:], rel=1e-3)


def test_a_temperature_is_asked_for_in_kelvins_and_moves(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = ['plans', 'twelve_position', '--imu', 'fog_medium', '--verbose', '--temperature-rise']
    assert main([*asked, '6']) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (row,) = (line for line in lines if line and line[0] == 'thermal:D_g')
    assert row[2:] == ['deg/h', 'per', 'K']
    assert main([*asked, '0.1']) == 2
    assert 'found 0.1 K, expected 0.5 K or more' in capsys.readouterr().err
    assert main([*asked, '6', '--reach', 'D_gx=1deg/h']) == 2
    assert '--reach cannot be combined with --temperature-rise' in capsys.readouterr().err


def test_a_trend_that_a_plan_does_not_tell_has_no_deviation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: object) -> None:
        raise NotObservable('no')

    monkeypatch.setattr(each_term, 'with_changes', refused)
    words = ['plans', 'twelve_position', '--imu', 'fog_medium', '--gravity', '9.8']
    assert main([*words, '--verbose']) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (row,) = (line for line in lines if line and line[0] == 'trend:D_g')
    assert row[1] == '-'
    assert 'requires the same dwells and turns early and late' in ' '.join(row)


def test_the_command_says_what_a_plan_tells_of_each_term(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ['plans', 'nineteen_position', '--imu', 'fog_medium', '--table', 'two_axis_level']
    assert main([*words, '--gravity', '9.8', '--verbose']) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    rows = {row[0]: row[1:] for row in lines if row and row[0] in {t.name for t in TERMS}}
    assert len(rows) == len(TERMS)
    assert rows['accel_cubic'][0] == '-'
    assert ' '.join(rows['accel_cubic'][2:]).startswith(
        'requires static dwells with each axis some 45 degrees'
    )
    changing = {row[0]: row[1:] for row in lines if row and ':' in row[0]}
    assert changing['trend:D_g'][1:4] == ['deg/h', 'per', 'h']
    assert changing['warm_up:K_a'][1] == 'ppm'
    assert rows['accel_quadratic'][1] == 'ug/g^2'
    assert rows['accel_quadratic'][2:4] == ['D_a', '1.3']
