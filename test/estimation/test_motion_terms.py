"""Accelerometers that are apart and answer late: what only motion shows, found and taken off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from apart_and_late import TERMS, UNIT, known, true_values
from other_sessions import fed, true_vector
from other_world import World
from sessions import SITE, at_one_rate, gathered, quick_plan, stand, truth
from sessions import fed as fed_blocks

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.common.errors import NotObservable
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import Estimate, estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.joint import solve
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.system import Observed
from imu_calib.estimation.term_tests import TermState
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, parameters_of
from imu_calib.model.terms import DELAY, SIZE_EFFECT, Term, named_terms
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table
from imu_calib.simulation.stand import simulate

MISSES = (0.002, -0.001, 0.001), (-0.001, 0.002, 0.001)

WORLD = World(azimuth=0.4, dwell=10.0, misses=MISSES)
FAR = 4.5


@pytest.fixture(scope='module')
def moved() -> Evidence:
    """A session of the plain loops."""
    return gathered(fed(WORLD, UNIT))


@pytest.fixture(scope='module')
def found(moved: Evidence) -> Estimate:
    return estimate(replace(moved, coarse=True), parameters_of(TERMS))


def ran(model: SensorModel, terms: tuple[Term, ...] = ()) -> Calibrator:
    """A session of the package's own simulation, of fine pulses."""
    spec = load_imu('fog_navigation')
    spec = replace(spec, accel=replace(spec.accel, scale_factor=1e-5))
    plan, table = at_one_rate(quick_plan('twelve_position', 10.0)), load_table('three_axis')
    options = stand(azimuth=0.3, lever=(0.1, -0.2, 0.05), sample_rate=50.0)
    setup = Setup(spec, plan, table, SITE, terms=terms)
    return fed_blocks(simulate(plan, table, spec, model, SITE, options, 4), setup)


def test_places_and_delays_are_found(found: Estimate) -> None:
    std = np.sqrt(np.diag(found.covariance)[:31])
    off = (found.state[:31] - true_values()) / std
    # 31 parameters: chance passes 4.5 deviations once in 4000 sessions.
    assert np.abs(off).max() < FAR, np.round(off, 1)
    # Chi-square of 31 is below 7 with a probability of 1e-6.
    assert (off**2).sum() > 7
    # They are seen: a hundredth of a centimetre, ten microseconds.
    assert std[24:30].max() < 5e-4
    assert std[30:].max() < 5e-5
    assert not found.rejected_moves
    assert not found.outliers


def test_places_and_delays_that_nobody_asked_for_are_found_and_named(moved: Evidence) -> None:
    solution = solve(moved, find_terms=True)
    findings = [f for f in solution.findings if 'The session shows' in f]
    assert ['size_effect' in one for one in findings].count(True) == 1
    assert ['(delay' in one for one in findings].count(True) == 1
    assert len(findings) == 2
    assert solution.parameters == parameters_of(TERMS)
    off = (solution.model.values(solution.parameters) - true_values()) / solution.std
    assert np.abs(off).max() < FAR, np.round(off, 1)
    states = {test.name: test.state for test in solution.tests}
    assert {name for name, state in states.items() if state is TermState.FOUND} == {
        'size_effect',
        'delay',
    }


def test_where_they_are_off_the_others_are_right_all_the_same(moved: Evidence) -> None:
    without = solve(moved)
    off = (without.model.vector() - true_vector(UNIT)) / without.std
    assert np.abs(off).max() < FAR, np.round(off, 1)
    # What the velocities tell of them is no more than of what is sought: the deviations stay.
    known = solve(moved, TERMS)
    assert known.std[:24] == pytest.approx(without.std, rel=0.02)


def test_accelerometers_that_are_together_and_in_time_are_found_so() -> None:
    solution = solve(gathered(ran(truth().model)), find_terms=True)
    assert not [f for f in solution.findings if 'The session shows' in f]
    tests = {test.name: test for test in solution.tests}
    for name in ('size_effect', 'delay'):
        assert tests[name].state is TermState.OFF
        assert tests[name].log10_p > -3


def test_verify_holds_them_against_a_recording(moved: Evidence) -> None:
    observation = Observed(moved, known(terms=True).imu)
    right = SensorModel().with_values(parameters_of(TERMS), true_values())
    spread = np.diag((1e-6 * np.abs(true_values())) ** 2)
    calibration = replace(known(terms=True), model=right, covariance=spread)
    assert verify(calibration, observation).verdict is Verdict.PASS
    for parameter in (*SIZE_EFFECT.parameters[:1], *DELAY.parameters):
        value = right.values((parameter,))
        wrong = replace(calibration, model=right.with_values((parameter,), 1.1 * value))
        judged = {t.gyros: t.verdict for t in verify(wrong, observation).triads}
        assert judged == {True: Verdict.PASS, False: Verdict.FAIL}, parameter.name
    # Gyros carry the axes of velocities: 1000 ppm are their fault alone.
    wrong = replace(calibration, model=right.with_values(PARAMETERS[:1], right.vector()[:1] + 1e-3))
    judged = {t.gyros: t.verdict for t in verify(wrong, observation).triads}
    assert judged == {True: Verdict.FAIL, False: Verdict.PASS}


def test_pulses_that_hide_them_refuse_them(moved: Evidence) -> None:
    coarse = tuple(
        replace(m, velocity_steps=replace(m.velocity_steps, pulse=np.full(3, 1.0)))
        for m in moved.moves
    )
    blind = replace(moved, moves=coarse, coarse=True)
    with pytest.raises(NotObservable, match=r'do not determine size_effect \(P_axy.*pulses'):
        estimate(blind, parameters_of(named_terms('size_effect')))
    with pytest.raises(NotObservable, match=r'determine delay \(T_a\)'):
        estimate(replace(moved, moves=()), parameters_of(named_terms('delay')))


def test_derivatives_are_those_of_the_prediction(moved: Evidence) -> None:
    equations = Equations(moved, parameters_of(TERMS))
    state = equations.nominal()
    state[:32] = [*true_values(), 0.4]
    found = equations.jacobian(state)
    for k in range(24, 31):
        # The axes half way lean by the arcseconds that the rotation is off; of the delay the second
        # order is what they turn by in it.
        step, within = (1e-4, 1e-5) if k < 30 else (1e-6, 2e-3)
        up, down = state.copy(), state.copy()
        up[k] += step
        down[k] -= step
        slope = (equations.predict(up) - equations.predict(down)) / (2 * step)
        size = np.abs(found[:, k]).max()
        assert size > 0.1
        assert slope == pytest.approx(found[:, k], abs=within * size)


def test_the_package_simulates_what_other_code_does() -> None:
    """The stand's own unit with them, calibrated: they come out as they were stated."""
    given = np.concatenate([truth().model.vector(), true_values()[24:]])
    model = SensorModel().with_values(parameters_of(TERMS), given)
    found = ran(model, TERMS).finish().calibration
    off = (found.values - given) / found.std
    assert np.abs(off[24:]).max() < FAR, np.round(off, 1)
    assert found.std[24:30].max() < 1e-3
    again = Calibration.from_yaml(found.to_yaml(), 'file')
    assert again.values.tolist() == found.values.tolist()
