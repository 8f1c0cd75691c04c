"""Gravity scales the accelerometers: what is not known of it is in K_a, and said."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from sessions import (
    LATITUDE,
    SITE,
    at_one_rate,
    calibrate,
    fed,
    paper_imu,
    quick_plan,
    session,
    stand,
    truth,
)

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.thermal import combine
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.files import named_file
from imu_calib.common.finding import is_warning
from imu_calib.common.stream import Floats
from imu_calib.common.units import PPM
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.optimise import reach
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.system import observe
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.reports.repeatability import repeated
from imu_calib.session.metadata import describe, described_site
from imu_calib.session.table import load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.repetition import Study, economical, run_once

LUOYANG_520 = Site.at(LATITUDE, 520.0)
PLAN = at_one_rate(quick_plan('twelve_position', 20.0))
K_A = np.array([p.triad == 'a' and p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in PARAMETERS])
OF_FORCE = np.array([p.triad == 'a' and p.kind is not ParameterKind.BIAS for p in PARAMETERS])


@cache
def made_with(site: Site, truly: Site = LUOYANG_520) -> Calibration:
    """A session at a place, solved with what somebody knows of it."""
    return calibrate(session(PLAN, stand(azimuth=0.3), 4, site=truly), PLAN, site=site).calibration


def of_gravity(calibration: Calibration) -> Floats:
    """What the standard deviations are more than with an exact gravity, in ppm of the response."""
    exact = made_with(replace(SITE, gravity=calibration.provenance['gravity']))
    more = np.sqrt(np.maximum(calibration.std**2 - exact.std**2, 0.0))
    return np.asarray((more / (1 + calibration.values))[K_A] / PPM)


@pytest.mark.parametrize(
    ('stated', 'milligal'),
    [
        # Free air: 0.3086 mGal per metre. Normal gravity alone: 30 mGal.
        ({}, np.hypot(30.0, 0.3086 * 500)),
        ({'height': 520.0}, 30.0),
        ({'height': 520.0, 'height_std': 100.0}, np.hypot(30.0, 30.86)),
        ({'height': 520.0, 'gravity_std': 5e-5}, 5.0),
        ({'gravity': 9.79642}, 0.0),
        ({'gravity': 9.79642, 'gravity_std': 2e-5}, 2.0),
    ],
)
def test_what_is_known_of_a_place_is_what_is_known_of_its_gravity(stated, milligal) -> None:
    assert Site.at(LATITUDE, **stated).gravity_std == pytest.approx(milligal * 1e-5, rel=2e-3)


@pytest.mark.parametrize(
    ('stated', 'words'),
    [
        ({'height_std': 5.0}, 'height_std: .* state the height'),
        ({'height': 5.0, 'height_std': -1.0}, 'height_std: found -1'),
        ({'gravity': 9.8, 'gravity_std': float('nan')}, 'gravity_std: found nan'),
    ],
)
def test_a_doubt_that_is_none_is_refused(stated, words) -> None:
    with pytest.raises(InputError, match=words):
        Site.at(LATITUDE, **stated)


def test_an_unstated_height_is_within_the_deviations_that_are_stated() -> None:
    found = made_with(Site.at(LATITUDE))
    error = found.values - truth().values
    # 520 m are 160 mGal: 164 ppm of any response, and many deviations of the noise.
    assert error[K_A] / (1 + truth().values[K_A]) == pytest.approx(-164e-6, abs=20e-6)
    assert (np.abs(error) < 4.5 * found.std).all()
    assert of_gravity(found) == pytest.approx(np.hypot(30, 154.3) / 0.97970, rel=5e-3)
    # One gravity for all three: their errors go together.
    scale = found.covariance[np.ix_(K_A, K_A)] / np.outer(found.std[K_A], found.std[K_A])
    assert scale.min() > 0.95
    (finding,) = [f for f in found.findings if 'height' in f]
    assert '160 ppm' in finding
    assert '`height`' in finding
    assert found.provenance['height_assumed'] is True
    assert found.provenance['gravity_std'] == pytest.approx(157e-5, rel=0.01)


def test_a_height_that_is_stated_leaves_normal_gravity_in_doubt_alone() -> None:
    found = made_with(LUOYANG_520)
    assert of_gravity(found) == pytest.approx(30 / 0.97970, rel=5e-3)
    assert not [f for f in found.findings if 'height' in f]
    assert (found.provenance['height'], found.provenance['height_assumed']) == (520.0, False)


def test_the_deviations_follow_what_another_gravity_makes_of_the_same_session() -> None:
    plan, step = quick_plan('twelve_position', 20.0), 200 * PPM
    blocks = list(session(plan, stand(azimuth=0.3), 4, site=LUOYANG_520))

    def at(site: Site) -> Calibration:
        return calibrate(blocks, plan, site=site).calibration

    changed = at(replace(SITE, gravity=LUOYANG_520.gravity * (1 + step)))
    slope = (changed.values - at(replace(SITE, gravity=LUOYANG_520.gravity)).values) / step
    one = replace(LUOYANG_520, gravity_std=LUOYANG_520.gravity)
    share = at(one).covariance - at(replace(one, gravity_std=0.0)).covariance
    # Second order, and what the step leaves of the digits.
    assert share == pytest.approx(np.outer(slope, slope), abs=2e-3)
    assert np.abs(slope[~OF_FORCE]).max() < 1e-6


def test_gyros_alone_know_no_gravity() -> None:
    plan = quick_plan('off_axis_four', 20.0)
    site = Site.at(LATITUDE)
    table = replace(load_table('two_axis_off_axis'), azimuth=0.0)
    blocks = session(plan, stand(), table=table, site=site)
    found = calibrate(blocks, plan, table=table, site=site).calibration
    assert not [f for f in found.findings if 'height' in f]
    assert not np.isfinite(found.std[K_A]).any()


def test_the_screen_and_the_file_say_what_was_assumed(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    short = named_file('plans', 'twelve_position').read_text().replace('dwell: 120', 'dwell: 20')
    # The fastest turns alone.
    Path('short.yaml').write_text(re.sub(r'rates: \[.*, (.*, .*)\]', r'rates: [\1]', short))
    place = ['--latitude', '34.65', '--height', '520']
    assert main(['simulate', './short.yaml', '-o', 'bag', *place]) == 0
    assert main(['simulate', './short.yaml', '-o', 'low', *place[:2]]) == 0
    assert main(['calibrate', 'low', '-o', 'unknown.yaml']) == 0
    output = ' '.join(capsys.readouterr().out.split())
    assert 'Gravity was computed for height 0 m, since no height is stated' in output
    assert 'adds 160 ppm to the standard deviation of every K_a' in output
    document = yaml.safe_load(Path('unknown.yaml').read_text())
    assert any('no height is stated' in f for f in document['findings'])
    unknown = Calibration.load(Path('unknown.yaml'))
    assert (np.abs(unknown.values - truth().values)[K_A] < 4.5 * unknown.std[K_A]).all()
    # The recording knows its height, the command line a measured gravity.
    measured = ['--gravity', repr(LUOYANG_520.gravity)]
    for options, doubt, words in (
        ([], 30.62, ['9.79543(30) m/s']),
        (measured, 0.0, ['taken as exact', '520 m above the ellipsoid (not used']),
        (['--gravity-std', '1e-4'], 10.2, ['9.79543(10) m/s']),
        (['--height', '520', '--height-std', '100'], 43.9, ['9.79543(43) m/s']),
    ):
        assert main(['calibrate', 'bag', '-o', 'known.yaml', '--verbose', *options]) == 0
        output = ' '.join(capsys.readouterr().out.split())
        assert all(text in output for text in words)
        assert 'no height is stated' not in output
        found = Calibration.load(Path('known.yaml')).provenance
        assert found['gravity_std'] / found['gravity'] / PPM == pytest.approx(doubt, rel=2e-3)
        assert found['gravity'] == LUOYANG_520.gravity


def test_a_recording_says_what_is_known_of_its_gravity() -> None:
    for site in (Site.at(0.5), Site.at(0.5, 520.0, height_std=9.0), Site.at(0.5, gravity=9.8)):
        data = describe('twelve_position', 'fog_medium', 'three_axis', site)
        assert described_site(data, 'bag') == replace(site, latitude=pytest.approx(0.5, rel=1e-15))
    # As they were described before anybody asked for a height.
    old = {
        k: v
        for k, v in describe('twelve_position', 'si', None, Site.at(0.5)).items()
        if 'std' not in k
    }
    assert described_site(old, 'bag').gravity_std == Site.at(0.5).gravity_std


def setup(site: Site) -> Setup:
    return Setup(paper_imu(), PLAN, load_table('three_axis'), site)


def test_the_prediction_and_a_live_session_count_what_the_calibration_counts() -> None:
    site = Site.at(LATITUDE)
    ahead = forecast(setup(site), truth().model, 0.3).std
    assert ahead[K_A] == pytest.approx(made_with(site, SITE).std[K_A], rel=0.05)
    halfway = fed(session(PLAN, stand(azimuth=0.3), 4), setup(site)).snapshot().review()
    assert np.array_equal(halfway.std, made_with(site, SITE).std)


def test_no_dwell_makes_up_for_a_gravity_that_nobody_knows() -> None:
    wanted = {'K_ax': 20 * PPM}
    with pytest.raises(NotObservable, match=r'gravity is known to 1\d\d ppm.*`gravity`'):
        reach(setup(Site.at(LATITUDE)), truth().model, wanted, 0.3)
    assert reach(setup(SITE), truth().model, wanted, 0.3).forecast.std[12] < 20 * PPM


@pytest.mark.repeats
def test_repeated_sessions_err_by_what_is_not_known_of_gravity() -> None:
    study = Study(
        setup(Site.at(LATITUDE)), truth().model, economical(StandOptions(bias_instability=False))
    )
    runs = [run_once(study, seed) for seed in range(6)]
    ratio = np.array([(r.error / r.std)[12] for r in runs])
    # One standard normal number each: six of them lie between these with 99.9 %.
    assert 0.25 < np.sqrt(np.mean(ratio**2)) < 1.95
    assert np.ptp([r.error[12] for r in runs]) > 100 * PPM


def test_verify_asks_less_of_k_a_where_gravity_differs_and_no_less_where_it_is_the_same() -> None:
    unknown = Site.at(LATITUDE)
    good = made_with(unknown, SITE)
    off = replace(good, model=_scaled(good.model, 100 * PPM))

    def verdict(calibration: Calibration, site: Site) -> Verdict:
        table = load_table('three_axis')
        plan = at_one_rate(quick_plan('six_position', 20.0))
        blocks = session(plan, stand(azimuth=0.7), 3)
        calibrator = fed(blocks, Setup(paper_imu(), plan, table, site))
        observation = observe(calibrator._segmenter.finish(), paper_imu(), site, plan, table)
        return verify(calibration, observation).verdict

    assert verdict(good, unknown) is Verdict.PASS
    # The same place: gravity errs alike in both, and 100 ppm are the unit's.
    assert verdict(off, unknown) is Verdict.FAIL
    # Elsewhere they are less than one standard deviation of the gravities.
    assert verdict(off, replace(unknown, latitude=LATITUDE + 1e-9)) is Verdict.PASS


def _scaled(model, more):
    matrix = model.accel.response * (1 + more) - np.eye(3)
    return replace(model, accel=replace(model.accel, error_matrix=matrix))


def test_several_sessions_of_one_place_share_the_error_of_gravity() -> None:
    both = []
    for celsius in (0.0, 40.0):
        made = made_with(Site.at(LATITUDE))
        temperature = {'mean': celsius, 'lowest': celsius, 'highest': celsius}
        # Of two recordings: one in place of both would be refused.
        values = made.model.vector() + celsius * 1e-12
        made = replace(made, model=made.model.with_values(PARAMETERS, values))
        both.append(replace(made, provenance={**made.provenance, 'temperature': temperature}))
    between = combine(both, ['a', 'b']).at(20.0)
    assert of_gravity(between) == pytest.approx(of_gravity(both[0]), rel=0.01)
    rows = {r.parameter.name: r for r in repeated(both, ['a', 'b'])}
    exact = made_with(replace(SITE, gravity=normal_gravity(LATITUDE)))
    assert rows['K_ax'].stated == pytest.approx(exact.std[12], rel=1e-6)


@pytest.mark.parametrize(
    ('place', 'off', 'std', 'said'),
    [
        ((52.29, 120.0), -582, 2e-6, '-582 ppm off normal gravity at latitude 52.29 deg'),
        ((52.29, 120.0), 600, 0.0, '+600 ppm off normal gravity at latitude 52.29 deg'),
        # Anomalies of lowlands and of mountains; a deviation that covers the difference.
        ((52.29, 120.0), 100, 2e-6, ''),
        ((46.0, 3000.0), 350, 0.0, ''),
        ((52.29, 120.0), -582, 0.003, ''),
        # 2000 m of height that are not stated.
        ((52.29, None), -620, 0.0, 'height 0 m (none is stated)'),
    ],
)
def test_a_gravity_that_no_place_of_the_latitude_and_height_has_is_a_warning(place, off, std, said):
    latitude, height = math.radians(place[0]), place[1]
    gravity = normal_gravity(latitude, height or 0.0) * (1 + off * 1e-6)
    found = Site.at(latitude, height, gravity, gravity_std=std).contradictions
    assert [is_warning(text) and said in text for text in found] == [True] * bool(said)


@pytest.mark.parametrize(
    ('gravity', 'latitude', 'std', 'said'),
    [
        # WGS 84 gives 9.80900 m/s^2 at 48.1 deg: 9.80665 would be that of 760 m.
        (9.80665, 48.1, 0.0, '9.80900 m/s^2: without a measurement every K_a is wrong by'),
        (9.81, 48.1, 0.0, 'about 102 ppm'),
        # Measured, one that agrees with the place, and one that is stated as uncertain.
        (9.80723, 48.1, 0.0, ''),
        (9.81, 49.2, 0.0, ''),
        (9.81, 48.1, 0.005, ''),
    ],
)
def test_standard_gravity_that_is_not_that_of_the_place_is_a_note(gravity, latitude, std, said):
    found = Site.at(math.radians(latitude), None, gravity, gravity_std=std).contradictions
    assert [not is_warning(text) and said in text for text in found] == [True] * bool(said)


def test_the_textbook_value_of_gravity_is_a_warning_of_calibration_and_verification(tmp_path):
    """9.80665 m/s^2 is 0.1 % more than the Luoyang of the session has."""
    imu_calib.simulate('six_position', tmp_path / 'day1', azimuth=0.0)
    imu_calib.simulate('six_position', tmp_path / 'day2', azimuth=0.0, seed=1)
    stated = {'gravity': 9.80665, 'gravity_std': 2e-6, 'latitude': 34.65, 'height': 0.0}
    made = imu_calib.calibrate(tmp_path / 'day1', **stated).calibration
    off = (9.80665 / normal_gravity(math.radians(34.65)) - 1) / PPM
    verified = imu_calib.verify(tmp_path / 'day2', made, **stated)
    for findings in (made.findings, verified.findings):
        warnings = [text for text in findings if is_warning(text)]
        assert any(f'gravity of 9.80665 m/s^2 is {off:+.0f} ppm off' in text for text in warnings)
