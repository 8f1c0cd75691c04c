"""The acceptance test of a calibration: the right one passes, every spoilt one is named."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, norm
from sessions import LATITUDE, SITE, at_one_rate, calibrate, paper_imu, quick_plan, session, stand

from imu_calib.api.simulate import serialised
from imu_calib.api.verify import described_by
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.diagnosis import diagnose, mistakes, share_in_words
from imu_calib.calibration.verify import Quantity, Verdict, Verification, _Trial, verify
from imu_calib.cli.main import main
from imu_calib.common.errors import NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.common.units import (
    ARCMIN,
    ARCSEC,
    DEG,
    DEG_H,
    MICRO_G,
    PPM,
    STANDARD_GRAVITY,
)
from imu_calib.estimation import system
from imu_calib.estimation.free_dwells import Sensors
from imu_calib.estimation.system import Observed, Shifts, observe
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import ParameterKind
from imu_calib.model.sensors import Triad
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.segmentation.segmented import Segmented
from imu_calib.segmentation.segmenter import Segmenter
from imu_calib.session.imu import load_imu
from imu_calib.session.metadata import describe
from imu_calib.session.plan import UNPLANNED, Plan, load_plan
from imu_calib.session.table import Table, load_table
from imu_calib.session.table_errors import TableErrors
from imu_calib.simulation.options import begin_of

PLAN = quick_plan('six_position', 20.0)
HEADING = 0.7
EXCHANGE = np.eye(3)[[1, 0, 2]]
REVERSED_Y = np.diag([1.0, -1.0, 1.0])


@cache
def calibration() -> Calibration:
    """Twelve positions, 60 s each, another day and another azimuth."""
    plan = quick_plan('twelve_position', 60.0)
    return calibrate(session(plan, stand(azimuth=0.3), seed=100), plan).calibration


def segmented(
    seed: int, table: Table | None, mounted: Table | None = None, plan: Plan = PLAN
) -> Segmented:
    """A session of the table `mounted`, read as if it were of `table`; None: by the IMU alone."""
    segmenter = Segmenter(paper_imu(), table)
    blocks = session(plan, stand(azimuth=HEADING), seed, table=mounted or table)
    for _, block in blocks:
        if table is not None or isinstance(block, ImuBlock):
            segmenter.add_block(block)
    return segmenter.finish()


@cache
def observed(seed: int = 0) -> Observed:
    table = load_table('three_axis')
    return observe(segmented(seed, table), paper_imu(), SITE, PLAN, table)


@cache
def verified(seed: int = 0) -> Verification:
    return verify(calibration(), observed(seed))


@cache
def by_the_imu_alone() -> Observed:
    return observe(segmented(2, None), paper_imu(), SITE, UNPLANNED, None)


@cache
def without_moves() -> Observed:
    """Rests and turns alone: moves are led on anew at each step of a fit."""
    return replace(observed(), evidence=replace(observed().evidence, moves=()))


def at(site: Site) -> Observed:
    """The rests and turns as if they had been recorded elsewhere."""
    return replace(without_moves(), evidence=replace(without_moves().evidence, site=site))


def symptom(verification: Verification, *, gyros: bool) -> str:
    (judged,) = [t for t in verification.triads if t.gyros == gyros]
    return judged.diagnosis.symptom if judged.diagnosis is not None else ''


@pytest.mark.parametrize('seed', range(3))
def test_the_right_calibration_is_accepted(seed: int) -> None:
    verification = verified(seed)
    assert verification.verdict is not Verdict.FAIL
    for judged in verification.triads:
        assert judged.diagnosis is None
        # Five standard deviations of chi-square.
        assert abs(judged.chi_square - judged.freedom) < 5 * np.sqrt(2 * judged.freedom)


def test_parameters_that_a_recording_does_not_test_are_named() -> None:
    """A recording cut off after two positions accepted a K_az off by 500 ppm without a word."""
    assert verified().untested == ()
    whole = observed().evidence
    along_x = [
        [one for one in of if one.position in {'x_up', 'x_down'}]
        for of in (whole.segments, whole.turns)
    ]
    cut = replace(whole, segments=tuple(along_x[0]), turns=tuple(along_x[1]), moves=())
    wrong = accel(a().error_matrix + 500 * PPM * np.diag([0.0, 0.0, 1.0]))
    for tested in (calibration(), wrong):
        found = verify(tested, replace(observed(), evidence=cut))
        assert found.accepted
        assert {'K_ay', 'K_az', 'E_ayz', 'K_gz'} <= set(found.untested)
        assert {'K_gx', 'K_ax', 'E_azx', 'D_ax', 'D_gx'}.isdisjoint(found.untested)
        assert 'It does not test K_g' in found.outcome
    assert not verify(wrong, observed()).accepted


def test_moves_between_rests_alone_tell_scale_factors_of_gyros() -> None:
    # What turns and their run-ups were is a move of a thousand degrees, a minute for each axis at
    # the fastest rate alone; the Earth's rate alone knows K_g to a percent.
    table, plan = load_table('three_axis'), at_one_rate(PLAN)
    observation = observe(segmented(0, table, plan=plan), paper_imu(), SITE, plan, table)
    observation = replace(observation, evidence=replace(observation.evidence, turns=()))
    assert len(observation.evidence.used_moves) == 5
    (gyros, _) = verify(calibration(), observation).triads
    assert gyros.verdict is Verdict.PASS
    assert abs(gyros.chi_square - gyros.freedom) < 5 * np.sqrt(2 * gyros.freedom)
    wrong = verify(gyro(g().error_matrix + 300 * PPM * np.eye(3)), observation)
    assert wrong.triads[0].verdict is Verdict.FAIL
    assert 'the scale factors are others' in symptom(wrong, gyros=True)
    resting = replace(observation, evidence=replace(observation.evidence, moves=()))
    unseen = verify(gyro(g().error_matrix + 300 * PPM * np.eye(3)), resting)
    assert unseen.triads[0].verdict is Verdict.PASS


def test_a_search_that_does_not_converge_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = _Trial.fit_triad(
        gyro(g().error_matrix + 2000 * PPM * np.eye(3)), observed(), gyros=True
    )
    monkeypatch.setattr('imu_calib.estimation.system._ROUNDS', 1)
    begun = trial.system.fit(trial.values, trial.factor)
    assert trial.findings() == []
    (finding,) = replace(trial, fit=begun).findings()
    assert 'The errors of the gyros that explain the session best were not found' in finding
    assert begun.chi_square > trial.fit.chi_square > 2 * trial.fit.freedom


def test_parameters_that_were_not_found_are_not_said_to_have_moved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(3)
    vector = calibration().model.vector() * rng.uniform(-1.0, 0.5, 24)
    other = replace(calibration(), model=calibration().model.from_vector(vector))
    trial = _Trial.fit_triad(other, observed(), gyros=True)
    monkeypatch.setattr('imu_calib.estimation.system._ROUNDS', 1)
    diagnosis = diagnose(trial.system, trial.values, trial.factor, trial.fit.chi_square)
    assert not diagnosis.moved
    assert (
        'no other parameters were found that do (the search did not converge)' in diagnosis.symptom
    )


def test_a_mistake_whose_remedy_no_imu_has_explains_nothing() -> None:
    """Misalignments a thousand times as large make nothing of any rate, whatever is wrong."""
    sensors = Sensors.from_parameters(calibration().parameters, gyros=True)
    values = Triad(np.full((3, 3), 2e-2), np.full(3, 0.01)).vector()
    tried = {mistake.when for mistake in mistakes(sensors, values)}
    assert 'the misalignments are read as radians' not in tried
    assert 'the scale-factor errors are read as ratios' not in tried
    assert 'the misalignments are read as arc minutes' in tried


def test_by_lengths_body_axes_are_not_blamed() -> None:
    moved = gyro(bias=g().bias + np.array([30.0, -20.0, 40.0]) * DEG_H)
    assert 'input axes' not in symptom(verify(moved, by_the_imu_alone()), gyros=True)


def test_a_bias_instability_that_nobody_stated_is_named_where_it_counts() -> None:
    spec = paper_imu()
    silent = replace(spec, gyro=replace(spec.gyro, bias_instability=0.0))
    seen = replace(by_the_imu_alone(), imu=silent)
    moved = gyro(bias=g().bias + np.array([30.0, -20.0, 40.0]) * DEG_H)
    findings = [f for f in verify(moved, seen).findings if 'No bias instability' in f]
    assert len(findings) == 1 and 'of the gyros is stated' in findings[0]
    assert not [f for f in verify(calibration(), seen).findings if 'No bias instability' in f]


def test_what_is_compared_scatters_as_stated() -> None:
    ratios = [c.ratio for seed in range(3) for c in verified(seed).compared]
    assert len(ratios) == 3 * (6 * 4 + 18 * 2)
    # 180 ratios, not all independent of each other.
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_the_limits_are_those_of_the_largest_of_all_that_is_compared() -> None:
    verification = verified()
    # The chance that the largest of n independent ratios exceeds the limit, by sound data.
    n = len(verification.compared)
    assert n == 6 * 4 + 18 * 2
    # Every parameter is one more number.
    n += len(calibration().parameters)
    for limit, chance in zip(verification.limits, (1e-2, 1e-6), strict=True):
        assert -np.expm1(n * np.log1p(-2 * norm.sf(limit))) == pytest.approx(chance, rel=0.01)


@pytest.mark.parametrize(('gyros', 'size'), [(True, 5 * DEG_H), (False, 2e-3)])
def test_biases_that_moved_as_the_data_sheet_allows_are_no_fault(gyros: bool, size: float) -> None:
    # Far beyond what the calibration and the session leave open: the data sheet's figure alone is
    # the measure of what the rests differ by.
    name = 'gyro' if gyros else 'accel'
    imu = paper_imu()
    imu = replace(imu, **{name: replace(getattr(imu, name), bias_instability=size)})
    observation, rng, square, runs = replace(observed(), imu=imu), np.random.default_rng(6), 0.0, 12
    for _ in range(runs):
        moved = size * rng.standard_normal(3)
        good = getattr(calibration().model, name)
        verification = verify(_spoilt(name, None, good.bias + moved), observation)
        assert verification.verdict is Verdict.PASS
        # At x_up the channel x sees gravity, or the Earth's vertical rate, and the bias of x.
        quantity = Quantity.UP_RATE if gyros else Quantity.GRAVITY
        along = [c.ratio for c in verification.compared if c.quantity is quantity]
        square += np.mean(np.square(along)) * 3
    # The three biases of each run, each seen up and down.
    assert chi2.ppf(1e-3, 3 * runs) < square < chi2.isf(1e-3, 3 * runs)


@pytest.mark.parametrize('seed', range(3))
def test_biases_that_drift_as_the_data_sheet_states_are_no_fault(seed: int) -> None:
    spec, table = load_imu('fog_medium'), load_table('three_axis')
    segmenter, drifting = Segmenter(spec, table), stand(azimuth=HEADING, bias_instability=True)
    for _, block in session(PLAN, drifting, seed, spec=spec):
        segmenter.add_block(block)
    seen = observe(segmenter.finish(), spec, SITE, PLAN, table)
    verification = verify(calibration(), seen)
    assert verification.verdict is Verdict.PASS
    assert not verification.findings
    # By 20 ug, four times the noise of a rest.
    wrong = accel(a().error_matrix + 100 * PPM * np.diag([1.0, 0.0, 0.0]))
    assert verify(wrong, seen).triads[1].verdict is Verdict.FAIL


def stating(seen: Observed, **instability: float) -> Observed:
    triads = {k: replace(getattr(seen.imu, k), bias_instability=v) for k, v in instability.items()}
    return replace(seen, imu=replace(seen.imu, **triads))


def test_a_drift_that_the_session_does_not_have_hides_nothing() -> None:
    generous = stating(observed(), accel=200 * MICRO_G)
    wrong = accel(a().error_matrix + 50 * PPM * np.diag([1.0, 0.0, 0.0]))
    assert verify(calibration(), generous).verdict is Verdict.PASS
    assert verify(wrong, generous).triads[1].verdict is Verdict.FAIL


def test_the_drift_that_the_calibration_found_is_expected_where_none_is_stated() -> None:
    found = replace(calibration(), provenance={'bias_drift': [1e-7] * 3 + [2e-4] * 3})
    spec = described_by(found)
    assert (spec.gyro.bias_instability, spec.accel.bias_instability) == pytest.approx((1e-7, 2e-4))
    assert described_by(replace(found, provenance={})).accel.bias_instability == 0.0


@pytest.mark.parametrize(('name', 'gyros'), [('D_gx', True), ('E_gxy', True), ('K_az', False)])
@pytest.mark.parametrize('size', [7.0, -7.0, 10.0])
def test_one_parameter_that_moved_is_named_whatever_the_others_dilute(
    name: str, gyros: bool, size: float
) -> None:
    """Of 92 degrees of freedom one bias that moved by eight deviations was a doubt at most."""
    trial = _Trial.fit_triad(calibration(), without_moves(), gyros=gyros)
    index = [p.name for p in trial.system.sensors.parameters].index(name)
    std = 1 / float(trial.shifts.sensitivities[index])
    # Beside what the noise of the session shows already.
    shift = (size - float(trial.shifts.deviates[index])) * std
    found = verify(_moved(name, -shift), without_moves())
    (judged,) = [t for t in found.triads if t.gyros == gyros]
    assert judged.verdict is Verdict.FAIL
    assert [one.parameter.name for one in found.moved] == [name]
    if abs(size) < 9:
        assert found.moved[0].difference == pytest.approx(size * std, rel=0.01)
        assert found.moved[0].std == pytest.approx(std, rel=0.01)
        # Chi-square alone does not reject it, of either sign.
        assert chi2.sf(judged.chi_square, judged.freedom) > 1e-6
        assert f'{name} off by' in str(judged)


def _moved(name: str, shift: float) -> Calibration:
    good = calibration()
    index = [p.name for p in good.parameters].index(name)
    values = good.values + shift * np.eye(len(good.values))[index]
    return replace(good, model=good.model.with_values(good.parameters, values))


def test_a_shift_of_a_sound_session_is_a_standard_normal_number() -> None:
    """Drawn sessions of equations in which the parameters are correlated."""
    rng, runs = np.random.default_rng(5), 4000
    columns = rng.standard_normal((8, 5)) @ (np.eye(5) + 0.7)
    noise = rng.standard_normal((runs, 8))
    sound = np.array([Shifts(columns, one).deviates for one in noise])
    assert np.abs(np.cov(sound.T).diagonal() - 1).max() < 5 * np.sqrt(2 / runs)
    # One that moved by twelve deviations shows in others too, and is named alone.
    own, every = 12 / Shifts(columns, noise[0]).sensitivities, np.ones(5, bool)
    for k in range(5):
        shown = Shifts(columns, noise[k] + columns[:, k] * own[k])
        assert (np.abs(shown.deviates) > 4).sum() > 1
        ((index, size, std),) = shown.beyond(4.0, every)
        assert index == k and std == pytest.approx(own[k] / 12)
        assert abs(size - own[k]) < 4 * std
    assert not Shifts(columns, noise[0]).beyond(4.0, every)
    # What no session shows is no number.
    unseen = Shifts(np.insert(columns, 2, 0.0, axis=1), noise[0])
    assert unseen.deviates[2] == 0.0 and np.isfinite(unseen.deviates).all()


def test_what_passes_by_the_drift_stated_alone_is_said() -> None:
    # Lengths do not tell half of the Earth rate from biases that may be as large.
    generous = stating(by_the_imu_alone(), gyro=10 * DEG_H)
    wrong = verify(gyro(g().error_matrix + 0.5 * np.diag([1.0, 0.0, 0.0])), generous)
    assert wrong.triads[0].verdict is not Verdict.FAIL
    words = 'Without the bias instability of the gyros, 10 deg/h, the calibration would be rejected'
    assert [f for f in wrong.findings if words in f]
    assert not [f for f in verify(calibration(), generous).findings if 'Without' in f]


def test_no_drift_is_blamed_that_is_merely_stated() -> None:
    """Biases and scale factors that moved at once: constant parameters explain the session."""
    matrix, bias = a().error_matrix, a().bias
    moved = accel(
        matrix + np.diag([60, 12, -30]) * PPM, bias + np.array([200, 100, -120]) * MICRO_G
    )
    # By the gravity of another place no scale factor alone is significant.
    elsewhere = replace(SITE, latitude=SITE.latitude + 1e-9, gravity_std=3e-4)
    judged = verify(moved, stating(at(elsewhere), accel=20 * MICRO_G))
    assert 'other parameters do' in symptom(judged, gyros=False)
    assert 'nothing else is seen' not in judged.outcome


def gyro(matrix: Floats | None = None, bias: Floats | None = None) -> Calibration:
    return _spoilt('gyro', matrix, bias)


def accel(matrix: Floats | None = None, bias: Floats | None = None) -> Calibration:
    return _spoilt('accel', matrix, bias)


def _spoilt(name: str, matrix: Floats | None, bias: Floats | None) -> Calibration:
    good = getattr(calibration().model, name)
    bad = Triad(
        good.error_matrix if matrix is None else matrix, good.bias if bias is None else bias
    )
    return replace(calibration(), model=replace(calibration().model, **{name: bad}))


def scaled(**changes: float) -> Calibration:
    """The nominal scale factors of another description."""
    imu = calibration().imu
    triads = {k: replace(getattr(imu, k), scale_factor=v) for k, v in changes.items()}
    return replace(calibration(), imu=replace(imu, **triads))


def g() -> Triad:
    return calibration().model.gyro


def a() -> Triad:
    return calibration().model.accel


DEFECTS: dict[str, tuple[Callable[[], Calibration], bool, str]] = {
    'gyro matrix transposed': (
        lambda: gyro(g().error_matrix.T),
        True,
        'the gyro error matrix is transposed',
    ),
    'accelerometer matrix transposed': (
        lambda: accel(a().error_matrix.T),
        False,
        'the accelerometer error matrix is transposed',
    ),
    'gyro matrix negated': (
        lambda: gyro(-g().error_matrix),
        True,
        'the gyro error matrix has the opposite sign',
    ),
    'gyro biases negated': (
        lambda: gyro(bias=-g().bias),
        True,
        'the biases have the opposite sign',
    ),
    'one gyro bias negated': (
        lambda: gyro(bias=g().bias * np.array([1.0, -1.0, 1.0])),
        True,
        'the bias of y has the opposite sign',
    ),
    'accelerometer biases negated': (
        lambda: accel(bias=-a().bias),
        False,
        'the biases have the opposite sign',
    ),
    'gyro channel reversed': (
        lambda: gyro(REVERSED_Y @ g().response - np.eye(3), REVERSED_Y @ g().bias),
        True,
        'channels are reversed (y is -y)',
    ),
    'axes of the file exchanged': (
        lambda: accel(EXCHANGE @ a().error_matrix @ EXCHANGE, EXCHANGE @ a().bias),
        False,
        'the axes of the file change places (y for x, x for y)',
    ),
    'channels exchanged': (
        lambda: accel(EXCHANGE @ a().response - np.eye(3), EXCHANGE @ a().bias),
        False,
        'channels are exchanged or reversed (x is y, y is x)',
    ),
    'biases in deg/s': (lambda: gyro(bias=g().bias / DEG), True, 'the biases are read as deg/s'),
    'biases in g': (
        lambda: accel(bias=a().bias / STANDARD_GRAVITY),
        False,
        'the biases are read as g.',
    ),
    'misalignments in arc minutes': (
        lambda: accel(
            np.diag(np.diag(a().error_matrix))
            + (a().error_matrix - np.diag(np.diag(a().error_matrix))) / ARCMIN
        ),
        False,
        'the misalignments are read as arc minutes',
    ),
    'another scale factor': (
        lambda: scaled(gyro=2 * paper_imu().gyro.scale_factor),
        True,
        'reads 2 times too much',
    ),
    'a scale factor for one of another unit': (
        lambda: scaled(gyro=1e6 * paper_imu().gyro.scale_factor),
        True,
        'the outputs are read as the recording describes them',
    ),
}


@pytest.mark.parametrize('name', DEFECTS)
def test_a_spoilt_calibration_is_rejected_with_its_symptom(name: str) -> None:
    spoil, gyros, words = DEFECTS[name]
    verification = verify(spoil(), without_moves())
    assert verification.verdict is Verdict.FAIL
    assert words in symptom(verification, gyros=gyros).split('as good')[0]


@pytest.mark.parametrize('units', [Units.SI, Units.RATES, Units.COUNTS])
def test_a_recording_in_other_units_than_the_calibration_is_read_as_it_says(units: Units) -> None:
    """Parameters are ratios and SI biases: pulses were read as SI, and the same unit rejected."""
    imu = replace(scaled(gyro=1.0, accel=1.0).imu, units=units)
    other = replace(calibration(), imu=imu)
    assert verify(other, without_moves()).verdict is Verdict.PASS
    wrong = replace(gyro(g().error_matrix.T), imu=imu)
    assert 'matrix is transposed' in symptom(verify(wrong, without_moves()), gyros=True)


def test_what_has_moved_is_told_with_its_size() -> None:
    verification = verify(gyro(bias=g().bias + np.array([2 * DEG_H, 0.0, 0.0])), observed())
    diagnosis = verification.triads[0].diagnosis
    assert verification.verdict is Verdict.FAIL
    assert diagnosis is not None
    assert 'the biases are others' in diagnosis.symptom.split('as good')[0]
    (moved,) = diagnosis.moved
    assert moved.parameter.name == 'D_gx'
    assert abs(moved.difference + 2 * DEG_H) < 4 * moved.std < 0.6 * 2 * DEG_H


def test_by_moves_too_a_mistake_is_told() -> None:
    spoil, _, words = DEFECTS['gyro channel reversed']
    verification = verify(spoil(), observed())
    assert verification.verdict is Verdict.FAIL
    assert words in symptom(verification, gyros=True).split('as good')[0]


def test_the_calibration_of_another_unit_is_told_from_a_mistake() -> None:
    rng = np.random.default_rng(3)
    vector = calibration().model.vector() * rng.uniform(-1.0, 0.5, 24)
    other = replace(calibration(), model=calibration().model.from_vector(vector))
    verification = verify(other, observed())
    for gyros in (True, False):
        assert 'that of another unit' in symptom(verification, gyros=gyros)


def test_a_unit_turned_in_its_mount_is_told_by_how_much() -> None:
    table = load_table('three_axis')
    small = np.array([1.0, -2.0, 1.5]) * ARCMIN
    angle = float(np.linalg.norm(small))
    otherwise = replace(table, mount=rotation(small / angle, angle))
    observation = observe(segmented(7, table, otherwise), paper_imu(), SITE, PLAN, table)
    verification = verify(calibration(), observation)
    # The body turns with the mount; what it sees turns the other way.
    for gyros in (True, False):
        words = symptom(verification, gyros=gyros)
        assert 'the unit is turned by -1.0' in words or 'the unit is turned by -0.9' in words


def test_another_gravity_is_told_from_accelerometers_that_have_changed() -> None:
    # Five degrees of latitude further north, as somebody believes: 440 ppm.
    site = Site.at(LATITUDE + 5 * DEG, gravity=normal_gravity(LATITUDE + 5 * DEG))
    alone = by_the_imu_alone()
    by_lengths = replace(alone, evidence=replace(alone.evidence, site=site))
    for seen in (at(site), by_lengths):
        words = symptom(verify(calibration(), seen), gyros=False)
        assert 'when gravity is 9.79' in words
        assert f'instead of {site.gravity:.5f}' in words


@pytest.mark.parametrize(
    ('warmer', 'words'),
    [
        (None, 'causes: another temperature, the clock of the IMU, or another nominal scale'),
        (0.02, 'causes: the clock of the IMU, or another nominal scale factor'),
        (-1.5, 'causes: the temperature (the recording is 1.5 K colder; 20 ppm/K suffice), the cl'),
    ],
)
def test_temperature_is_a_cause_where_it_differs_or_is_not_known(
    warmer: float | None, words: str
) -> None:
    seen = replace(without_moves(), warmer=warmer)
    alike = gyro(g().error_matrix + 30 * PPM * g().response)
    said = symptom(verify(alike, seen), gyros=True)
    assert re.search(r'all gyros answer (29|30|31)\.\d ppm less', said)
    assert words in said
    biased = verify(gyro(bias=g().bias + np.array([2 * DEG_H, 0.0, 0.0])), seen)
    told = {
        None: 'They have moved: another temperature, or time.',
        0.02: 'moved with time: the temperature is that of the calibration.',
        -1.5: 'They have moved: the recording is 1.5 K colder than the calibration, or with time.',
    }
    assert told[warmer] in symptom(biased, gyros=True)


def test_without_plan_and_table_lengths_are_compared() -> None:
    verification = verify(calibration(), by_the_imu_alone())
    assert verification.verdict is not Verdict.FAIL
    assert {c.quantity for c in verification.compared} == {
        Quantity.GRAVITY,
        Quantity.EARTH_RATE,
        Quantity.UP_RATE,
    }
    assert any('The attitudes are unknown' in finding for finding in verification.findings)
    of_gyros = [p.name for p in calibration().parameters[:12] if p.kind is not ParameterKind.BIAS]
    assert set(of_gyros) <= set(verification.untested)
    assert {'K_ax', 'K_ay', 'K_az', 'D_ax', 'D_gx'}.isdisjoint(verification.untested)


@pytest.mark.parametrize(
    'name', ['accelerometer biases negated', 'gyro biases negated', 'another scale factor']
)
def test_lengths_alone_tell_biases_and_scales(name: str) -> None:
    spoil, gyros, words = DEFECTS[name]
    verification = verify(spoil(), by_the_imu_alone())
    assert verification.verdict is Verdict.FAIL
    assert words in symptom(verification, gyros=gyros)


def test_a_hold_in_which_the_unit_still_turned_is_named_and_left_out() -> None:
    """Three of five calibrations of real units in the hand were rejected for one such hold."""
    alone = by_the_imu_alone()
    once = alone.evidence.segments
    later = once[-1].end - once[0].start
    again = (
        replace(s, position=f'{s.position} again', start=s.start + later, end=s.end + later)
        for s in once
    )
    holds = [*once, *again]
    good = replace(alone, evidence=replace(alone.evidence, segments=tuple(holds)))
    assert verify(calibration(), good).verdict is Verdict.PASS
    mean = holds[3].statistics.mean
    turned = mean + np.append(0.1 * DEG * mean[3:] / np.linalg.norm(mean[3:]), np.zeros(3))
    holds[3] = replace(holds[3], statistics=replace(holds[3].statistics, mean=turned))
    seen = replace(alone, evidence=replace(alone.evidence, segments=tuple(holds)))
    found = verify(calibration(), seen)
    assert found.verdict is Verdict.PASS
    assert f'In hold {holds[3].position}, at ' in found.findings[0]
    assert 'contradict all others by 0.1 deg/s about the vertical' in found.findings[0]
    # Of a calibration that is wrong more than one hold tells.
    spoil = DEFECTS['gyro biases negated'][0]
    assert verify(spoil(), seen).verdict is Verdict.FAIL


@pytest.mark.parametrize('name', ['accelerometer biases negated', 'gyro biases negated'])
def test_by_lengths_what_cannot_explain_a_session_is_not_fitted(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared, fitted = [], []
    monkeypatch.setattr(system, 'compare_lengths', counting(system.compare_lengths, compared))
    monkeypatch.setattr(system, 'least_squares', counting(system.least_squares, fitted))
    spoil, gyros, words = DEFECTS[name]
    assert words in symptom(verify(spoil(), by_the_imu_alone()), gyros=gyros)
    sensors = Sensors.from_parameters(calibration().parameters, gyros=gyros)
    values = calibration().model.values(sensors.parameters)
    # What frees parameters is fitted, and the two triads, and few of the others.
    assert len(fitted) < 20
    assert len(compared) < 4 * len(list(mistakes(sensors, values)))


def counting(function: Callable[..., Any], calls: list[None]) -> Callable[..., Any]:
    def counted(*arguments: Any) -> Any:
        calls.append(None)
        return function(*arguments)

    return counted


def test_a_g_sensitivity_that_has_moved_is_said_in_words() -> None:
    good = calibration()
    parameters = G_SENSITIVITY.parameters
    covariance = np.pad(good.covariance, (0, len(parameters)))
    covariance[-len(parameters) :, -len(parameters) :] += 1e-24 * np.eye(len(parameters))
    values = np.append(good.values, np.full(len(parameters), 2e-6))
    model = good.model.with_values((*good.parameters, *parameters), values)
    wrong = replace(
        good, model=model, parameters=(*good.parameters, *parameters), covariance=covariance
    )
    assert 'the g-sensitivity is' in symptom(verify(wrong, without_moves()), gyros=True)


def test_turns_alone_tell_no_heading_and_spend_nothing_on_it() -> None:
    evidence = replace(without_moves().evidence, segments=())
    (judged,) = verify(calibration(), replace(without_moves(), evidence=evidence)).triads
    assert judged.freedom == 3 * len(evidence.turns)


def test_a_recording_of_nothing_known_is_no_judge() -> None:
    evidence = without_moves().evidence
    first, _, third, *_ = seen = list(evidence.segments)
    # Two positions exchanged: no parameters explain the outputs.
    seen[0], seen[2] = (
        replace(first, attitude=third.attitude),
        replace(third, attitude=first.attitude),
    )
    with pytest.raises(NotObservable, match='No parameters whatever explain'):
        exchanged = replace(evidence, segments=tuple(seen))
        verify(calibration(), replace(without_moves(), evidence=exchanged))


@pytest.mark.repeats
def test_an_axis_off_by_what_the_table_states_is_no_fault_of_the_calibration() -> None:
    # The inner axis leans by 60 arcsec, ten times what a rest of 20 s leaves open of up.
    table, lean = load_table('three_axis'), 60 * ARCSEC
    across = replace(table.joints[2], axis=(0.0, 1.0, 0.0))
    leaning = replace(table, joints=(*table.joints[:2], across, table.joints[2]))

    def attitude(angles: Floats | None) -> Floats:
        assert angles is not None
        return leaning.attitude(np.insert(angles, 2, lean))

    evidence = observed().evidence
    segments = tuple(replace(s, attitude=attitude(s.angles)) for s in evidence.segments)
    turns = tuple(replace(t, up=attitude(t.angles)[2]) for t in evidence.turns)

    def stating(**stated: float) -> Verification:
        stated_table = replace(table, errors=TableErrors(**stated))
        seen = replace(evidence, segments=segments, turns=turns, table=stated_table)
        return verify(calibration(), replace(observed(), evidence=seen))

    assert stating().verdict is Verdict.FAIL
    known = stating(orthogonality=lean)
    assert known.verdict is Verdict.PASS
    # What leans in common leaves every angle its own deviation, and no length.
    far, near = (
        {q: max(abs(c.ratio) for c in v.compared if c.quantity is q) for q in Quantity}
        for v in (stating(), known)
    )
    for quantity in (Quantity.DIRECTION, Quantity.TURN_AXIS):
        assert far[quantity] > stating().limits[1]
        assert near[quantity] < known.limits[0]
    assert near[Quantity.GRAVITY] == pytest.approx(far[Quantity.GRAVITY], rel=1e-3)


def test_what_a_latitude_leaves_open_is_no_fault_of_the_calibration() -> None:
    # 10 deg off: the vertical Earth rate of every rest by 2.1 deg/h, three of its deviations.
    off = replace(SITE, latitude=LATITUDE + 10 * DEG)
    assert verify(calibration(), at(off)).verdict is not Verdict.PASS
    unsure = verify(calibration(), at(replace(off, latitude_std=10 * DEG)))
    assert unsure.verdict is Verdict.PASS
    assert not unsure.findings
    up = [c.ratio for c in unsure.compared if c.quantity is Quantity.UP_RATE]
    # All are off alike, by less than one deviation and their own noise.
    assert abs(np.mean(up)) < 1.5


def test_a_session_that_scatters_beyond_its_noise_is_not_accepted_without_a_doubt() -> None:
    # At the pole the level Earth rate of these rests has no place.
    site = replace(SITE, latitude=85 * DEG)
    verification = verify(calibration(), at(site))
    assert verification.verdict is not Verdict.PASS
    words = 'Scatter this large alone makes the verdict MARGINAL.'
    assert any(words in finding for finding in verification.findings)


def test_a_model_without_an_inverse_is_refused_in_words() -> None:
    with pytest.raises(NotObservable, match='cannot be inverted'):
        verify(gyro(-np.eye(3)), observed())


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of unit A1 in the six positions, short dwells and the fastest turns alone."""
    folder = tmp_path_factory.mktemp('recorded')
    text = named_file('plans', 'six_position').read_text(encoding='utf-8')
    text = re.sub(r'(?m)^dwell: .* s', 'dwell: 20 s', text)
    file, bag = folder / 'short.yaml', folder / 'bag'
    file.write_text(re.sub(r'rates: \[.*, (.*, .*)\]', r'rates: [\1]', text))
    data = describe(str(file), 'fog_medium', 'three_axis', SITE, 'A1')
    with RecordingWriter(bag, data) as writer:
        # A day after the session of the calibration.
        later = stand(azimuth=HEADING, start_time=begin_of(1))
        for topic, block in session(load_plan(str(file)), later, seed=1):
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)
    return bag


def test_the_command_accepts_rejects_and_refuses_by_its_exit_code(
    tmp_path: Path, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = recorded
    good, bad = tmp_path / 'good.yaml', tmp_path / 'bad.yaml'
    calibration().save(good)
    gyro(g().error_matrix.T).save(bad)
    assert main(['verify', str(bag), '--calibration', str(good)]) == 0
    output = capsys.readouterr().out
    assert 'PASS: ' in output
    assert 'x_down' in output
    assert main(['verify', str(bag), '--calibration', str(bad)]) == 1
    output = capsys.readouterr().out
    assert 'FAIL: ' in output
    assert 'vanish when the gyro error matrix is transposed' in output
    assert main(['verify', str(bag), '--calibration', str(tmp_path / 'none.yaml')]) == 2


def test_the_calibration_of_another_unit_is_refused_by_its_name_and_by_its_data(
    tmp_path: Path, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = recorded
    good = replace(calibration(), serial_number='A1')
    other_type = replace(good, imu=replace(good.imu, id='fog_other'))
    other_unit = replace(good, serial_number='B9')
    file = tmp_path / 'a.yaml'
    words = ['verify', str(bag), '--calibration', str(file)]
    for stranger, found, expected in (
        (other_type, 'imu: found fog_other', 'expected fog_medium'),
        (other_unit, 'serial_number: found B9', 'expected A1'),
    ):
        stranger.save(file)
        assert main(words) == 2
        errors = ' '.join(capsys.readouterr().err.split())
        assert found in errors
        assert expected in errors
        assert '--another-unit' in errors
        assert main([*words, '--another-unit']) == 0
    # One of the same type that states no serial number: ten deviations of the data sheet off.
    far = gyro(bias=g().bias + np.array([1.0, -1.0, 1.0]) * 10 * 0.1 * DEG_H * np.sqrt(3))
    far.save(file)
    assert main(words) == 1


@pytest.mark.parametrize(
    ('share', 'gyros', 'words'),
    [
        (DEG, True, 'degrees taken for radians'),
        (1 / DEG, True, 'radians taken for degrees'),
        (STANDARD_GRAVITY, False, 'g taken for m/s^2'),
        (1 / STANDARD_GRAVITY, False, 'm/s^2 taken for g'),
    ],
)
def test_numbers_to_be_multiplied_are_of_the_larger_unit(
    share: float, gyros: bool, words: str
) -> None:
    assert share_in_words(share, gyros=gyros) == words
