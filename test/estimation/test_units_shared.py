"""What several units share of their table, against a simulation that shares no code with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
import units_world as world
from units_sessions import PULSE, TABLE, TURNED, WALK, solved, tilt, truth

from imu_calib.calibration.calibrator import estimate_together
from imu_calib.common.budget import ErrorSource, total
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.session_model import Nuisance

NAMES = ['one', 'two', 'three', 'four']
UNITS = len(NAMES)


class Session:
    """Four units on one table: the truth, each by itself, and all of them together."""

    def __init__(self, seed):
        self.table = world.turned(seed)
        rng = np.random.default_rng([seed, 7])
        self.units, self.counts = [], []
        for k in range(UNITS):
            unit = world.drawn(rng, WALK, PULSE, TURNED if k % 2 else np.eye(3))
            self.units.append(unit)
            self.counts.append(world.sampled(self.table, unit, rng))
        pairs = zip(self.units, self.counts, strict=True)
        self.alone = [solved(self.table, unit, counts) for unit, counts in pairs]
        self.shared = estimate_together(self.alone, NAMES)


@pytest.fixture(scope='module')
def sessions():
    return [Session(seed) for seed in range(2)]


def likely(square, freedom):
    """Chi-square within what chance gives but once in 10^5 on either side."""
    low, high = scipy.stats.chi2.isf([1 - 1e-5, 1e-5], freedom)
    return low < square < high


def test_all_units_take_part_and_their_deviations_are_honest(sessions):
    for session in sessions:
        assert session.shared.shared == tuple(range(UNITS))
        for unit, result in zip(session.units, session.shared.results, strict=True):
            found = result.calibration
            error = found.values - truth(unit)
            assert likely(error @ np.linalg.solve(found.covariance, error), 24)
            others = [name for name in NAMES if name not in found.provenance['shared_with']]
            assert len(others) == 1


def test_the_tables_tilts_are_better_by_the_root_of_the_number_of_units(sessions):
    squares = 0.0
    for session in sessions:
        table_estimate = session.shared.table
        assert table_estimate.names[:3] == ('azimuth', 'tilt about x', 'tilt about y')
        squares += float(
            (
                ((table_estimate.values[1:3] - tilt(session.table)) / table_estimate.std[1:3]) ** 2
            ).sum()
        )
        for which, std in zip(
            (Nuisance.TILT_X, Nuisance.TILT_Y), table_estimate.std[1:3], strict=True
        ):
            by_itself = [
                result.solution.search.estimate.nuisance(which)[1] for result in session.alone
            ]
            # Sensors' noise alone limits them: positioning errors of a joint do not tilt the base.
            assert std == pytest.approx(np.mean(by_itself) / np.sqrt(UNITS), rel=0.1)
    assert likely(squares, 2 * len(sessions))


def test_positioning_errors_are_those_of_the_table(sessions):
    """Each stop's error, but for what is a change of frame, lies within its stated deviation."""
    for session in sessions:
        table_estimate = session.shared.table
        true = {}
        for joint, name in enumerate(TABLE.names):
            mine = [error for of, _, error in session.table.stops if of == joint]
            true[name] = np.array(mine)
        for name in ('middle', 'inner'):
            rows = [k for k, of in enumerate(table_estimate.names) if of.startswith(f'{name} at')]
            # The first stop is that of the start, which no motion led to.
            found = table_estimate.values[rows][-len(true[name]) :]
            std = table_estimate.std[rows][-len(true[name]) :]
            assert (np.abs(found - true[name]) < 4.5 * std).all()
            assert (std < 3 * world.ARCSEC).all()


def test_the_budget_of_each_unit_adds_up_to_its_covariance(sessions):
    for result in sessions[0].shared.results:
        solution = result.solution
        assert ErrorSource.OTHER_UNITS in solution.shares
        added, whole = total(solution.shares), solution.covariance
        assert np.abs(added - whole).max() < 1e-9 * np.abs(whole).max()


def test_what_other_units_say_has_the_degrees_of_freedom_of_their_noise(sessions):
    """Its size is estimated from blocks at rest, as that of the unit's own noise is."""
    alone = [result.solution.search.estimate.equations.evidence for result in sessions[0].alone]
    of_channels = np.array([evidence.walk_freedom for evidence in alone])
    turns = len(alone[0].turns)
    for k, result in enumerate(sessions[0].shared.results):
        others = np.delete(of_channels, k, axis=0)
        freedom = result.solution.shares[ErrorSource.OTHER_UNITS].freedom
        # Welch-Satterthwaite: at least those of the worst term, at most the sum (three units'
        # channels at even parts). Quantisation is known, and is under a tenth of the variance.
        assert (freedom >= others.min()).all()
        assert (freedom[:3] < 1.1 * others.sum()).all()
        # Sixteen blocks less a line's two unknowns, for each turn.
        freedom = result.solution.shares[ErrorSource.ENCODER_RATE].freedom
        assert (freedom[:3] >= 14).all()
        assert (freedom[:3] <= 14 * turns * (1 + 1e-9)).all()


def test_a_unit_that_is_loose_on_the_fixture_is_left_out_and_named(sessions):
    """It stops elsewhere by 20 arcsec each time; the others are as they are without it."""
    session = sessions[0]
    loose = replace_table(session.table, np.random.default_rng(5), 20 * world.ARCSEC)
    rng = np.random.default_rng(8)
    counts = world.sampled(loose, session.units[1], rng)
    bad = solved(session.table, session.units[1], counts)
    alone = [session.alone[0], bad, *session.alone[2:]]
    found = estimate_together(alone, NAMES)
    assert found.shared == (0, 2, 3)
    assert list(found.left_out) == [1]
    assert any(
        'contradicts the other units' in one for one in found.results[1].calibration.findings
    )
    without = estimate_together([session.alone[0], None, *session.alone[2:]], NAMES)
    for k in (0, 2, 3):
        ours, theirs = (one.results[k].calibration for one in (found, without))
        np.testing.assert_array_equal(ours.values, theirs.values)
        np.testing.assert_array_equal(ours.covariance, theirs.covariance)


def replace_table(table, rng, size):
    """The table as a unit feels it that slips about all axes at every stop of the middle joint."""
    true = table.true.copy()
    for joint, time, _ in table.stops:
        if joint:
            after = table.time >= time
            true[after] += size * rng.standard_normal(3)
    return replace(table, true=true)


def test_of_two_that_contradict_each_other_neither_is_changed(sessions):
    session = sessions[0]
    loose = replace_table(session.table, np.random.default_rng(5), 20 * world.ARCSEC)
    counts = world.sampled(loose, session.units[1], np.random.default_rng(8))
    pair = [session.alone[0], solved(session.table, session.units[1], counts)]
    found = estimate_together(pair, NAMES[:2])
    assert found.table is None
    assert found.shared == ()
    for before, after in zip(pair, found.results, strict=True):
        np.testing.assert_array_equal(before.calibration.values, after.calibration.values)
        assert any('A third unit' in one for one in after.calibration.findings)


def test_what_is_there_once_stays_as_it_is(sessions):
    """One unit, beside one that failed, shares nothing: the same bits."""
    first = sessions[0].alone[0]
    found = estimate_together([first, None], NAMES[:2])
    assert found.results[0] is first
    assert found.table is None


def test_what_one_unit_takes_for_errors_of_the_table_convinces_no_other(sessions):
    """One that believes in positioning errors of a degree leaves the others as they are."""
    session = sessions[0]
    first = session.alone[0]
    search = first.solution.search
    wild = PositioningErrors(joints=np.deg2rad(1))
    equations = replace(search.estimate.equations, positioning=wild)
    estimate = replace(search.estimate, equations=equations)
    solution = replace(first.solution, search=replace(search, estimate=estimate))
    credulous = replace(first, solution=solution)
    found = estimate_together([credulous, *session.alone[1:]], NAMES)
    for ours, theirs in zip(found.results[1:], session.shared.results[1:], strict=True):
        np.testing.assert_allclose(ours.calibration.std, theirs.calibration.std, rtol=1e-6)


def test_a_unit_that_saw_less_than_half_of_the_session_tells_nothing_of_its_table(sessions):
    session = sessions[0]
    search = session.alone[1].solution.search
    evidence = search.estimate.equations.evidence
    # Four rests and no turn are left of it.
    short = replace(evidence, segments=evidence.segments[:4], turns=(), moves=())
    equations = replace(search.estimate.equations, evidence=short, inflation=None, extra=())
    estimate = replace(search.estimate, equations=equations)
    solution = replace(session.alone[1].solution, search=replace(search, estimate=estimate))
    units = [session.alone[0], replace(session.alone[1], solution=solution), session.alone[2]]
    found = estimate_together(units, NAMES[:3])
    assert found.shared == (0, 2)
    assert 'saw 4 of the' in found.left_out[1]
