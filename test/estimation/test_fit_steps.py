"""What the joint estimate does step by step: starts, headings, levels, moves, outliers, changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of
from scipy.stats import chi2

from imu_calib.common.budget import ErrorSource
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, PPM
from imu_calib.estimation import changing, estimate, outliers
from imu_calib.estimation import solve as fit
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.excess_scatter import ExcessScatter
from imu_calib.estimation.information import Information
from imu_calib.estimation.positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors
from imu_calib.estimation.session_model import Nuisance
from imu_calib.estimation.term_tests import temperature_finding
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.model.session_terms import Course, change, session_term
from imu_calib.model.terms import ACCEL_CUBIC, GYRO_CUBIC

RNG = np.random.default_rng(0)
MODEL = SensorModel(
    Triad(RNG.normal(0, 1e-3, (3, 3)), RNG.normal(0, 1e-5, 3)),
    Triad(RNG.normal(0, 1e-3, (3, 3)), RNG.normal(0, 1e-2, 3)),
)


@cache
def session(azimuth: float = 0.0, *, known: bool = False, noisy: bool = True) -> Equations:
    noise = np.random.default_rng(1) if noisy else None
    return Equations(evidence_of(model=MODEL, azimuth=azimuth, known=known, noise=noise))


@pytest.mark.parametrize('heading', [10.0, 100.0, -170.0])
def test_the_start_is_near_wherever_north_is(heading: float) -> None:
    equations = session(heading * DEG, noisy=False)
    state = fit.start(equations)
    off = state[equations.sensors + Nuisance.AZIMUTH] - heading * DEG
    # Eight headings: the next is half of 45 deg off, and what is linear comes nearer.
    assert abs((off + np.pi) % (2 * np.pi) - np.pi) < 23 * DEG
    found = fit.fit(equations, state)
    assert found[:24] == pytest.approx(MODEL.vector(), abs=1e-7)
    assert found[equations.sensors + Nuisance.AZIMUTH] == pytest.approx(heading * DEG, abs=1e-4)


def test_where_north_is_known_the_start_is_there_and_linear() -> None:
    equations = session(1.0, known=True, noisy=False)
    state = fit.start(equations)
    assert state[24:28] == pytest.approx(np.zeros(4), abs=1e-9)
    assert state[:24] == pytest.approx(MODEL.vector(), abs=1e-5)


@pytest.mark.parametrize(('azimuth', 'begun'), [(-3.0, 0.2), (3.0, -0.2)])
def test_an_azimuth_found_beyond_half_a_turn_is_told_within(azimuth: float, begun: float) -> None:
    equations = session(azimuth, noisy=False)
    state = equations.nominal()
    # The same heading, a turn further.
    turn = 2 * np.pi if azimuth < 0 else -2 * np.pi
    state[equations.sensors + Nuisance.AZIMUTH] = azimuth + turn + begun
    found = fit.fit(equations, state)
    assert found[equations.sensors + Nuisance.AZIMUTH] == pytest.approx(azimuth, abs=1e-7)
    assert found[:24] == pytest.approx(MODEL.vector(), rel=1e-6, abs=1e-10)


def test_a_table_is_trusted_to_be_level_within_four_deviations() -> None:
    equations = session()
    level = equations.evidence.levelling
    for x, y, seen in ((3.9, 0.0, None), (-4.1, 1.0, 4.1), (0.0, 5.0, 5.0)):
        state = np.zeros(equations.size)
        state[25:27] = np.array([x, y]) * level
        levelled = fit.levelled(equations, state).levelled
        assert levelled == (None if seen is None else pytest.approx(seen * level))


@pytest.mark.parametrize(
    ('off', 'std', 'trusted'),
    [
        (4.9e-2, 1e-2, True),
        (5.1e-2, 1e-2, False),
        (0.049 * DEG, 1e-9, True),
        (0.051 * DEG, 1e-9, False),
    ],
)
def test_a_stated_azimuth_stands_unless_the_gyros_contradict_it(
    off: float, std: float, trusted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # By five deviations, and by more than a tenth of a degree is rounded.
    equations = session(1.0, known=True)
    where = np.zeros(equations.size)
    where[24] = off
    covariance = np.eye(equations.size)
    covariance[24, 24] = std**2
    monkeypatch.setattr(fit, 'fit', lambda *_: where)
    monkeypatch.setattr(fit, 'excess', lambda *_: ExcessScatter(NO_POSITIONING_ERRORS, np.zeros(6)))
    of = SimpleNamespace(from_jacobian=lambda _: SimpleNamespace(covariance=covariance))
    monkeypatch.setattr(fit, 'Information', of)
    found = fit.headed(equations, where)
    assert found.any_heading is not trusted
    assert (found is equations) is trusted
    unknown = session()
    assert fit.headed(unknown, where) is unknown


def test_terms_that_a_session_leaves_open_are_refused_with_what_would_do() -> None:
    open_ones = replace(session(), parameters=(*PARAMETERS, *ACCEL_CUBIC.parameters))
    with pytest.raises(NotObservable, match=r'accel_cubic.*45 degrees off the vertical'):
        fit.check_observable(open_ones)
    # Of two terms the one that is left open is named.
    both = replace(
        session(), parameters=(*PARAMETERS, *GYRO_CUBIC.parameters, *ACCEL_CUBIC.parameters)
    )
    with pytest.raises(NotObservable) as refused:
        fit.check_observable(both)
    assert 'gyro_cubic' not in str(refused.value)
    fit.check_observable(session())
    few = replace(session().evidence, segments=session().evidence.segments[:4], turns=())
    with pytest.raises(NotObservable, match='turn'):
        fit.check_observable(Equations(few))


def test_scatter_is_taken_into_the_covariance() -> None:
    scatter: Any = ExcessScatter(PositioningErrors(1e-5, 0.0), np.zeros(6), ('part',))  # type: ignore[arg-type]
    found = fit.with_scatter(session(), scatter)
    assert (found.positioning, found.extra) == (scatter.positioning, ('part',))


@dataclass(frozen=True)
class Step:
    """A move, with a velocity or without."""

    velocity_steps: Any


LIMIT = float(np.sqrt(chi2.isf(1e-9, 3)))


@pytest.mark.parametrize(
    ('angle', 'speed', 'astray', 'velocity_kept'),
    [(0.99, 0.99, (), True), (1.01, 0.0, ('angle',), True), (0.5, 1.01, ('velocity',), False)],
)
def test_a_move_is_left_out_that_chance_makes_once_in_a_billion(
    angle: float, speed: float, astray: Any, velocity_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its noise has the variance 0.5, and what rests leave open adds 0.5 to it.
    @dataclass(frozen=True)
    class There:
        evidence: Any
        extra: Any = ()

        def predict(self, _: Floats) -> Floats:
            return np.array([0.0, angle * LIMIT, 0.0, speed * LIMIT, 0.0, 0.0])

        def jacobian(self, _: Floats) -> Floats:
            return np.eye(6)

        def covariance(self, _: Floats) -> Floats:
            return 0.5 * np.eye(6)

        def whitened(self, _: Floats) -> tuple[Floats, Floats]:
            return np.sqrt(2) * np.eye(6), np.zeros(6)

        @property
        def layout(self) -> Any:
            return SimpleNamespace(
                moves_with_accels=(0,), velocity=np.array([[3, 4, 5]]), move=np.array([[0, 1, 2]])
            )

    link = SimpleNamespace(first=0, second=1, move=Step('steps'))
    segments = [SimpleNamespace(position='a'), SimpleNamespace(position='b')]
    evidence: Any = SimpleNamespace(used_moves=SimpleNamespace(linked=[link]), segments=segments)
    kept, found = outliers._judged(There(evidence, ()), np.zeros(6), evidence)  # type: ignore[arg-type]
    assert [(one.positions, one.velocity) for one in found] == [
        (('a', 'b'), which == 'velocity') for which in astray
    ]
    for one in found:
        assert one.misclosure == pytest.approx((speed if one.velocity else angle) * LIMIT)
    if astray == ('angle',):
        assert kept == ()
    else:
        assert (kept[0].velocity_steps is not None) is velocity_kept


@dataclass(frozen=True)
class Moving:
    """Of a session's evidence, its moves."""

    moves: tuple[Any, ...] = ()

    @property
    def used_moves(self) -> tuple[Any, ...]:
        return self.moves


def test_moves_are_judged_anew_with_the_positioning_errors_that_they_show(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plain: Any = Moving()
    sizes = iter((1.0, 2.0, 3.0))
    sees = []

    def judged(resting: Any, _: Any, __: Any, **___: Any) -> Any:
        sees.append(resting.positioning)
        return answers.pop(0)

    def shown(*_: Any) -> Any:
        return ExcessScatter(PositioningErrors(next(sizes), 0.0), np.zeros(6))

    resting = replace(session(), evidence=plain)
    monkeypatch.setattr(outliers, 'excess', shown)
    monkeypatch.setattr(outliers, '_judged', judged)
    one, two = (Step(None),), (Step(None), Step(None))
    answers = [(one, ('x', 'y')), (two, ('x',)), (two, ('z',))]
    evidence, astray = outliers.moves_that_fit(resting, np.zeros(9), two)  # type: ignore[arg-type]
    # More fit with each look, until no more do.
    assert (evidence, astray) == (Moving(two), ('z',))
    assert [p.joints for p in sees] == [1.0, 2.0, 3.0]
    answers, sizes = [(two, ())], iter((1.0,))
    seen = outliers.moves_that_fit(resting, np.zeros(9), two)  # type: ignore[arg-type]
    assert seen == (Moving(two), ())
    assert outliers.moves_that_fit(resting, np.zeros(9), ()) == (plain, ())


def test_a_dwell_that_was_knocked_is_an_outlier_of_its_own_chi_square() -> None:
    equations = session()
    first = equations.evidence.segments[3]
    off = np.zeros(6)
    deviation = np.sqrt(equations.own_variances[18:24])
    off[4] = 30 * deviation[4]
    knocked = replace(first, statistics=replace(first.statistics, mean=first.statistics.mean + off))
    segments = (*equations.evidence.segments[:3], knocked, *equations.evidence.segments[4:])
    there = Equations(replace(equations.evidence, segments=segments))
    state = fit.fit(there, fit.start(there))
    views = ((there, state), (there, state))
    found = outliers.find_outlier(views, outliers.candidates(there.evidence, turns=True))
    assert found is not None
    assert found.name == f'the accelerometers at position {first.position}'
    assert found.rows.tolist() == [21, 22, 23]
    # Thirty deviations squared, less what the dwell itself would say: most of 900.
    assert 300 < found.chi_square < 1000
    sound = session()
    state = fit.fit(sound, fit.start(sound))
    quiet = ((sound, state), (sound, state))
    assert outliers.find_outlier(quiet, outliers.candidates(sound.evidence, turns=True)) is None
    silent = replace(sound, evidence=replace(sound.evidence, walk=np.zeros(6)))
    none = ((silent, state), (silent, state))
    assert outliers.find_outlier(none, outliers.candidates(sound.evidence, turns=True)) is None


@pytest.mark.parametrize(
    ('freedom', 'sigma', 'named'),
    [(np.inf, 6.1, True), (30.0, 6.1, False), (30.0, 7.8, True), (20.0, 7.8, False)],
)
def test_how_far_an_outlier_is_off_depends_on_how_well_the_noise_is_known(
    freedom: float, sigma: float, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Once in 10^6 dwells three squares are beyond 5.5^2, and by noise that is known to 30 and 20
    # degrees of freedom beyond 7.2^2 and 8.4^2: three times F, by tables.
    monkeypatch.setattr(
        outliers, 'excess', lambda *_, **__: ExcessScatter(NO_POSITIONING_ERRORS, np.zeros(6))
    )
    sound = replace(session().evidence, walk_freedom=np.full(6, freedom))
    segment, deviation = sound.segments[3], np.sqrt(session().own_variances[22])

    def pushed(by: float) -> tuple[Equations, Floats]:
        mean = segment.statistics.mean + by * deviation * np.eye(6)[4]
        off = replace(segment, statistics=replace(segment.statistics, mean=mean))
        segments = (*sound.segments[:3], off, *sound.segments[4:])
        there = Equations(replace(sound, segments=segments))
        return there, fit.fit(there, fit.start(there))

    rows = np.array([21, 22, 23])
    near, far = 0.0, 40.0
    while far - near > 0.01:
        middle = (near + far) / 2
        beyond = outliers._mean_shift_test(*pushed(middle), rows)[0] > sigma**2
        near, far = (near, middle) if beyond else (middle, far)
    view = pushed(far)
    found = outliers.find_outlier((view, view), outliers.candidates(view[0].evidence, turns=True))
    assert (found is not None) is named
    if found is not None:
        assert found.rows.tolist() == rows.tolist()


@cache
def warmed(rise: float = 4.0) -> Evidence:
    """Twelve positions twice, from one temperature to another."""
    evidence = session().evidence
    last = max(p.end for p in (*evidence.segments, *evidence.turns)) + 200 * 10**9
    again = [replace(s, start=s.start + last, end=s.end + last) for s in evidence.segments]
    turned = [replace(t, start=t.start + last, end=t.end + last) for t in evidence.turns]

    def over(starts: Any, ends: Any) -> Floats:
        return 20.0 + rise * (np.asarray(starts) + np.asarray(ends)) / 4 / last

    temperature: Any = SimpleNamespace(over=over, mean=20.0 + rise / 2)
    return replace(
        evidence,
        segments=(*evidence.segments, *again),
        turns=(*evidence.turns, *turned),
        temperature=temperature,
    )


def test_changes_that_a_session_does_not_tell_go_or_are_refused() -> None:
    twice = Equations(warmed())
    assert changing.with_changes(twice, ()) == (twice, ())
    found, residuals = changing.with_changes(twice, session_term('trend'))
    assert (found.changes, residuals) == (session_term('trend'), ())
    assert found.shape == 0.25
    once = session()
    few = replace(once.evidence, segments=once.evidence.segments[:1], turns=())
    with pytest.raises(NotObservable, match='two static dwells or turns before it and two after'):
        changing.with_changes(Equations(few), session_term('step'))
    with pytest.raises(NotObservable) as refused:
        changing.with_changes(Equations(few), session_term('trend:D_g'))
    text = str(refused.value)
    assert text.startswith('1 static dwell and 0 turns do not determine trend (D_gx, D_gy, D_gz)')
    assert ' apart from K_gx, ' in text
    assert text.endswith('leave it out (`terms`).')


def test_scale_factors_of_choice_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    trend, all_of = session_term('trend'), np.ones(24, bool)
    assert [c.name for c in trend[-2:]] == ['K_g', 'K_a']
    known, without_k_a = np.ones(8, bool), np.array([True] * 7 + [False])
    answers = [(without_k_a, all_of), (known[:7], all_of)]
    monkeypatch.setattr(changing, '_determined', lambda _: answers.pop(0))
    found, residuals = changing.with_changes(session(), trend)
    assert (found.changes, residuals) == (trend[:7], trend[7:])
    # Where parameters are open, too, nobody knows by which of them: both go.
    answers[:] = [(without_k_a, ~all_of), (known[:6], all_of)]
    found, residuals = changing.with_changes(session(), trend)
    assert (found.changes, residuals) == (trend[:6], trend[6:])
    # What was asked for by name stays, and is refused; and so is a bias.
    for changes in (session_term('trend:K_a'), trend[:1]):
        answers[:] = [(known[:1] & False, all_of)] * 2
        with pytest.raises(NotObservable, match=rf'trend \({changes[0].name}\): not observable'):
            changing.with_changes(session(), changes)


@pytest.mark.parametrize(('share', 'told'), [(0.99, True), (1.01, False), (np.nan, False)])
def test_a_scale_factor_is_told_to_a_thousandth_over_the_session(
    share: float, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    equations = replace(session(), changes=session_term('trend:D_ax+K_a'))
    span = changing.change_of(equations, equations.changes[0])
    std = np.ones(equations.size)
    # A bias may be as unknown as it is.
    std[-2:] = [1e9, share * 1e-3 / span]
    found: Any = SimpleNamespace(covariance=np.diag(std**2), std=std)
    monkeypatch.setattr(changing, 'nominal_information', lambda _: found)
    known, parameters = changing._determined(equations)
    assert known.tolist() == [True, told]
    assert len(parameters) == 24


def test_a_coefficient_changes_by_all_of_its_course() -> None:
    equations = replace(Equations(warmed()), shape=0.5)
    rise = changing.change_of(equations, change(Course.THERMAL, 'K_a'))
    assert rise == pytest.approx(4.0, rel=0.1)
    whole = changing.change_of(equations, change(Course.WARM_UP, 'K_a'))
    # From one to exp(-2), less what the first and the last part of the session take off.
    assert whole == pytest.approx(1 - np.exp(-2), rel=0.1)


def test_the_time_constant_is_the_one_that_explains_most_and_is_doubted_by_the_others() -> None:
    plain = Equations(warmed())
    warming = replace(plain, changes=session_term('warm_up'), shape=0.5)
    true = np.append(fit.fit(plain, fit.start(plain)), [2e-5] * 3 + [2e-2] * 3 + [1e-3] * 2)
    outputs = warming.predict(true)
    there = replace(plain, changes=session_term('warm_up'), shape=0.25)
    object.__setattr__(there, 'outputs', outputs)
    found, state = stubbed(there, outputs, changing.with_shape, true)
    assert found.shape == 0.5
    assert state[:24] == pytest.approx(true[:24], abs=1e-6)
    assert state[-8:] == pytest.approx(true[-8:], rel=1e-3, abs=1e-7)
    # Beside the others of the grid, by so much as they explain the outputs.
    doubt = stubbed(there, outputs, changing.shape_covariance, state)
    off, squares = [], []
    for fraction in [2 ** (k / 2) for k in range(-8, 3)]:
        one = replace(there, shape=fraction)
        jacobian, residuals = stubbed(one, outputs, whitened, state)
        step = np.linalg.lstsq(jacobian, residuals, rcond=1e-13)[0]
        off.append(step)
        squares.append(float(((residuals - jacobian @ step) ** 2).sum()))
    weights = np.exp(-0.5 * np.array(squares))
    wanted = sum(w * np.outer(o, o) for w, o in zip(weights, off, strict=True)) / weights.sum()
    assert doubt[:24, :24] == pytest.approx(wanted[:24, :24], rel=1e-2, abs=1e-3 * wanted.max())
    assert changing.with_shape(plain, true[:-8]) == (plain, pytest.approx(true[:-8]))
    assert changing.shape_covariance(plain, true[:-8]) is None


def test_an_instant_is_found_between_those_of_the_grid_and_doubted_by_its_neighbours() -> None:
    evidence = warmed()
    lasting = [replace(s, end=s.start + 40 * 10**9) for s in evidence.segments]
    plain = Equations(replace(evidence, segments=tuple(lasting)))
    first = plain.evidence.segments[4]
    begin = min(p.start for p in (*plain.evidence.segments, *plain.evidence.turns))
    end = max(p.end for p in (*plain.evidence.segments, *plain.evidence.turns))
    # A third of the way through a dwell; the grid has its begin and its middle.
    wanted = (2 * first.start + first.end) / 3 - begin
    stepping = replace(plain, changes=session_term('step'), shape=wanted / (end - begin))
    true = np.append(fit.fit(plain, fit.start(plain)), [2e-6] * 3 + [2e-3] * 3)
    outputs = stepping.predict(true)
    found, state = stubbed(replace(stepping, shape=0.5), outputs, changing.with_shape, true)
    assert found.shape * (end - begin) == pytest.approx(wanted, abs=0.5e9)
    # Chi-square is within one of its least: so are the coefficients, within their deviations.
    jacobian, _ = stubbed(found, outputs, whitened, state)
    std = np.sqrt(np.diag(Information.from_jacobian(jacobian).covariance))
    assert (np.abs(state - true) < std)[-6:].all()
    doubt = stubbed(found, outputs, changing.shape_covariance, state)
    # Against the integral over a fine line of instants, each with its likelihood.
    fine = found.shape + np.linspace(-3, 3, 241) * 1e9 / (end - begin)
    start, off, squares = np.append(state[:-6], np.zeros(6)), [], []
    for shape in fine.tolist():
        jacobian, residuals = stubbed(replace(found, shape=shape), outputs, whitened, start)
        step = np.linalg.lstsq(jacobian, residuals, rcond=1e-13)[0]
        off.append(start + step - state)
        squares.append(float(((residuals - jacobian @ step) ** 2).sum()))
    weights = np.exp(-0.5 * (np.array(squares) - min(squares)))
    whole = sum(w * np.outer(o, o) for w, o in zip(weights, off, strict=True)) / weights.sum()
    assert np.sqrt(np.diag(doubt)[-6:]) == pytest.approx(np.sqrt(np.diag(whole)[-6:]), rel=0.3)


def whitened(equations: Equations, state: Floats) -> tuple[Floats, Floats]:
    """Look the method up when it is called, so that the stub is."""
    return equations.whitened(state)


def stubbed(there: Equations, outputs: Floats, call: Any, state: Floats) -> Any:
    """Let equations of any time constant have these outputs."""
    kept = Equations.__dict__['whitened']

    def whitened(self: Equations, state: Floats) -> tuple[Floats, Floats]:
        jacobian, residuals = kept(self, state)
        m = len(outputs)
        return jacobian, np.append(
            np.linalg.solve(self.factor(state), outputs - self.predict(state)), residuals[m:]
        )

    patch = pytest.MonkeyPatch()
    patch.setattr(Equations, 'whitened', whitened)
    try:
        return call(there, state)
    finally:
        patch.undo()


def moved_by(rise: float, thermal: Any, std: float) -> Any:
    """An estimate whose scale factors are known to the same deviation."""
    equations = Equations(replace(warmed(rise), thermal=np.array(thermal)))
    state = equations.nominal()
    jacobian, _ = equations.whitened(state)
    gain = np.linalg.pinv(jacobian)
    covariance = std**2 * np.eye(equations.size)
    return SimpleNamespace(equations=equations, state=state, gain=gain, covariance=covariance)


def test_a_temperature_that_moved_is_said_with_what_it_means() -> None:
    assert temperature_finding(moved_by(0.0, np.zeros((2, 2)), 1e-6)) == []
    stated = moved_by(4.0, [[20 * PPM, 0.0], [3e-5, 0.0]], 1e-6)
    (text,) = temperature_finding(stated)
    assert text.startswith('The temperature moved by 3.9 K (20.0 to 23.9')
    assert text.endswith(
        'the standard deviations allow for scale factors that change by 20 ppm/K for gyros and '
        '30 ppm/K for accelerometers. To follow it, use the terms thermal or trend (`terms`).'
    )
    asked = replace(stated.equations, changes=session_term('thermal'))
    assert temperature_finding(SimpleNamespace(**{**vars(stated), 'equations': asked})) == []


def test_a_temperature_matters_where_the_cheapest_units_would_be_off_by_a_deviation() -> None:
    (text,) = temperature_finding(moved_by(4.0, np.zeros((2, 2)), 1e-6))
    assert text.startswith('Warning: The temperature moved by 3.9 K')
    assert (
        "State scale_factor_temperature of the gyros and accelerometers in the IMU's file" in text
    )
    assert ' or of accelerometers with ' in text
    # What is stated of the gyros is not asked for again.
    (text,) = temperature_finding(moved_by(4.0, [[3 * PPM, 0.0], [0.0, 0.0]], 1e-6))
    assert 'that change by 3 ppm/K for gyros; scale factors of accelerometers with' in text
    assert "State scale_factor_temperature of the accelerometers in the IMU's file" in text
    # At 200 ppm/K and 4 K everything is below a deviation of a tenth.
    assert temperature_finding(moved_by(4.0, np.zeros((2, 2)), 0.1)) == []


def test_shares_by_source_add_up_to_the_covariance_and_name_each_prior() -> None:
    found = estimate.estimate(session(1.0, known=True).evidence)
    shares = found.shares()
    whole = sum(one.covariance for one in shares.values())
    assert whole == pytest.approx(found.covariance[:24, :24], rel=1e-6, abs=1e-22)
    assert {
        ErrorSource.NOISE,
        ErrorSource.AZIMUTH,
        ErrorSource.TILT,
        ErrorSource.CLOCK,
        ErrorSource.ARM,
    } <= shares.keys()
    assert found.nuisance(Nuisance.TILT_X) == (
        found.state[25],
        pytest.approx(found.covariance[25, 25] ** 0.5),
    )
    assert found.downweighted_outputs == 0
    inflation = np.ones(len(found.equations.outputs))
    inflation[:6] = [1.0, 2.0, 3.0, 1.0, 4.0, 1.0]
    down = replace(found.equations, inflation=inflation)
    moves: Any = ('one', 'two')
    assert replace(found, equations=down, rejected_moves=moves).downweighted_outputs == 3 + 6
    between = np.arange(found.equations.size**2, dtype=float).reshape(found.equations.size, -1)
    doubted = replace(found, between=between).shares()[ErrorSource.TIME_CONSTANT]
    assert doubted.covariance.tolist() == between[:24, :24].tolist()


def weighed(
    monkeypatch: pytest.MonkeyPatch, squares: list[float], *, shown: bool, turns: bool = True
) -> tuple[Any, list[Any]]:
    """Weigh down what is found one after the other; return the estimate and what was asked."""
    asked: list[Any] = []
    residuals = list(squares)

    def scattering(equations: Any, state: Any, **more: Any) -> Any:
        asked.append(('scatter', equations.inflation is None, more))
        positioning = PositioningErrors(1e-5 if more else 2e-5, 0.0)
        return ExcessScatter(positioning, np.zeros(6), (), (), 0.5 if shown else 0.0)

    def finding(views: Any, candidates: Any) -> Any:
        (plain, _), (with_scatter, _) = views
        asked.append(
            ('find', plain.positioning.joints, with_scatter.positioning.joints, candidates)
        )
        rows = np.arange(3) + 6 * len(residuals)
        return outliers.Outlier(f'{len(residuals)}', rows, residuals.pop(0)) if residuals else None

    monkeypatch.setattr(estimate, 'excess', scattering)
    monkeypatch.setattr(estimate, 'find_outlier', finding)
    monkeypatch.setattr(estimate, 'candidates', lambda _, turns: turns)
    monkeypatch.setattr(estimate, 'fit', lambda _, state: state)
    equations = session()
    return estimate._without_outliers(equations, equations.nominal(), turns=turns), asked


def test_what_does_not_fit_counts_for_less_by_its_chi_square(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, asked = weighed(monkeypatch, [99.0, 50.0], shown=True)
    assert [one.name for one in found.outliers] == ['2', '1']
    inflation = found.equations.inflation
    assert inflation[12:15].tolist() == [100.0] * 3
    assert inflation[6:9].tolist() == [51.0] * 3
    assert inflation.sum() == len(inflation) + 3 * 99 + 3 * 50
    # The scatter is that without them, and last of all with the noise in doubt.
    looked = ('find', 0.0, 2e-5, True)
    assert asked == [
        ('scatter', True, {}),
        looked,
        ('scatter', False, {}),
        looked,
        ('scatter', False, {}),
        looked,
        ('scatter', False, {'doubted': True}),
    ]
    assert found.equations.positioning.joints == found.scatter.positioning.joints == 1e-5


def test_scatter_that_is_not_shown_leaves_the_noise_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, asked = weighed(monkeypatch, [], shown=False, turns=False)
    assert asked == [('scatter', True, {}), ('find', 0.0, 2e-5, False)]
    assert (found.outliers, found.equations.inflation) == ((), None)
    assert found.equations.positioning.joints == 2e-5


def test_no_more_than_a_third_of_the_rests_falls_out(monkeypatch: pytest.MonkeyPatch) -> None:
    # A third of twelve, and one more by which it shows that there are too many.
    found, _ = weighed(monkeypatch, [30.0] * 9, shown=False)
    assert len(found.outliers) == 5
