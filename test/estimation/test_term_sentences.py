"""What a search says of terms, word by word: on the screen, among the findings, in the file."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.finding import is_warning, without_label
from imu_calib.common.units import ARCSEC, DEG_H
from imu_calib.estimation import term_tests
from imu_calib.estimation.score import Family, Score
from imu_calib.estimation.search import SignificantFamily
from imu_calib.estimation.term_tests import (
    TermState,
    TermTest,
    confounded_errors,
    findings,
    summary,
)
from imu_calib.model.parameters import PARAMETERS, Parameter
from imu_calib.model.session_terms import Course, session_term
from imu_calib.model.terms import ACCEL_CUBIC, GYRO_ASYMMETRY, GYRO_CUBIC
from imu_calib.session.table_errors import TableErrors

LN10 = 2.302585092994046
CUBIC = Family('gyro_cubic', GYRO_CUBIC)
TREND = Family('trend', course=Course.TREND)
WARM_UP = Family('warm_up', course=Course.WARM_UP)
STEP = Family('step', course=Course.STEP)
THERMAL = Family('thermal', course=Course.THERMAL)
WOBBLE = Family('wobble')
BY_NAME = {p.name: p for p in PARAMETERS}
TO_TELL = (
    'To tell, record the temperature (imu/temperature), or let the unit run for an hour before the '
    'session.'
)
TO_TELL_HEAT = (
    'To tell, let the temperature rise and fall during the session, or let the unit run for an '
    'hour before it where the temperature stays.'
)


def searched(
    found: Any = (),
    probability: Any = None,
    std: float = 1e-6,
    by_drifts: Any = None,
    table: Any = None,
    **more: Any,
) -> Any:
    """A search by 24 parameters, all known to the same deviation."""
    covariance = std**2 * np.eye(30)
    begin = 1_700_000_000 * 10**9
    whole = np.array([[begin], [begin + 120 * 10**9]])
    evidence = SimpleNamespace(table=table, instants=whole)
    equations = SimpleNamespace(parameters=PARAMETERS, sensors=24, evidence=evidence, shape=0.5)
    return SimpleNamespace(
        broken_off=False,
        unobservable=(),
        found=found,
        probability=probability or {},
        by_drifts=np.zeros((24, 24)) if by_drifts is None else by_drifts,
        estimate=SimpleNamespace(covariance=covariance, equations=equations),
        before_search=SimpleNamespace(equations=equations),
        possible_step=None,
        **more,
    )


def score(statistic: float, deviation: Any, rank: int = 3, freedom: float = 1e9) -> Score:
    count = len(deviation)
    return Score(statistic, rank, 1.0, freedom, np.zeros(count), np.array(deviation), np.eye(count))


@pytest.mark.parametrize(
    ('found', 'sentence'),
    [
        (
            SignificantFamily(WOBBLE, -20 * LN10, size=2.5 * ARCSEC),
            'The session shows joint axes that wobble (by chance once in 10^20 sessions): the '
            'standard deviations allow for 2.5 arcsec each, which the description of the table '
            'does not state (wobble).',
        ),
        (
            SignificantFamily(TREND, -4.4 * LN10),
            'The session shows parameters that drift evenly with time (trend, by chance once in '
            '10^4 sessions): it is estimated.',
        ),
        (
            # Never less than a thousand: that is what the search asks for.
            SignificantFamily(TREND, -2 * LN10, alternatives=(WARM_UP, CUBIC)),
            'The session shows parameters that drift evenly with time (trend, by chance once in '
            '10^3 sessions): it is estimated; warm_up or gyro_cubic would explain it as well, and '
            f'the standard deviations allow for that. {TO_TELL}',
        ),
        (
            SignificantFamily(STEP, -12 * LN10),
            'Warning: The session shows biases that step at one instant (step, by chance once in '
            '10^12 sessions) at 2023-11-14 22:14:20.000 UTC: it is estimated, and the biases '
            'stated are the mean over the session, which holds for neither part. Biases step '
            'where a unit is switched off and on, or is struck; if it was neither, one of its '
            'sensors is not stable.',
        ),
        (
            SignificantFamily(TREND, -5 * LN10, alternatives=(THERMAL,)),
            'The session shows parameters that drift evenly with time (trend, by chance once in '
            '10^5 sessions): it is estimated; thermal would explain it as well, and the standard '
            f'deviations allow for that. {TO_TELL_HEAT}',
        ),
        (
            SignificantFamily(CUBIC, -6 * LN10),
            'The session shows gyro cubic term (gyro_cubic, by chance once in 10^6 sessions): it '
            'is estimated.',
        ),
        (
            SignificantFamily(
                CUBIC, -6 * LN10, considered=tuple((p, 25e-6) for p in GYRO_CUBIC.parameters)
            ),
            'The session shows gyro cubic term (gyro_cubic, by chance once in 10^6 sessions) and '
            'does not determine it: the standard deviations allow for coefficients of 25 ppm. To '
            'determine it takes turns about each axis at two rates or more, four to tell it from '
            'gyro_rate_dependence.',
        ),
        (
            SignificantFamily(
                CUBIC, -6 * LN10, alternatives=(Family('gyro_asymmetry', GYRO_ASYMMETRY), TREND)
            ),
            'The session shows gyro cubic term (gyro_cubic, by chance once in 10^6 sessions): it '
            'is estimated; gyro_asymmetry or trend would explain it as well, and the standard '
            'deviations allow for that. To tell them apart takes turns about each axis at two '
            'rates or more, four to tell it from gyro_rate_dependence.',
        ),
    ],
)
def test_what_was_found_is_said_with_its_chance_and_what_would_tell_more(
    found: SignificantFamily, sentence: str
) -> None:
    assert findings(searched((found,))) == [sentence]


def test_a_drift_that_is_there_in_nineteen_cases_of_twenty_is_said() -> None:
    # K_gx by 0.46 of its deviation more: a tenth is sqrt(1.21) - 1. K_gy stays just below.
    by_drifts = np.diag([0.2117e-12, 0.2098e-12, *[0.0] * 22])
    probability = {TREND: 0.55, WARM_UP: 0.4, THERMAL: 0.05}
    assert findings(searched((), probability, 1e-6, by_drifts)) == [
        'There may be parameters that drift evenly with time (trend) or parameters that '
        'settle as the unit warms up (warm_up) (probability 0.99), too small to be estimated; '
        f'the standard deviations of K_gx allow for it. {TO_TELL_HEAT}'
    ]
    assert findings(searched((), {TREND: 0.96})) == [
        'There may be parameters that drift evenly with time (trend) (probability 0.96), too small '
        f'to be estimated. {TO_TELL}'
    ]
    assert findings(searched((), {STEP: 0.97, TREND: 0.01})) == [
        'There may be biases that step at one instant (step) (probability 0.98), too small to be '
        'estimated. To tell, calibrate it again, and leave it switched on.'
    ]
    # What is less likely is in the deviations, and in the summary, and no finding points to it.
    assert findings(searched((), {TREND: 0.52, WARM_UP: 0.42}, 1e-6, by_drifts)) == []


def test_every_family_becomes_what_was_made_of_it() -> None:
    # Ninety percent of normal numbers are above -1.2816: with the limit of chi-square it is found.
    scores = {
        Family('accel_cubic', ACCEL_CUBIC): score(6.0, [1e-6, np.inf, np.inf]),
        TREND: score(7.0, [1e-9] * 8, rank=8),
        WOBBLE: score(7.0, [1e-6] * 2, rank=0),
    }
    slope = np.zeros((24, 3))
    slope[13, 1], slope[14, 2] = 50.0, 1e-9
    search = searched(
        (
            SignificantFamily(CUBIC, -5 * LN10),
            SignificantFamily(TREND, -4 * LN10, considered=((BY_NAME['K_gx'], 1.0),)),
        ),
        {TREND: 0.25},
        scores=scores,
        alpha=1e-4,
        leverage={Family('accel_cubic', ACCEL_CUBIC): slope},
    )
    changes = session_term('warm_up:D_a')
    asked, warming, found, doubted, off, drift, table = term_tests.tested(
        search, (GYRO_ASYMMETRY,), changes
    )
    assert (asked.name, asked.state) == ('gyro_asymmetry', TermState.ASKED)
    assert asked.parameters == GYRO_ASYMMETRY.parameters
    assert (warming.name, warming.state, warming.changes) == ('warm_up', TermState.ASKED, changes)
    assert (found.name, found.state) == ('gyro_cubic', TermState.FOUND)
    assert found.log10_p == pytest.approx(-5)
    assert found.parameters == GYRO_CUBIC.parameters
    assert (doubted.state, doubted.changes) == (TermState.NOT_DETERMINED, session_term('trend'))
    assert (off.name, off.state) == ('accel_cubic', TermState.OFF)
    # Chi-square of three degrees of freedom is above 6 by a chance of 0.1116.
    assert off.log10_p == pytest.approx(np.log10(0.1116), abs=1e-3)
    # And above 21.108 by 1e-4: sqrt(21.108) + 1.2816 deviations are found nine times in ten.
    assert off.smallest == (pytest.approx(5.876e-6, rel=1e-3), np.inf, np.inf)
    # Ten ug/g^3 of the second move K_ay by 50 * 1.04e-7, five of its deviations of 1e-6.
    assert off.moved == (None, (BY_NAME['K_ay'], 50.0), None)
    assert off.probability is None
    assert (drift.state, drift.probability, drift.moved) == (TermState.OFF, 0.25, ())
    assert (table.state, table.log10_p) == (TermState.NOT_TESTED, None)


def test_a_coefficient_is_named_where_it_moves_a_parameter_by_what_matters() -> None:
    family, change = Family('gyro_cubic', GYRO_CUBIC), session_term('trend')
    for by, named in ((0.099, False), (0.101, True)):
        # Ten ppm move K_gz, whose deviation is 1e-6, by so much of it.
        slope = np.zeros((24, 3))
        slope[2, 0] = -by / 10
        there = searched(
            scores={family: score(1.0, [1e-6] * 3)}, alpha=1e-4, leverage={family: slope}
        )
        (one,) = term_tests.tested(there, ())
        assert (one.moved[0] is not None) is named
    for by, named in ((4.49, False), (4.51, True)):
        # Of a term of the session it is what is just found: 9.0 deviations of 1e-9 of the first.
        just = float(score(1.0, [1e-9] * 8, rank=8).smallest(1e-4)[0])
        slope = np.zeros((24, 8))
        slope[2, 0] = by * 1e-6 / just
        there = searched(
            scores={TREND: score(1.0, [1e-9] * 8, rank=8)}, alpha=1e-4, leverage={TREND: slope}
        )
        (one,) = term_tests.tested(there, ())
        assert len(one.changes) == len(change)
        assert (one.moved[0] == (BY_NAME['K_gz'], slope[2, 0])) is named


def test_the_screen_says_what_is_on_what_is_off_and_what_is_not_seen() -> None:
    k_ax, k_ay = BY_NAME['K_ax'], BY_NAME['K_ay']
    unit = ACCEL_CUBIC.parameters[0].unit.scale
    tests = (
        TermTest('g_sensitivity', TermState.ASKED),
        TermTest('gyro_cubic', TermState.FOUND, parameters=GYRO_CUBIC.parameters),
        TermTest('trend', TermState.NOT_DETERMINED),
        TermTest('wobble', TermState.OFF, smallest=(1e-5,)),
        TermTest(
            'gyro_asymmetry',
            TermState.OFF,
            parameters=GYRO_ASYMMETRY.parameters,
            smallest=(1.2e-5, 3.4e-5, np.inf),
            hidden=((BY_NAME['K_gx'], 0.8), (BY_NAME['K_gy'], -0.9), None),
        ),
        TermTest(
            'accel_cubic',
            TermState.OFF,
            parameters=ACCEL_CUBIC.parameters,
            smallest=(np.inf,) * 3,
            moved=((k_ax, -96.0), (k_ay, 96.2), None),
        ),
        TermTest('gyro_g2', TermState.NOT_TESTED, parameters=GYRO_CUBIC.parameters),
    )
    # Ten units of 1.04e-8 move K_ax by 96 times that; the first of those alike to two digits.
    assert round(96 * 10 * unit * 1e6, 2) == 9.98
    assert summary(tests) == [
        'terms: g_sensitivity, gyro_cubic, trend',
        'not significant; detectable above: gyro_asymmetry 34 ppm',
        'not observable in this session: accel_cubic',
        # 3.4e-5 by 0.9 is more than 1.2e-5 by 0.8.
        'An undetected gyro_asymmetry of up to 34 ppm could bias K_gx, K_gy: K_gy by up to 31 ppm',
        'This session does not show accel_cubic, which could bias K_ax, K_ay: 10 ug/g^3 would '
        'move K_ax by 10 ppm. To determine it takes ' + ACCEL_CUBIC.needs,
    ]
    one = TermTest(
        'accel_cubic',
        TermState.OFF,
        parameters=ACCEL_CUBIC.parameters,
        smallest=(np.inf, 1e-8, 1e-8),
        moved=((k_ax, 20.0), (k_ay, 96.2), None),
    )
    assert summary((one,))[1:] == [
        'not significant; detectable above: accel_cubic 0.96 ug/g^3',
        'This session does not show accel_cubic, which could bias K_ax: 10 ug/g^3 would move '
        'K_ax by 2.1 ppm. To determine it takes ' + ACCEL_CUBIC.needs,
    ]
    assert summary(()) == ['terms: none']


@pytest.mark.parametrize(
    ('assumed', 'whose', 'more'),
    [
        ({'wobble'}, 'assumed of', ''),
        (
            (),
            'stated by the file of',
            ' What the file states of zeros, which no session shows, may '
            'be as wrong: measure the table.',
        ),
    ],
)
def test_an_error_of_the_table_is_said_beside_what_was_known_of_it(
    assumed: Any, whose: str, more: str
) -> None:
    table = SimpleNamespace(errors=TableErrors(wobble=2 * ARCSEC), not_stated=assumed)
    found = SignificantFamily(WOBBLE, -20 * LN10, size=151 * ARCSEC, seen=110 * ARCSEC)
    (said,) = findings(searched((found,), table=table))
    assert is_warning(said) is bool(more)
    assert without_label(said) == (
        'The session shows joint axes that wobble (wobble, by chance once in 10^20 sessions), by '
        f'110 arcsec where 2 arcsec are {whose} the table: the standard deviations allow for '
        f'151 arcsec each.{more}'
    )


def test_errors_of_the_table_are_untold_where_outputs_are_too_few_to_test_them() -> None:
    tested = score(9.0, np.ones(24), rank=9, freedom=9)
    scores = {
        WOBBLE: score(9.0, np.ones(24), rank=9, freedom=8),
        Family('encoder'): tested,
        # Nothing of it is seen.
        Family('zeros'): score(0.0, np.ones(2), rank=0),
        CUBIC: score(9.0, np.ones(3), rank=3, freedom=2),
    }
    assert confounded_errors(searched(scores=scores)) == ('joint axes that wobble (wobble)',)


def drift(**more: Any) -> TermTest:
    """A trend that is off: biases of 2e-10, scale factors of 3e-9 and 1.5e-9 per second."""
    moved: list[tuple[Parameter, float] | None] = [(BY_NAME['D_gx'], 9.0), *[None] * 7]
    moved[6], moved[7] = (BY_NAME['K_gz'], -1000.0), (BY_NAME['K_ax'], 2000.0)
    smallest = (2e-10,) * 6 + (3e-9, 1.5e-9)
    changes = session_term('trend')
    return TermTest(
        'trend', TermState.OFF, changes=changes, smallest=smallest, moved=tuple(moved), **more
    )


def test_a_drift_of_scale_factors_that_may_hide_is_said_with_what_it_would_move() -> None:
    # Per hour 3e-9 / s are 10.8 ppm; they move K_gz by 3 ppm, as the others K_ax.
    power = f'D_g {2e-10 * 3600 / DEG_H:.2g} deg/h per h, D_a {2e-10 * 3600 / 9.80665e-6:.2g}'
    may = (
        'An undetected trend of up to K_g 11 ppm per h, K_a 5.4 ppm per h could bias K_gz, K_ax: '
        'K_gz by 3 ppm and K_ax by 3 ppm'
    )
    assert summary((drift(),)) == [
        'terms: none',
        f'not significant; detectable above: trend {power} ug per h, K_g 11 ppm per h, K_a 5.4 ppm '
        'per h',
        may,
    ]
    assert summary((drift(probability=0.123),))[-1] == (
        f'{may}. The standard deviations allow for it by its probability, 0.12'
    )
    moved = drift().moved
    alone = TermTest(
        'trend',
        TermState.OFF,
        changes=session_term('trend'),
        smallest=drift().smallest,
        moved=(*moved[:6], moved[6], None),
    )
    assert summary((alone,))[-1] == (
        'An undetected trend of up to K_g 11 ppm per h could bias K_gz: K_gz by 3 ppm'
    )


def test_the_file_keeps_what_was_tested() -> None:
    k_ax = BY_NAME['K_ax']
    one = TermTest(
        'accel_cubic',
        TermState.NOT_TESTED,
        -1.23456,
        ACCEL_CUBIC.parameters,
        smallest=(1e-8, np.inf, 2e-8),
        moved=((k_ax, 96.2), None, None),
        probability=0.123456,
    )
    assert one.document() == {
        'state': 'not tested',
        'log10_p': -1.23,
        'probability': 0.1235,
        'found_from': [1e-8, None, 2e-8],
        'would_move': {'K3_ax': {'parameter': 'K_ax', 'by': 96.2}},
    }
    assert drift().document()['would_move'] == {
        'D_gx': {'parameter': 'D_gx', 'by': 9.0},
        'K_g': {'parameter': 'K_gz', 'by': -1000.0},
        'K_a': {'parameter': 'K_ax', 'by': 2000.0},
    }
    # Of the table it is the chance alone.
    table = TermTest('wobble', TermState.OFF, -0.5, smallest=(1e-5,))
    assert table.document() == {'state': 'off', 'log10_p': -0.5}
    assert TermTest('wobble', TermState.FOUND).document() == {'state': 'found'}
