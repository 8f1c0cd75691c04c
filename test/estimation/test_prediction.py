"""What a plan is said to give beforehand, against what sessions gave and what a bound allows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bound import bound
from scipy.stats import chi2
from sessions import (
    LATITUDE,
    SITE,
    brisk,
    fed,
    gathered,
    paper_imu,
    session,
    stand,
    truth,
)

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.units import DEG, DEG_H, PPM
from imu_calib.estimation.closed_forms import skewed
from imu_calib.estimation.forecast import check_session, forecast, information
from imu_calib.estimation.optimise import candidates, log_information, optimise, reach
from imu_calib.estimation.predict import duration, expected
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.parameters import PARAMETER_NAMES
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan, RateTest, load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.repetition import Study, economical, repeat
from imu_calib.simulation.stand import SimulatedStand

SETTLE = 1.0
D_GX = PARAMETER_NAMES.index('D_gx')
K_AX = PARAMETER_NAMES.index('K_ax')


def setup(plan: Plan | str = 'twelve_position', method: str | None = None) -> Setup:
    plan = load_plan(plan) if isinstance(plan, str) else plan
    return Setup(paper_imu(), plan, load_table('three_axis'), SITE, method)


def test_the_best_is_the_bound_of_the_full_stream() -> None:
    plan = load_plan('twelve_position')
    found = forecast(setup(), truth().model, 0.5)
    at_rest = {p.id: p.dwell + SETTLE for p in plan.positions}
    floor = bound(plan, paper_imu(), truth().model, SITE, 0.5, at_rest, load_table('three_axis'))
    # What is seen of a rest varies by half a second; the rate beyond a turn tells 1.5 %. A level
    # accelerometer passes few pulses while its axis turns: a counter so slow tells less than the
    # white noise of the bound.
    slow = np.array([name.startswith(('E_a', 'D_a')) for name in PARAMETER_NAMES])
    assert found.best[~slow] == pytest.approx(floor[~slow], rel=0.02)
    assert np.all((found.best > floor * 0.98) & (found.best < floor * 1.08))


def test_velocities_of_moves_are_predicted_as_the_bound_has_them() -> None:
    """Accelerometers and gyros of so little noise that velocities tell beside rests of 3 s."""
    spec, plan = load_imu('fog_navigation'), brisk(3.0)
    gyro = replace(spec.gyro, scale_factor=1e-8, random_walk=1e-6)
    accel = replace(spec.accel, scale_factor=1e-6, random_walk=1e-5)
    case = Setup(replace(spec, gyro=gyro, accel=accel), plan, load_table('three_axis'), SITE)
    # Near their nominal scale: of accelerometers that are far off steps leave more than the noise.
    model = SensorModel.from_vector(truth().model.vector() / 100)
    ahead = expected(case, model, 0.5)
    plain = replace(ahead, moves=tuple(replace(m, velocity_steps=None) for m in ahead.moves))
    best, without = (
        np.sqrt(np.diag(information(one, model).covariance)[:24]) for one in (ahead, plain)
    )
    at_rest = {s.position: s.statistics.duration for s in ahead.segments}
    floor = bound(plan, case.imu, model, SITE, 0.5, at_rest, case.table)
    assert np.all(best > 0.97 * floor), best / floor
    # What misalignments show of arms along the axis of a turn, the bound takes for nothing: of K_a
    # and D_a together, which that axis shows.
    others = np.delete(np.arange(24), [12, 13, 14, 21, 22, 23])
    assert np.all(best[others] < 1.01 * floor[others]), best / floor
    assert np.all(best[21:] < 1.08 * floor[21:]), best / floor
    assert np.all(without[12:] > 1.005 * best[12:]), without / best
    assert np.all(without[[12, 13, 14]] > 1.04 * best[[12, 13, 14]])


@pytest.mark.parametrize('name', ['twelve_position', 'six_position'])
def test_time_is_that_of_a_stand(name: str) -> None:
    plan, table = load_plan(name), load_table('three_axis')
    course = SimulatedStand(plan, table, paper_imu(), truth().model, SITE, stand())
    first = course.visits[0]
    took = course.visits[-1].end - first.rest
    # The stand looks every 0.1 s whether the table has come to rest.
    steps = len(course.visits)
    assert 0 <= took - duration(plan.steps(table), table) <= 0.1 * steps


def test_stretches_last_as_long_as_the_segmentation_makes_them() -> None:
    from sessions import calibrate

    plan = brisk(15.0)
    found = calibrate(session(plan), plan).labelled
    foreseen = expected(setup(plan), truth().model)
    real = {s.position: s.statistics.duration for s in found.segments}
    # After the last step the stand records on.
    for segment in foreseen.segments[:-1]:
        assert segment.statistics.duration == pytest.approx(real[segment.position], abs=0.3)
    ahead = [(t.position, t.angle, t.seconds) for t in foreseen.turns]
    turned = [(t.position, t.angle, pytest.approx(t.seconds, rel=1e-4)) for t in found.turns]
    assert ahead == turned


@pytest.mark.parametrize(
    ('sample_rate', 'limit', 'led'), [(100.0, 300.0, 9), (30.0, 300.0, 2), (100.0, 150.0, 2)]
)
def test_moves_that_a_session_cannot_follow_are_not_promised(sample_rate, limit, led) -> None:
    """A table at 190 deg/s turns a sample at 30 Hz by 6 deg, and leaves a range of 150 deg/s."""
    plan, spec = brisk(12.0), replace(paper_imu(), sample_rate=sample_rate)
    spec = replace(spec, gyro=replace(spec.gyro, range=limit * DEG))
    case = replace(setup(plan), imu=spec)
    ahead = expected(case, truth().model)
    found = gathered(fed(session(plan, economical(stand()), spec=spec), case))
    assert len(ahead.used_moves) == len(found.used_moves) == led


@pytest.mark.repeats
def test_predicted_is_what_many_sessions_achieve() -> None:
    runs = 40
    case = Study(setup(brisk(15.0)), truth().model, economical(stand()), 0.5)
    ahead = forecast(case.setup, case.truth, 0.5)
    outcome = repeat(case, runs, seed=100)
    square = (outcome.errors / ahead.std) ** 2
    for row, name in zip(square.T, PARAMETER_NAMES, strict=True):
        low, high = chi2.ppf([1e-4, 1 - 1e-4], runs)
        # Dwells of 15 s are known to 0.3 s, what pulses leave on average over phases.
        assert 0.9 * low < row.sum() < 1.1 * high, name


def test_biases_that_wander_widen_what_rests_on_stretches() -> None:
    wild = replace(setup(), imu=load_imu('fog_medium'))
    calm, stormy = (forecast(wild, truth().model, 0.5, drifting=w) for w in (False, True))
    extra = np.sqrt(stormy.std**2 - calm.std**2)[D_GX]
    # 0.1 deg/h with 1000 s over 36 min: between the mean of independent stretches and all of it.
    assert 0.1 / np.sqrt(12) < extra / DEG_H < 0.1
    assert (stormy.best <= stormy.std * (1 + 1e-6)).all()


def test_the_method_without_north_says_so() -> None:
    found = forecast(setup('six_position', 'six_position'), truth().model)
    assert np.isnan(found.std).all()
    assert 'north' in found.refusal


def test_in_the_hand_the_closed_form_is_as_sharp_as_the_joint_estimate_but_for_gyro_biases() -> (
    None
):
    own = Setup(load_imu('mems_counts'), load_plan('six_position_by_hand'), None, SITE)
    names = ('joint', 'six_position')
    joint, closed = (forecast(replace(own, method=m), truth().model) for m in names)
    assert np.isfinite(joint.std).all()
    assert closed.best == pytest.approx(joint.std)
    # Of holds as long as each other the mean is the least squares of accelerometers.
    assert closed.std[K_AX:] == pytest.approx(joint.std[K_AX:], rel=1e-3)
    # Gyros with the axis vertical do not feel where north is.
    assert (joint.std[D_GX : D_GX + 3] < 0.99 * closed.std[D_GX : D_GX + 3]).all()


def test_an_imu_without_noise_figures_is_refused() -> None:
    silent = replace(setup(), imu=load_imu('si'))
    with pytest.raises(InputError, match='angle_random_walk'):
        forecast(silent, truth().model)


def test_half_the_deviation_takes_four_times_the_dwell() -> None:
    # The joint estimate would rest on the turns too, which dwells do not lengthen.
    case = setup('twelve_position', 'twelve_position')
    now = forecast(case, truth().model, 0.5).std[D_GX]
    found = reach(case, truth().model, {'D_gx': now / 2}, 0.5)
    dwells = np.array([p.dwell for p in found.plan.positions])
    # The gyros of the paper are ruled by their walk over such times.
    assert dwells == pytest.approx(480.0, rel=0.05)
    assert 0.99 < found.forecast.std[D_GX] / (now / 2) <= 1.0


def test_only_the_positions_that_matter_dwell() -> None:
    plan = load_plan('twelve_position')
    found = reach(setup(method='joint'), truth().model, {'K_ax': 1 * PPM}, 0.5)
    level = [
        p.dwell
        for p, was in zip(found.plan.positions, plan.positions, strict=True)
        if abs(was.up[0]) < 0.5
    ]
    assert found.forecast.std[K_AX] <= 1 * PPM
    assert max(level) < 0.2 * found.plan.position('1').dwell


def test_what_dwells_cannot_reach_is_refused_by_name() -> None:
    case = setup(method='joint')
    # What limits it is the table, at any sample rate; dwells are tried up to hours.
    slow = replace(case, imu=replace(case.imu, sample_rate=10.0))
    with pytest.raises(NotObservable, match='K_gx'):
        reach(slow, truth().model, {'K_gx': 1 * PPM, 'D_gx': 1 * DEG_H}, 0.5)


def test_a_skewed_gyro_is_predicted_as_sessions_give_it() -> None:
    plan, spec = load_plan('skewed'), load_imu('fog_skewed')
    test = RateTest((45 * DEG, -45 * DEG, 90 * DEG, -90 * DEG), 3)
    plan = replace(plan, positions=tuple(replace(p, rate_test=test) for p in plan.positions))
    unit = Calibration.load(named_file('truths', 'fog_skewed')).model
    case = Setup(spec, plan, load_table('three_axis'), SITE)
    found = forecast(case, unit)
    names = [p.name for p in found.parameters]
    known = np.isfinite(found.std)
    assert [names[k] for k in np.flatnonzero(known)[-4:]] == ['R_gsx', 'R_gsy', 'R_gsz', 'D_gs']
    assert known.sum() == 16
    # Two turns at each of two rates and senses about three axes see the walk for 216 s.
    assert found.best[-1] == pytest.approx(0.02 / 60 * DEG / np.sqrt(216), rel=0.05)
    assert (found.std[known] > found.best[known]).all()
    outcome = repeat(Study(case, unit, economical(stand())), 12, jobs=1)
    square = (outcome.errors[:, known] / found.std[known]) ** 2
    # Sixteen numbers, four each of a channel, in twelve runs.
    low, high = chi2.ppf([1e-4, 1 - 1e-4], square.size)
    assert low < square.sum() < high


def test_weights_that_are_estimates_widen_the_prediction_for_a_skewed_gyro(monkeypatch) -> None:
    unit = Calibration.load(named_file('truths', 'fog_skewed')).model
    case = Setup(load_imu('fog_skewed'), load_plan('skewed'), load_table('three_axis'), SITE)
    real = skewed.variance_by_weights
    monkeypatch.setattr(skewed, 'variance_by_weights', lambda evidence: 0 * real(evidence))
    without = forecast(case, unit).std ** 2
    monkeypatch.setattr(skewed, 'variance_by_weights', lambda evidence: 0 * real(evidence) + 4e-9)
    added = forecast(case, unit).std ** 2 - without
    assert added[np.isfinite(added)] == pytest.approx(np.full(16, 4e-9), rel=1e-6)


@pytest.mark.repeats
def test_weights_that_are_estimates_cost_what_is_predicted() -> None:
    spec, unit = load_imu('fog_skewed'), Calibration.load(named_file('truths', 'fog_skewed')).model
    case = replace(setup('skewed'), imu=spec)
    found, session_ = forecast(case, unit), expected(case, unit)
    rng, wrong = np.random.default_rng(0), []
    for _ in range(600):
        turns = []
        for turn in session_.turns:
            mean = np.append(turn.statistics.mean[:3], turn.skewed.mean[0])
            noise = spec.gyro.random_walk / np.sqrt(turn.statistics.duration / len(turn.each))
            each = mean + noise * rng.standard_normal((len(turn.each), 4))
            seen = [*each.mean(axis=0)[:3], 0, 0, 0], [each[:, 3].mean(), 0, 0, 0, 0, 0]
            three, fourth = (
                replace(s, mean=np.array(m))
                for s, m in zip((turn.statistics, turn.skewed), seen, strict=True)
            )
            turns.append(replace(turn, statistics=three, skewed=fourth, each=each))
        solved = skewed.solve_skewed(replace(session_, turns=tuple(turns)))
        wrong.append(solved.model.values(found.parameters) - unit.values(found.parameters))
    known = np.isfinite(found.std)
    square = np.square(wrong)[:, known].mean(axis=0)
    # Sixteen numbers from four independent channels in 600 runs: 2 % in their mean.
    assert np.sqrt(np.mean(square / found.std[known] ** 2)) == pytest.approx(1.0, abs=0.03)
    assert np.sqrt(np.mean(square / found.best[known] ** 2)) > 1.03


def test_a_skewed_bias_that_wanders_adds_to_its_own_deviation_alone() -> None:
    case = replace(setup('skewed'), imu=load_imu('fog_skewed'))
    quiet = replace(case.imu, gyro=replace(case.imu.gyro, bias_instability=0.0))
    unit = truth().model
    still = forecast(case, unit)
    moved = forecast(replace(case, imu=quiet), unit, drifting=True)
    names = [p.name for p in still.parameters]
    added = moved.std[names.index('D_gs')] ** 2 - still.std[names.index('D_gs')] ** 2
    # Well over a dozen correlation times would leave nothing, less than one all of it.
    assert 0.2 < np.sqrt(added) / (0.02 * DEG_H) < 1
    assert moved.std[names.index('D_gx')] == pytest.approx(still.std[names.index('D_gx')])


def test_what_no_session_of_a_plan_could_give_is_refused_before_it_begins() -> None:
    with pytest.raises(NotObservable, match='need north'):
        check_session(setup('six_position', 'six_position'))
    with pytest.raises(NotObservable, match='No position with X north'):
        check_session(setup('six_position', 'off_axis_four'))
    with pytest.raises(InputError, match=r'outer, inner.*Only three joints'):
        check_session(replace(setup(), table=load_table('two_axis')))
    check_session(setup())
    check_session(replace(setup('skewed'), imu=load_imu('fog_skewed')))


def test_turns_beyond_the_range_of_the_gyros_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imu = tmp_path / 'slow.yaml'
    unit = named_file('imus', 'fog_medium').read_text()
    imu.write_text(unit.replace('range: 300 deg/s', 'range: 40 deg/s'))
    plan = tmp_path / 'fast.yaml'
    said = named_file('plans', 'twelve_position').read_text()
    plan.write_text(said.replace('60 deg/s, -60 deg/s', '39.9 deg/s, -45 deg/s'))
    with pytest.raises(InputError, match=r'position 1: turns at -45 deg/s .* range is 40 deg/s'):
        check_session(replace(setup(), imu=load_imu(imu), plan=load_plan(plan)))
    words = 'turns at -45 deg/s saturate the gyros'
    options = [str(plan), '--imu', str(imu)]
    assert main(['plans', *options]) == 2
    assert words in capsys.readouterr().err
    assert main(['stand', *options, '-o', str(tmp_path / 'stand')]) == 2
    assert words in capsys.readouterr().err and not (tmp_path / 'stand').exists()


@pytest.mark.parametrize(
    ('arguments', 'code', 'words'),
    [
        (['six_position', '--method', 'six_position'], 1, ['need north', 'three_axis does not']),
        (['six_position', '--method', 'off_axis_four'], 1, ['K_gx', 'D_gz']),
        (['twelve_position', '--table', 'two_axis'], 2, ['position 1', 'outer, inner']),
        (['skewed', '--imu', 'fog_skewed'], 2, ['--truth', 'skewed gyro']),
    ],
)
def test_a_stand_that_cannot_be_solved_does_not_start(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    words: list[str],
) -> None:
    folder = tmp_path / 'stand'
    assert main(['stand', *arguments, '-o', str(folder)]) == code
    errors = capsys.readouterr().err
    assert all(word in errors for word in words), errors
    assert not folder.exists()


def test_dwells_of_a_plan_without_any_reach_nothing() -> None:
    case = replace(setup('skewed'), imu=load_imu('fog_skewed'))
    with pytest.raises(NotObservable, match='no dwells'):
        reach(case, truth().model, {'D_gx': 1 * DEG_H})


def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    latitude = str(LATITUDE / DEG)
    arguments = ['plans', 'twelve_position', '--imu', 'fog_medium', '--latitude', latitude]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert '0.079' in shown  # D_gx, deg/h: 0.05 deg/sqrt(h) over 12 stretches of two minutes
    assert '35.8 min' in shown
    assert main([*arguments, '--method', 'joint', '--reach', 'D_gx=0.1 deg/h']) == 0
    shown = capsys.readouterr().out
    assert 'Dwell in s at each position (that of the plan): 1: ' in shown
    assert len(shown.splitlines()) <= 40
    assert main([*arguments, '--reach', 'D_gx=1 ppm']) == 2
    assert main([*arguments, '--reach', 'Q_gx=1 ppm']) == 2
    assert main(['plans', '--reach', 'D_gx=0.1 deg/h']) == 2


@pytest.mark.parametrize(
    'option', [['--method', 'joint'], ['--bias-instability'], ['--azimuth', '0']]
)
@pytest.mark.parametrize('plan', [[], ['six_position']])
def test_what_counts_in_a_prediction_is_refused_without_one(
    capsys: pytest.CaptureFixture[str], option: list[str], plan: list[str]
) -> None:
    assert main(['plans', *plan]) == 0
    capsys.readouterr()
    assert main(['plans', *plan, *option]) == 2
    printed = capsys.readouterr()
    assert f'{option[0]} is for the prediction of a plan' in printed.err
    assert not printed.out


def test_the_optimised_plan_gains_what_its_page_says() -> None:
    table = load_table('three_axis')
    plain, best = load_plan('twelve_position'), load_plan('optimised_twelve')
    # It takes no longer, and is made for the estimate that weighs all.
    assert duration(best.steps(table), table) <= duration(plain.steps(table), table)
    assert best.method == 'joint'
    before, after = (forecast(setup(p, 'joint'), truth().model, 0.5).std for p in (plain, best))
    ratio = after / before
    # Scale factors and misalignments of the gyros, which moves tell in either plan.
    assert ratio[:9].max() < 0.34
    assert ratio[9:12].max() < 1.0
    # Turns at one rate tell a lever arm from gravity less well than turns at three.
    assert ratio[12:].max() < 1.13


def test_no_exchange_of_one_attitude_gains() -> None:
    case = setup(method='joint')
    found = optimise(case, truth().model, 1500.0, 60 * DEG, sizes=(6,), turns=(4,))
    assert found.seconds <= 1500.0
    assert len(found.plan.positions) == 6
    best = log_information(replace(case, plan=found.plan), truth().model)
    assert best == pytest.approx(found.information)
    for matrix in candidates(case.table)[::9]:
        other = list(found.plan.positions)
        place = next(k for k, p in enumerate(other) if p.rate_test is None)
        other[place] = replace(other[place], attitude=matrix)
        worse = replace(found.plan, positions=tuple(other))
        value = log_information(replace(case, plan=worse), truth().model)
        # Headings move the determinant by the Earth rate's share in the gyros' responses.
        assert value < best + 0.01, matrix


def test_a_plan_is_optimised_for_a_time_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in {'sizes': (6,), 'turns': (4,)}.items():
        monkeypatch.setitem(optimise.__kwdefaults__, name, value)
    # A name that YAML would take for something else.
    written = tmp_path / 'no.yaml'
    ask = ['plans', '--imu', 'fog_medium', '-o', str(written)]
    assert main([*ask, '--optimise', '20', '--rate', '30']) == 0
    found, table = load_plan(written), load_table('three_axis')
    assert found.name == 'no'
    assert 19 * 60 < duration(found.steps(table), table) <= 20 * 60
    rates = [r for p in found.positions if p.rate_test for r in p.rate_test.rates]
    assert rates == pytest.approx([30 * DEG, -30 * DEG] * 3)
    assert 'K_gx' in capsys.readouterr().out
    by_api = imu_calib.optimise(load_imu('fog_medium'), 20, rate=30, output=tmp_path / 'yes.yaml')
    assert by_api.text('no') == written.read_text()
    assert load_plan(tmp_path / 'yes.yaml').name == 'yes'
    assert by_api.seconds == duration(by_api.plan.steps(table), table)
    with pytest.raises(InputError, match=r'mine: expected a file that ends in \.yaml'):
        imu_calib.optimise('fog_medium', 20, output='mine')
    with pytest.raises(InputError, match='too short'):
        imu_calib.optimise('fog_medium', 2)
    for wrong, words in (
        (['--optimise', '2'], 'too short'),
        (['--optimise', '20', '--rate', '900'], 'slowest joint'),
        (['--rate', '30'], 'for --optimise'),
        (['--optimise', 'nan'], 'expected more than 0'),
        (['--optimise', '1e9'], 'no more than 1440'),
        (['--optimise', '20', '--rate', '0'], 'expected more than 0'),
        (['--optimise', '20', '-o', 'mine'], 'ends in .yaml'),
        (['--optimise', '20', '--table', 'two_axis'], 'nineteen_position'),
    ):
        assert main([*ask, *wrong]) == 2
        assert words in capsys.readouterr().err


def test_a_table_of_two_axes_gives_fewer_candidates() -> None:
    three, two = (candidates(load_table(f'{n}_axis')) for n in ('three', 'two'))
    assert len(three) > len(two) > 0
    for choice in two:
        load_table('two_axis').angles(choice)


@pytest.mark.parametrize(
    ('plan', 'method', 'closed', 'with_g'),
    [
        ('twelve_position', 'joint_33', 'twelve_position', 'joint_33'),
        ('twelve_position_33', 'joint', 'n_positions', 'n_positions'),
    ],
)
def test_a_joint_estimate_of_24_stands_beside_a_closed_form_of_33_and_the_reverse(
    capsys: pytest.CaptureFixture[str], plan: str, method: str, closed: str, with_g: str
) -> None:
    words = ['--imu', 'fog_medium', '--method', method, '--azimuth', '0', '--gravity', '9.8']
    assert main(['plans', plan, *words]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    heading = next(row for row in rows if row[:1] == ['parameter'])
    assert heading[1:3] == [closed, method]
    place = load_table('three_axis')
    case = Setup(
        load_imu('fog_medium'),
        load_plan(plan),
        replace(place, azimuth=0.0),
        Site.at(34.65 * DEG, gravity=9.8),
    )
    found = {m: forecast(replace(case, method=m), truth().model) for m in (closed, method)}
    # Those after the 24th stand to the right of the others.
    shown = {
        row[k]: row[k + 1 : k + 3]
        for row in rows
        for k in range(len(row))
        if row[k][:2] in {'K_', 'E_', 'D_', 'G_'} and len(row) > k + 3
    }
    assert len(shown) == 33
    for m, k in ((closed, 0), (method, 1)):
        std = dict(zip([p.name for p in found[m].parameters], found[m].std, strict=True))
        assert float(shown['D_gx'][k]) == pytest.approx(std['D_gx'] / DEG_H, rel=0.05)
        assert (shown['G_gzz'][k] == '-') == (m != with_g)


def test_what_a_plan_leaves_open_is_a_sentence_and_an_exit_code(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(['plans', 'static_six', '--method', 'joint', '--imu', 'fog_medium']) == 1
    printed = capsys.readouterr()
    assert ' '.join(printed.err.split()) == (
        'imu-calib plans: Plan static_six, method joint: No position has X vertical: K_ax, E_ayx, '
        'E_azx not observable.'
    )
    assert 'D_gz' in printed.out
    assert main(['plans', 'six_position', '--method', 'six_position', '--imu', 'fog_medium']) == 1
    assert 'need north' in capsys.readouterr().err


def test_a_prediction_says_what_it_takes_gravity_to_be_known_to(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ['plans', 'twelve_position', '--imu', 'fog_medium']
    for options, sentence in (
        ([], 'K_a includes 160 ppm of gravity'),
        (['--height', '0'], 'K_a includes 30.6 ppm of gravity'),
        (
            ['--gravity', '9.81', '--gravity-std', '2e-5'],
            'K_a includes 2.04 ppm of gravity: as --gravity-std states',
        ),
    ):
        assert main([*words, *options]) == 0
        assert sentence in ' '.join(capsys.readouterr().out.split())
    assert main([*words, '--gravity', '9.8']) == 0
    assert 'ppm of gravity' not in capsys.readouterr().out
