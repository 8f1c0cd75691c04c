"""Terms that nobody asked for: found where they are, and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import TypeVar

import numpy as np
import pytest
from extent import ALL
from other_sessions import MEDIUM, MICRO_G, NAVIGATION, fed, stop, true_vector
from other_world import DEG, Stop, Terms, Unit, World
from sessions import SITE, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.budget import ErrorSource, total
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.joint import solve
from imu_calib.estimation.predict import expected
from imu_calib.estimation.score import Family, Score, WhitenedResiduals, columns_of, shapes_of
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.solve import fit
from imu_calib.estimation.term_tests import TermState, summary
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, terms_of
from imu_calib.model.session_terms import LOOKED_FOR
from imu_calib.model.terms import ACCEL_CROSS, ACCEL_CUBIC, GYRO_ASYMMETRY, Term
from imu_calib.segmentation.segments import Segment, Turn
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import UNPLANNED, load_plan
from imu_calib.session.table import load_table

Stretch = TypeVar('Stretch', Segment, Turn)

PPM = 1e-6
G = 9.80665
TOO_FAR = 4.5
"""Standard deviations that one of some thirty normal numbers exceeds once in 5000 sessions."""


def leaning() -> tuple[Stop, ...]:
    """All attitudes with up along an axis or between two of them, turns about each axis."""
    rates = (15.0, 40.0, 90.0)
    tests = {(0, 0): rates, (90, 0): rates, (90, 90): rates}
    found = [(m, i) for i, m in product((0, 90), range(0, 360, 45))]
    found += [(90, i) for i in (45, 135, 225, 315)]
    return tuple(stop(0, m, i, *tests.get((m, i), ())) for m, i in found)


UPRIGHT = World(dwell=15.0, rates=(15 * DEG, 40 * DEG, 90 * DEG))
LEANING = World(dwell=10.0, program=leaning())


@dataclass(frozen=True)
class Case:
    """A unit with terms, and what a session must say of them.

    Attributes:
        terms: What the unit adds.
        values: By name of the term, in the order of its parameters, SI units.
        world: Where.
        alike: What the session cannot tell from a term.
    """

    terms: Terms
    values: dict[str, tuple[float, ...]]
    world: World = UPRIGHT
    alike: tuple[str, ...] = ()


def own(values: tuple[float, float, float], unit: float) -> tuple[float, float, float]:
    return values[0] * unit, values[1] * unit, values[2] * unit


SENSES, SIZE, CUBE, SQUARE = (
    own(v, PPM) for v in ((25, -20, 22), (45, 40, -50), (25, -20, 20), (-25, 30, 22))
)
K2, SIGNS = own((20, -15, 25), MICRO_G / G**2), own((-20, 25, 18), PPM)
K3 = own((30, -25, 35), MICRO_G / G**3)
BY_SQUARE = own((0.3, -0.4, 0.35), DEG / 3600 / G**2)
BY_FORCE = tuple(
    own(r, DEG / 3600 / G) for r in ((0.4, -0.3, 0.3), (0.3, 0.5, -0.3), (-0.4, 0.3, 0.6))
)
CROSS = tuple(own(r, MICRO_G / G**2) for r in ((20, -30, 25), (-20, 25, 30), (30, 20, -25)))

CASES = {
    'senses and K2': Case(
        Terms(senses=SENSES, accel_square=K2),
        {'gyro_asymmetry': SENSES, 'accel_quadratic': K2},
        alike=('accel_asymmetry',),
    ),
    'rate and force': Case(
        Terms(size=SIZE, by_force=BY_FORCE),
        {'gyro_rate_dependence': SIZE, 'g_sensitivity': sum(BY_FORCE, ())},
    ),
    'cube and force squared': Case(
        Terms(cube=CUBE, by_square=BY_SQUARE), {'gyro_cubic': CUBE, 'gyro_g2': BY_SQUARE}
    ),
    'square and signs': Case(
        Terms(square=SQUARE, accel_signs=SIGNS),
        {'gyro_quadratic': SQUARE, 'accel_asymmetry': SIGNS},
        LEANING,
    ),
    'K3 and cross': Case(
        Terms(accel_cube=K3, accel_cross=CROSS),
        {'accel_cubic': K3, 'accel_cross': sum(CROSS, ())},
        LEANING,
    ),
}
BLAMED = ('drift by', 'scatter', 'given less weight', 'elsewhere', 'arrive', 'tilted')
"""Words of the findings that blame something else."""


def looked(world: World, unit: Unit, seed: int = 0) -> Calibration:
    """What a session says of a unit when nobody says which terms it has."""
    plan = UNPLANNED if world.program else None
    return fed(world, unit, seed, plan, find_terms=True).finish().calibration


# One of them where CI has not the time for all (`.ci/run`).
SOME = list(CASES) if ALL else ['rate and force']


@pytest.mark.parametrize('name', SOME)
def test_terms_that_nobody_asked_for_are_named_and_estimated(name: str) -> None:
    case = CASES[name]
    unit = replace(NAVIGATION, terms=case.terms)
    found = looked(case.world, unit)
    assert set(found.provenance['terms']) == set(case.values), found.findings
    truth = dict(zip(PARAMETERS, true_vector(unit), strict=True))
    for term in terms_of(found.parameters):
        truth |= dict(zip(term.parameters, case.values[term.name], strict=True))
    off = (found.values - [truth[p] for p in found.parameters]) / found.std
    assert np.abs(off).max() < TOO_FAR, np.round(off, 1)
    findings = [text for text in found.findings if 'The session shows' in text]
    assert len(findings) == len(case.values)
    blamed = [text for text in found.findings if any(word in text for word in BLAMED)]
    assert not blamed
    for rival in case.alike:
        assert any(f'{rival} would explain it as well' in text for text in findings)


@pytest.mark.parametrize(
    'world',
    [pytest.param(UPRIGHT, marks=pytest.mark.repeats), LEANING],
    ids=['upright', 'leaning'],
)
def test_a_sound_session_has_no_terms(world: World) -> None:
    for unit in (NAVIGATION, MEDIUM):
        found = looked(world, unit)
        assert found.provenance['terms'] == []
        assert not [text for text in found.findings if 'The session shows' in text]


def test_looking_for_terms_changes_nothing_where_there_are_none() -> None:
    """But that drifts that are not excluded count by how likely they are (test_undecided)."""
    plain, searched = (fed(UPRIGHT, NAVIGATION, 1, find_terms=on).finish() for on in (False, True))
    assert searched.calibration.values.tobytes() == plain.calibration.values.tobytes()
    assert searched.solution.shares is not None
    drifts = searched.solution.shares[ErrorSource.TERMS].covariance
    assert (plain.solution.covariance + drifts).tobytes() == searched.solution.covariance.tobytes()
    # Where no drift shows deviations grow by some hundredths, those of K_az most.
    assert (
        searched.solution.covariance.diagonal() < 1.4 * plain.solution.covariance.diagonal()
    ).all()


@cache
def expectation(terms: tuple[tuple[Term, tuple[float, ...]], ...]) -> tuple[Evidence, SensorModel]:
    """Twelve positions of a navigation-grade unit with terms, all as it would be without noise."""
    model = truth().model
    for term, values in terms:
        model = model.with_values(term.parameters, values)
    setup = Setup(
        load_imu('fog_navigation'), load_plan('twelve_position'), load_table('three_axis'), SITE
    )
    return replace(expected(setup, model), moves=()), model


def noisy(evidence: Evidence, seed: int) -> Evidence:
    """The evidence with the noise of its outputs."""
    equations = Equations(evidence)
    deviations = np.sqrt(equations.own_variances)
    noise = np.random.default_rng(seed).standard_normal(len(deviations)) * deviations
    rows = equations.layout
    segments = tuple(moved(s, noise[rows.dwell[k]]) for k, s in enumerate(evidence.segments))
    turns = tuple(
        moved(t, np.append(noise[rows.turn[k]], np.zeros(3))) for k, t in enumerate(evidence.turns)
    )
    return replace(evidence, segments=segments, turns=turns)


def moved(stretch: Stretch, by: Floats) -> Stretch:
    """A rest or a turn whose means are off by (6,)."""
    return replace(
        stretch, statistics=replace(stretch.statistics, mean=stretch.statistics.mean + by)
    )


def test_the_power_that_is_stated_is_that_of_the_test() -> None:
    family = Family(GYRO_ASYMMETRY.name, GYRO_ASYMMETRY)
    alpha = 1e-4

    def score(evidence: Evidence) -> Score:
        equations = Equations(evidence)
        state = fit(equations, equations.nominal())
        columns = columns_of([family], equations, state)
        return WhitenedResiduals.at(equations, state).score(family, columns[family])

    without, _ = expectation(())
    least = float(score(noisy(without, 0)).smallest(alpha)[1])
    there, _ = expectation(((GYRO_ASYMMETRY, (0.0, least, 0.0)),))
    runs = 30
    found = sum(score(noisy(there, seed)).log_p < np.log(alpha) for seed in range(runs))
    # Nine in ten at least: fewer than 20 of 30 come once in 5000 times.
    assert found >= 20
    half, _ = expectation(((GYRO_ASYMMETRY, (0.0, least / 2, 0.0)),))
    assert sum(score(noisy(half, seed)).log_p < np.log(alpha) for seed in range(runs)) < found / 2
    assert not any(score(noisy(without, seed)).log_p < np.log(alpha) for seed in range(runs))


def test_a_rest_that_was_disturbed_is_no_term() -> None:
    evidence, model = expectation(())
    evidence = noisy(evidence, 3)
    first = moved(evidence.segments[0], np.array([0, 0, 0, 60, -40, 50]) * MICRO_G)
    evidence = replace(evidence, segments=(first, *evidence.segments[1:]))
    found = solve(evidence, find_terms=True)
    assert [text for text in found.findings if 'the accelerometers at position 1' in text]
    assert not [text for text in found.findings if 'The session shows' in text]
    off = (found.model.values(PARAMETERS) - model.values(PARAMETERS)) / found.std
    assert np.abs(off).max() < TOO_FAR


def test_a_term_that_shows_in_part_is_named_and_widens_what_it_touches() -> None:
    cross = 40 * MICRO_G / G**2
    evidence, model = expectation(((ACCEL_CROSS, (cross, -cross, cross) * 3),))
    leaning = []
    for k, angle in enumerate((45, 135, 225, 315)):
        attitude = rotation(np.array([1.0, 0, 0]), angle * DEG)
        rate, force = attitude.T @ SITE.earth_rate, attitude.T @ SITE.specific_force
        like = evidence.segments[-1]
        mean = np.concatenate(model.predict(rate, force))
        span = like.end - like.start
        start = like.end + k * span
        leaning.append(
            Segment(
                start,
                start + span,
                replace(like.statistics, mean=mean),
                attitude,
                f'leaning {angle}',
                like.angles,
            )
        )
    evidence = noisy(replace(evidence, segments=(*evidence.segments, *leaning), table=None), 5)
    found = solve(evidence, find_terms=True)
    named = [text for text in found.findings if 'accel_cross' in text]
    assert len(named) == 1
    assert 'does not determine it' in named[0]
    assert 'To determine it takes static dwells with two axes at once' in named[0]
    assert {t.name: t.state for t in found.tests}['accel_cross'] is TermState.NOT_DETERMINED
    off = (found.model.values(PARAMETERS) - model.values(PARAMETERS)) / found.std
    assert np.abs(off).max() < TOO_FAR
    assert found.shares is not None
    assert total(found.shares) == pytest.approx(found.covariance, rel=1e-6, abs=1e-20)
    assert (np.diag(found.shares[ErrorSource.TERMS].covariance)[12:] > 0).any()


def test_the_screen_says_what_a_session_cannot_show() -> None:
    found = solve(noisy(expectation(())[0], 1))
    lines = summary(found.tests)
    assert lines[0] == 'terms: none'
    assert 'gyro_asymmetry' in lines[1]
    assert 'ppm' in lines[1]
    # At 0 and 1 g the cubic term is the scale factor, ug for ppm.
    assert [line for line in lines if 'does not show accel_cubic' in line] == [
        'This session does not show accel_cubic, which could bias K_ax, K_ay, K_az: 10 ug/g^3 '
        'would move K_ax by 10 ppm. To determine it takes ' + ACCEL_CUBIC.needs
    ]
    # And in the file, SI: 1 / (9.80665 m/s^2)^-2.
    kept = {test.name: test for test in found.tests}['accel_cubic'].document()
    assert kept['state'] == 'not tested'
    moved = kept['would_move']
    assert isinstance(moved, dict)
    assert moved['K3_ax']['parameter'] == 'K_ax'
    assert moved['K3_ax']['by'] == pytest.approx(SITE.gravity**2, rel=1e-3)


INSTABILITY = np.repeat([0.05 * DEG / 3600, 10 * MICRO_G], 3)
"""Of biases that drift as they are stated to: some times what the noise of rests hides."""

CORRELATION = 1000.0
"""Of such wandering, s, as a simulated unit has it."""


def changed(evidence: Evidence, biases: Floats, slopes: Floats) -> Evidence:
    """The evidence whose biases are off by (n, 6) and rise by (n, 6) per s, rests, then turns."""
    parts: list[Segment | Turn] = []
    for k, part in enumerate((*evidence.segments, *evidence.turns)):
        there = replace(
            part.statistics,
            mean=part.statistics.mean + biases[k],
            drift=part.statistics.drift + slopes[k],
        )
        parts.append(replace(part, statistics=there))
    rests = len(evidence.segments)
    segments = tuple(p for p in parts[:rests] if isinstance(p, Segment))
    turns = tuple(p for p in parts[rests:] if isinstance(p, Turn))
    return replace(evidence, segments=segments, turns=turns)


def instants(evidence: Evidence) -> tuple[Floats, Floats]:
    """Middle and length of rests and turns, s."""
    parts = (*evidence.segments, *evidence.turns)
    starts, ends = (np.array([getattr(p, of) for p in parts]) * 1e-9 for of in ('start', 'end'))
    return (starts + ends) / 2, ends - starts


def wandering(evidence: Evidence, seed: int) -> Evidence:
    """The evidence with biases that drift as they are stated to, from instant to instant."""
    rng = np.random.default_rng([7, seed])
    middles, lengths = instants(evidence)
    grid = (np.arange(8) + 0.5) / 8 - 0.5
    times = (middles[:, None] + lengths[:, None] * grid).ravel()
    path, now, last = np.empty((len(times), 6)), rng.standard_normal(6), np.inf
    for k in np.argsort(times).tolist():
        kept = np.exp(-max(0.0, times[k] - last) / CORRELATION)
        now = kept * now + np.sqrt(1 - kept**2) * rng.standard_normal(6)
        path[k], last = now, times[k]
    path = path.reshape(-1, 8, 6) * INSTABILITY
    slopes = np.einsum('j,kjc->kc', grid / (grid @ grid), path) / lengths[:, None]
    return changed(evidence, path.mean(axis=1), slopes)


def drifting(evidence: Evidence, size: float) -> Evidence:
    """The evidence with biases that drift evenly by so many times what they may wander by."""
    middles, _ = instants(evidence)
    span = float(np.ptp(middles))
    signs = np.array([1, -1, 0.7, 1, -0.8, 1.2])
    biases = np.outer((middles - middles.mean()) / span, size * signs * INSTABILITY)
    return changed(evidence, biases, np.tile(size * signs * INSTABILITY / span, (len(middles), 1)))


def chances(evidence: Evidence, *, drifting: bool = True) -> dict[str, float]:
    """The chances of trend and warm-up in a session, natural logarithms, as the search tests them.

    With `wander` off noise alone is allowed for.
    """
    evidence = replace(evidence, instability=INSTABILITY)
    equations = Equations(evidence)
    state = fit(equations, equations.nominal())
    found = {}
    for course in LOOKED_FOR:
        family = Family(course.value, course=course)
        patterns = columns_of([family], equations, state)[family]
        score = WhitenedResiduals.at(equations, state).score(family, patterns)
        if drifting:
            scatter = family.scatter(
                equations, state, float(shapes_of(family, equations)[score.chosen])
            )
            there = WhitenedResiduals.at(family.with_scatter(equations, scatter), state)
            score = there.score(family, patterns)
        found[course.value] = score.log_p
    return found


def test_biases_that_wander_as_stated_are_no_drift() -> None:
    still, _ = expectation(())
    runs = 16
    sessions = [wandering(noisy(still, seed), seed) for seed in range(runs)]
    found = [p for session in sessions for p in chances(session).values()]
    # Of 48 chances four below 0.01 come once in 600 times.
    assert sum(p < np.log(0.01) for p in found) < 4
    assert min(found) > np.log(1e-3 / 15)
    # Noise alone would take most of them for a drift.
    alone = [min(chances(session, drifting=False).values()) for session in sessions[:4]]
    assert sum(p < np.log(1e-3 / 15) for p in alone) >= 3


def test_a_drift_counts_beside_all_the_wander_that_is_stated() -> None:
    still, _ = expectation(())
    # Nothing else wanders, and what is stated is held against the drift all the same.
    assert chances(drifting(noisy(still, 1), 2.5))['trend'] > np.log(1e-3)
    found = chances(drifting(noisy(still, 1), 10.0))
    assert found['trend'] < np.log(1e-6)
    # A line is a warm-up that has hardly begun, and that it is one of eleven has its price.
    assert found['trend'] < found['warm_up'] < np.log(1e-4)
