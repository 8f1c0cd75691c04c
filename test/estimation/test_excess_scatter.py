"""Scatter beyond the noise: its patterns by hand, and its sizes in drawn sessions."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of
from scipy.integrate import quad
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from imu_calib.common.budget import ErrorSource
from imu_calib.common.stream import Floats
from imu_calib.estimation.bias_drift import BiasDrift
from imu_calib.estimation.components import Blocks, Component
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.excess_scatter import (
    ExcessScatter,
    _hidden_variance,
    _is_fast,
    _motion_variances,
    _slope_variance,
    _Triad,
    _triads,
    excess,
    kept_share,
)
from imu_calib.estimation.positioning_errors import NO_POSITIONING_ERRORS
from imu_calib.estimation.variances import restricted
from imu_calib.model.session_terms import session_term


def normal(left: Any, covariance: Any) -> float:
    return float(multivariate_normal(np.zeros(len(left)), covariance).logpdf(left))


def triads(equations: Equations, state: Floats) -> list[_Triad]:
    usual = _hidden_variance(equations), _motion_variances(equations)
    return _triads(equations, state, *usual)


def test_variances_of_positioning_errors_are_those_that_noise_hides() -> None:
    own = np.array([9.0, 9, 9, 4, 4, 4, 9, 9, 9, 16, 16, 16])
    site, rest = SimpleNamespace(gravity=10.0), np.arange(12).reshape(2, 6)
    equations: Any = SimpleNamespace(
        own_variances=own,
        layout=SimpleNamespace(dwell=rest),
        evidence=SimpleNamespace(site=site, used_moves=[], walk=None),
    )
    # The median of 4 and 16 (m/s^2)^2, over 10 m/s^2 squared.
    assert _hidden_variance(equations) == pytest.approx(0.1)

    class Links(list):
        def variances(self, walk: Any) -> Any:
            return np.array([[0.02, 0.02, 0.02, 5.0, 5.0, 5.0]])

    equations.evidence.used_moves = Links([1])
    assert _hidden_variance(equations) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ('fast', 'length', 'swift'),
    [(True, 10_000.0, True), (False, 10_000.0, False), (True, 20_000.0, False)],
)
def test_drift_is_swift_within_a_thirtieth_of_a_session_and_sooner_than_stated(
    fast: bool, length: float, swift: bool
) -> None:
    # A thirtieth and a tenth have a seventeenth between them: 577 s of 10 000, 1155 s of 20 000.
    answers = np.tile(np.eye(3), (2, 1, 1))
    drift = BiasDrift.over(np.array([0.0, length]), np.full(2, 1.0), answers, np.zeros(2, bool))
    there: Any = SimpleNamespace(bias_drift=drift)
    assert _is_fast(there, np.array([3.0, 1, 1, 0, 0] if fast else [1.0, 3, 0, 0, 0])) is swift


@pytest.mark.parametrize('odds', [1000.0, 10.0])
@pytest.mark.parametrize('size', [1.0, 0.1])
def test_a_unit_keeps_the_mean_share_of_the_drift_that_its_data_sheet_states(
    size: float, odds: float
) -> None:
    # Of a share the standard deviation is equally probable from none to all, or it is all by odds.
    rng = np.random.default_rng(0)
    root = rng.standard_normal((12, 12))
    stated, residuals = size * root @ root.T, rng.standard_normal(12)

    def likelihood(share: float) -> float:
        return float(np.exp(normal(residuals, np.eye(12) + share * stated)))

    weight = quad(lambda s: likelihood(s * s), 0, 1)[0] + odds * likelihood(1.0)
    mean = quad(lambda s: s * s * likelihood(s * s), 0, 1)[0] + odds * likelihood(1.0)
    assert kept_share(residuals, stated, odds) == pytest.approx(mean / weight, rel=0.01)
    assert 0.02 < mean / weight < 0.98 or odds == 1000.0


def test_what_is_left_has_the_restricted_likelihood_of_the_outputs() -> None:
    rng = np.random.default_rng(0)
    jacobian, residuals = rng.standard_normal((9, 3)), rng.standard_normal(9)
    root = rng.standard_normal((9, 9))
    noise, prior = root @ root.T + np.eye(9), rng.standard_normal((2, 4))
    project, z = restricted(jacobian, residuals, noise, prior)
    assert project.shape == (9, 9 + 2 - 3)

    def log_likelihood(covariance: Any) -> float:
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
    assert gained == pytest.approx(log_likelihood(noise + more) - log_likelihood(noise))


@pytest.mark.parametrize('rounding', [0.0, 1e-16, -3e-16])
def test_columns_that_say_the_same_take_up_one_direction(rounding: float) -> None:
    rng = np.random.default_rng(1)
    jacobian, residuals = rng.standard_normal((9, 3)), rng.standard_normal(9)
    prior = np.zeros((2, 4))
    project, z = restricted(jacobian, residuals, np.eye(9), prior)
    twice = np.column_stack([jacobian, 1e-6 * (jacobian[:, 0] + rounding)])
    same, rest = restricted(twice, residuals, np.eye(9), np.zeros((2, 5)))
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
    for first, found in zip((0, 3), triads(equations, state), strict=True):
        rows = layout.gyros if first == 0 else layout.accels
        assert found.rows.tolist() == rows.tolist()
        assert found.unit_variance == np.median(equations.own_variances[layout.dwell[:, first]])
        assert found.stated_variance == pytest.approx((2e-7 if first == 0 else 3e-5) ** 2)
        # Eleven dwells have slopes, of three channels each.
        seen = [k for k in range(12) if k != 2]
        slopes = np.array(
            [equations.evidence.segments[k].statistics.drift[first : first + 3] for k in seen]
        )
        offsets = 10.0 * np.arange(12) - 55
        variance = 0.1 * equations.evidence.walk[first] ** 2 / (offsets**2).sum()
        assert found.residuals[-33:] == pytest.approx(slopes.ravel() / np.sqrt(variance))
        # What the parameters leave, and the noise in it: white, one degree for each output freed.
        white = sum(kernel for kernel, _ in found.noise)
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
    gyros, _ = triads(equations, state)
    state[-7] = 3e-9
    drifting, _ = triads(equations, state)
    # The bias of y rises by 3e-9 rad/s each second: by so much each of eleven slopes is too high.
    off = (gyros.residuals - drifting.residuals)[-33:].reshape(11, 3)
    residuals = gyros.residuals[-33:].reshape(11, 3)
    drift = equations.evidence.segments[0].statistics.drift[1]
    assert off[:, 1] == pytest.approx(np.full(11, 3e-9 * residuals[0, 1] / drift), rel=1e-6)
    assert off[:, [0, 2]] == pytest.approx(np.zeros((11, 2)), abs=1e-9)


def drifting(scale: float, kind: str) -> tuple[Equations, Floats]:
    """Twelve positions, in each of which the biases of a triad are others, by this much."""
    evidence = evidence_of(noise=np.random.default_rng(3))
    rng, first = np.random.default_rng(5), 0 if kind == 'gyros' else 3

    def off(part: Any) -> Any:
        mean = part.statistics.mean.copy()
        mean[first : first + 3] += scale * rng.standard_normal(3)
        return replace(part, statistics=replace(part.statistics, mean=mean))

    segments = tuple(off(segment) for segment in evidence.segments)
    turns = tuple(off(turn) for turn in evidence.turns)
    equations = Equations(replace(evidence, segments=segments, turns=turns))
    return equations, equations.nominal()


def test_pure_noise_shows_no_scatter() -> None:
    equations = Equations(evidence_of(noise=np.random.default_rng(3)))
    for doubted in (False, True):
        found = excess(equations, equations.nominal(), doubted=doubted)
        assert not found.shown
        assert found.positioning == NO_POSITIONING_ERRORS
        assert found.bias_drift.tolist() == [0.0] * 6


@pytest.mark.parametrize(('kind', 'scale'), [('gyros', 3e-6), ('accelerometers', 1e-3)])
def test_biases_that_differ_from_dwell_to_dwell_have_their_scatter(kind: str, scale: float) -> None:
    equations, state = drifting(scale, kind)
    found = excess(equations, state)
    first = 0 if kind == 'gyros' else 3
    # Some thirty numbers show a deviation to an eighth.
    assert found.bias_drift[first] == pytest.approx(scale, rel=0.4)
    assert found.fast_drift[first // 3]
    rows = equations.layout.gyros if first == 0 else equations.layout.accels
    parts = [c.part for c in found.extra if c.source is ErrorSource.BIAS_FOUND]
    mine = [p for p in parts if isinstance(p, Blocks) and np.array_equal(p.rows[0], rows)]
    # The bias of a dwell has all of the variance.
    assert mine[0].matrices[0][0, 0] == pytest.approx(scale**2, rel=0.8)


@pytest.mark.parametrize(('kind', 'scale'), [('gyros', 3e-6), ('accelerometers', 1e-3)])
def test_a_calm_triad_is_calm_beside_one_that_drifts(kind: str, scale: float) -> None:
    calm = 3 if kind == 'gyros' else 0
    instability = np.zeros(6)
    instability[calm : calm + 3] = 1e-5 if kind == 'accelerometers' else 1e-3

    def found(scale: float) -> ExcessScatter:
        equations, state = drifting(scale, kind)
        return excess(Equations(replace(equations.evidence, instability=instability)), state)

    alone, beside = found(0.0), found(scale)
    assert beside.shown and not alone.shown
    assert 0 < alone.bias_drift[calm] < 0.5 * instability[calm]
    assert beside.bias_drift[calm] == pytest.approx(alone.bias_drift[calm], rel=0.05)


def test_stops_that_lean_are_found_by_both_triads() -> None:
    evidence = evidence_of(noise=np.random.default_rng(3))
    rng, size = np.random.default_rng(5), 2e-4
    segments = []
    for segment in evidence.segments:
        mean = segment.statistics.mean.copy()
        mean[3:] += np.cross(mean[3:], size * rng.standard_normal(3))
        segments.append(replace(segment, statistics=replace(segment.statistics, mean=mean)))
    equations = Equations(replace(evidence, segments=tuple(segments)))
    found = excess(equations, equations.nominal())
    assert found.positioning_probability > 0.99
    whole = np.hypot(found.positioning.joints, found.positioning.stops)
    assert whole == pytest.approx(size, rel=0.5)


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
