"""Biases that drift in a session in the hand: estimated where even, allowed for where not."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import mems_by_hand
import numpy as np
import pytest
from extent import ALL
from hand_sessions import spread_holds
from mpu_by_hand import IMU, UNIT, off
from shaky import GRAVITY, LATITUDE, shaky

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.hand import HandCalibrator
from imu_calib.calibration.results import Result
from imu_calib.calibration.verify import verify
from imu_calib.common.budget import ErrorSource
from imu_calib.common.finding import is_warning
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.hand import ESTIMATES
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.system import observe
from imu_calib.model.earth import Site
from imu_calib.model.parameters import ParameterKind
from imu_calib.model.sensors import SensorModel
from imu_calib.session.plan import load_plan
from imu_calib.simulation.options import BiasStep

SITE = Site.at(float(LATITUDE), gravity=GRAVITY)
EVENLY = r'Biases drift evenly during the session, of the gyros by up to ([0-9.]+) deg/s'
NONE = (0.0, 0.0)
GYROS = (0.5 * DEG, 0.0)
BOTH = (0.5 * DEG, 0.2)
"""By how much biases drift during the session, rad/s and m/s^2."""
ALONG = np.array([1.0, -0.6, 0.3])
"""Of that, by the axes."""


@cache
def session(drift: tuple[float, float], holds: int, seed: int, settling: float = 0.0) -> Result:
    """Calibrate a unit whose biases drift: evenly, or settling within a share of the session."""
    held = shaky(SensorModel(), rate=100, noise=(0.1 * DEG, 0.01), holds=holds, seed=seed)
    block = held.block
    # From the first hold to the last: its middle is that of the holds.
    time = (block.stamp - block.stamp[0]) * 1e-9 - held.holds[0, 0]
    share = time / (held.holds[-1, 1] - held.holds[0, 0])
    course = np.exp(-np.maximum(share, 0.0) / settling) if settling else share - 0.5
    gyro = block.gyro @ UNIT.gyro.response.T + UNIT.gyro.bias
    accel = block.accel @ UNIT.accel.response.T + UNIT.accel.bias
    gyro = gyro + np.outer(course, drift[0] * ALONG)
    accel = accel + np.outer(course, drift[1] * ALONG)
    found = HandCalibrator(Setup(IMU, load_plan('free_positions'), None, SITE))
    found.add_block(replace(block, gyro=gyro, accel=accel))
    return found.finish()


def said(found: Result) -> str:
    return ' '.join(found.calibration.findings)


def per_second(found: Result, drift: tuple[float, float]) -> Floats:
    """Drifts, as they are: rad/s and m/s^2 in a second."""
    first, *_, last = found.session.segments
    length = (last.end - first.start) * 1e-9
    return np.concatenate([size * ALONG for size in drift if size]) / length


@pytest.mark.parametrize(
    ('drift', 'holds', 'seed'),
    [
        # Two turns were outliers, and a parameter off by 4.6 deviations.
        (GYROS, 10, 0),
        # Gyros were said to respond to gravity, by 0.32 deg/s per g.
        (BOTH, 12, 2),
        # A turn was an outlier, and a parameter off by 7.2 deviations.
        (BOTH, 10, 4),
        *((drift, 10 + seed % 5, seed) for drift in (GYROS, BOTH) for seed in range(6) if ALL),
    ],
)
def test_an_even_drift_is_estimated(drift: tuple[float, float], holds: int, seed: int) -> None:
    found = session(drift, holds, seed)
    assert np.abs(off(found)).max() < 4.5
    changes = found.calibration.changes
    assert changes is not None
    assert np.abs((changes.values - per_second(found, drift)) / changes.std).max() < 4.5
    assert len(found.calibration.parameters) == 24
    assert changes.cross.shape == (24, len(changes.values))
    sentence = re.search(EVENLY, said(found))
    assert sentence is not None
    assert float(sentence[1]) == pytest.approx(0.5, rel=0.1)
    assert ('of the accelerometers by up to 2' in said(found)) == (drift is BOTH)
    assert 'times their noise' not in said(found)


def test_a_drift_is_among_the_terms_and_in_the_file() -> None:
    found = session(BOTH, 12, 2)
    assert found.terms[0] == 'terms: trend:D_g, trend:D_a'
    read = Calibration.from_yaml(found.calibration.to_yaml(), 'it')
    tests = read.provenance['tests_of_terms']
    assert tests['trend:D_g']['state'] == 'found'  # type: ignore[index]
    assert read.changes is not None
    names = [change.name for change in read.changes.changes]
    assert names == ['D_gx', 'D_gy', 'D_gz', 'D_ax', 'D_ay', 'D_az']
    assert found.calibration.changes is not None
    assert read.changes.values == pytest.approx(found.calibration.changes.values)


@pytest.mark.parametrize(
    ('drift', 'seed', 'names'), [(GYROS, 1, 'D_gx, D_gy, D_gz'), (NONE, 0, '')]
)
def test_verify_says_which_parameters_changed(
    drift: tuple[float, float], seed: int, names: str
) -> None:
    holds = 16 if names else 10
    found = session(drift, holds, seed)
    observed = observe(found.session, IMU, SITE, load_plan('free_positions'), None)
    changed = [f for f in verify(found.calibration, observed).findings if 'changed during' in f]
    assert [f.partition(' changed')[0] for f in changed] == [names] * bool(names)


def test_verify_tells_biases_that_drift_within_the_recording_from_another_unit() -> None:
    recorded = session((0.0, 0.3), 32, 1).session
    observed = observe(recorded, IMU, SITE, load_plan('free_positions'), None)
    judged = verify(session(NONE, 16, 0).calibration, observed)
    (found,) = [triad.diagnosis for triad in judged.triads if not triad.gyros]
    assert found is not None
    assert 'these drifted or stepped within the recording' in found.symptom
    assert {one.parameter.kind for one in found.moved} <= {ParameterKind.BIAS}


def test_verify_names_no_mistake_in_one_attitude() -> None:
    observed = observe(session(NONE, 16, 0).session, IMU, SITE, load_plan('free_positions'), None)
    evidence = observed.evidence
    alone = replace(observed, evidence=replace(evidence, segments=evidence.segments[:1], moves=()))
    calibration = session(NONE, 16, 1).calibration
    model = calibration.model
    far = replace(model.accel, bias=model.accel.bias + 0.1)
    judged = verify(replace(calibration, model=replace(model, accel=far)), alone)
    (accels,) = [triad for triad in judged.triads if not triad.gyros]
    assert accels.diagnosis is not None
    assert re.match(
        r'In the only attitude of the recording the accelerometers are off by [\d.]+ mg along '
        r'[XYZ]. Bias, scale factor and gravity cannot be told apart in one attitude: ',
        accels.diagnosis.symptom,
    )


def test_one_attitude_tests_what_it_rejects_and_names_the_others_whatever_their_errors() -> None:
    """One length of gravity accepted D_ay off by 14 standard deviations, and did not name it."""
    observed = observe(session(NONE, 16, 0).session, IMU, SITE, load_plan('free_positions'), None)
    evidence = observed.evidence
    alone = replace(observed, evidence=replace(evidence, segments=evidence.segments[:1], moves=()))
    calibration = session(NONE, 16, 1).calibration
    own = [k for k, p in enumerate(calibration.parameters) if p.triad == 'a' and calibration.std[k]]
    mine = [calibration.parameters[k] for k in own]
    found = verify(calibration, alone)
    for parameter, value, std in zip(
        mine, calibration.model.values(mine), calibration.std[own], strict=True
    ):
        # An error half as large again as one that would reach the limit exactly.
        model = calibration.model.with_values([parameter], np.array([value + 75 * std]))
        other = verify(replace(calibration, model=model), alone)
        if other.accepted:
            assert parameter.name in found.untested
            assert set(found.untested) == set(other.untested)
    assert {'K_ax', 'K_ay', 'K_az'} - set(found.untested)


def test_biases_that_stay_have_no_drift() -> None:
    for seed in range(16 if ALL else 3):
        found = session(NONE, 10, seed)
        assert found.calibration.changes is None
        assert 'drift evenly' not in said(found)
        assert 'drift unevenly' not in said(found)


def test_what_few_holds_do_not_show_is_said() -> None:
    """In ten holds a drift of the accelerometers hides in their parameters."""
    found = session(NONE, 10, 0)
    (held,) = [text for text in found.terms if 'undetected trend:D_a of up to D_a' in text]
    assert 'mg per h could bias' in held


def test_a_drift_that_settles_is_allowed_for() -> None:
    """Two turns were outliers, and a parameter was off by 8.6 deviations."""
    found = session((1.0 * DEG, 0.0), 10, 0, settling=0.4)
    # Its biases are those of no instant.
    ratios = [k for k, p in enumerate(ESTIMATES) if p.kind is not ParameterKind.BIAS]
    assert np.abs(off(found)[ratios]).max() < 4.5
    assert 'Biases wander during the session, of the gyros by up to' in said(found)
    assert 'they were still moving, and those stated are of its middle. Let the' in said(found)
    assert any(is_warning(f) for f in found.calibration.findings if 'Biases wander' in f)
    for false in ('unevenly', 'Outliers', 'respond to specific force', 'times their noise'):
        assert false not in said(found)
    assert found.solution.shares is not None
    assert ErrorSource.BIAS_FOUND in found.solution.shares


def test_a_step_of_the_biases_is_named_with_its_time_and_size() -> None:
    step = BiasStep(50.0, (120 * DEG_H, 0.0, -90 * DEG_H), (0.03, -0.02, 0.04))
    found = mems_by_hand.calibrator(
        spread_holds(30, 2), mems_by_hand.unit(2), 2, bias_step=step
    ).finish()
    (text,) = filter(is_warning, found.calibration.findings)
    stepped = re.search(r'stepped (\d+) s after .* to (0.03\d*) deg/s .* to (4|4.\d|3.\d) mg', text)
    assert stepped is not None
    assert float(stepped[1]) == pytest.approx(50, abs=3)
    assert 'wander' not in said(found)
