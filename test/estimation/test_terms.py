"""Sessions of units with terms: simulated, calibrated with --terms, verified, applied."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sessions import SITE, fed, quick_plan, stand

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import calibrator_of
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file, share_folder
from imu_calib.estimation.forecast import forecast
from imu_calib.estimation.hand import NAME as FREE_POSITIONS
from imu_calib.estimation.hand import in_frame_of_accelerometers
from imu_calib.estimation.methods import JOINT, METHODS, estimated_parameters, method
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import parameters_of, terms_of
from imu_calib.model.terms import TERMS, asks_for_search, named_terms
from imu_calib.session.imu import load_imu
from imu_calib.session.keywords import Stated
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

PLAN = quick_plan('twelve_position', 30.0)
TOO_FAR = 4.5
"""Standard deviations that one of some forty normal numbers exceeds once in 4000 sessions."""


@cache
def calibrated_with(truth: str, terms: str, seed: int = 0) -> tuple[Calibration, Result]:
    model = Calibration.load(named_file('truths', truth))
    imu, table = load_imu(model.imu.id), load_table('three_axis')
    blocks = simulate(PLAN, table, imu, model.model, SITE, stand(azimuth=0.4), seed)
    return model, fed(blocks, Setup(imu, PLAN, table, SITE, terms=named_terms(terms))).finish()


def requested_terms(truth: str) -> str:
    """The terms that the head of a shipped truth says to calibrate with."""
    found = re.search(r'--terms ([\w,]+)', named_file('truths', truth).read_text())
    assert found is not None
    return found[1]


SHIPPED = ['fog_navigation_terms', 'mems_counts_terms', 'mems_counts_motion']


@pytest.mark.parametrize('truth', SHIPPED)
def test_a_simulated_session_gives_back_its_terms(truth: str) -> None:
    model, result = calibrated_with(truth, requested_terms(truth))
    calibration = result.calibration
    assert calibration.parameters == parameters_of(terms_of(model.parameters))
    off = (calibration.values - model.model.values(calibration.parameters)) / calibration.std
    assert np.abs(off).max() < TOO_FAR
    # They are there beyond chance, one coefficient of each at least.
    for term in terms_of(calibration.parameters):
        mine = [k for k, p in enumerate(calibration.parameters) if p in term.parameters]
        assert np.abs(calibration.values[mine] / calibration.std[mine]).max() > TOO_FAR
    assert calibration.provenance['terms'] == requested_terms(truth).split(',')


def test_what_is_reached_is_what_was_predicted() -> None:
    truth = 'fog_navigation_terms'
    model, result = calibrated_with(truth, requested_terms(truth))
    imu, table = load_imu(model.imu.id), load_table('three_axis')
    setup = Setup(imu, PLAN, table, SITE, terms=named_terms(requested_terms(truth)))
    found = forecast(setup, model.model)
    assert found.refusal == ''
    assert found.parameters == result.calibration.parameters
    # Scatter that one short session seems to show may widen it, pulses and dwells are not quite
    # those of the plan.
    ratio = result.calibration.std / found.std
    assert 0.7 < np.exp(np.mean(np.log(ratio))) < 2.0


def test_terms_are_chosen_by_name() -> None:
    assert named_terms('none') == ()
    assert [t.name for t in named_terms('gyro_cubic, g_sensitivity,gyro_cubic')] == [
        'gyro_cubic',
        'g_sensitivity',
    ]
    assert named_terms('auto') == ()
    assert [t.name for t in named_terms('auto,gyro_cubic')] == ['gyro_cubic']
    assert [asks_for_search(text) for text in ('auto', 'gyro_g2, auto', 'none', 'gyro_g2')] == [
        True,
        True,
        False,
        False,
    ]
    with pytest.raises(InputError, match=r"No term is called 'cubic'; there are: g_sensitivity, "):
        named_terms('gyro_cubic,cubic')


@pytest.mark.parametrize('name', sorted(METHODS))
def test_every_method_declares_what_it_estimates(name: str) -> None:
    parameters = estimated_parameters(name)
    assert len(set(parameters)) == len(parameters) >= 12
    one = TERMS[1:2]
    if name in JOINT:
        assert set(estimated_parameters(name, one)) == {*parameters, *one[0].parameters}
        return
    if name == FREE_POSITIONS:
        said = 'in the hand cannot estimate gyro_asymmetry. It tests g_sensitivity, .* trend:D_a,'
    else:
        said = f'Method {name} estimates its own parameters'
    with pytest.raises(InputError, match=said):
        method(name, one)


@pytest.mark.parametrize('terms', ['gyro_g2', 'trend', 'thermal', 'step, g_sensitivity'])
def test_a_session_in_the_hand_refuses_terms_that_it_does_not_test(terms: str) -> None:
    stated = Stated(terms=terms)
    setup = Setup(
        load_imu('si'),
        load_plan('free_positions'),
        None,
        Site.at(0.8),
        terms=stated.sensor_terms,
        changes=stated.changes,
    )
    with pytest.raises(InputError, match=f'cannot estimate {terms.split(",", maxsplit=1)[0]}'):
        calibrator_of(setup)
    tested = Stated(terms='g_sensitivity, accel_cubic, trend:D_g+D_a')
    assert calibrator_of(replace(setup, terms=tested.sensor_terms, changes=tested.changes))


def test_the_commands_take_terms_from_simulation_to_firmware(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    truth = SHIPPED[0]
    text = (share_folder() / 'config' / 'plans' / 'twelve_position.yaml').read_text()
    text = re.sub(r'rates: \[.*\]', 'rates: [20 deg/s, -20 deg/s, 60 deg/s, -60 deg/s]', text)
    (tmp_path / 'short.yaml').write_text(text.replace('dwell: 120 s', 'dwell: 25 s'))

    def run(*words: str, code: int = 0) -> str:
        assert main(list(words)) == code
        printed = capsys.readouterr()
        return ' '.join((printed.out + printed.err).split())

    place = ['--latitude', '34.65', '--gravity', '9.797']
    for bag, seed in (('one', '1'), ('two', '2')):
        words = ['--imu', 'fog_navigation', '--truth', truth, '--seed', seed, *place]
        run('simulate', './short.yaml', '-o', bag, *words)
    run('calibrate', 'one', '-o', 'auto.yaml')
    found = Calibration.load(tmp_path / 'auto.yaml')
    assert set(found.provenance['terms']) == set(requested_terms(truth).split(','))
    assert any('accel_asymmetry would explain it as well' in f for f in found.findings)
    shown = run('calibrate', 'one', '--terms', requested_terms(truth), '-o', 'c.yaml')
    assert all(name in shown for name in ('A_gx', 'N_gz', 'K2_ay', 'ug/g^2'))
    assert 'PASS: ' in run('verify', 'two', '--calibration', 'c.yaml')
    # The truth is of a paper; it is outside the limits of the file's example.
    run('report', 'c.yaml', 'one', '-o', 'c.html', code=3)
    report = (tmp_path / 'c.html').read_text(encoding='utf-8')
    assert '<h2>Terms</h2>' in report
    assert 'gyro rate dependence' in report
    assert 'samples of /imu/pulses' in run(
        'compensate', 'two', '--calibration', 'c.yaml', '-o', 'three'
    )
    run('export', 'c.yaml', '--format', 'c', '-o', 'unit.h')
    refused = run('export', 'c.yaml', '--format', 'imucal', '-o', 'x', '--sample-rate', '9', code=2)
    assert 'The format imucal has no gyro asymmetry' in refused
    # Joints pass 45 degrees one at a time: velocities tell accel_cubic, if badly, no cross term.
    refused = run('calibrate', 'one', '--terms', 'accel_cross', '-o', 'x.yaml', '--verbose', code=1)
    assert 'accel_cross (X_axxy, X_axyz, X_ayxz' in refused
    assert '45 degrees off the vertical' in refused
    words = ['--terms', 'gyro_cubic', '--method', 'six_position']
    assert 'no further terms' in run('calibrate', 'one', *words, '-o', 'x.yaml', code=2)


def test_a_frame_of_holds_keeps_the_terms() -> None:
    model = Calibration.load(named_file('truths', 'fog_navigation_terms')).model
    kept = in_frame_of_accelerometers(model)
    for term in terms_of(model.parameters):
        assert kept.values(term.parameters).tolist() == model.values(term.parameters).tolist()
