"""The uncertainty budget: what it adds up to, and each source against what it truly does."""

import io
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from evidence import ACCEL_WALK, CLOCK, GYRO_WALK, SECOND, SITE, evidence_of
from mems_by_hand import result as by_hand
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter
from sessions import LATITUDE, at_one_rate, brief_plan, calibrate, quick_plan, session, stand, truth

from imu_calib.api.session import site_of
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.budget import Budget, BudgetLine, ErrorSource, Share, effective_freedom, total
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import Floats, Units
from imu_calib.common.units import ARCSEC, DEG, DEG_H, MICRO_G, PPM
from imu_calib.estimation.equations import GIVEN_AZIMUTH
from imu_calib.estimation.estimate import estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.methods import method
from imu_calib.estimation.session_model import Nuisance
from imu_calib.estimation.solution import Solution
from imu_calib.model.earth import Site
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel
from imu_calib.reports.budget import _share_tables, budget_section, budget_sources, budget_tables
from imu_calib.session.keywords import Stated
from imu_calib.session.metadata import describe, described_site
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import LEVELLED, clock_share

NAMES = [p.name for p in PARAMETERS]
POSITIONING, TABLE_CLOCK = 2 * ARCSEC, 5 * PPM
PLACE = Site.at(LATITUDE, 520.0)


def of(*names: str) -> list[int]:
    return [NAMES.index(name) for name in names]


K_G, D_G = of('K_gx', 'K_gy', 'K_gz'), of('D_gx', 'D_gy', 'D_gz')
K_A, D_A = of('K_ax', 'K_ay', 'K_az'), of('D_ax', 'D_ay', 'D_az')


@cache
def made(plan_name: str, method_name: str) -> Calibration:
    """A short session at a table that states all that a table can state."""
    plan = at_one_rate(quick_plan(plan_name, 12.0))
    table = replace(
        load_table('three_axis'), positioning=POSITIONING, clock=TABLE_CLOCK, azimuth=0.0
    )
    blocks = session(plan, stand(positioning_error=np.sqrt(3) * POSITIONING), 1, table=table)
    return calibrate(blocks, plan, table=table, site=PLACE, method=method_name).calibration


METHODS = [
    ('twelve_position', 'joint'),
    ('twelve_position_33', 'joint_33'),
    ('six_position', 'six_position'),
]
WHATEVER_THE_METHOD = {
    ErrorSource.NOISE,
    ErrorSource.QUANTISATION,
    ErrorSource.POSITIONING_STATED,
    ErrorSource.ENCODER_RATE,
    ErrorSource.ENCODER_NOISE,
    ErrorSource.CLOCK,
    ErrorSource.TABLE_CLOCK,
    ErrorSource.GRAVITY,
    ErrorSource.LATITUDE,
    # What cuts within samples leave of the level Earth rate in a turn.
    ErrorSource.NORTH,
}


@pytest.mark.parametrize(('plan', 'name'), METHODS)
def test_the_sources_in_the_file_add_up_to_the_covariance_in_the_file(plan, name):
    document = yaml.safe_load(made(plan, name).to_yaml())
    written = document['uncertainty_budget']
    sources = {entry['source']: entry for entry in written['sources']}
    joint = {ErrorSource.AZIMUTH, ErrorSource.TILT, ErrorSource.ARM, ErrorSource.DELAY}
    priors = joint if name.startswith('joint') else set()
    assert set(sources) == {s.value for s in WHATEVER_THE_METHOD | priors}
    variances = [np.square(entry['standard_uncertainty']) for entry in sources.values()]
    stated = np.diag(document['covariance']['matrix'])
    assert np.sum(variances, axis=0) == pytest.approx(stated, rel=1e-9)
    assert written['parameters'] == document['covariance']['parameters']
    assert written['units'][0] == '1'
    assert written['units'][9] == 'rad/s'
    assert written['units'][23] == 'm/s^2'
    assert np.square(written['standard_uncertainty']) == pytest.approx(stated, rel=1e-9)
    factor, std = written['coverage_factor'], written['standard_uncertainty']
    assert written['expanded_uncertainty'] == pytest.approx(np.multiply(factor, std))
    assert sources['gravity']['evaluation'] == 'B'
    assert sources['sensor_noise']['evaluation'] == 'A'


@pytest.mark.parametrize(('plan', 'name'), METHODS)
def test_a_budget_is_read_as_it_was_written(plan, name):
    text = made(plan, name).to_yaml()
    assert Calibration.from_yaml(text, 'c.yaml').to_yaml() == text


@pytest.mark.parametrize('heading', [0.0, np.pi / 2])
@pytest.mark.parametrize(('plan', 'name'), [*METHODS, ('six_position', 'joint')])
def test_the_shares_are_covariances_that_add_up_to_the_covariance(plan, name, heading):
    # Six positions see one of the tilts and not the other, which one by their heading.
    found = method(name)(loaded(plan, heading))
    scale = np.outer(found.std, found.std)
    assert total(found.shares) / scale == pytest.approx(found.covariance / scale, abs=1e-9)
    for share in found.shares.values():
        assert np.linalg.eigvalsh(share.covariance / scale).min() > -1e-9


def loaded(plan: str = 'twelve_position', heading: float = 0.0) -> Evidence:
    """An ideal session, its outputs noisy, of which everything is in doubt, north known."""
    evidence = evidence_of(
        plan, truth().model, azimuth=heading, known=True, noise=np.random.default_rng(5)
    )
    quantum = np.repeat([(1e-8) ** 2, (1e-6) ** 2], 3)
    segments = tuple(
        replace(
            s,
            attitude_error=ARCSEC,
            statistics=replace(s.statistics, quantisation_variance=quantum),
        )
        for s in evidence.segments
    )
    turns = tuple(replace(t, rate_error=2 * PPM, up_error=ARCSEC) for t in evidence.turns)
    return replace(
        evidence,
        segments=segments,
        turns=turns,
        clock=replace(CLOCK, rate_std=PPM),
        site=replace(SITE, latitude_std=0.01 * DEG),
        positioning=POSITIONING,
        walk_freedom=np.full(6, 30.0),
    )


def std_of(solution: Solution, source: ErrorSource) -> Floats:
    return np.sqrt(np.diag(solution.shares[source].covariance))


SIX = loaded('six_position')
RESPONSES = 1 + truth().model.vector()
DWELL = SIX.segments[0].statistics.duration


@cache
def six_positions() -> Solution:
    return method('six_position')(SIX)


def test_six_positions_err_by_what_their_means_and_differences_make_of_each_source():
    # Cao 2022, eqs. (15) to (18): K_a is half a difference over g, D_a the mean of all six.
    found = six_positions()
    walk = ACCEL_WALK / np.sqrt(DWELL)
    assert std_of(found, ErrorSource.NOISE)[D_A] == pytest.approx(walk / np.sqrt(6), rel=1e-6)
    half = walk / np.sqrt(2) / SITE.gravity
    assert std_of(found, ErrorSource.NOISE)[K_A] == pytest.approx(half, rel=1e-6)
    assert std_of(found, ErrorSource.QUANTISATION)[D_A] == pytest.approx(
        1e-6 / np.sqrt(6), rel=1e-6
    )
    # A level channel reads g times the error of the attitude: four positions of the six.
    reads = SITE.gravity * ARCSEC * np.sqrt(4) / 6
    assert std_of(found, ErrorSource.ENCODER_NOISE)[D_A] == pytest.approx(reads, rel=1e-6)
    gyro_bias = GYRO_WALK / np.sqrt(6 * DWELL)
    # What the Earth rate that is taken off owes to the responses comes on top: a percent.
    assert std_of(found, ErrorSource.NOISE)[D_G] == pytest.approx(gyro_bias, rel=0.01)


def test_six_positions_err_by_the_arrivals_in_the_directions_that_these_have():
    # Up and down each have an arrival of their own; turns keep that of their axis.
    found = std_of(six_positions(), ErrorSource.POSITIONING_STATED) / POSITIONING
    assert found[of('E_gxy', 'E_gyx', 'E_gzx')] == pytest.approx(1.0, rel=0.01)
    across = {'E_axy': 'K_ax', 'E_ayx': 'K_ay', 'E_azx': 'K_az'}
    for name, own in across.items():
        response = RESPONSES[of(own)[0]]
        assert found[of(name)[0]] == pytest.approx(response / np.sqrt(2), rel=0.01)
        bias = SITE.gravity * response * np.sqrt(4) / 6
        assert found[of(f'D_a{own[-1]}')[0]] == pytest.approx(bias, rel=0.01)


def test_an_error_of_the_encoders_rate_goes_into_the_slope_on_the_rates():
    rates = np.array([t.rate() for t in SIX.turns if abs(t.up[0]) > 0.5])
    centred = rates - rates.mean()
    # Each turn errs by its share of its rate, weighted as a line's slope weighs it.
    slope = np.linalg.norm(centred * rates * 2 * PPM) / (centred @ centred)
    share = six_positions().shares[ErrorSource.ENCODER_RATE]
    found = np.sqrt(np.diag(share.covariance))
    assert found[K_G[0]] == pytest.approx(RESPONSES[K_G[0]] * slope, rel=1e-4)
    # Fourteen for each turn: the fast ones count most, all together as Welch and Satterthwaite say.
    each = (centred * rates) ** 2
    expected = 14 * each.sum() ** 2 / (each**2).sum()
    assert share.freedom[K_G[0]] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(('plan', 'name'), METHODS)
def test_the_rate_between_the_clocks_goes_into_every_scale_factor_of_pulses(plan, name):
    evidence = loaded(plan)
    found = std_of(method(name)(evidence), ErrorSource.CLOCK)
    std = evidence.clock_rate()[1]
    assert found[K_G] == pytest.approx(RESPONSES[K_G] * std, rel=0.01)
    # The interval that divides the pulses of accelerometers is the table's, through the stamps'.
    assert found[K_A] == pytest.approx(RESPONSES[K_A] * std, rel=0.01)
    # Counts and SI values are rates by themselves, against rates by the table's clock.
    rates = std_of(method(name)(replace(evidence, units=Units.COUNTS)), ErrorSource.CLOCK)
    assert (rates[[*K_G, *K_A]] < 1e-3 * std).all()


def test_the_degrees_of_freedom_are_those_of_the_estimates_behind_them():
    shares = six_positions().shares
    # One walk for each channel: of each 30.
    assert shares[ErrorSource.NOISE].freedom[K_A] == pytest.approx(30.0)
    # Thirty motions, a rate and an offset.
    assert shares[ErrorSource.CLOCK].freedom[K_G] == pytest.approx(28.0)
    assert np.isinf(shares[ErrorSource.POSITIONING_STATED].freedom[0])


def perfect(plan: str, model: SensorModel, **known: float) -> Evidence:
    """Outputs without noise, of which some is stated: what is wrong is what was put in."""
    return replace(evidence_of(plan, model, **known), azimuth=0.0)


@pytest.mark.parametrize(
    ('plan', 'name'),
    [
        ('six_position', 'six_position'),
        ('six_position', 'joint'),
        ('twelve_position_33', 'n_positions'),
        ('twelve_position', 'twelve_position'),
    ],
)
def test_a_wrong_latitude_does_what_the_budget_says_of_it(plan, name):
    std = 0.01 * DEG
    right = replace(perfect(plan, truth().model), site=replace(SITE, latitude_std=std))
    found = method(name)(right)
    wrong = replace(SITE, latitude=SITE.latitude + std, latitude_std=std)
    moved = method(name)(replace(right, site=wrong)).model.vector() - found.model.vector()
    of_latitude = std_of(found, ErrorSource.LATITUDE)[:24]
    # To first order; rounding in sums of gravity is some 1e-14.
    assert of_latitude == pytest.approx(np.abs(moved), rel=0.02, abs=1e-13)


def test_a_table_that_stands_off_its_azimuth_does_what_the_budget_says_of_it():
    right = perfect('six_position', truth().model)
    found = method('joint')(right)
    off = perfect('six_position', truth().model, azimuth=GIVEN_AZIMUTH)
    moved = method('joint')(off).model.vector() - found.model.vector()
    assert std_of(found, ErrorSource.AZIMUTH)[D_G] == pytest.approx(np.abs(moved[D_G]), rel=0.02)
    # North of the Earth rate, one arc minute wide, in the mean of the headings.
    assert std_of(found, ErrorSource.AZIMUTH)[D_G].max() < SITE.north_rate * GIVEN_AZIMUTH


def test_a_tilted_table_does_what_the_budget_says_of_it():
    evidence = perfect('six_position', truth().model)
    # Turns that no table times have no accelerometers, which would see both tilts.
    untimed = tuple(replace(turn, seconds=None) for turn in evidence.turns)
    evidence = replace(evidence, turns=untimed)
    estimated = estimate(evidence)
    equations, state = estimated.equations, estimated.state.copy()
    square = np.zeros(24)
    for which in (Nuisance.TILT_X, Nuisance.TILT_Y):
        tilted = state.copy()
        tilted[equations.sensors + which] += LEVELLED
        outputs = equations.predict(tilted)
        at_rest = outputs[equations.layout.dwell]
        segments = tuple(
            replace(s, statistics=replace(s.statistics, mean=row))
            for s, row in zip(evidence.segments, at_rest, strict=True)
        )
        moved = estimate(replace(evidence, segments=segments)).state[:24] - state[:24]
        square += moved**2
    found = std_of(method('joint')(evidence), ErrorSource.TILT)
    # Six rests do not see one of the tilts: it is in how channel z answers to X and Y.
    assert found[of('E_azx')[0]] == pytest.approx(RESPONSES[K_A[2]] * LEVELLED, rel=0.01)
    assert found**2 == pytest.approx(square, rel=0.05, abs=(1e-3 * LEVELLED) ** 2)


INSTABILITY = np.repeat([0.1 * DEG_H, 1 * MICRO_G], 3)


def test_biases_that_drift_as_stated_do_what_the_budget_says_of_them():
    # Processes second by second, in plain sums, through the weights of the estimate.
    evidence = evidence_of(noise=np.random.default_rng(1))
    evidence = replace(evidence, instability=INSTABILITY)
    found = estimate(evidence)
    factor = np.linalg.cholesky(found.equations.covariance(found.state))
    m = len(found.equations.outputs)
    weights = np.linalg.solve(factor.T, found.gain[:24, :m].T).T
    parts = [*evidence.segments, *evidence.turns]
    starts = [p.start // SECOND for p in parts]
    lengths = [max(1, round(p.statistics.duration)) for p in parts]
    seconds, runs = max(starts) + max(lengths), 1500
    decay = np.exp(-1 / 1000.0)
    rng = np.random.default_rng(2)
    errors = np.empty((runs, 24))
    for run in range(runs):
        drive = rng.standard_normal((seconds, 6)) * np.sqrt(1 - decay**2)
        drive[0] /= np.sqrt(1 - decay**2)
        drift = np.vstack([np.zeros(6), np.cumsum(lfilter([1], [1, -decay], drive, axis=0), 0)])
        means = [(drift[a + n] - drift[a]) / n for a, n in zip(starts, lengths, strict=True)]
        outputs = [mean * INSTABILITY for mean in means[: len(evidence.segments)]]
        turned = [mean * INSTABILITY for mean in means[len(evidence.segments) :]]
        outputs += [mean[:3] for mean in turned] + [mean[3:] for mean in turned]
        errors[run] = weights @ np.concatenate(outputs)
    spread = np.sqrt(np.mean(errors**2, axis=0))
    shares, sources = found.shares(), (ErrorSource.BIAS_STATED, ErrorSource.BIAS_CALM)
    stated = np.sqrt(sum(np.diag(shares[s].covariance) for s in sources if s in shares))
    # What the session says against the data sheet takes a little off.
    share = np.repeat(found.scatter.bias_drift[[0, 3]] / INSTABILITY[[0, 3]], 12)
    assert (share > 0.8).all()
    spread *= share
    # A spread of 1500 runs errs by 2 %; eight nodes stand for a stretch: 5 sigma and a percent.
    assert stated[D_G + D_A] == pytest.approx(spread[D_G + D_A], rel=0.1)
    assert stated[K_G] == pytest.approx(spread[K_G], rel=0.12)


def test_a_drift_that_the_session_shows_smaller_is_not_as_stated():
    # Biases that do not drift: of the gyros as noise hides it, of accelerometers far below.
    instability = np.repeat([1e-3 * DEG_H, 200 * MICRO_G], 3)
    evidence = replace(evidence_of(noise=np.random.default_rng(1)), instability=instability)
    lines = {x.source: x for x in Budget.from_shares(method('joint')(evidence).shares).lines}
    stated, calm = lines[ErrorSource.BIAS_STATED], lines[ErrorSource.BIAS_CALM]
    assert (stated.std[D_G] > 1e3 * calm.std[D_G]).all()
    assert (calm.std[D_A] > 1e3 * stated.std[D_A]).all()
    assert (stated.source.evaluation, calm.source.evaluation) == ('B', 'A')


def test_what_the_session_shows_beyond_what_is_stated_has_lines_of_its_own():
    rng = np.random.default_rng(4)
    evidence = replace(loaded(), positioning=0.0)
    ups = [s.attitude[2] for s in evidence.segments]
    segments, last, leaning = [], None, np.zeros(3)
    for segment, up in zip(evidence.segments, ups, strict=True):
        if last is None or up @ last < 0.9:
            # Twenty arc seconds that no encoder shows, until the axes across move again.
            leaning = np.cross(up, 20 * ARCSEC * rng.standard_normal(3)) * SITE.gravity
        last = up
        mean = segment.statistics.mean + np.append(np.zeros(3), leaning)
        segments.append(replace(segment, statistics=replace(segment.statistics, mean=mean)))
    found = method('joint')(replace(evidence, segments=tuple(segments)))
    budget = Budget.from_shares(found.shares)
    lines = {line.source: line for line in budget.lines}
    e_a = slice(NAMES.index('E_axy'), NAMES.index('D_ax'))
    assert lines[ErrorSource.POSITIONING_FOUND].std[e_a].min() > 10 * ARCSEC
    assert lines[ErrorSource.NOISE].std[e_a].max() < ARCSEC
    # A mean over the posterior of the variance holds the doubt of its size already.
    assert np.isinf(lines[ErrorSource.POSITIONING_FOUND].freedom).all()
    assert budget.std == pytest.approx(found.std, rel=1e-9)


@pytest.mark.parametrize('name', ['joint', 'twelve_position'])
def test_turns_that_disagree_are_a_source_of_their_own(name):
    evidence = loaded()
    turns = tuple(
        replace(
            t, statistics=replace(t.statistics, mean=t.statistics.mean * (1 + 2e-4 * (k in (4, 5))))
        )
        for k, t in enumerate(evidence.turns)
    )
    found = method(name)(replace(evidence, turns=turns))
    scattered = std_of(found, ErrorSource.SCATTER)
    assert scattered[K_G[0]] > std_of(found, ErrorSource.NOISE)[K_G].max()
    # Six turns about each axis, less the two unknowns of a line, in three channels at most.
    assert 1 <= found.shares[ErrorSource.SCATTER].freedom[K_G[0]] <= 36
    assert np.sqrt(np.diag(total(found.shares))) == pytest.approx(found.std, rel=1e-9)


@pytest.mark.parametrize(('plan', 'name'), METHODS)
def test_the_doubt_of_gravity_is_that_of_every_response_to_force(plan, name):
    calibration = made(plan, name)
    (line,) = [x for x in calibration.budget.lines if x.source is ErrorSource.GRAVITY]
    doubt = PLACE.gravity_std / PLACE.gravity
    assert line.std[K_A] == pytest.approx((1 + calibration.values[K_A]) * doubt, rel=1e-12)
    assert not line.std[:12].any()
    assert not line.std[D_A].any()


def test_a_gravity_as_measured_is_exact_and_has_no_line():
    measured = Site.at(LATITUDE, gravity=9.79642, latitude_std=0.0)
    plan = at_one_rate(quick_plan('twelve_position', 12.0))
    found = calibrate(session(plan, stand(), 1), plan, site=measured).calibration
    sources = {line.source for line in found.budget.lines}
    assert not sources & {ErrorSource.GRAVITY, ErrorSource.LATITUDE, ErrorSource.TABLE_CLOCK}


@pytest.mark.parametrize('units', [Units.PULSES, Units.COUNTS])
def test_a_table_whose_clock_is_off_does_what_the_budget_says_of_it(units):
    off, model = 20 * PPM, truth().model
    right = perfect('twelve_position', model)
    found = method('joint')(right)
    counted = 1 + off if units is Units.PULSES else 1.0

    def by_that_clock(statistics):
        return replace(statistics, mean=statistics.mean * counted)

    # Fewer seconds: faster turns, and more pulses in each. What counts and SI values are, they are.
    wrong = replace(
        right,
        segments=tuple(replace(s, statistics=by_that_clock(s.statistics)) for s in right.segments),
        turns=tuple(
            replace(t, statistics=by_that_clock(t.statistics), seconds=t.seconds / (1 + off))
            for t in right.turns
        ),
    )
    moved = method('joint')(wrong).model.vector() - found.model.vector()
    share = clock_share(model, PARAMETERS, units, off)
    stated = np.sqrt(np.diag(share.covariance))
    felt, unfelt = (K_A + D_A, K_G) if units is Units.PULSES else (K_G, K_A + D_A)
    assert stated[felt] == pytest.approx(np.abs(moved[felt]), rel=1e-3)
    assert stated[K_A if units is Units.PULSES else K_G] == pytest.approx(off, rel=0.3)
    assert not stated[unfelt].any()
    assert np.abs(moved[unfelt]).max() < 1e-3 * off


def test_a_table_states_its_clock_and_a_calibration_counts_it(tmp_path):
    path = tmp_path / 't.yaml'
    text = named_file('tables', 'three_axis').read_text()
    path.write_text(text + 'clock: 5 ppm\n')
    assert load_table(path).clock == pytest.approx(TABLE_CLOCK)
    for stated, words in (('-1 ppm', 'clock: found -1 ppm'), ('0.5 %', 'at most 1000 ppm')):
        path.write_text(text + f'clock: {stated}\n')
        with pytest.raises(InputError, match=words):
            load_table(path)
    calibration = made('twelve_position', 'joint')
    (line,) = [x for x in calibration.budget.lines if x.source is ErrorSource.TABLE_CLOCK]
    assert line.std[K_A] == pytest.approx((1 + calibration.values[K_A]) * TABLE_CLOCK)
    assert calibration.provenance['table_clock_std'] == TABLE_CLOCK


def test_degrees_of_freedom_add_up_as_in_the_guides_example():
    # JCGM 100:2008, H.1.6: calibration of a gauge block, nm; 25, 9.7, 2.9 and 16.6 with
    # 18, 25.6, 50 and 2 degrees of freedom give 16.7.
    variances = np.array([[25.0], [9.7], [2.9], [16.6]]) ** 2
    freedom = np.array([[18.0], [25.6], [50.0], [2.0]])
    assert effective_freedom(variances, freedom) == pytest.approx(16.7, abs=0.1)


@pytest.mark.parametrize(
    ('freedom', 'factor'), [(1.0, 12.71), (5.0, 2.57), (10.0, 2.23), (50.0, 2.01), (np.inf, 1.96)]
)
def test_the_coverage_factor_is_students(freedom, factor):
    # JCGM 100:2008, table G.2, 95 %.
    line = BudgetLine(ErrorSource.NOISE, np.array([2.0]), np.array([freedom]))
    assert Budget((line,)).coverage_factor == pytest.approx(factor, abs=0.005)
    assert Budget((line,)).expanded == pytest.approx(2 * factor, abs=0.01)


@pytest.mark.parametrize(
    ('plan', 'name'), [('six_position', 'joint'), ('six_position', 'six_position')]
)
def test_each_source_is_missed_where_it_is_left_out(plan, name):
    # The sessions here feel each of them by more than rounding: a sum without it is too small.
    found = method(name)(loaded(plan))
    for source in found.shares:
        rest = {s: share for s, share in found.shares.items() if s is not source}
        lost = 1 - np.diag(total(rest)) / np.diag(found.covariance)
        silent = source is ErrorSource.NORTH or not found.shares[source].covariance.any()
        assert silent or lost.max() > 1e-6, source


@cache
def written() -> dict[str, Any]:
    return yaml.safe_load(made('twelve_position', 'joint').to_yaml())


@pytest.fixture
def recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    brief_plan(tmp_path / 'short.yaml', 6.0)
    assert main(['simulate', './short.yaml', '-o', 'bag', '--latitude', '34.65']) == 0
    return 'bag'


def test_the_screen_shows_the_budget_in_40_lines(recording, tmp_path, capsys):
    options = ['--height', '520', '--latitude-std', '0.1']
    assert main(['calibrate', recording, '--budget', '-o', 'c.yaml', *options]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) <= 40
    assert max(map(len, shown)) <= 100
    found = Calibration.load(tmp_path / 'c.yaml')
    assert found.provenance['latitude_std_deg'] == pytest.approx(0.1)
    (k_ax,) = [line.split() for line in shown if line.startswith('K_ax')]
    row = dict(zip(shown[0].replace('U 95%', 'U').split(), k_ax, strict=True))
    assert float(row['U']) == pytest.approx(found.budget.expanded[K_A[0]] / PPM, abs=0.5)
    assert float(row['value']) == pytest.approx(found.values[K_A[0]] / PPM, abs=0.5)
    assert float(row['gravity']) > 90
    assert any(line.startswith('U 95%: std times k') for line in shown)
    assert main(['calibrate', recording, '--budget', '--verbose', '-o', 'c.yaml']) == 0
    whole = capsys.readouterr().out.splitlines()
    assert any(line.split()[:3] == ['gravity', 'B', 'inf'] for line in whole)
    assert main(['calibrate', recording, '-o', 'c.yaml']) == 0
    assert 'U 95%' not in capsys.readouterr().out


def test_columns_of_all_sources_keep_to_100_letters():
    names = [source.heading for source in ErrorSource]
    shown: Any = SimpleNamespace(headings=names, percents=2 * [['1'] * len(names)])
    first = [['parameter', 'value'], ['K_gx', '12345.6'], ['K_gy', '0.1']]
    tables = _share_tables(shown, first)
    seen = [str(column.header) for table in tables for column in table.columns]
    assert [name for name in seen if name not in first[0]] == names
    assert seen.count('value') == 1
    for table in tables:
        written = io.StringIO()
        Console(width=200, file=written).print(table)
        assert max(map(len, written.getvalue().splitlines())) <= 100


def test_free_positions_tell_noise_pulses_and_what_trembles():
    calibration = by_hand(0).calibration
    lines = {line.source: line for line in calibration.budget.lines}
    assert {ErrorSource.NOISE, ErrorSource.QUANTISATION, ErrorSource.NORTH} <= set(lines)
    assert calibration.budget.std == pytest.approx(calibration.std, rel=1e-9)
    known = calibration.std > 0
    assert np.isfinite(lines[ErrorSource.NOISE].freedom[known]).all()
    # A share of the noise and one of the pulses: neither is all of it.
    assert (lines[ErrorSource.QUANTISATION].std[K_A] < calibration.std[K_A]).all()


def test_what_concerns_no_estimated_parameter_has_no_row_and_no_column():
    # As where only the gyros are calibrated, and gravity is a source of the others alone.
    whole = made('six_position', 'six_position')
    of_gyros = [p.triad == 'g' for p in whole.parameters]
    covariance = np.where(np.outer(of_gyros, of_gyros), whole.covariance, np.nan)
    gyros_alone = replace(whole, covariance=covariance)
    tables = budget_tables(gyros_alone)
    headings = [
        str(c.header) for table in tables if isinstance(table, Table) for c in table.columns
    ]
    assert 'noise' in headings and 'gravity' not in headings
    assert not any('gravity at the site' in line for line in budget_sources(gyros_alone))


def test_drifts_are_stated_each_by_its_own_size():
    # Gyros that drift beyond what is stated, accelerometers that are calmer than that.
    drifting = [ErrorSource.BIAS_STATED, ErrorSource.BIAS_CALM, ErrorSource.BIAS_FOUND]
    whole = made('twelve_position', 'joint')
    imu = replace(
        whole.imu,
        gyro=replace(whole.imu.gyro, bias_instability=0.3 * DEG_H),
        accel=replace(whole.imu.accel, bias_instability=20 * MICRO_G),
    )
    drift = np.repeat([0.5 * DEG_H, 4 * MICRO_G], 3).tolist()
    budget = whole.budget
    for source in drifting:
        budget = budget.with_share(source, Share.known(np.diag(whole.std**2)))
    provenance = {**whole.provenance, 'bias_drift': drift}
    found = replace(whole, imu=imu, budget=budget, provenance=provenance)
    sources = [' '.join(text.split()) for text in budget_sources(found)]
    sizes = ('gyros 0.3 deg/h', 'accelerometers 4 ug', 'gyros 0.4 deg/h')
    for source, size in zip(drifting, sizes, strict=True):
        (words,) = (text for text in sources if text.split()[0] == source.heading)
        assert words.endswith(f'{source.words}: {size}')


@pytest.mark.parametrize(
    ('share', 'said'), [(0.003, '(at most 0.3 %, '), (0.0009, '(< 0.1 %)'), (6e-19, '(< 0.1 %)')]
)
def test_a_source_without_a_column_says_what_it_does(share, said):
    calibration = made('twelve_position', 'joint')
    line = calibration.budget.lines[0]
    small = replace(line, source=ErrorSource.BIAS_CALM, std=share**0.5 * calibration.std)
    budget = Budget((*(x for x in calibration.budget.lines if x.source is not small.source), small))
    sources = budget_sources(replace(calibration, budget=budget))
    (words,) = (' '.join(text.split()) for text in sources if text.startswith('calm-bias'))
    assert said in words
    assert ('%, ' not in said) or any(words.endswith(f' of {name})') for name in NAMES)


def test_a_method_that_does_not_tell_says_so():
    calibration = replace(made('twelve_position', 'joint'), budget=None)
    (words,) = budget_tables(calibration)
    assert 'there is no budget' in words
    assert budget_section(calibration) == []
    assert 'uncertainty_budget' not in calibration.to_yaml()


def test_the_picture_shares_out_every_variance():
    calibration = made('twelve_position_33', 'joint_33')
    picture, *_, table, correlations = budget_section(calibration)
    for parameter in calibration.parameters:
        assert f'>{parameter.name}</text>' in picture
        assert f'<td class="l">{parameter.name}</td>' in table
    assert picture.count('<title>K_ax: grav') == 1
    names = [parameter.name for parameter in calibration.parameters]
    x, y = names.index('K_ax'), names.index('K_ay')
    std = calibration.std
    expected = calibration.covariance[x, y] / std[x] / std[y]
    assert abs(expected) > 0.1 and f'K_ax and K_ay {expected:+.2f}' in correlations


def test_what_is_known_of_a_latitude_goes_with_the_recording():
    assert Site.at(0.5).latitude_std == pytest.approx(0.01 * DEG)
    site = Site.at(0.5, 100.0, latitude_std=0.002)
    again = described_site(describe('twelve_position', 'fog_medium', None, site), 'bag')
    assert again.latitude_std == pytest.approx(site.latitude_std, rel=1e-12)
    assert again.gravity_std == site.gravity_std
    # Normal gravity changes by 5 cm/s^2 from the equator to the pole, fastest between them.
    assert site.gravity_std**2 - Site.at(0.5, 100.0, latitude_std=0.0).gravity_std ** 2 == (
        pytest.approx((0.05186 * np.sin(1.0) * 0.002) ** 2, rel=0.02)
    )
    with pytest.raises(InputError, match=r'latitude_std: found -1 deg, expected 0 to 10'):
        Site.at(0.5, latitude_std=-DEG)


@pytest.mark.parametrize('stated', [48.1, 48.14, 50.0])
def test_a_stated_latitude_keeps_the_height_of_the_recording(stated):
    own = Site.at(48.1 * DEG, 520.0)
    recording = SimpleNamespace(
        path='bag', custom_data=describe('free_positions', 'mems_counts', None, own)
    )
    found = site_of(Stated(latitude=stated), recording)
    assert found.height == 520.0
    assert found.latitude == pytest.approx(stated * DEG, rel=1e-12)


def test_covariance_and_budget_grow_by_the_same_share():
    calibration = made('six_position', 'six_position')
    share = Share.known(np.diag(calibration.std**2))
    more = calibration.with_share(ErrorSource.SCATTER, share)
    assert more.budget.std == pytest.approx(more.std)
    assert more.std == pytest.approx(np.sqrt(2) * calibration.std)
