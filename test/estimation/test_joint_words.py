"""What the joint estimate says beside its numbers, and the Earth rate that it sees."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import ACCEL_WALK, GYRO_WALK, SITE, evidence_of, statistics

from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC, DEG
from imu_calib.estimation import joint
from imu_calib.estimation import joint as joint_findings
from imu_calib.estimation.checks import WrongLatitude
from imu_calib.estimation.estimate import estimate
from imu_calib.estimation.outputs import OutputLayout
from imu_calib.estimation.session_model import Nuisance
from imu_calib.estimation.solve import NotConverged
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Triad
from imu_calib.model.terms import G_SENSITIVITY

TRUE = SensorModel(
    Triad(np.array([[1e-3, 2e-4, 0], [-3e-4, -2e-3, 1e-4], [0, 5e-4, 1e-3]]), np.full(3, 2e-6)),
    Triad(np.array([[2e-3, 1e-4, 0], [-2e-4, 1e-3, 3e-4], [1e-4, 0, -1e-3]]), np.full(3, 5e-3)),
)
CLEAN = evidence_of(model=TRUE, azimuth=0.3)


class Equations(SimpleNamespace):
    """Equations of two rests and a turn, of which all is given."""

    layout = OutputLayout(2, 1)
    any_heading = False
    levelled = None
    sensors = 24

    def predict(self, _: Floats) -> Floats:
        return np.asarray(self.predicted)

    def factor(self, _: Floats) -> Floats:
        return np.asarray(self.root)


def found(**given: Any) -> Any:
    """An estimate of which nothing is to be said, but for what is given."""
    quiet = {'outliers': (), 'turns_scatter': 1.0, 'constant': (), 'state': np.zeros(30)}
    equations = Equations(
        outputs=np.zeros(15),
        predicted=np.zeros(15),
        root=np.eye(15),
        evidence=SimpleNamespace(
            levelling=20 * ARCSEC,
            segments=[SimpleNamespace(position=k + 1, start=k * 7) for k in range(2)],
        ),
    )
    return SimpleNamespace(**{**quiet, 'equations': equations, **given})


def finding_texts(monkeypatch: pytest.MonkeyPatch, what: Any) -> list[str]:
    for name in ('_rejected_moves_finding', '_scatter_findings', 'temperature_finding'):
        monkeypatch.setattr(joint_findings, name, lambda *_: [])
    return joint_findings.estimate_findings(what, ())


def test_a_clean_estimate_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert finding_texts(monkeypatch, found()) == []
    assert finding_texts(monkeypatch, found(turns_scatter=1.5)) != []


def test_residuals_are_told_with_the_deviation_of_all_that_errs() -> None:
    what = found()
    what.equations.outputs = np.arange(15.0)
    what.equations.predicted = np.full(15, 0.5)
    what.equations.root[7, 2] = np.sqrt(3)
    first, second = joint._residuals(what)
    assert (first.position, first.start, second.position, second.start) == ('1', 0, '2', 7)
    assert first.value.tolist() == [-0.5, 0.5, 1.5, 2.5, 3.5, 4.5]
    assert second.value.tolist() == [5.5, 6.5, 7.5, 8.5, 9.5, 10.5]
    assert second.std == pytest.approx([1, 2, 1, 1, 1, 1])


def outlying(off: Any, rows: Any = (9, 10, 11)) -> str:
    """What is said of a rest of which gravity is along the third axis, and an error."""
    what = found()
    what.equations.predicted[9:12] = [0, 0, 10.0]
    what.equations.outputs[9:12] = what.equations.predicted[9:12] + off
    outlier: Any = SimpleNamespace(rows=np.array(rows), name='rest 2', chi_square=36.0)
    return joint_findings._tilt_explanation(what, outlier)


def test_an_error_across_gravity_is_an_attitude_error() -> None:
    across = 10 * np.array([30 * ARCSEC, 40 * ARCSEC, 0])
    assert outlying(across) == ', as an attitude error of the table of 50 arcsec makes it'
    third = 10 * 50 * ARCSEC / 3
    assert outlying(np.add(across, [0, 0, 0.99 * third])) != ''
    assert outlying(across - [0, 0, 0.99 * third]) != ''
    assert outlying(np.add(across, [0, 0, 1.01 * third])) == ''
    assert outlying(across - [0, 0, 1.01 * third]) == ''
    # Of gyros nothing leans.
    assert outlying(across, (6, 7, 8)) == ''


def test_what_counts_for_less_is_named_with_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        joint_findings, '_tilt_explanation', lambda _, o: ', leaning' if o.name == 'b' else ''
    )
    outliers = [
        SimpleNamespace(name=name, chi_square=square) for name, square in (('a', 36.0), ('b', 81.0))
    ]
    assert finding_texts(monkeypatch, found(outliers=outliers)) == [
        'Warning: Outliers, given less weight: a (6 sigma), b (9 sigma, leaning).'
    ]


def test_a_heading_that_was_found_elsewhere_and_a_tilt_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    values = {
        Nuisance.AZIMUTH: (3.0 * DEG, 0.4 * DEG),
        Nuisance.TILT_X: (30 * ARCSEC, 1.0),
        Nuisance.TILT_Y: (-40 * ARCSEC, 1.0),
    }
    what = found(nuisance=lambda which: values[which])
    what.equations.any_heading = True
    assert finding_texts(monkeypatch, what) == [
        'Warning: The gyros see north 3.0 +- 0.4 deg off the stated azimuth: the stated one is not '
        'used.'
    ]
    what.equations.any_heading, what.equations.levelled = False, 1.0
    assert finding_texts(monkeypatch, what) == [
        'Warning: The table is tilted by 50 arcsec, more than the 20 arcsec that are assumed.'
    ]


def test_changes_that_a_session_does_not_tell_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    constant = [SimpleNamespace(name='K_gx'), SimpleNamespace(name='D_ax')]
    monkeypatch.setattr(joint_findings, 'names_of', lambda _: ['trend', 'warm_up'])
    (sentence,) = finding_texts(monkeypatch, found(constant=constant))
    assert sentence.startswith(
        'The session does not show how K_gx, D_ax change (trend and warm_up): they are taken as'
    )


# Whole estimates of small sessions


@pytest.fixture(scope='module')
def solved() -> Any:
    return joint.solve(CLEAN)


def test_the_heading_is_counted_from_the_given_one(solved: Any) -> None:
    assert solved.azimuth == pytest.approx(0.3, abs=1e-5)
    given = evidence_of(model=TRUE, azimuth=0.3, known=True)
    again = joint.provisional(given)
    assert again.azimuth == pytest.approx(0.3, abs=1e-5)
    assert again.search is None
    assert again.tests == ()


def test_the_earth_rate_is_told_as_sure_as_its_dwells(solved: Any) -> None:
    std = GYRO_WALK / np.sqrt(12 * 120)
    assert solved.earth_up == pytest.approx(SITE.up_rate, rel=1e-5)
    # What turns about up show of biases, in 324 s about each axis, is about up alone.
    assert solved.earth_up_std == pytest.approx(GYRO_WALK / np.sqrt(12 * 120 + 324), rel=0.02)
    assert solved.azimuth_std == pytest.approx(std / SITE.north_rate, rel=0.05)


def test_parameters_and_their_shares_are_of_the_24(solved: Any) -> None:
    assert solved.parameters == PARAMETERS
    assert solved.model.vector() == pytest.approx(TRUE.vector(), abs=1e-6)
    total = sum(share.covariance for share in solved.shares.values())
    scale = np.sqrt(np.diag(solved.covariance))
    np.testing.assert_allclose(
        total / np.outer(scale, scale), solved.covariance / np.outer(scale, scale), atol=1e-6
    )
    assert np.abs([r.value[:3] for r in solved.residuals]).max() < 1e-9
    assert solved.residuals[0].std[3] == pytest.approx(ACCEL_WALK / np.sqrt(120), rel=0.5)
    assert solved.changes is None
    terms = joint.provisional(CLEAN, (G_SENSITIVITY,))
    assert len(terms.parameters) == 33
    assert terms.shares is not None


def test_the_earth_rate_is_free_of_the_latitude_that_was_given() -> None:
    there = estimate(CLEAN)
    rate, covariance = joint.observed_earth_rate(there)
    # Level, by the heading of the attitudes: a table turned by 0.3 sees north to its left.
    level = SITE.north_rate * np.array([np.sin(0.3), np.cos(0.3)])
    assert rate == pytest.approx([*level, SITE.up_rate], abs=1e-9)
    std = GYRO_WALK / np.sqrt(12 * 120)
    assert np.sqrt(np.diag(covariance)) == pytest.approx([std, std, std * 0.903], rel=0.02)
    elsewhere = replace(CLEAN, site=replace(SITE, latitude=30 * DEG))
    wrong = replace(there, equations=replace(there.equations, evidence=elsewhere))
    rate, widened = joint.observed_earth_rate(wrong)
    assert rate == pytest.approx([*level, SITE.up_rate], rel=2e-3)
    assert np.sqrt(np.diag(widened)) == pytest.approx([std, std, std * 0.903], rel=0.02)


def test_what_the_noise_leaves_of_a_session_widens_the_earth_rate() -> None:
    off, segments = np.zeros(6), []
    for k, segment in enumerate(CLEAN.segments):
        off[:3] = 2e-5 * np.array([1, -2, 1.5]) * (-1) ** k
        segments.append(
            replace(segment, statistics=statistics(segment.statistics.mean + off, 120.0))
        )
    noisy = replace(CLEAN, segments=tuple(segments))
    there = estimate(CLEAN)
    wrong = replace(there, equations=replace(there.equations, evidence=noisy))
    plain = joint.observed_earth_rate(there)[1]
    # What six unknowns of each dwell's three leave of the square, over all that is free: outputs
    # and priors less parameters, nuisances and two more components of the rate.
    square = 0.0
    rows, wanted = [], []
    for segment, clean in zip(segments, CLEAN.segments, strict=True):
        rows += [[*TRUE.gyro.response[c] @ clean.attitude.T, *np.eye(3)[c]] for c in range(3)]
        wanted += list((segment.statistics.mean - clean.statistics.mean)[:3])
    residuals = np.array(wanted) - np.array(rows) @ np.linalg.lstsq(rows, wanted, rcond=None)[0]
    square = float(residuals @ residuals) / (GYRO_WALK**2 / 120)
    size = len(there.state)
    outputs = len(there.equations.outputs) + there.equations.nuisances
    ratio = square / (outputs - size - 2)
    assert ratio > 1.5
    found = joint.observed_earth_rate(wrong)[1]
    assert np.diag(found) / np.diag(plain) == pytest.approx([ratio] * 3, rel=0.02)


def test_axes_and_units_are_held_to_the_world() -> None:
    for triad, words in (('gyro', 'the turns and the Earth'), ('accel', 'gravity')):
        there = estimate(CLEAN)
        state = there.state.copy()
        first = 0 if triad == 'gyro' else 12
        state[first : first + 3] += 2.0
        with pytest.raises(InputError, match=f'read 3.* times what they should of {words}'):
            joint._checked_solution(replace(there, state=state))


def test_a_latitude_that_is_wrong_is_refused_with_the_right_one() -> None:
    wrong = replace(CLEAN, site=replace(SITE, latitude=SITE.latitude + 3 * DEG))
    with pytest.raises(WrongLatitude, match=r'It fits a latitude of 34\.[67]'):
        joint.solve(wrong)


def raising(error: Exception) -> Any:
    def one(*_: Any, **__: Any) -> None:
        raise error

    return one


def test_what_converges_at_no_latitude_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint, 'search_terms', raising(NotConverged('does not end')))
    with pytest.raises(NotConverged):
        joint.solve(CLEAN)
    # Where it converges at the latitude that the gyros see, that is the cause.
    wrong = replace(CLEAN, site=replace(SITE, latitude=SITE.latitude + 3 * DEG))
    calls: list[float] = []

    def estimated(evidence: Any) -> Any:
        calls.append(evidence.site.latitude)
        return replace(
            there, equations=replace(there.equations, evidence=replace(CLEAN, site=wrong.site))
        )

    there = estimate(CLEAN)
    monkeypatch.setattr(joint, 'estimate', estimated)
    with pytest.raises(WrongLatitude):
        joint.solve(wrong)
    assert calls[0] == pytest.approx(SITE.latitude, abs=0.05 * DEG)
    monkeypatch.setattr(joint, 'estimate', raising(NotObservable('lost')))
    with pytest.raises(NotConverged):
        joint.solve(wrong)
    # In the hand no rate tells a latitude.
    monkeypatch.setattr(joint, 'estimate', estimated)
    with pytest.raises(NotConverged):
        joint.solve(replace(wrong, plan=replace(wrong.plan, by_hand=True)))


@pytest.mark.parametrize(
    ('misfit', 'found_there', 'refused'),
    [(1.9, (), True), (2.1, (), False), (1.9, ('term',), False)],
)
def test_terms_that_another_latitude_explains_alone_are_none(
    monkeypatch: pytest.MonkeyPatch, misfit: float, found_there: Any, refused: bool
) -> None:
    asked: list[float] = []

    def searched(evidence: Any, *_: Any, **__: Any) -> Any:
        asked.append(evidence.site.latitude)
        return SimpleNamespace(found=found_there)

    error = WrongLatitude('elsewhere', 0.7, misfit)
    monkeypatch.setattr(joint, 'check_latitude', raising(error))
    monkeypatch.setattr(joint, 'search_terms', searched)
    plain: Any = SimpleNamespace(
        equations=SimpleNamespace(evidence=CLEAN, parameters=PARAMETERS, changes=())
    )
    monkeypatch.setattr(joint, 'observed_earth_rate', lambda _: (None, None))
    if refused:
        with pytest.raises(WrongLatitude):
            joint._check_that_no_latitude_explains(plain)
    else:
        joint._check_that_no_latitude_explains(plain)
    assert asked == ([0.7] if misfit < 2 else [])


def test_the_first_three_moves_are_named() -> None:
    moves: Any = [SimpleNamespace(positions=(str(k), str(k + 1))) for k in range(5)]
    assert joint_findings._names_of_moves(moves[:3]) == 'from position 0 to 1, 1 to 2, 2 to 3'
    assert (
        joint_findings._names_of_moves(moves) == 'from position 0 to 1, 1 to 2, 2 to 3 and 2 more'
    )
