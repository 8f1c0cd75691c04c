"""Several units on one table against one dense system of them all, from a few rests and turns."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of

from imu_calib.common.budget import ErrorSource, total
from imu_calib.common.errors import NotObservable
from imu_calib.common.units import ARCSEC
from imu_calib.estimation import common_unknowns as module
from imu_calib.estimation.common_unknowns import (
    Contradicting,
    TableEstimate,
    _System,
    _worst,
    join,
    own_components,
    own_covariance,
)
from imu_calib.estimation.components import Component, Diagonal
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import Estimate
from imu_calib.estimation.excess_scatter import ExcessScatter
from imu_calib.estimation.information import Information
from imu_calib.estimation.positioning_errors import NO_POSITIONING_ERRORS, PositioningErrors
from imu_calib.estimation.solve import fit
from imu_calib.estimation.table_effects import CommonSizes, CommonTable
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors

SECOND = 10**9
TABLE = replace(
    load_table('three_axis'), errors=TableErrors(wobble=ARCSEC), positioning=2 * ARCSEC, azimuth=1.0
)
SIZES = CommonSizes(TABLE.errors, PositioningErrors(3 * ARCSEC, ARCSEC))


def unit_of(seed: int) -> Estimate:
    """What a unit finds by itself of twelve positions, all of them on one table."""
    evidence = evidence_of(azimuth=1.0, known=True, noise=np.random.default_rng(seed))
    rests = tuple(
        replace(s, end=s.start + 120 * SECOND, angles=np.array([0.0, 0.3 * k, -0.2 * k]))
        for k, s in enumerate(evidence.segments)
    )
    turns = tuple(
        replace(t, end=t.start + 30 * SECOND, angles=np.array([0.0, 0.3, 0.1]), joint=0)
        for t in evidence.turns
    )
    site = replace(evidence.site, latitude_std=1e-3)
    evidence = replace(
        evidence, segments=rests, turns=turns, table=TABLE, positioning=2 * ARCSEC, site=site
    )
    equations = Equations(evidence, positioning=SIZES.positioning)
    state = fit(equations, equations.nominal())
    found = Information.from_jacobian(equations.whitened(state)[0])
    scatter = ExcessScatter(NO_POSITIONING_ERRORS, np.zeros(6))
    return Estimate(equations, state, found.covariance, found.condition, scatter, (), found.gain)


@cache
def alone() -> tuple[Estimate, ...]:
    return tuple(unit_of(seed) for seed in (1, 2, 3))


class Dense:
    """All unknowns of some units at once: three of the table, its errors, and what is their own."""

    def __init__(self, states: list[Any], members: tuple[int, ...], *, priors: bool = True) -> None:
        units = [found.equations for found in alone()]
        common = CommonTable(units, SIZES).errors_at(states)
        shared = 3 + len(common.sources)
        own = [np.delete(np.arange(u.size), u.sensors + np.arange(3)) for u in units]
        width = shared + sum(map(len, own))
        rows, left, first = [], [], shared
        for k, (unit, state) in enumerate(zip(units, states, strict=True)):
            jacobian, place = unit.jacobian(state), first + np.arange(len(own[k]))
            first += len(own[k])
            if k not in members:
                continue
            white = np.linalg.inv(np.linalg.cholesky(own_covariance(unit, state)))
            block = np.zeros((len(jacobian), width))
            block[:, :3] = jacobian[:, unit.sensors + np.arange(3)]
            block[:, 3:shared], block[:, place] = common.columns[k], jacobian[:, own[k]]
            rows.append(white @ block)
            left.append(white @ (unit.outputs - unit.predict(state)))
            deviation = unit.prior_deviations
            below = np.zeros((unit.nuisances - 3, width))
            below[:, place[unit.sensors :]] = np.diag(1 / deviation[3:])
            rows.append(below)
            left.append(-state[unit.sensors :][3:] / deviation[3:])
        if priors:
            deviation = np.append(units[0].prior_deviations[:3], np.ones(shared - 3))
            rows.append(np.hstack([np.diag(1 / deviation), np.zeros((shared, width - shared))]))
            table = states[0][units[0].sensors :][:3]
            left.append(np.append(-table / deviation[:3], np.zeros(shared - 3)))
        self.rows, self.left = np.vstack(rows), np.concatenate(left)
        self.scale = np.maximum(np.linalg.norm(self.rows, axis=0), 1e-300)
        self.own = [shared + sum(map(len, own[:k])) + np.arange(24) for k in range(3)]
        self.common, self.named = shared, [k for k, name in enumerate(common.names) if name]
        self.size_of = common.sizes

    def solved(self) -> tuple[Any, float]:
        """Return the step to the least squares and the sum of squares there."""
        step = np.linalg.lstsq(self.rows / self.scale, self.left, rcond=1e-13)[0] / self.scale
        rest = self.left - self.rows @ step
        return step, float(rest @ rest)

    def covariance(self) -> Any:
        scaled = self.rows / self.scale
        return np.linalg.inv(scaled.T @ scaled) / np.outer(self.scale, self.scale)


@cache
def system() -> _System:
    found = _System(alone(), SIZES)
    found.solve()
    return found


def test_units_are_where_one_dense_system_of_them_all_has_them() -> None:
    found = [system().estimate(k) for k in range(3)]
    states = [one.state for one in found]
    dense = Dense(states, (0, 1, 2))
    step, _ = dense.solved()
    covariance = dense.covariance()
    std = np.sqrt(np.diag(covariance))
    # All but the table's errors have arrived, and these are what is found of them.
    arrived = np.delete(step / std, np.arange(3, dense.common))
    assert np.abs(arrived).max() < 1e-4
    for one, own in zip(found, dense.own, strict=True):
        n = one.equations.sensors
        both = np.append(own, np.arange(3))
        wanted = covariance[np.ix_(both, both)]
        mine = np.append(np.arange(n), n + np.arange(3))
        got = one.covariance[np.ix_(mine, mine)]
        unit = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
        assert got / unit == pytest.approx(wanted / unit, abs=1e-6)
        # What each source does adds up to all of it.
        whole = total(one.shares())
        assert whole / unit[:n, :n] == pytest.approx(wanted[:n, :n] / unit[:n, :n], abs=1e-6)
        assert one.state[n : n + 3].tolist() == found[0].state[n : n + 3].tolist()
    table_estimate = system().table_estimate()
    named = 3 + np.array(dense.named)
    sizes = dense.size_of[dense.named]
    assert table_estimate.names[:3] == ('azimuth', 'tilt about x', 'tilt about y')
    assert len(table_estimate.names) == 3 + len(named)
    values = np.append(states[0][24:27], step[named] * sizes)
    deviations = np.append(std[:3], std[named] * sizes)
    assert (table_estimate.values - values) / deviations == pytest.approx(0, abs=1e-4)
    assert table_estimate.std == pytest.approx(deviations)
    assert table_estimate.prior == pytest.approx(
        np.append(alone()[0].equations.prior_deviations[:3], sizes)
    )
    # Joints are known to two arcseconds stated and three found.
    assert sizes == pytest.approx([13**0.5 * ARCSEC] * len(sizes))


def test_a_contradiction_is_what_chi_square_rises_by_once_a_unit_is_joined(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    states = [system().estimate(k).state for k in range(3)]
    everyone = Dense(states, (0, 1, 2)).solved()[1]
    for k in range(3):
        others = Dense(states, tuple(j for j in range(3) if j != k)).solved()[1]
        by_itself = Dense(states, (k,), priors=False).solved()[1]
        message = system().contradiction(k)
        # Directions of which a unit tells a thousandth of what the others do are left out.
        monkeypatch.setattr(module, '_INFORMATIVE', 1e-9)
        square, freedom = system().contradiction(k)
        monkeypatch.undo()
        assert 3 <= message[1] < freedom
        assert message[0] < square
        assert square == pytest.approx(everyone - others - by_itself, rel=0.03)


def test_the_likelihood_is_that_of_all_outputs_but_for_a_constant() -> None:
    """Residuals, priors, and the information about what is common, over that of the priors."""
    found = []
    for joints in (3 * ARCSEC, 6 * ARCSEC):
        there = _System(alone(), replace(SIZES, positioning=PositioningErrors(joints, ARCSEC)))
        there.solve()
        found.append(there.log_likelihood)
    # Errors of six arcseconds that are not there are the less likely of the two.
    assert found[0] > found[1] + 3
    states = [system().estimate(k).state for k in range(3)]
    dense = Dense(states, (0, 1, 2))
    _, square = dense.solved()
    values = np.linalg.slogdet(dense.rows.T @ dense.rows)[1]
    own = sum(
        np.linalg.slogdet(part.T @ part)[1]
        for k in range(3)
        for part in [Dense(states, (k,), priors=False).rows[:, dense.common :]]
        for part in [part[:, part.any(axis=0)]]
    )
    deviation = alone()[0].equations.prior_deviations[:3]
    gained = values - own + 2 * np.log(deviation).sum()
    assert system().log_likelihood == pytest.approx(-0.5 * (square + gained), abs=1e-3)


def test_what_others_say_and_what_is_stated_have_shares_of_their_own() -> None:
    shares = system().estimate(0).shares()
    assert ErrorSource.OTHER_UNITS in shares
    stated, beyond = (
        shares[s] for s in (ErrorSource.POSITIONING_STATED, ErrorSource.POSITIONING_FOUND)
    )
    # Four parts of thirteen of the variance are stated.
    assert stated.covariance * 9 == pytest.approx(beyond.covariance * 4)
    assert np.isfinite(shares[ErrorSource.CLOCK].covariance).all()
    more = replace(system().estimate(0), between=np.eye(alone()[0].equations.size))
    assert more.shares()[ErrorSource.TIME_CONSTANT].covariance.tolist() == np.eye(24).tolist()
    assert ErrorSource.OTHER_UNITS not in replace(more, by_source=None).shares()


def test_what_no_other_unit_has_is_a_units_own() -> None:
    unit = alone()[0].equations
    sources = {c.source for c in own_components(unit, alone()[0].state)}
    assert ErrorSource.NOISE in sources
    assert not sources & {
        ErrorSource.POSITIONING_STATED,
        ErrorSource.STOPS,
        ErrorSource.TABLE,
        ErrorSource.LATITUDE,
    }
    outputs = len(unit.outputs)
    quiet = replace(unit, evidence=replace(unit.evidence, walk=np.zeros(6)))
    extra = Component(ErrorSource.BIAS_FOUND, Diagonal(np.arange(float(outputs))))
    found = np.diag(own_covariance(replace(quiet, extra=(extra,)), alone()[0].state))
    assert found[0] == 1e-24
    assert found[1:3] == pytest.approx([1.0, 2.0])


class Given:
    """A system whose likelihood and contradictions are given."""

    def __init__(self, units: Any, sizes: Any, squares: Any) -> None:
        self.units, self.sizes, self.squares = units, sizes, squares

    def solve(self) -> None:
        if self.sizes == 'refused':
            raise NotObservable('no end')

    @property
    def log_likelihood(self) -> float:
        return {'small': 1.0, 'large': 2.0}[self.sizes]

    def contradiction(self, k: int) -> tuple[float, int]:
        return self.squares[self.units[k]]

    def estimate(self, k: int) -> str:
        return f'{self.units[k]} of {len(self.units)}'

    def table_estimate(self) -> Any:
        return self.sizes


def joined(monkeypatch: pytest.MonkeyPatch, squares: Any, sizes: Any, seen: Any) -> Any:
    """Join units of which these chi-squares, sizes and numbers of rests of ten are known."""
    monkeypatch.setattr(module, '_System', lambda units, size: Given(units, size, squares))
    of_one_unit = lambda of: sizes[of]  # noqa: E731
    monkeypatch.setattr(module, 'CommonSizes', type('Sizes', (), {'of_one_unit': of_one_unit}))
    monkeypatch.setattr(module, 'dwell_counts', lambda _: (seen, 10))
    units = [type('Alone', (str,), {'equations': name})(name) for name in sizes]
    return join(units)


def test_the_unit_that_contradicts_the_others_most_goes_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Chi-square of 30.66 with three degrees of freedom comes once in a million.
    sizes = {'a': 'small', 'b': 'large', 'c': 'refused', 'd': 'small'}
    squares = {'a': (30.6, 3), 'b': (99.0, 3), 'c': (90.0, 2), 'd': (900.0, 0)}
    found = joined(monkeypatch, squares, sizes, [10, 10, 5, 4])
    # The last saw less than half of the rests; c contradicts by 45 a degree, then b by 33.
    assert found.partial == ((3, 4, 10),)
    assert found.contradicting == (Contradicting(2, 90.0, 2), Contradicting(1, 99.0, 3))
    assert (found.estimates, found.table) == ({}, None)
    squares = dict.fromkeys('abcd', (30.6, 3))
    found = joined(monkeypatch, squares, sizes, [10] * 4)
    assert found.contradicting == found.partial == ()
    assert found.estimates == {0: 'a of 4', 1: 'b of 4', 2: 'c of 4', 3: 'd of 4'}
    # The likeliest of the sizes that converge.
    assert found.table == 'large'
    squares['d'] = (30.7, 3)
    found = joined(monkeypatch, squares, sizes, [10] * 4)
    assert found.contradicting == (Contradicting(3, 30.7, 3),)
    assert list(found.estimates) == [0, 1, 2]
    with pytest.raises(NotObservable, match='no end'):
        joined(monkeypatch, squares, {'a': 'refused', 'b': 'refused'}, [10, 10])
    one = joined(monkeypatch, squares, {'a': 'small'}, [10])
    assert (one.estimates, one.contradicting) == ({}, ())


def test_nothing_contradicts_that_tells_nothing() -> None:
    given: Any = Given('ab', 'small', {'a': (900.0, 0), 'b': (30.0, 3)})
    assert _worst(given, [0, 1]) is None
    # What follows it is looked at all the same.
    given.squares['b'] = (31.0, 3)
    assert _worst(given, [4, 7]) == Contradicting(7, 31.0, 3)


def test_what_was_found_of_the_table_is_kept_by_name() -> None:
    two = np.array([1.0, 2.0])
    assert TableEstimate(('azimuth', 'inner at 3'), two, 10 * two, 100 * two).to_dict() == [
        {'name': 'azimuth', 'value': 1.0, 'std': 10.0, 'prior_std': 100.0},
        {'name': 'inner at 3', 'value': 2.0, 'std': 20.0, 'prior_std': 200.0},
    ]


def test_units_that_come_to_no_end_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, '_ROUNDS', 1)
    with pytest.raises(NotObservable, match='over all units did not converge in 1 steps'):
        _System(alone(), SIZES).solve()
