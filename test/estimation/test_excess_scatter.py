"""Scatter beyond the noise: likelihoods by densities, mixtures by sums, parts by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from imu_calib.common.budget import ErrorSource
from imu_calib.estimation import excess_scatter as module
from imu_calib.estimation.bias_drift import BiasDrift
from imu_calib.estimation.components import Blocks, Component
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.excess_scatter import (
    _ODDS,
    _RATIOS,
    _SHARES,
    _TIMES,
    ExcessScatter,
    _Drift,
    _likeliest,
    _pooled,
    _positioning,
    _PositioningOfTriad,
    _posterior_drift,
    _restricted,
    _slope_variance,
    _Triad,
    _triads,
    _variances,
    excess,
)
from imu_calib.estimation.positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors
from imu_calib.model.session_terms import session_term

SIZE = 6
ODDS = np.log(np.array([0.1, 0.2, 0.3, 0.4]))


def normal(left: Any, covariance: Any) -> float:
    return float(multivariate_normal(np.zeros(len(left)), covariance).logpdf(left))


def square(seed: int, rank: int = SIZE) -> Any:
    root = np.random.default_rng(seed).standard_normal((SIZE, rank))
    return root @ root.T


def still(count: int = 2) -> BiasDrift:
    """Rests of 100 s at the beginning and the end of a session of 10 000 s."""
    starts = np.linspace(0.0, 9900.0, count)
    answers = np.tile(np.eye(3), (count, 1, 1))
    return BiasDrift.over(starts, np.full(count, 100.0), answers, np.zeros(count, bool))


def triad(**changed: Any) -> _Triad:
    """Six outputs of which everything may be given; all that is not is none."""
    nothing = np.zeros((SIZE, SIZE))
    joints, stops = np.random.default_rng(9).standard_normal((2, SIZE, 2))
    found = _Triad(
        rows=np.arange(10, 10 + SIZE),
        residuals=np.array([1.0, -2.0, 0.5, 3.0, -1.0, 2.0]),
        stated_covariance=nothing,
        further_covariances=(nothing,) * len(_TIMES),
        positioning=(joints, stops),
        noise=(),
        bias_drift=still(),
        unit_variance=4.0,
        stated_variance=9.0,
        log_odds=ODDS,
        in_motion=np.zeros((SIZE, 0)),
        motion_variance=0.0,
    )
    return replace(found, **changed)


def drifts(rank: int = SIZE) -> dict[str, Any]:
    """Covariances of the drift stated and of further ones, of this rank."""
    further = tuple(square(k, rank) for k in range(2, 7))
    return {'stated_covariance': square(1), 'further_covariances': further}


def test_cases_are_as_likely_as_their_densities_say() -> None:
    there = triad(
        stated_covariance=square(1), further_covariances=tuple(square(k, 2) for k in range(2, 7))
    )
    joints, stops = (p @ p.T for p in there.positioning)
    base = np.eye(SIZE) + 0.3 * joints + 0.7 * stops
    calm, beyond = there.drift_likelihoods(0.3, 0.7)
    constant = normal(np.zeros(SIZE), np.eye(SIZE))
    wanted = [
        normal(there.residuals, base + s * there.stated_covariance) for s in (0, 1 / 16, 1 / 4, 1)
    ]
    assert calm + constant == pytest.approx(np.array(wanted))
    # Half decades of 10^-1.5 to 10^8, on top of all that is stated.
    ratios = [10 ** (-1.5 + k / 2) for k in range(20)]
    wanted_beyond = [
        [normal(there.residuals, base + there.stated_covariance + r * kernel) for r in ratios]
        for kernel in there.further_covariances
    ]
    assert beyond + constant == pytest.approx(np.array(wanted_beyond), rel=1e-6)


def test_kinds_of_positioning_errors_split_one_variance() -> None:
    there, drift = triad(), square(3)
    joints, stops = (p @ p.T for p in there.positioning)
    found = there.positioning_likelihoods(drift, np.array([0.5, 20.0]))
    constant = normal(np.zeros(SIZE), np.eye(SIZE))
    for share, line in zip((0.0, 0.1, 0.5, 0.9, 1.0), found, strict=True):
        for size, value in zip((0.5, 20.0), line, strict=True):
            whole = np.eye(SIZE) + drift + size * ((1 - share) * joints + share * stops)
            assert value + constant == pytest.approx(normal(there.residuals, whole))


def test_a_drift_is_a_share_of_what_is_stated_and_what_comes_on_top() -> None:
    there = triad(
        stated_covariance=square(1), further_covariances=tuple(square(k) for k in range(2, 7))
    )
    found = there.drift_covariance(0.25, 3, 7.0)
    assert found == pytest.approx(
        0.25 * there.stated_covariance + 7.0 * there.further_covariances[3]
    )
    assert there.drift_covariance(0.5, 3, 0.0) == pytest.approx(0.5 * there.stated_covariance)


def test_noise_gains_beside_drift_and_positioning_errors_alike() -> None:
    columns = np.eye(SIZE)[:, :3]
    there = triad(noise=((columns, 4.0),))
    # The same covariance however it comes about.
    whole = 0.3 * there.positioning[0] @ there.positioning[0].T
    by_drift = there.gain_by_larger_noise(whole)
    assert by_drift > 0.1
    assert there.gain_by_larger_noise(0 * whole, 0.3, 0.0) == pytest.approx(by_drift, rel=1e-6)
    assert triad().gain_by_larger_noise(whole) == 0.0


def weighed(calm: list[float], beyond: Any) -> Any:
    """A triad whose log likelihoods are given, and whose noise gains are of no account."""
    there = triad(
        stated_covariance=square(1), further_covariances=tuple(square(k) for k in range(2, 7))
    )
    answers = (np.array(calm), np.asarray(beyond, dtype=float))
    gains = iter((5.0, 8.0))
    object.__setattr__(there, 'drift_likelihoods', lambda joints, stops: answers)
    object.__setattr__(there, 'gain_by_larger_noise', lambda drift, joints, stops: next(gains))
    return there


def test_what_is_stated_counts_by_odds_and_what_is_beyond_by_an_even_spread() -> None:
    beyond = np.full((5, 20), -3.0)
    found = _Drift.weighed(weighed([0.0, 0.0, 0.0, 1.0], beyond))
    known = 0.1 + 0.2 + 0.3 + 0.4 * np.e
    assert found.known == pytest.approx(np.log(known))
    assert found.unknown == pytest.approx(-3.0)
    assert found.highest == pytest.approx(-3.0)
    assert not found.called_for
    calm, none = found.weights()
    assert calm == pytest.approx(np.array([0.1, 0.2, 0.3, 0.4 * np.e]) / known)
    assert none.shape == (5, 20)
    assert not none.any()


def test_drift_beyond_is_called_for_at_three_deviations_and_takes_all_the_weight() -> None:
    # Half of chi-square 9; one of a hundred cases has it.
    for height, asked in ((4.49, False), (4.51, True)):
        beyond = np.full((5, 20), -50.0)
        beyond[2, 7] = height
        found = _Drift(np.log([0.25] * 4), beyond - np.log(100.0))
        assert found.highest == pytest.approx(height)
        assert found.known == pytest.approx(0.0)
        assert found.called_for is asked
        calm, by_ratio = found.weights()
        assert calm.sum() == pytest.approx(float(not asked))
        assert by_ratio[2, 7] == pytest.approx(float(asked))
        assert by_ratio.sum() == pytest.approx(float(asked))


def test_larger_noise_takes_from_the_drift_that_is_called_for_what_it_explains() -> None:
    beyond = np.full((5, 20), -50.0)
    beyond[2, 7] = 30.0
    found = _Drift.weighed(weighed([0.0] * 4, beyond))
    # Noise gains 5 beside the known, 8 beside the other: the drift is three more likely.
    assert found.highest == pytest.approx(30.0 + 3.0)
    assert found.known == pytest.approx(0.0)


def test_hypotheses_are_the_likeliest_of_either_kind() -> None:
    there = triad(
        stated_covariance=square(1), further_covariances=tuple(square(k) for k in range(2, 7))
    )
    calm = np.array([0.5, 2.0, 1.0, 0.0]) + ODDS
    beyond = np.full((5, 20), -9.0)
    beyond[1, 4], beyond[3, 0] = 3.0, 2.0
    found = _Drift(calm, beyond - np.log(100.0))
    (known, first), (unknown, second) = found.hypotheses(there)
    # The weight of the likeliest share is that of all of them, less its own likelihood.
    assert known == pytest.approx(np.log(np.exp(calm).sum()) - 2.0)
    assert first == pytest.approx(there.stated_covariance / 16)
    assert unknown == pytest.approx(np.log(np.exp(beyond).sum() / 100) - 3.0)
    assert second == pytest.approx(there.stated_covariance + 10**0.5 * there.further_covariances[1])


def positioned(size: float) -> list[_Triad]:
    """Gyros and accelerometers without any drift, whose stops scatter by so many deviations."""
    rng = np.random.default_rng(4)
    found = []
    for _ in range(2):
        joints, stops = rng.standard_normal((2, SIZE, 4))
        residuals = rng.standard_normal(SIZE) + size * stops @ rng.standard_normal(4)
        found.append(triad(residuals=residuals, positioning=(joints, stops)))
    return found


VARIANCES = np.array([0.1, 3.0, 100.0])
KINDS = (0.0, 0.1, 0.5, 0.9, 1.0)


def grid(triads: list[_Triad]) -> tuple[Any, float]:
    """Likelihoods of positioning errors by both triads, over that of none; and their sum."""
    none = sum(normal(t.residuals, np.eye(SIZE)) for t in triads)
    found = np.zeros((5, 3))
    for (k, v), _ in np.ndenumerate(found):
        for t in triads:
            joints, stops = (p @ p.T for p in t.positioning)
            mixed = (1 - KINDS[k]) * joints + KINDS[k] * stops
            found[k, v] += normal(t.residuals, np.eye(SIZE) + VARIANCES[v] * mixed)
    return np.exp(found - none), float(np.exp(found - none).mean())


@pytest.mark.parametrize('size', [0.9, 1.2, 5.0])
def test_positioning_errors_are_the_mean_of_their_posterior(size: float) -> None:
    triads = positioned(size)
    drifts = [_Drift.weighed(t) for t in triads]
    share, joints, stops = _positioning(triads, drifts, VARIANCES)
    each, mean = grid(triads)
    # Without any drift its three hypotheses are one: nine pairs of them for positioning errors,
    # and of the four pairs of known and beyond the three that are not known beforehand.
    assert 9 * each.max() > np.exp(4.5)
    exact = 9 * mean / (9 * mean + 3)
    assert share == pytest.approx(exact if exact < 0.999 else 1.0)
    weights = each / each.sum()
    split = np.array(KINDS)[:, None]
    assert joints == pytest.approx((weights * (1 - split) * VARIANCES).sum())
    assert stops == pytest.approx((weights * split * VARIANCES).sum())


def test_positioning_errors_that_the_likelihood_does_not_ask_for_are_none() -> None:
    triads = positioned(0.0)
    assert 9 * grid(triads)[0].max() < np.exp(4.5)
    assert _positioning(triads, [_Drift.weighed(t) for t in triads], VARIANCES) == (0.0, 0.0, 0.0)


def test_noise_that_explains_as_much_leaves_no_positioning_errors() -> None:
    plain = positioned(1.2)
    drifts = [_Drift.weighed(t) for t in plain]
    shares = [
        _positioning([replace(t, noise=((np.eye(SIZE), nu),)) for t in plain], drifts, VARIANCES)[0]
        for nu in (np.inf, 10.0, 0.01)
    ]
    # The better the size of the outputs' noise is known the less it explains.
    assert shares[0] > 0.999 > shares[1] > 0.5
    assert shares[2] == 0.0


def test_noise_counts_where_positioning_errors_are_likeliest() -> None:
    lines = [np.array([[0.0, 1.0], [2.0, 9.0]]), np.array([[8.0, 0.0], [0.0, 3.0]])]
    variances = np.array([10.0, 20.0])
    asked = []

    def gains(drift: float, joints: float = 0.0, stops: float = 0.0) -> float:
        asked.append((drift, joints, stops))
        return 10 * drift + joints + stops

    def of_drifts(*drifts: float) -> _PositioningOfTriad:
        of_each = dict(zip(drifts, lines, strict=True))
        still: Any = SimpleNamespace(hypotheses=lambda _: [(0.0, drift) for drift in drifts])
        triad: Any = SimpleNamespace(
            gain_by_larger_noise=gains, positioning_likelihoods=lambda drift, _: of_each[drift]
        )
        return _PositioningOfTriad(triad, still, variances)

    each = [of_drifts(1.0, 2.0), of_drifts(4.0, 6.0)]
    together = _pooled(each)
    likeliest = _likeliest(together, variances)
    found = sum(one.gain_by_larger_noise(int(together.argmax()), *likeliest) for one in each)
    # Kind 1 of size 1 is likeliest, by the first of the hypotheses: a tenth of 20 is of stops.
    assert asked == [(1.0, 18.0, 2.0), (1.0, 0.0, 0.0), (4.0, 18.0, 2.0), (4.0, 0.0, 0.0)]
    assert found == pytest.approx(2 * 20.0)


def test_variances_of_positioning_errors_begin_at_a_tenth_of_what_noise_hides() -> None:
    own = np.array([9.0, 9, 9, 4, 4, 4, 9, 9, 9, 16, 16, 16])
    site, rest = SimpleNamespace(gravity=10.0), np.arange(12).reshape(2, 6)
    equations: Any = SimpleNamespace(
        own_variances=own,
        layout=SimpleNamespace(dwell=rest),
        evidence=SimpleNamespace(site=site, used_moves=[], walk=None),
    )
    half_decades = [10 ** (-1 + k / 2) for k in range(15)]
    # The median of 4 and 16 (m/s^2)^2, over 10 m/s^2 squared.
    assert _variances(equations) == pytest.approx(np.array(half_decades) * 0.1)

    class Links(list):
        def variances(self, walk: Any) -> Any:
            return np.array([[0.02, 0.02, 0.02, 5.0, 5.0, 5.0]])

    equations.evidence.used_moves = Links([1])
    assert _variances(equations) == pytest.approx(np.array(half_decades) * 0.02)


def mixture() -> list[tuple[float, _Drift]]:
    """A quarter for drift as it is stated, three quarters for one beyond it."""
    quiet = _Drift(np.log([0.1, 0.2, 0.3, 0.4]), np.full((5, 20), -60.0))
    beyond = np.full((5, 20), -60.0)
    beyond[1, 3] = beyond[4, 10] = 30.0
    return [(0.25, quiet), (0.75, _Drift(quiet.stated, beyond))]


def test_drift_is_the_mean_of_its_posterior() -> None:
    there = triad()
    deviation, parts, spared, swift = _posterior_drift(there, mixture())
    # Shares of 0, 1/16, 1/4 and 1 of what is stated; beyond it all of that.
    stated = 0.25 * (0.2 / 16 + 0.3 / 4 + 0.4) + 0.75
    ratios = 10**0.0, 10**3.5
    size = stated * 9.0 + 0.375 * (ratios[0] + ratios[1]) * 4.0
    assert deviation == pytest.approx(np.sqrt(size))
    span = there.bias_drift.span
    kernels = [there.bias_drift.kernel(t) for t in (1000 / span, 0.1, 3.0)]
    assert [part.source for part in parts] == [ErrorSource.BIAS_STATED, ErrorSource.BIAS_FOUND]
    assert dense(parts[0]) == pytest.approx(stated * 9.0 * kernels[0])
    found = 4.0 * 0.375 * (ratios[0] * kernels[1] + ratios[1] * kernels[2])
    assert dense(parts[1]) == pytest.approx(found)
    assert [part.source for part in spared] == [ErrorSource.BIAS_STATED]
    assert dense(spared[0]) == pytest.approx((1 - stated) * 9.0 * kernels[0])
    assert not swift
    assert dense(parts[0]).shape == (SIZE, SIZE)


def dense(component: Component) -> Any:
    assert isinstance(component.part, Blocks)
    (rows,), (matrix,) = component.part.rows, component.part.matrices
    assert rows.tolist() == list(range(10, 10 + SIZE))
    return matrix


def test_without_a_data_sheet_nothing_is_stated_and_nothing_spared() -> None:
    quiet = _Drift(np.log([0.1, 0.2, 0.3, 0.4]), np.full((5, 20), -60.0))
    assert _posterior_drift(triad(stated_variance=0.0), [(1.0, quiet)]) == (0.0, (), (), False)


@pytest.mark.parametrize(
    ('time', 'length', 'swift'), [(0, 10_000.0, True), (1, 10_000.0, False), (0, 20_000.0, False)]
)
def test_drift_is_swift_within_a_thirtieth_of_a_session_and_sooner_than_stated(
    time: int, length: float, swift: bool
) -> None:
    # A thirtieth and a tenth have a seventeenth between them: 577 s of 10 000, 1155 s of 20 000.
    beyond = np.full((5, 20), -60.0)
    beyond[time, 5] = 30.0
    answers = np.tile(np.eye(3), (2, 1, 1))
    drift = BiasDrift.over(np.array([0.0, length]), np.full(2, 1.0), answers, np.zeros(2, bool))
    found = _posterior_drift(triad(bias_drift=drift), [(1.0, _Drift(np.log([0.25] * 4), beyond))])
    assert found[3] is swift


def test_what_is_left_has_the_restricted_likelihood_of_the_outputs() -> None:
    rng = np.random.default_rng(0)
    jacobian, residuals = rng.standard_normal((9, 3)), rng.standard_normal(9)
    root = rng.standard_normal((9, 9))
    noise, prior = root @ root.T + np.eye(9), rng.standard_normal((2, 4))
    project, z = _restricted(jacobian, residuals, noise, prior)
    assert project.shape == (9, 9 + 2 - 3)

    def restricted(covariance: Any) -> float:
        """Patterson and Thompson: outputs and priors, less what the parameters take up."""
        inverse = np.linalg.inv(block_diag(covariance, np.eye(2)))
        design, y = np.vstack([jacobian, prior[:, :3]]), np.append(residuals, prior[:, 3])
        told = design.T @ inverse @ design
        rest = y - design @ np.linalg.solve(told, design.T @ inverse @ y)
        logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(told)[1]
        return float(-0.5 * (logs + rest @ inverse @ rest))

    scatter = rng.standard_normal((9, 4))
    more = scatter @ scatter.T
    gained = normal(z, np.eye(8) + project.T @ more @ project) - normal(z, np.eye(8))
    assert gained == pytest.approx(restricted(noise + more) - restricted(noise))


@pytest.mark.parametrize('rounding', [0.0, 1e-16, -3e-16])
def test_columns_that_say_the_same_take_up_one_direction(rounding: float) -> None:
    rng = np.random.default_rng(1)
    jacobian, residuals = rng.standard_normal((9, 3)), rng.standard_normal(9)
    prior = np.zeros((2, 4))
    project, z = _restricted(jacobian, residuals, np.eye(9), prior)
    twice = np.column_stack([jacobian, 1e-6 * (jacobian[:, 0] + rounding)])
    same, rest = _restricted(twice, residuals, np.eye(9), np.zeros((2, 5)))
    assert same.shape == project.shape
    assert same @ same.T == pytest.approx(project @ project.T, abs=1e-9)
    assert rest @ rest == pytest.approx(z @ z)


def test_a_slope_varies_as_the_line_through_its_blocks() -> None:
    # Blocks at 10, 20 and 30 s: their line rises by half of the last less the first, over 10 s.
    blocks = np.array([[0.0, 0.1, 5.0, 10.0], [0.0, 0.2, 6.0, 20.0], [0.0, 0.3, 7.0, 30.0]])
    walk, whole = _slope_variance(blocks, 3.0)
    assert walk == pytest.approx(9 * (0.1 + 0.3) / 20**2)
    assert whole == pytest.approx((9 * (0.1 + 0.3) + 5 + 7) / 20**2)
    # Without noise the smallest variance that is claimed: 1e-24.
    none = _slope_variance(blocks * [0, 0, 0, 1], 3.0)
    assert none == (0.0, pytest.approx(2e-24 / 20**2))


def session() -> Equations:
    """Twelve positions whose dwells have blocks, of gyros and accelerometers that drift as said."""
    evidence = evidence_of(noise=np.random.default_rng(1))
    rng, second = np.random.default_rng(2), 10**9
    segments = []
    for k, segment in enumerate(evidence.segments):
        # The third has three blocks only, which give no slope.
        count = 3 if k == 2 else 12
        block = np.column_stack(
            [np.zeros(count), np.full(count, 0.1), np.zeros(count), 5.0 + 10 * np.arange(count)]
        )
        there = replace(
            segment.statistics,
            blocks=(block,) * 6,
            drift=rng.standard_normal(6) * np.repeat([1e-9, 1e-7], 3),
        )
        end = segment.start + 120 * second
        segments.append(replace(segment, statistics=there, end=end))
    # The second turn is one by hand, whose accelerometers do not count.
    by_hand = replace(evidence.turns[1], seconds=None)
    turns = (evidence.turns[0], by_hand, *evidence.turns[2:])
    instability = np.repeat([2e-7, 3e-5], 3)
    freedom = np.array([11.0, 12, 13, 14, 15, 16])
    return Equations(
        replace(
            evidence,
            segments=tuple(segments),
            turns=turns,
            instability=instability,
            walk_freedom=freedom,
        )
    )


def test_gyros_and_accelerometers_are_cut_out_with_their_slopes_and_their_noise() -> None:
    equations = session()
    state = equations.nominal()
    layout = equations.layout
    for first, found in zip((0, 3), _triads(equations, state, 1000.0), strict=True):
        rows = layout.gyros if first == 0 else layout.accels
        assert found.rows.tolist() == rows.tolist()
        assert found.unit_variance == np.median(equations.own_variances[layout.dwell[:, first]])
        assert found.stated_variance == pytest.approx((2e-7 if first == 0 else 3e-5) ** 2)
        odds = np.array([1 / 3, 1 / 3, 1 / 3, 1000]) / 1001
        assert np.exp(found.log_odds) == pytest.approx(odds)
        # Eleven dwells have slopes, of three channels each.
        seen = [k for k in range(12) if k != 2]
        slopes = np.array(
            [equations.evidence.segments[k].statistics.drift[first : first + 3] for k in seen]
        )
        offsets = 10.0 * np.arange(12) - 55
        variance = 0.1 * equations.evidence.walk[first] ** 2 / (offsets**2).sum()
        assert found.residuals[-33:] == pytest.approx(slopes.ravel() / np.sqrt(variance))
        # What the parameters leave, and the noise in it: white, one degree for each output freed.
        white = sum(columns @ columns.T for columns, _ in found.noise)
        # Less what is no walk of each output: the level Earth rate that turns leave, say.
        assert np.diag(white).max() < 1 + 1e-6
        assert np.diag(white).sum() == pytest.approx(len(white), rel=0.1)
        assert white[-33:, -33:] == pytest.approx(np.eye(33))
        assert white[-33:, :-33] == pytest.approx(np.zeros((33, len(white) - 33)))
        assert [freedom for _, freedom in found.noise] == [11 + first, 12 + first, 13 + first]
        assert len(found.bias_drift.segment) == len(rows) // 3 + 11
        # The first node is a sixteenth into the first turn, of 36 s; a rest of 120 s comes after
        # six turns, 100 s from one to the next.
        assert found.bias_drift.nodes.min() == pytest.approx(36 / 16)
        assert found.bias_drift.nodes[0] == pytest.approx(600 + 120 * (np.arange(8) + 0.5) / 8)


def test_slopes_are_what_is_left_of_drifts_that_are_estimated() -> None:
    equations = replace(session(), changes=session_term('trend'))
    state = np.append(session().nominal(), np.zeros(8))
    gyros, _ = _triads(equations, state, 1000.0)
    state[-7] = 3e-9
    drifting, _ = _triads(equations, state, 1000.0)
    # The bias of y rises by 3e-9 rad/s each second: by so much each of eleven slopes is too high.
    off = (gyros.residuals - drifting.residuals)[-33:].reshape(11, 3)
    residuals = gyros.residuals[-33:].reshape(11, 3)
    drift = equations.evidence.segments[0].statistics.drift[1]
    assert off[:, 1] == pytest.approx(np.full(11, 3e-9 * residuals[0, 1] / drift), rel=1e-6)
    assert off[:, [0, 2]] == pytest.approx(np.zeros((11, 2)), abs=1e-9)


def test_scatter_of_a_session_is_that_of_both_triads_and_their_positions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    equations = session()
    state = equations.nominal()
    monkeypatch.setattr(module, '_positioning', lambda *_: (0.25, 4e-10, 1e-10))
    found = excess(equations, state)
    # Positioning errors by their probability: a quarter of the variances.
    assert found.positioning == PositioningErrors(pytest.approx(1e-5), pytest.approx(5e-6))
    assert found.positioning_probability == 0.25
    assert found.shown
    triads = [replace(t, noise=()) for t in _triads(equations, state, _ODDS)]
    spread = [
        _posterior_drift(t, [(0.75, _Drift.weighed(t)), (0.25, _Drift.weighed(t, 4e-10, 1e-10))])
        for t in triads
    ]
    deviations = np.repeat([spread[0][0], spread[1][0]], 3)
    assert found.bias_drift == pytest.approx(deviations)
    wanted = [part for _, parts, _, _ in spread for part in parts]
    for one, other in zip(found.extra, wanted, strict=True):
        assert one.source is other.source
        assert one.part.matrices == pytest.approx(other.part.matrices)  # type: ignore[attr-defined]
    spared = [part for _, _, its, _ in spread for part in its]
    for one, other in zip(found.absent_drift, spared, strict=True):
        assert one.part.matrices == pytest.approx(other.part.matrices)  # type: ignore[attr-defined]
    assert found.fast_drift == (spread[0][3], spread[1][3])


def test_beside_outliers_the_data_sheet_has_ten_to_one_and_doubt_lets_noise_grow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = []

    def watched(triads: Any, *_: Any) -> tuple[float, float, float]:
        asked.append((np.exp(triads[0].log_odds[-1]), len(triads[0].noise)))
        return 0.0, 0.0, 0.0

    monkeypatch.setattr(module, '_positioning', watched)
    equations = session()
    state = equations.nominal()
    for doubted, suspecting in ((False, False), (True, False), (False, True)):
        found = excess(equations, state, doubted=doubted, suspecting=suspecting)
        assert found.positioning == NO_POSITIONING_ERRORS
    wanted = [(1000 / 1001, 0), (1000 / 1001, 3), (10 / 11, 0)]
    for got, (odds, count) in zip(asked, wanted, strict=True):
        assert got == (pytest.approx(odds), count)


def test_a_session_without_rests_or_without_noise_shows_no_scatter() -> None:
    equations = session()
    quiet = replace(equations.evidence, walk=np.zeros(6))
    for evidence in (replace(equations.evidence, segments=()), quiet):
        there = replace(equations, evidence=evidence)
        found = excess(there, there.nominal())
        assert found.positioning == NO_POSITIONING_ERRORS
        assert found.bias_drift.tolist() == [0.0] * 6
        assert found.extra == found.absent_drift == ()
        assert not found.shown
        assert found.fast_drift == (False, False)


def test_scatter_is_shown_where_something_is_not_known_beforehand() -> None:
    stated, beyond = (
        Component(source, Blocks(np.arange(1)[None], np.eye(1)[None]))
        for source in (ErrorSource.BIAS_STATED, ErrorSource.BIAS_FOUND)
    )
    known = ExcessScatter(NO_POSITIONING_ERRORS, np.zeros(6), (stated,))
    assert not known.shown
    assert replace(known, extra=(stated, beyond)).shown
    assert replace(known, positioning_probability=0.1).shown
    assert replace(known, extra=(stated, beyond)).stated == (stated,)


def test_what_is_tried_reaches_from_nothing_to_thousands_of_times_the_noise() -> None:
    assert np.array(_TIMES) == pytest.approx([1 / 30, 1 / 10, 1 / 3, 1, 3])
    assert np.log10(_RATIOS) == pytest.approx(np.arange(20) / 2 - 1.5)
    assert _SHARES.tolist() == [0, 1 / 16, 1 / 4, 1]
