"""A closed form held against its data: what widens, what is seen of the world, what is said."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import ACCEL_WALK, GYRO_WALK, SITE, evidence_of, statistics
from scipy.spatial.transform import Rotation

from imu_calib.common.budget import ErrorSource, Share
from imu_calib.common.errors import Contradiction, InputError
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG, DEG_H
from imu_calib.estimation.conclusion import _Fit, _fit, _residuals, _Scatter, _tilt, conclude
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.methods import method
from imu_calib.estimation.solution import Solution
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.session.plan import load_plan

TRUE = SensorModel(
    Triad(np.array([[1e-3, 2e-4, 0], [-3e-4, -2e-3, 1e-4], [0, 5e-4, 1e-3]]), np.full(3, 2e-6)),
    Triad(np.array([[2e-3, 1e-4, 0], [-2e-4, 1e-3, 3e-4], [1e-4, 0, -1e-3]]), np.full(3, 5e-3)),
)
VARIANCES = np.arange(1.0, 25.0)
CLEAN = evidence_of(model=TRUE)
RESTS = len(CLEAN.segments)


def with_errors(evidence: Evidence, off: Floats, seconds: Floats | None = None) -> Evidence:
    """The session with (s, 6) errors of its means at rest, and dwells of other lengths."""
    seconds = (
        np.array([s.statistics.duration for s in evidence.segments]) if seconds is None else seconds
    )
    segments = tuple(
        replace(s, statistics=statistics(s.statistics.mean + row, float(long)))
        for s, row, long in zip(evidence.segments, off, seconds, strict=True)
    )
    return replace(evidence, segments=segments)


def concluded(evidence: Evidence, *, accels: bool = False, north: bool = False) -> Solution:
    variances = VARIANCES.copy()
    if not accels:
        variances[12:] = np.nan
    shares = {ErrorSource.NOISE: Share.known(np.diag(variances))}
    gain = np.full((24, 3), 2.0)
    return conclude(evidence, TRUE, shares, 3.5, gain=gain, findings=['First.'], north_known=north)


def fitted(evidence: Evidence, first: int) -> _Fit:
    equations = Equations(evidence)
    return _fit(equations, np.append(TRUE.vector(), np.zeros(equations.nuisances)), first)


def least_squares(rows: Any, wanted: Any, std: Any) -> tuple[Floats, Floats, float]:
    """Return what rows (m, n) give of (m,) outputs, its covariance, and chi-square."""
    rows, wanted, std = (np.array(one, dtype=float) for one in (rows, wanted, std))
    matrix = rows / std[:, None]
    found = np.linalg.lstsq(matrix, wanted / std, rcond=None)[0]
    square = float(np.sum((wanted / std - matrix @ found) ** 2))
    return found, np.linalg.inv(matrix.T @ matrix), square


def test_a_sound_session_is_concluded_as_it_is() -> None:
    found = concluded(evidence_of(model=TRUE, azimuth=0.3))
    assert found.findings == ('First.',)
    assert found.condition == 3.5
    assert np.diag(found.covariance)[:12].tolist() == VARIANCES[:12].tolist()
    assert (found.gain == 2.0).all()
    assert found.shares is not None
    assert list(found.shares) == [ErrorSource.NOISE, ErrorSource.SCATTER]
    assert not found.shares[ErrorSource.SCATTER].covariance[:12, :12].any()
    assert np.isinf(found.shares[ErrorSource.SCATTER].freedom).all()
    # Twelve dwells of 120 s; up, east and north each are seen by one channel's worth of all.
    std = GYRO_WALK / np.sqrt(12 * 120)
    assert found.azimuth == pytest.approx(0.3, abs=1e-6)
    assert found.azimuth_std == pytest.approx(std / SITE.north_rate, rel=2e-3)
    assert found.earth_up == pytest.approx(SITE.up_rate, rel=1e-6)
    assert found.earth_up_std == pytest.approx(std, rel=2e-3)


def test_residuals_are_those_of_each_dwell() -> None:
    found = concluded(CLEAN)
    assert [r.position for r in found.residuals] == [str(k) for k in range(1, 13)]
    assert [r.start for r in found.residuals] == [s.start for s in CLEAN.segments]
    for residual in found.residuals:
        assert np.abs(residual.value[:3]).max() < 1e-12
        assert np.isnan(residual.value[3:]).all()
        wanted = np.repeat([GYRO_WALK, ACCEL_WALK], 3) / np.sqrt(120)
        assert residual.std == pytest.approx(wanted)
    fit: Any = SimpleNamespace(residuals=np.arange(36.0).reshape(12, 3))
    both: Any = SimpleNamespace(residuals=-np.arange(36.0).reshape(12, 3))
    third = _residuals(CLEAN, fit, both)[2]
    assert third.value.tolist() == [6, 7, 8, -6, -7, -8]


def gyro_rows(evidence: Evidence, stated: float = 0.0) -> tuple[Floats, Floats, float]:
    """The Earth rate and a common offset, by least squares over all dwells."""
    rows, wanted, std = [], [], []
    for segment in evidence.segments:
        for channel in range(3):
            seen = TRUE.gyro.response[channel] @ segment.attitude.T
            rows.append([*seen, *np.eye(3)[channel]])
            wanted.append(segment.statistics.mean[channel] - TRUE.gyro.bias[channel])
            own = GYRO_WALK**2 / segment.statistics.duration
            std.append(np.sqrt(own + (stated * 7.292115e-5) ** 2))
    return least_squares(rows, wanted, std)


def test_gyros_that_scatter_from_dwell_to_dwell_are_widened_by_that() -> None:
    # The two of a group of one axis err against each other.
    off, seconds = np.zeros((RESTS, 6)), np.linspace(60, 200, RESTS)
    off[:, :3] = 1e-5 * np.outer(np.tile([1, -1], 6), [1, -2, 1.5])
    evidence = with_errors(CLEAN, off, seconds)
    vector, covariance, square = gyro_rows(evidence)
    ratio = square / (36 - 6)
    assert ratio > 3
    found = concluded(evidence)
    wanted = VARIANCES[:12] * ratio
    assert np.diag(found.covariance)[:12] == pytest.approx(wanted, rel=1e-9)
    assert found.earth_up == pytest.approx(vector[2], rel=1e-9)
    assert found.earth_up_std == pytest.approx(np.sqrt(covariance[2, 2] * ratio), rel=1e-9)
    assert found.findings[1] == (
        f'Between positions the gyros scatter {np.sqrt(ratio):.1f} times more than within '
        'them: their standard deviations are widened. Possible causes: positioning errors that the '
        'table does not state, and drift.'
    )
    assert found.shares is not None
    added = found.shares[ErrorSource.SCATTER]
    assert np.diag(added.covariance)[:12] == pytest.approx(VARIANCES[:12] * (ratio - 1), rel=1e-9)
    assert added.freedom.tolist() == [30.0] * 12 + [np.inf] * 12


def test_what_two_dwells_of_a_group_have_in_common_counts_once() -> None:
    # Six groups of one up each, a mean of two dwells at opposite headings, less the vertical rate
    # and three offsets: of what is level nothing is left in a mean.
    off = np.zeros((RESTS, 6))
    off[:, :3] = 1e-5 * np.outer(np.repeat([1, -1, -1, 1, 1, -1], 2), [1, -2, 1.5])
    evidence = with_errors(CLEAN, off)
    _, _, square = gyro_rows(evidence)
    found = concluded(evidence)
    assert found.shares is not None
    freedom = found.shares[ErrorSource.SCATTER].freedom[0]
    groups = {tuple(np.round(s.attitude[2]).astype(int)) for s in evidence.segments}
    assert len(groups) == 6
    assert freedom == 14
    # What is left is alike in both dwells but for the attitudes' part in it.
    assert found.covariance[0, 0] == pytest.approx(square / 14, rel=0.05)


def test_a_stated_positioning_error_is_no_scatter() -> None:
    # Without joint angles both dwells of one up share what the lower joints do to it, about two
    # level axes; what the vertical joint does is another for each.
    rng, stated = np.random.default_rng(7), 0.001
    outputs, leans = [], np.zeros((RESTS, 3, 0))
    for pair in range(0, RESTS, 2):
        ups = CLEAN.segments[pair].attitude[2]
        across = np.linalg.svd(ups[None])[2][1:]
        columns = np.zeros((RESTS, 3, 4))
        for row in (pair, pair + 1):
            assert CLEAN.segments[row].attitude[2] == pytest.approx(ups, abs=1e-9)
            columns[row] = np.column_stack([*across, ups * (row == pair), ups * (row > pair)])
        leans = np.concatenate([leans, columns], axis=2)
    turned = leans @ rng.standard_normal(leans.shape[2]) * stated
    for segment, lean in zip(CLEAN.segments, turned, strict=True):
        true = segment.attitude @ Rotation.from_rotvec(lean).as_matrix()
        rates, forces = true.T @ SITE.earth_rate, true.T @ SITE.specific_force
        outputs.append(np.concatenate(TRUE.predict(rates, forces)))
    # Gyros that are good enough to see it.
    walk = CLEAN.walk * np.repeat([0.001, 1.0], 3)
    unstated = replace(with_errors(CLEAN, np.array(outputs) - CLEAN.outputs()), walk=walk)
    assert 'Between positions the gyros scatter' in concluded(unstated).findings[1]
    assert fitted(unstated, 3).scatter.significant
    evidence = replace(unstated, positioning=stated)
    found = concluded(evidence)
    assert found.findings == ('First.',)
    rows, felt = [], []
    for segment, columns in zip(evidence.segments, leans, strict=True):
        response, inward = TRUE.gyro.response, segment.attitude.T
        rows += np.hstack([response @ inward, np.eye(3)]).tolist()
        felt += (response @ np.cross(inward @ SITE.earth_rate, columns.T).T * stated).tolist()
    own = walk[0] ** 2 / 120 * np.eye(3 * RESTS)
    design, square = np.array(rows), own + np.array(felt) @ np.array(felt).T
    covariance = np.linalg.inv(design.T @ np.linalg.solve(square, design))
    assert found.earth_up_std == pytest.approx(np.sqrt(covariance[2, 2]), rel=1e-6)
    assert not fitted(evidence, 3).scatter.significant


def test_accelerometers_are_held_to_responses_biases_and_tilts() -> None:
    off, seconds = np.zeros((RESTS, 6)), np.linspace(60, 200, RESTS)
    off[:, 3:] = 3e-3 * np.outer(np.tile([1, -1], 6), [1, -2, 1.5])
    evidence = with_errors(CLEAN, off, seconds)
    rows, wanted, std = [], [], []
    for segment in evidence.segments:
        force = segment.attitude.T @ [0, 0, SITE.gravity]
        for channel in range(3):
            row = np.zeros((3, 4))
            row[channel] = [*force, 1.0]
            # A lean about east or north turns gravity by as much.
            lean = [
                TRUE.accel.response[channel]
                @ segment.attitude.T
                @ np.cross(axis, [0, 0, SITE.gravity])
                for axis in np.eye(3)[:2]
            ]
            rows.append([*row.ravel(), *lean])
            wanted.append(segment.statistics.mean[3 + channel])
            std.append(ACCEL_WALK / np.sqrt(segment.statistics.duration))
    ratio = least_squares(rows, wanted, std)[2] / (36 - 14)
    found = concluded(evidence, accels=True)
    own = np.diag(found.covariance)
    assert own[:12] == pytest.approx(VARIANCES[:12])
    # Tilts times misalignments are of second order.
    assert own[12:] == pytest.approx(VARIANCES[12:] * ratio, rel=2e-3)
    assert f'the accelerometers scatter {np.sqrt(ratio):.1f} times' in found.findings[1]
    assert found.shares is not None
    assert found.shares[ErrorSource.SCATTER].freedom.tolist() == [np.inf] * 12 + [22.0] * 12


def test_a_tilted_table_is_no_scatter_of_the_accelerometers() -> None:
    # A hundredth of a radian: of second order 5e-5 of gravity, of the noise several times.
    lean = Rotation.from_rotvec([0.008, -0.006, 0.0]).as_matrix()
    segments = []
    for segment in CLEAN.segments:
        true = lean @ segment.attitude
        outputs = TRUE.predict(true.T @ SITE.earth_rate, true.T @ SITE.specific_force)
        segments.append(replace(segment, statistics=statistics(np.concatenate(outputs), 120.0)))
    evidence = replace(CLEAN, segments=tuple(segments))
    assert concluded(evidence, accels=True).findings == ('First.',)
    fit = fitted(evidence, 3)
    assert fit.vector / SITE.gravity == pytest.approx(lean.T[:, 2], abs=1e-7)


def with_turn_errors(size: float) -> tuple[Evidence, float]:
    """Turns whose outputs leave a line, and their chi-square."""
    turns, square = [], 0.0
    for axis in range(3):
        mine = [t for t in CLEAN.turns if int(np.argmax(np.abs(t.up))) == axis][:4]
        inputs = np.array([t.up[axis] * (t.rate() + SITE.up_rate) for t in mine])
        off = size * np.abs(inputs)
        std = np.array([GYRO_WALK / np.sqrt(t.statistics.duration) for t in mine])
        rows = np.column_stack([np.ones(len(mine)), inputs])
        square += least_squares(rows, off, std)[2]
        for turn, more in zip(mine, off, strict=True):
            mean = turn.statistics.mean.copy()
            mean[axis] += more
            turns.append(replace(turn, statistics=replace(turn.statistics, mean=mean)))
    return replace(CLEAN, turns=tuple(turns)), square


def test_turns_that_scatter_widen_scale_factors_and_misalignments_alone() -> None:
    evidence, square = with_turn_errors(1e-4)
    # Three channels and three axes, four turns of each less a line.
    freedom = 3 * 3 * (4 - 2)
    found = concluded(evidence)
    own = np.diag(found.covariance)
    # Level Earth rate in the turn's noise: next to nothing.
    assert own[:9] == pytest.approx(VARIANCES[:9] * square / freedom, rel=1e-3)
    assert own[9:12] == pytest.approx(VARIANCES[9:12])
    assert 'Between turns the gyros scatter' in found.findings[1]
    assert found.shares is not None
    assert found.shares[ErrorSource.SCATTER].freedom[:12].tolist() == [freedom] * 9 + [np.inf] * 3
    # Both: the fewer degrees of freedom count, and both factors.
    off = np.zeros((RESTS, 6))
    off[:, :3] = 1e-5 * np.outer(np.tile([1, -1], 6), [1, -2, 1.5])
    both = with_errors(evidence, off)
    ratio = gyro_rows(both)[2] / 30
    found = concluded(both)
    own = np.diag(found.covariance)
    assert own[:9] == pytest.approx(VARIANCES[:9] * ratio * square / freedom, rel=1e-3)
    assert own[9:12] == pytest.approx(VARIANCES[9:12] * ratio)
    assert found.shares is not None
    assert found.shares[ErrorSource.SCATTER].freedom[:12].tolist() == [freedom] * 9 + [30] * 3


def test_two_turns_about_an_axis_leave_nothing_to_compare() -> None:
    evidence, _ = with_turn_errors(1e-4)
    axes = [int(np.argmax(np.abs(t.up))) for t in evidence.turns]
    two = tuple(t for k, t in enumerate(evidence.turns) if axes[:k].count(axes[k]) < 2)
    assert [axes.count(axis) for axis in range(3)] == [4, 4, 4]
    assert len(two) == 6
    assert concluded(replace(evidence, turns=two)).findings == ('First.',)


def test_without_turns_nothing_is_said_of_them() -> None:
    assert concluded(replace(CLEAN, turns=())).findings == ('First.',)


# North


def north_of(azimuth: float, walk: float = 1.0) -> str:
    evidence = evidence_of(model=TRUE, azimuth=azimuth)
    known = replace(evidence, azimuth=0.25, walk=evidence.walk * walk)
    solution = concluded(known, north=True)
    # The heading of the frame is the given one; what is seen comes on top.
    assert solution.azimuth == pytest.approx(0.25 + azimuth, abs=1e-6)
    return ' '.join(solution.findings[1:])


def test_north_that_is_elsewhere_is_told_beyond_five_deviations() -> None:
    std = GYRO_WALK / np.sqrt(12 * 120) / SITE.north_rate
    assert north_of(4.9 * std) == ''
    assert north_of(-4.9 * std) == ''
    assert north_of(5.1 * std) != ''
    off = 10 * DEG
    assert north_of(off) == (
        f'Warning: The gyros see north 10.0 +- {std / DEG:.1f} deg off the stated azimuth: the '
        f'gyro biases are wrong by up to {SITE.north_rate * np.sin(off) / DEG_H:.2f} deg/h.'
    )
    assert 'north -10.0 +-' in north_of(-off)
    assert f'up to {SITE.north_rate * np.sin(off) / DEG_H:.2f} deg/h' in north_of(-off)


def test_and_beyond_a_twentieth_of_a_degree() -> None:
    assert north_of(0.049 * DEG, 1e-3) == ''
    assert 'north 0.1 +- 0.0 deg' in north_of(0.051 * DEG, 1e-3)


def test_where_north_is_unknown_it_is_found_without_a_word() -> None:
    assert concluded(evidence_of(model=TRUE, azimuth=10 * DEG)).findings == ('First.',)


# What is refused, and what tilts do


def test_a_latitude_that_the_gyros_contradict_is_refused_but_in_the_hand() -> None:
    elsewhere = replace(CLEAN, site=replace(SITE, latitude=SITE.latitude + 2 * DEG))
    with pytest.raises(Contradiction, match=r'latitude 36\.65 deg'):
        concluded(elsewhere)
    by_hand = replace(elsewhere, plan=replace(CLEAN.plan, by_hand=True))
    concluded(by_hand)


@pytest.mark.parametrize('triad', ['gyro', 'accel'])
def test_each_triad_is_held_to_its_axes(triad: str) -> None:
    wrong = replace(TRUE, **{triad: Triad(2 * np.eye(3), np.zeros(3))})
    shares = {ErrorSource.NOISE: Share.known(np.diag(VARIANCES))}
    options: Any = {'gain': np.zeros((24, 3)), 'findings': (), 'north_known': False}
    what = {'gyro': 'gyros read 3 .* whole turns', 'accel': 'accelerometers read 3 .* gravity'}
    with pytest.raises(InputError, match=what[triad]):
        conclude(CLEAN, wrong, shares, 1.0, **options)
    if triad == 'gyro':
        with pytest.raises(InputError, match=r'gyros read 3 .* the Earth rate'):
            conclude(replace(CLEAN, turns=()), wrong, shares, 1.0, **options)


def test_the_tilt_is_that_of_the_force_and_as_sure_as_its_worse_axis() -> None:
    force = np.array([0.3, -0.4, 12.0])
    accel = _Fit(force, np.diag([4e-4, 9e-4, 1.0]), np.zeros((2, 3)), _Scatter(4.0, 5.0))
    tilt = _tilt(accel)
    size = np.sqrt(0.25 + 144)
    assert tilt.up == pytest.approx(force / size)
    assert tilt.std == pytest.approx(2 * 0.03 / size)
    turned = _Fit(force, np.diag([9e-4, 4e-4, 1.0]), np.zeros((2, 3)), _Scatter())
    assert _tilt(turned).std == pytest.approx(0.03 / size)


def test_a_closed_form_is_widened_by_what_the_tilt_does_to_it() -> None:
    lean = 100 * ARCSEC
    attitudes = [
        Rotation.from_rotvec([lean, 0, 0]).as_matrix() @ s.attitude for s in CLEAN.segments
    ]
    segments = []
    for segment, true in zip(CLEAN.segments, attitudes, strict=True):
        outputs = TRUE.predict(true.T @ SITE.earth_rate, true.T @ SITE.specific_force)
        segments.append(replace(segment, statistics=statistics(np.concatenate(outputs), 120.0)))
    evidence = replace(CLEAN, segments=tuple(segments))

    def solver(session: Evidence) -> Triad:
        """A closed form that takes the first dwell's first output for the bias of z."""
        return Triad(np.zeros((3, 3)), np.array([0, 0, session.outputs()[0, 3]]))

    variances = np.full(24, 1e-12)
    shares = {ErrorSource.NOISE: Share.known(np.diag(variances))}
    options: Any = {'gain': np.zeros((24, 3)), 'findings': (), 'north_known': False}
    found = conclude(evidence, TRUE, shares, 1.0, accelerometers=solver, **options)
    tilted, level = (
        TRUE.accel.response[0] @ attitude.T @ SITE.specific_force
        for attitude in (attitudes[0], CLEAN.segments[0].attitude)
    )
    assert found.shares is not None
    added = found.shares[ErrorSource.TILT].covariance
    assert added[23, 23] == pytest.approx((tilted - level) ** 2, rel=1e-3)
    assert np.count_nonzero(added) == 1
    assert found.covariance[23, 23] == pytest.approx(1e-12 + added[23, 23])
    assert 'tilted by 100 arcsec' in found.findings[0]
    # Against the plumb line the Earth rate is that of the site, and less sure by the tilt's own.
    assert found.earth_up == pytest.approx(SITE.up_rate, rel=1e-6)
    std = np.hypot(GYRO_WALK, ACCEL_WALK / SITE.gravity * SITE.north_rate) / np.sqrt(12 * 120)
    assert found.earth_up_std == pytest.approx(std, rel=2e-3)
    by_hand = replace(evidence, plan=replace(CLEAN.plan, by_hand=True))
    found = conclude(by_hand, TRUE, shares, 1.0, accelerometers=solver, **options)
    assert found.shares is not None
    assert ErrorSource.TILT not in found.shares


def test_a_session_without_noise_scatters_by_nothing() -> None:
    still = replace(CLEAN, walk=np.zeros(6))
    fit = fitted(still, 0)
    assert fit.scatter == _Scatter(1.0, np.inf)
    assert fit.vector == pytest.approx(SITE.earth_rate, abs=1e-14)


@pytest.mark.parametrize('name', ['twelve_position', 'joint'])
def test_nor_is_it_lost_to_rounding_on_a_table_that_misses(name: str) -> None:
    still = replace(CLEAN, walk=np.zeros(6), positioning=60 * ARCSEC)
    found = method(name)(still)
    off = found.model.vector() - TRUE.vector()
    assert np.abs(off).max() < 1e-14
    assert (np.abs(off) < found.std).all()


def test_the_plan_is_the_one_that_these_numbers_are_of() -> None:
    held = [p.dwell for p in load_plan('twelve_position').positions]
    assert held == [120.0] * 12
