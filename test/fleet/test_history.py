"""What a history says of units: scatter, trends, dates, steps and charts, against known truth."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from histories import MONTH, SCALE, START, index, joined, of, sessions

from imu_calib.common.errors import InputError
from imu_calib.fleet.control_charts import (
    Block,
    StepPlaces,
    chart_limits,
    ewma_limit,
    find_steps,
    mean_run_length,
)
from imu_calib.fleet.evaluation import backtest
from imu_calib.fleet.results import Cause, Chart, Rules
from imu_calib.fleet.scatter import Prior, between, interval
from imu_calib.session.imu import Verdict

LIMITS = {'fog': 300 * SCALE}

BCG = np.array(
    # Vaccine: ill, not ill; control: ill, not ill; latitude, deg. Colditz et al. 1994, table 1.
    [
        (4, 119, 11, 128, 44),
        (6, 300, 29, 274, 55),
        (3, 228, 11, 209, 42),
        (62, 13536, 248, 12619, 52),
        (33, 5036, 47, 5761, 13),
        (180, 1361, 372, 1079, 44),
        (8, 2537, 10, 619, 19),
        (505, 87886, 499, 87892, 13),
        (29, 7470, 45, 7232, 27),
        (17, 1699, 65, 1600, 42),
        (186, 50448, 141, 27197, 18),
        (5, 2493, 3, 2338, 33),
        (27, 16886, 29, 17825, 33),
    ],
    dtype=float,
)


def published() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log relative risks, their variances, and latitudes."""
    a, b, c, d, latitude = BCG.T
    y = np.log(a / (a + b)) - np.log(c / (c + d))
    return y, 1 / a - 1 / (a + b) + 1 / c - 1 / (c + d), latitude


def test_restricted_likelihood_gives_what_is_published():
    # Viechtbauer 2010 (J. Stat. Softw. 36(3)), 4.1: tau^2 0.3132, Q-profile 0.1197 to 1.1115.
    y, v, latitude = published()
    one = np.ones((13, 1))
    assert between(one, v, y) == pytest.approx(0.3132, abs=5e-5)
    low, high, odd = interval(one, v, y, 0.95)
    assert (low, high) == (pytest.approx(0.1197, abs=5e-5), pytest.approx(1.1115, abs=5e-5))
    assert not odd
    # With the latitude beside it (documentation of metafor): 0.0764, found to four digits.
    assert between(np.column_stack([one, latitude]), v, y) == pytest.approx(0.0764, abs=1e-4)


def test_restricted_likelihood_is_at_its_maximum():
    rng = np.random.default_rng(5)
    for _ in range(10):
        n = int(rng.integers(4, 12))
        X = np.column_stack([np.ones(n), rng.uniform(-40, 0, n)])
        v = rng.uniform(0.2, 2.0, n)
        y = rng.standard_normal(n) * np.sqrt(v + 1.5)
        K = scipy.linalg.null_space(X.T)

        def minus(t, K=K, v=v, y=y):
            V = K.T @ np.diag(v + t) @ K
            return np.linalg.slogdet(V)[1] + (K.T @ y) @ np.linalg.solve(V, K.T @ y)

        grid = np.concatenate([[0.0], np.geomspace(1e-3, 30.0, 2000)])
        best = min(grid, key=minus)
        assert float(between(X, v, y)) == pytest.approx(best, rel=0.02, abs=1e-3)


def test_the_interval_of_turn_on_repeatability_holds_the_truth():
    rng = np.random.default_rng(6)
    held, runs = 0, 4000
    for part in range(40):
        n = 4 + part % 6
        months = np.sort(rng.uniform(-40, 0, (runs // 40, n)), axis=1)
        X = np.stack([np.ones_like(months), months], axis=-1)
        v = rng.uniform(0.5, 1.5, months.shape)
        y = rng.standard_normal(months.shape) * np.sqrt(v + 1.5)
        low, high, _ = interval(X, v, y, 0.9)
        held += int(np.sum((low <= 1.5) & (high >= 1.5)))
    # A binomial law: three standard deviations of the share held.
    assert held / runs == pytest.approx(0.9, abs=3 * np.sqrt(0.09 / runs))


def test_sessions_that_agree_better_than_they_state_are_said_to():
    y = np.array([1.0, 1.001, 0.999, 1.0, 1.002, 0.998])
    one, v = np.ones((6, 1)), np.ones(6)
    low, high, odd = interval(one, v, y, 0.95)
    assert odd and low == 0 and between(one, v, y) == 0
    # All scatter is then between sessions: n s^2 / chi-square at its lower quantile.
    assert high == pytest.approx(5 * y.var(ddof=1) / scipy.stats.chi2.ppf(0.025, 5), rel=1e-6)


@pytest.mark.parametrize(
    ('smoothing', 'limit', 'runs'),
    # Lucas & Saccucci 1990, table 3 (as in Montgomery, table 9.11): shifts 0, 0.25, 0.5, 1, 2.
    [
        (0.40, 3.054, (500, 224, 71.2, 14.3, 3.5)),
        (0.25, 2.998, (500, 170, 48.2, 11.1, 3.6)),
        (0.20, 2.962, (500, 150, 41.8, 10.5, 3.7)),
        (0.10, 2.814, (500, 106, 31.3, 10.3, 4.4)),
        (0.05, 2.615, (500, 84.1, 28.8, 11.4, 5.2)),
    ],
)
def test_run_lengths_are_those_of_the_tables(smoothing, limit, runs):
    for shift, run in zip((0.0, 0.25, 0.5, 1.0, 2.0), runs, strict=True):
        assert mean_run_length(smoothing, limit, shift) == pytest.approx(run, rel=0.015)
    assert ewma_limit(smoothing, 500.0) == pytest.approx(limit, abs=1.5e-3)


def test_chart_limits_share_the_rate_among_the_parameters():
    limits = chart_limits(Rules(false_alarm=0.01))
    assert 24 * 2 * scipy.stats.norm.sf(limits.individuals) == pytest.approx(0.01)
    assert limits.parameter_run == pytest.approx(2400)
    assert limits.unit_run == pytest.approx(100)


@pytest.mark.parametrize('borrowed', [0.0, 30.0])
def test_the_smallest_step_that_would_be_found_is_found_from_there_on(borrowed):
    rng = np.random.default_rng(8)
    months = np.sort(rng.uniform(-40, 0, (1, 6)))
    values = np.tile(rng.standard_normal((1, 1, 6)), (1, 24, 1))
    weights = np.ones(values.shape)
    prior = Prior(np.ones(24), np.ones(24), np.full(24, borrowed))

    def found(size: float) -> StepPlaces:
        stepped = values.copy()
        stepped[0, :, -1] += size
        block = Block(np.arange(6)[None], months, stepped, weights)
        return find_steps(block, weights, prior, 0.01)

    least = float(found(0.0).least[0, 0])
    ends = []
    for sign in (-1.0, 1.0):
        low, high = 0.0, 3 * least
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (low, middle) if found(sign * middle).by_parameter else (middle, high)
        ends.append(high)
    # What chance makes of a step there adds to one side what it takes from the other.
    assert sum(ends) / 2 == pytest.approx(least, rel=1e-6)
    assert np.isnan(found(2.5 * least).least).all()


@pytest.fixture(scope='module')
def quiet():
    """A hundred units in which nothing changes, and what is said of them, at a rate of 5 %."""
    rng = np.random.default_rng(11)
    parts = [sessions(rng, 50, 8, stands=('east', 'west', 'south')) for _ in range(2)]
    rules = Rules(false_alarm=0.05)
    return [backtest(one, LIMITS, rules) for one in parts]


def most(share: float, count: int) -> float:
    """Largest share among so many that chance gives once in a thousand."""
    return float(scipy.stats.binom.ppf(0.999, count, share) / count)


def test_false_alarms_of_charts_come_as_seldom_as_stated(quiet):
    units = [unit for one in quiet for unit in one.units]
    for chart in Chart:
        count = sum(len(unit.key) - 1 for unit in units)
        alarms = sum(
            len({signal.index for signal in unit.charts.signals if signal.chart is chart})
            for unit in units
        )
        assert 0 < alarms / count <= most(0.05, count)


def test_scores_in_control_are_standard_normal(quiet):
    scores = np.concatenate([unit.charts.score[1:].ravel() for one in quiet for unit in one.units])
    # Scatter is known by 50 units with six degrees of freedom: to a hundredth or two.
    assert scores.mean() == pytest.approx(0.0, abs=0.03)
    assert scores.std() == pytest.approx(1.0, abs=0.04)
    assert np.mean(np.abs(scores) > 2.5758) == pytest.approx(0.01, abs=0.003)


def test_t2_in_control_has_the_law_that_is_stated(quiet):
    chances = np.concatenate([unit.charts.t2_chance[1:] for one in quiet for unit in one.units])
    assert np.isfinite(chances).all()
    assert scipy.stats.kstest(chances, 'uniform').pvalue > 0.001


def test_trends_and_steps_are_found_as_seldom_as_stated_where_there_are_none(quiet):
    units = [unit for one in quiet for unit in one.units]
    assert np.mean([unit.trend.significant.any() for unit in units]) <= most(0.05, len(units))
    assert np.mean([bool(unit.steps) for unit in units]) <= most(0.05, len(units))
    held = np.mean([(u.trend.low <= 0) & (u.trend.high >= 0) for u in units])
    assert held == pytest.approx(0.95, abs=0.015)


def test_nothing_is_called_apart_where_nothing_is(quiet):
    for one in quiet:
        assert one.stands.shifts == ()
        assert one.populations['fog'].outliers == ()
        turn_on = one.populations['fog'].turn_on / SCALE
        # Of 50 units with six degrees of freedom each: a tenth, and 24 of them.
        assert turn_on == pytest.approx(np.ones(24), abs=0.2)


def test_a_course_says_scatter_and_trend():
    def truth(unit, months, k, stand):
        return of(D_gx=0.3 * months) * (unit == 0)

    found = backtest(sessions(np.random.default_rng(21), 20, 8, truth=truth), LIMITS)
    unit = found.units[0]
    slope = unit.trend.slope / SCALE
    # Half-yearly sessions over 42 months with a scatter of 1.12: 0.028 a month.
    assert slope[index('D_gx')] == pytest.approx(0.3, abs=0.1)
    assert unit.trend.low[index('D_gx')] < 0.3 * SCALE[index('D_gx')]
    assert [n for n, s in zip(unit.trend.significant, slope, strict=True) if n] == [True]
    assert any(s.startswith('D_gx drifts: +0.') and 'deg/h/month' in s for s in unit.findings)
    assert unit.scatter.stated / SCALE == pytest.approx(np.full(24, 0.5))
    assert all(u.trend.significant.sum() == 0 for u in found.units[1:])


def test_units_are_inside_when_they_are_due_as_often_as_stated():
    rng = np.random.default_rng(31)
    count = 200
    # So much alike that the scatter of the next session counts as much as the line's doubt.
    rates, start = rng.normal(0.1, 0.01, count), rng.uniform(-2, 2, count)
    p = index('K_ax')

    def truth(unit, months, k, stand):
        return of(K_ax=start[unit] + rates[unit] * months)

    limit = np.full(24, np.nan)
    limit[p] = 10.0 * SCALE[p]
    made = sessions(rng, count, 10, apart=0.0, truth=truth)
    found = backtest(made, {'fog': limit}, Rules(inside=0.9))
    inside, due = 0, 0
    for k, unit in enumerate(found.units):
        at = unit.forecast.recalibrate
        if np.isnat(at) or at <= unit.date[-1]:
            continue
        months = (at.astype('datetime64[s]') - START).astype(float) / MONTH
        later = start[k] + rates[k] * months + rng.standard_normal(50)
        inside += np.mean(np.abs(later) <= 10.0)
        due += 1
        assert unit.forecast.parameter == 'K_ax'
    assert due > 0.8 * count
    # Three standard deviations of a share of 200 lines, which lean on one mean slope.
    assert inside / due == pytest.approx(0.9, abs=0.07)


def test_the_line_leaves_the_limit_where_it_does():
    def truth(unit, months, k, stand):
        return of(D_ay=2.0 * months)

    made = sessions(
        np.random.default_rng(3), 1, 10, turn_on=0.0, stated=0.01, apart=0.0, truth=truth
    )
    unit = backtest(made, {'fog': 200 * SCALE}).units[0]
    crossing = START + np.timedelta64(int(100 * MONTH), 's')
    leaves = unit.forecast.leaves[index('D_ay')]
    assert abs((leaves - crossing.astype('datetime64[D]')).astype(int)) <= 3
    # So little scatter leaves the date at which it may be outside close to that.
    earliest = unit.forecast.earliest[index('D_ay')]
    assert 0 <= (leaves - earliest).astype(int) <= 10
    assert unit.forecast.recalibrate <= earliest
    assert any(s.startswith(f'Recalibrate by {unit.forecast.recalibrate}') for s in unit.findings)


def test_sessions_of_two_days_are_no_drift_and_give_no_date():
    def truth(unit, months, k, stand):
        return of(D_ay=2.0 * months)

    rng = np.random.default_rng(3)
    made = sessions(rng, 1, 10, turn_on=0.5, stated=0.1, apart=0.0, truth=truth)
    for whole, dated in ((made.date[-1] - START, True), (np.timedelta64(2 * 86400, 's'), False)):
        share = (made.date - START) / (made.date[-1] - START)
        date = START + (share * whole.astype(float)).astype('timedelta64[s]')
        unit = backtest(replace(made, date=date), {'fog': 200 * SCALE}).units[0]
        assert unit.trend.significant.any() == dated
        assert np.isnat(unit.forecast.recalibrate) != dated
    assert 'of less than a month' in unit.forecast.reason


def test_a_mount_shift_and_a_repair_are_told_apart():
    turn = {'E_gxy': 8.0, 'E_gyx': -8.0, 'E_axy': 8.0, 'E_ayx': -8.0}

    def truth(unit, months, k, stand):
        if unit == 0:
            return of(**turn) * (k >= 4)
        return of(K_gz=30.0, D_gz=-20.0) * (k >= 6) if unit == 1 else of()

    made = sessions(np.random.default_rng(41), 20, 10, truth=truth)
    first, second, *others = backtest(made, LIMITS).units
    (shift,) = first.steps
    assert shift.index == 4 and shift.cause is Cause.MOUNT
    assert set(shift.parameters) == set(turn)
    # Turned about Z by what one misalignment gets; scatter of 1.12 before and after.
    assert shift.rotation[2] / SCALE[index('E_gxy')] == pytest.approx(8.0, abs=2.0)
    assert any('Step between' in s and 'a mount shift' in s for s in first.findings)
    (repair,) = second.steps
    assert repair.index == 6 and repair.cause is Cause.UNIT
    assert dict(zip(repair.parameters, repair.size, strict=True)).keys() == {'K_gz', 'D_gz'}
    k = repair.parameters.index('K_gz')
    assert repair.low[k] < 30 * SCALE[index('K_gz')] < repair.high[k]
    assert not any(unit.steps for unit in others)
    # The line does not follow the step.
    assert abs(second.trend.slope[index('K_gz')] / SCALE[index('K_gz')]) < 0.5


def test_one_session_unlike_its_neighbours_is_no_step_of_the_unit():
    def truth(unit, months, k, stand):
        return of(K_gz=40.0, E_ayz=-30.0) * (unit == 0 and k == 5)

    made = sessions(np.random.default_rng(41), 20, 10, truth=truth)
    unit = backtest(made, LIMITS).units[0]
    assert [step.cause for step in unit.steps] == [Cause.OUTLIER, Cause.RETURN]
    assert unit.own_steps == ()
    (sentence,) = [s for s in unit.findings if 'Step' in s or 'unlike' in s]
    assert sentence.startswith(f'The session of {unit.date[5].astype("M8[D]")} is unlike those')


def test_a_large_step_is_where_it_is():
    """A million standard deviations leave nothing of the places around it."""

    def truth(unit, months, k, stand):
        return of(K_gz=1e6) * (unit == 0 and k >= 6)

    made = sessions(np.random.default_rng(42), 20, 10, truth=truth)
    assert [step.index for step in backtest(made, LIMITS).units[0].steps] == [6]


def test_charts_see_a_unit_that_changes():
    together = of(K_gx=3.0, E_gxy=3.0, D_gx=3.0, K_ax=3.0, E_axy=3.0, D_ax=3.0, K_gy=3.0, K_gz=3.0)

    def truth(unit, months, k, stand):
        changed = {0: of(K_gx=12.0) * (k == 7), 1: of(K_ay=3.0) * (k >= 4), 2: together * (k == 7)}
        return changed.get(unit, of())

    found = backtest(sessions(np.random.default_rng(51), 30, 12, truth=truth), LIMITS)

    def signals_of(unit, chart):
        return {
            (s.index, s.parameter) for s in found.units[unit].charts.signals if s.chart is chart
        }

    assert (7, 'K_gx') in signals_of(0, Chart.INDIVIDUALS)
    assert {name for _, name in signals_of(1, Chart.EWMA)} == {'K_ay'}
    assert (7, '') in signals_of(2, Chart.T2)
    assert any('Out of control on' in s for s in found.units[0].findings)
    # One cause, one sentence.
    (sentence,) = [s for s in found.units[1].findings if 'Out of control' in s]
    of_it = {i for i, _ in signals_of(1, Chart.EWMA)}
    assert sentence.startswith(f'Out of control at {len(of_it)} of ')
    assert sentence.endswith('by K_ay.') and len(of_it) >= 3


def test_what_is_outside_is_said_with_its_limit():
    def truth(unit, months, k, stand):
        return of(K_gx=400.0) if unit == 1 else of()

    found = backtest(sessions(np.random.default_rng(61), 3, 3, apart=1.0, truth=truth), LIMITS)
    good, bad, _ = found.units
    assert bad.outside == ('K_gx',) and bad.verdict is Verdict.FAIL
    assert found.outside == (bad,)
    assert good.verdict is Verdict.PASS and good.outside == ()
    assert any(s.startswith('K_gx is outside its specification: 4') for s in bad.findings)
    assert np.isnat(bad.forecast.recalibrate) and 'outside' in bad.forecast.reason


def test_few_sessions_say_what_they_do_not_tell():
    rng = np.random.default_rng(71)
    for count, words in ((1, 'One session'), (2, 'Two sessions'), (3, None)):
        unit = backtest(sessions(rng, 1, count), LIMITS).units[0]
        assert (words is None) or any(s.startswith(words) for s in unit.findings)
        assert not unit.trend.significant.any() and unit.steps == ()
        if count < 3:
            assert np.isnan(unit.trend.slope).all() and np.isnat(unit.forecast.recalibrate)
            assert 'when it is due cannot be computed' in unit.forecast.reason
        assert np.isnan(unit.scatter.std).all() == (count == 1)
    # Others of its type lend what one session lacks.
    young = sessions(rng, 1, 1, imu='fog')
    young = replace(young, serial=('young',))
    found = backtest(joined(sessions(rng, 30, 6, apart=5.0), young), LIMITS)
    (unit,) = (u for u in found.units if u.serial == 'young')
    assert unit.forecast.borrowed and np.isnan(unit.trend.slope).all()
    assert unit.forecast.reason == '' or 'beyond the horizon' in unit.forecast.reason


def test_sessions_of_one_date_tell_no_trend():
    made = sessions(np.random.default_rng(81), 1, 5)
    unit = backtest(replace(made, date=np.full(5, START)), LIMITS).units[0]
    assert np.isnan(unit.trend.slope).all() and not unit.trend.significant.any()
    assert np.isfinite(unit.scatter.std).all()
    assert any('one date' in s for s in unit.findings)


def test_what_does_not_count_is_said():
    made = sessions(np.random.default_rng(91), 4, 3)
    date = made.date.copy()
    date[0] = np.datetime64('NaT', 's')
    values = made.values.copy()
    values[1] = np.nan
    serial = (*made.serial[:2], '', *made.serial[3:])
    found = backtest(replace(made, date=date, values=values, serial=serial), LIMITS)
    findings = ' '.join(found.findings)
    for reason in ('no date', 'no serial number', 'no estimated parameter'):
        assert f'1 of 12 sessions are ignored: they have {reason}' in findings
    assert [unit.serial for unit in found.units] == ['F001', 'F002', 'F003']


def test_a_type_without_limits_and_a_number_of_two_types():
    rng = np.random.default_rng(92)
    other = replace(sessions(rng, 2, 3, imu='mems'), serial=('F000',) * 3 + ('M1',) * 3)
    found = backtest(joined(sessions(rng, 2, 3), other), LIMITS)
    findings = ' '.join(found.findings)
    assert 'No specification of mems is known' in findings
    assert 'Serial number F000 occurs with the types fog and mems: counted as 2 units' in findings
    assert [(u.imu, u.serial) for u in found.units if u.serial == 'F000'] == [
        ('fog', 'F000'),
        ('mems', 'F000'),
    ]
    mems = [u for u in found.units if u.imu == 'mems']
    assert all(u.verdict is None and np.isnat(u.forecast.recalibrate) for u in mems)


def test_without_deviations_and_with_singular_covariances():
    made = sessions(np.random.default_rng(93), 20, 5, stands=('a', 'b', 'c'))
    bare = backtest(replace(made, covariance=np.full_like(made.covariance, np.nan)), LIMITS)
    assert any('states a standard deviation: all scatter' in s for s in bare.findings)
    # 1 between and 0.5 within, both taken for between.
    assert np.median(bare.populations['fog'].turn_on / SCALE) == pytest.approx(1.12, abs=0.1)
    some = made.covariance.copy()
    some[:7] = np.nan
    findings = backtest(replace(made, covariance=some), LIMITS).findings
    assert any(
        s.startswith('7 of 100 sessions of fog state no standard deviation') for s in findings
    )
    exact = backtest(replace(made, covariance=np.zeros_like(made.covariance)), LIMITS)
    assert np.median(exact.populations['fog'].turn_on / SCALE) == pytest.approx(1.12, abs=0.1)
    for one in (bare, exact):
        assert all(np.isfinite(u.trend.slope).all() for u in one.units)


def test_a_triad_that_is_not_estimated_is_left_out():
    made = sessions(np.random.default_rng(94), 20, 6)
    values, covariance = made.values.copy(), made.covariance.copy()
    values[:, 12:] = np.nan
    covariance[:, 12:, :] = covariance[:, :, 12:] = np.nan
    found = backtest(replace(made, values=values, covariance=covariance), LIMITS)
    unit = found.units[0]
    assert np.isfinite(unit.trend.slope[:12]).all() and np.isnan(unit.trend.slope[12:]).all()
    assert np.isnan(unit.charts.score[:, 12:]).all()
    assert np.isnan(found.populations['fog'].median[12:]).all()


@pytest.mark.parametrize(
    'wrong', [{'false_alarm': 0.0}, {'inside': 1.5}, {'smoothing': 0.01}, {'horizon': -1.0}]
)
def test_rules_are_refused_that_are_none(wrong):
    with pytest.raises(InputError, match=f'{next(iter(wrong))}: found .*, expected'):
        Rules(**wrong)


def test_nothing_is_nothing():
    made = sessions(np.random.default_rng(95), 1, 1)
    found = backtest(replace(made, serial=('',)), LIMITS)
    assert found.units == () and found.populations == {}
