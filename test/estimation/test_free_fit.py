"""Holds in the hand as a fit: what scatters, what is wild, clear, shown or left open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mems_by_hand import held, unit
from scipy.stats import chi2

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation import hand as free_positions
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.hand import (
    ESTIMATES,
    FREE,
    Scatter,
    _check_observable,
    _outlying_turn,
    _State,
    ellipsoid,
    in_frame_of_accelerometers,
    initial_equations,
    refuse,
    scatter_words,
    solve,
    term_words,
)
from imu_calib.estimation.hand_findings import Drift, DriftKind
from imu_calib.estimation.outputs import OutputLayout
from imu_calib.estimation.score import Family
from imu_calib.estimation.search import SignificantFamily
from imu_calib.model.parameters import PARAMETERS, Parameter
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.model.terms import G_SENSITIVITY

NAMES = [p.name for p in ESTIMATES]
RATIOS = [k for k, name in enumerate(NAMES) if name[0] in 'KE']


@dataclass(frozen=True, eq=False)
class Linear:
    """Equations of which everything is given: outputs are a matrix times the state."""

    jac: Floats
    outputs: Floats
    layout: OutputLayout
    parameters: tuple[Parameter, ...] = ESTIMATES
    inflation: Floats | None = None
    noise: float = 1.0
    north_slice = slice(21, 23)
    evidence = SimpleNamespace(segments=(0,) * 12, used_moves=(0,) * 11)

    def model(self, _: Floats) -> SensorModel:
        return SensorModel()

    def jacobian(self, _: Floats) -> Floats:
        return self.jac

    def predict(self, values: Floats) -> Floats:
        return self.jac @ values

    def covariance(self, _: Floats) -> Floats:
        return np.eye(len(self.outputs)) * self.noise**2

    def prior_rows(self, values: Floats) -> Floats:
        return np.zeros((0, self.jac.shape[1] + 1))

    def whitened(self, values: Floats) -> tuple[Floats, Floats]:
        columns = self.jac[:, : len(values)]
        std = np.ones(len(columns)) if self.inflation is None else np.sqrt(self.inflation)
        residuals = self.outputs - columns @ values
        return columns / std[:, None], residuals / std

    def moved(self, values: Floats, step: Floats) -> tuple[Linear, Floats]:
        return self, values + step


LAYOUT = OutputLayout(dwells=2, moves=3)


def state(left: Floats, columns: Floats | None = None, layout: OutputLayout = LAYOUT) -> _State:
    columns = np.zeros((len(left), 0)) if columns is None else columns
    equations: Any = Linear(columns, left, layout)
    return _State(equations, np.zeros(columns.shape[1]))


def test_groups_are_accelerometers_gyros_and_turns() -> None:
    accels, gyros, turns = state(np.zeros(21)).groups
    assert accels.tolist() == [3, 4, 5, 9, 10, 11]
    assert gyros.tolist() == [0, 1, 2, 6, 7, 8]
    assert turns.tolist() == list(range(12, 21))


@pytest.mark.parametrize(('likely', 'named'), [(0.89, []), (0.91, ['the gyros at rest'])])
def test_it_is_named_where_it_is_likely(likely: float, named: list[str]) -> None:
    scatter = Scatter(np.array([1.0, 3.0, 1.0]), np.zeros(2), np.array([0.5, likely, 0.8, 0, 0]))
    words = scatter_words(SimpleNamespace(scatter=scatter))  # type: ignore[arg-type]
    assert len(words) == len(named)
    assert all(f'{name} are 2.0 times' in w for name, w in zip(named, words, strict=True))


def sized(*sizes: float) -> Floats:
    """Residuals of turns of these sizes."""
    residuals = np.zeros(12 + 3 * len(sizes))
    residuals[12::3], residuals[13::3] = 0.6 * np.array(sizes), -0.8 * np.array(sizes)
    return residuals


@pytest.mark.parametrize(
    ('sizes', 'wanted'),
    [
        ((1.0, 1.0, 6.1), 2),
        ((1.0, 1.0, 5.9), None),
        ((0.1, 6.1, 0.1), 1),
        ((0.1, 5.9, 0.1), None),
        # Six times 2 / 1.1774, the median of a Rayleigh distribution: 10.19.
        ((2.0, 10.3, 2.0, 2.0, 2.0), 1),
        ((2.0, 10.1, 2.0, 2.0, 2.0), None),
        ((), None),
    ],
)
def test_a_turn_far_out_of_the_usual_is_found(sizes: tuple[float, ...], wanted: int | None) -> None:
    layout = OutputLayout(dwells=2, moves=len(sizes))
    residuals = sized(*sizes)
    # Headings are sought: about the vertical nothing is left.
    basis = np.zeros((len(residuals), len(sizes)))
    basis[14::3] = np.eye(len(sizes))
    assert _outlying_turn(state(residuals, None, layout), basis, residuals) == wanted


@pytest.mark.parametrize('seed', range(4))
def test_a_wild_turn_of_a_short_session_is_left_out_though_the_fit_bends_to_it(seed: int) -> None:
    rng, model = np.random.default_rng([seed, 12]), in_frame_of_accelerometers(unit(seed))
    ups = rng.standard_normal((12, 3))
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    good = held(model, ups, rng)
    assert solve(good).rejected_moves == ()
    # Half a degree, 90 times the noise of a turn: 12 unknowns of the gyros take most of it.
    wild, off = int(rng.integers(11)), rng.standard_normal(3)
    moves = list(good.moves)
    off *= 0.5 * DEG / np.linalg.norm(off) / 20
    moves[wild] = replace(moves[wild], turned=moves[wild].turned + off)
    found = solve(replace(good, moves=tuple(moves)))
    assert found.rejected_moves == (wild,)
    wrong = (found.model.vector() - model.vector())[: len(PARAMETERS)][FREE]
    covariance = found.covariance[np.ix_(*[FREE.nonzero()[0]] * 2)]
    assert wrong @ np.linalg.solve(covariance, wrong) < chi2.isf(1e-4, len(wrong))


def known_to(**std: float) -> _State:
    """A state whose parameters are known to a millionth, but for some."""
    deviations = np.array([std.get(name, 1e-6) for name in NAMES])
    with np.errstate(divide='ignore'):
        columns = np.diag(1 / deviations)
    return state(np.zeros(21), columns, OutputLayout(2, 0, 3))


def test_what_is_left_open_is_named_with_what_would_determine_it() -> None:
    _check_observable(known_to(K_ax=0.049, E_gyx=0.049, D_gx=100.0, D_az=100.0))
    with pytest.raises(NotObservable) as refused:
        _check_observable(known_to(K_ax=0.051))
    assert str(refused.value) == (
        '12 holds and 11 turns do not determine K_ax: hold the unit in more different attitudes, '
        'each axis up and down.'
    )
    with pytest.raises(NotObservable) as refused:
        _check_observable(known_to(E_gyx=0.051))
    assert str(refused.value) == (
        '12 holds and 11 turns do not determine E_gyx: turn it by a quarter turn or more about '
        'different axes between holds.'
    )
    with pytest.raises(NotObservable, match=r'D_gy, D_ax: hold .* down; turn it'):
        _check_observable(known_to(D_gy=np.inf, D_ax=np.inf))


# Terms


def test_terms_are_told_by_their_largest_coefficient_and_their_chance() -> None:
    g = np.zeros((3, 3))
    g[1, 2], g[0, 0] = -0.02 * DEG / STANDARD_GRAVITY, 0.01 * DEG / STANDARD_GRAVITY
    term = Family(G_SENSITIVITY.name, G_SENSITIVITY)
    fit: Any = SimpleNamespace(
        parameters=(*PARAMETERS, *G_SENSITIVITY.parameters),
        model=SensorModel(g_sensitivity=g),
        found=(SignificantFamily(term, float(np.log(3e-7))),),
        drifts=(),
    )
    (sentence,) = term_words(fit)
    assert 'by up to 0.02 deg/s per g' in sentence
    assert sentence.endswith('(probability of chance 3e-07): g_sensitivity is estimated, too.')
    fit.found = (SignificantFamily(term, -1e6),)
    assert 'chance 1e-99)' in term_words(fit)[0]
    fit.found = ()
    assert term_words(fit) == []


def test_drifts_are_told_by_their_size_and_their_chance() -> None:
    gyros = Drift('trend:D_g', -30.0, 0.25 * DEG)
    accels = Drift('trend:D_a', -20.0, 0.03 * STANDARD_GRAVITY)
    fit: Any = SimpleNamespace(found=(), parameters=PARAMETERS, drifts=(gyros, accels))
    (sentence,) = term_words(fit)
    assert sentence.startswith(
        'Biases drift evenly during the session, of the gyros by up to 0.25 deg/s (trend:D_g, by '
        'chance once in 10^13 sessions) and of the accelerometers by up to 30 mg (trend:D_a, by '
        'chance once in 10^9 sessions): this is estimated, and the biases stated are those of its '
        'middle. Let the unit run'
    )
    fit.drifts = (replace(accels, kind=DriftKind.UNEVEN), replace(gyros, kind=DriftKind.WANDER))
    wander, uneven = term_words(fit)
    assert wander.startswith(
        'Biases wander during the session, of the gyros by up to 0.25 deg/s: the standard '
        'deviations allow for it. Let the unit run'
    )
    assert uneven.startswith(
        'Warning: Biases drift unevenly during the session, of the accelerometers by up to 30 mg '
        '(by chance once in 10^9 sessions): no term describes this'
    )


# Whole fits


def ups(count: int) -> Floats:
    found = np.random.default_rng(12).standard_normal((count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


TRUE = in_frame_of_accelerometers(unit(3))


def test_fewer_than_nine_holds_are_too_few() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(NotObservable, match=r'^8 holds were found; gravity needs 9 or more in'):
        solve(held(TRUE, ups(8), rng))
    with pytest.raises(NotObservable, match=r'^9 holds and 8 turns|Too few attitudes'):
        solve(held(TRUE, np.tile(ups(3), (3, 1)), rng))


def test_gyros_begin_with_the_mean_at_rest_and_accelerometers_with_an_ellipsoid() -> None:
    evidence = held(TRUE, ups(12), np.random.default_rng(2))
    equations, values = initial_equations(evidence)
    outputs = evidence.outputs()
    found = dict(zip(NAMES, values.tolist(), strict=False))
    for k, axis in enumerate('xyz'):
        assert found[f'D_g{axis}'] == pytest.approx(np.mean(outputs[:, k]))
        assert found[f'K_g{axis}'] == 0.0
    wanted = ellipsoid(outputs[:, 3:], evidence.site.gravity)
    assert found['E_azx'] == pytest.approx(wanted.error_matrix[2, 0])
    assert found['D_ay'] == pytest.approx(wanted.bias[1])
    assert not values[21:].any()
    # What is up in the attitudes is what the accelerometers felt.
    true = np.linalg.solve(wanted.response, (outputs[:, 3:] - wanted.bias).T).T
    true /= np.linalg.norm(true, axis=1)[:, None]
    np.testing.assert_allclose(equations.evidence.dwell_attitudes[:, 2], true, atol=1e-12)
    # Of fewer the accelerometers are taken as ideal.
    few = dict(
        zip(NAMES, initial_equations(held(TRUE, ups(8), np.random.default_rng(2)))[1], strict=False)
    )
    assert few['K_ax'] == few['D_ax'] == 0.0


def test_holds_in_a_plane_lie_on_no_ellipsoid() -> None:
    angles = np.arange(12) * 1.3
    level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(12)]) * 9.8
    with pytest.raises(NotObservable, match='K_ax, K_ay, K_az cannot be separated'):
        ellipsoid(level, 9.8)
    # On a hyperboloid neither.
    t = np.linspace(-1, 1, 12)
    open_ = np.column_stack([np.cosh(t) * np.cos(5 * t), np.cosh(t) * np.sin(5 * t), np.sinh(t)])
    with pytest.raises(NotObservable, match='Too few attitudes: K_ax, K_ay, K_az'):
        ellipsoid(9.8 * open_, 9.8)


def test_a_fit_says_what_it_found_of_all_24() -> None:
    evidence = held(TRUE, ups(14), np.random.default_rng(3))
    found = solve(evidence)
    assert found.parameters == PARAMETERS
    assert found.found == ()
    assert not found.scatter.groups.any()
    assert found.rejected_moves == ()
    kept = [PARAMETERS.index(p) for p in PARAMETERS if p not in ESTIMATES]
    assert [PARAMETERS[k].name for k in kept] == ['E_axy', 'E_axz', 'E_ayz']
    assert not found.covariance[kept].any()
    total = sum(share.covariance for share in found.shares.values())
    np.testing.assert_allclose(total, found.covariance, atol=1e-3 * found.covariance.max())
    assert all(np.isinf(s.freedom[kept]).all() for s in found.shares.values())
    # Of 14 holds' 42 outputs nine parameters and two angles of each hold took their part.
    assert found.residuals.shape == (14, 6)
    assert np.sqrt(np.mean(found.residuals[:, 3:] ** 2)) == pytest.approx(
        1e-3 * np.sqrt((42 - 9 - 28) / 42), rel=0.9
    )
    wrong = np.abs(found.model.vector() - TRUE.vector())
    std = np.sqrt(np.diag(found.covariance))
    assert (wrong[std > 0] < 4.5 * std[std > 0]).all()


def g_sensitive_evidence(g: Floats, seed: int) -> Evidence:
    """Holds and turns whose gyros feel gravity wherever it is meanwhile."""
    them = ups(14)
    evidence = held(TRUE, them, np.random.default_rng(seed))
    segments, moves = [], []
    for segment, up in zip(evidence.segments, them, strict=True):
        mean = segment.statistics.mean + np.append(g @ up * evidence.site.gravity, np.zeros(3))
        segments.append(replace(segment, statistics=replace(segment.statistics, mean=mean)))
    for move, first, last in zip(evidence.moves, them, them[1:], strict=False):
        angle = np.arccos(first @ last)
        on = (np.arange(20)[:, None] + 0.5) / 20 * angle
        between = (np.sin(angle - on) * first + np.sin(on) * last) / np.sin(angle)
        felt = between @ g.T * evidence.site.gravity * move.seconds[:, None]
        moves.append(replace(move, turned=move.turned + felt))
    return replace(evidence, segments=tuple(segments), moves=tuple(moves))


def test_gyros_that_feel_gravity_get_a_term() -> None:
    g = np.array([[3e-4, 1e-4, 0.0], [0.0, -2e-4, 1e-4], [-1e-4, 0.0, 1e-4]])
    found = solve(g_sensitive_evidence(g, 4))
    assert found.parameters == (*PARAMETERS, *G_SENSITIVITY.parameters)
    (term,) = found.found
    assert term.log_p < np.log(1e-3)
    std = np.sqrt(np.diag(found.covariance)[24:]).reshape(3, 3)
    assert (np.abs(found.model.g_sensitivity - g) < 4.5 * std).all()
    assert std.max() < 2e-5
    assert found.covariance.shape == (33, 33)


def test_a_wild_turn_parts_a_run_in_two(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence = held(TRUE, ups(16), np.random.default_rng(5))
    monkeypatch.setattr(
        free_positions, '_outlying_turn', lambda state, *_: None if state.rejected_moves else 6
    )
    assert solve(evidence).rejected_moves == (6,)
    start = _State(*initial_equations(evidence), rejected_moves=(9,))
    start.values[:21] = np.arange(21.0)
    less = start.without_turn(4)
    assert less.rejected_moves == (4, 9)
    assert len(less.equations.evidence.moves) == 14
    assert less.values[:21].tolist() == list(range(21))
    assert not less.scatter.groups.any()
    # Two components of north of a second run, and its heading is free to choose.
    assert len(less.values) == len(start.values) + 2 - 1


def test_a_hand_that_trembles_widens_by_what_its_holds_scatter() -> None:
    evidence = held(TRUE, ups(14), np.random.default_rng(6))
    rng = np.random.default_rng(7)
    segments = []
    for segment in evidence.segments:
        mean = segment.statistics.mean + np.append(1e-3 * rng.standard_normal(3), np.zeros(3))
        segments.append(replace(segment, statistics=replace(segment.statistics, mean=mean)))
    found = solve(replace(evidence, segments=tuple(segments)))
    # 1e-3 rad/s where 2e-5 are stated, of 42 outputs.
    assert np.sqrt(found.scatter.groups[1]) == pytest.approx(50, rel=0.3)
    assert found.scatter.probability[1] > 0.99
    assert (found.scatter.probability[[0, 2, 3]] < 0.5).all()
    # It is new at every hold, which no bias is that drifts.
    assert found.drifts == ()
    assert found.changes is None


def test_turns_that_scatter_are_no_drift() -> None:
    """Of ten such sessions of twelve holds seven had errors of more than 4.5 deviations."""
    square = []
    for seed in range(6):
        rng = np.random.default_rng([seed, 8])
        them = rng.standard_normal((12, 3))
        evidence = held(TRUE, them / np.linalg.norm(them, axis=1)[:, None], rng)
        moves = []
        for move in evidence.moves:
            shaken = 5e-4 / np.sqrt(20) * rng.standard_normal((20, 3))
            moves.append(replace(move, turned=move.turned + shaken))
        found = solve(replace(evidence, moves=tuple(moves)))
        assert found.drifts == ()
        assert found.scatter.groups[2] > 0
        std = np.sqrt(np.diag(found.covariance))[FREE]
        square.append(((found.model.vector() - TRUE.vector())[FREE] / std) ** 2)
    assert np.max(square) < 4.5**2
    assert np.mean(square) == pytest.approx(1.0, abs=0.3)


def test_it_needs_what_table_sessions_lack() -> None:
    with pytest.raises(NotObservable, match='every sample between the holds'):
        refuse(SimpleNamespace())  # type: ignore[arg-type]


def test_an_axis_that_points_backwards_is_turned_round() -> None:
    accel = Triad(np.diag([-2.0, 0.0, 0.0]), np.zeros(3))
    found = in_frame_of_accelerometers(SensorModel(accel=accel)).accel
    np.testing.assert_allclose(found.response, np.eye(3), atol=1e-15)
