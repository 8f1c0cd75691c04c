"""Each step of the search for what is missing, with the tests of families given."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evidence import evidence_of
from scipy.stats import f as f_distribution
from scipy.stats import norm, t

from imu_calib.common.budget import ErrorSource, Share
from imu_calib.common.errors import NotObservable
from imu_calib.common.units import ARCMIN, ARCSEC, DEG, MICRO_G
from imu_calib.estimation import score as scores_module
from imu_calib.estimation import search as module
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.excess_scatter import ExcessScatter
from imu_calib.estimation.information import useful_limit
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.score import (
    Family,
    Score,
    columns_of,
    families,
    log_f,
    most_significant,
    shapes_of,
    tries_of,
    with_parameters,
)
from imu_calib.estimation.search import (
    SearchResult,
    SignificantFamily,
    _akaike_criterion,
    _assigned_sizes,
    _by_alternatives,
    _confirmed,
    _found_families,
    _likeliest,
    _log_chance_limit,
    _Model,
    _restored,
    _searched,
    _under_own_scatter,
    search_terms,
)
from imu_calib.estimation.solve import NotConverged
from imu_calib.estimation.term_tests import findings
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.session_terms import Course, session_term
from imu_calib.model.terms import ACCEL_CUBIC, ACCEL_QUADRATIC, GYRO_ASYMMETRY, GYRO_CUBIC, TERMS
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors

CUBIC, SENSES = Family('gyro_cubic', GYRO_CUBIC), Family('gyro_asymmetry', GYRO_ASYMMETRY)
OF_ACCELS = Family('accel_cubic', ACCEL_CUBIC)
TREND, WARM_UP, STEP, THERMAL = (Family(c.value, course=c) for c in Course)
WOBBLE = Family('wobble')
LN10 = 2.302585092994046


def score(statistic: float, rank: int = 3, freedom: float = 100.0, **more: Any) -> Score:
    deviation = more.pop('deviation', np.ones(3))
    estimate = more.pop('estimate', np.zeros(3))
    scale = more.pop('scale', 1.0)
    return Score(statistic, rank, scale, freedom, estimate, deviation, np.eye(3), **more)


def test_a_score_is_as_likely_as_f_says_each_of_its_tries_by_chance() -> None:
    one = score(30.0, scale=2.0)
    assert one.log_p == pytest.approx(f_distribution.logsf(30 / 3 / 2, 3, 100))
    assert replace(one, tries=11).log_p == pytest.approx(one.log_p + np.log(11))
    assert score(1.0, tries=11).log_p == 0.0
    # Half of what its outputs have left it may take, and no more.
    for rank, freedom, tested in ((3, 3.0, True), (3, 2.9, False), (0, 100.0, False)):
        there = score(900.0, rank, freedom)
        assert there.tested is tested
        assert (there.log_p < 0) is tested
        assert np.isfinite(there.smallest(1e-4)).all() == tested


def test_the_tail_of_f_is_exact_where_numbers_end() -> None:
    for first, second in ((3, 19), (9, 95), (1, 4), (12, 7.5)):
        for value in (0.3, 2.0, 40.0):
            exact = f_distribution.logsf(value, first, second)
            assert log_f(value, first, second) == pytest.approx(exact, rel=1e-9)
    # With two degrees of freedom in the numerator the tail is a power (Abramowitz 26.6.4).
    for value in (1e3, 1e9):
        assert log_f(value, 2, 400) == pytest.approx(-200 * np.log1p(value / 200), rel=1e-12)


def test_what_is_found_nine_times_in_ten_is_a_tenth_above_the_limit() -> None:
    one = score(1.0, scale=4.0, deviation=np.array([1.0, 0.5]), tries=2)
    limit = np.sqrt(3 * f_distribution.isf(1e-4 / 2, 3, 100))
    found = one.smallest(1e-4)
    assert found == pytest.approx(2 * np.array([1.0, 0.5]) * (limit + norm.isf(0.1)), rel=1e-5)


def test_of_several_scores_the_least_by_chance_is_the_first_of_its_like() -> None:
    found = most_significant([score(1.0), score(20.0), score(20.0), score(9.0)])
    assert (found.statistic, found.tries, found.chosen) == (20.0, 4, 1)


def stated(errors: TableErrors | None = None, **more: Any) -> Equations:
    evidence = evidence_of()
    if errors is None:
        return Equations(replace(evidence, **more))
    table = replace(load_table('three_axis'), errors=errors)
    rests = [replace(s, angles=np.zeros(3)) for s in evidence.segments]
    turns = [replace(s, angles=np.zeros(3)) for s in evidence.turns]
    there = replace(evidence, table=table, segments=tuple(rests), turns=tuple(turns))
    return Equations(there, **more)


def test_what_is_off_is_every_term_course_and_error_that_the_session_can_tell_of() -> None:
    still = [term.name for term in TERMS if not Family(term.name, term).held]
    assert not {'size_effect', 'delay'} & set(still)
    assert [f.name for f in families(stated())] == [*still, 'trend', 'warm_up', 'step']
    on = stated(TableErrors(wobble=1e-5), changes=session_term('trend'))
    on, _ = with_parameters(on, on.nominal(), GYRO_CUBIC.parameters)
    assert [f.name for f in families(on)] == [
        *(name for name in still if name != 'gyro_cubic'),
        'zeros',
        'orthogonality',
        'wobble',
        'encoder',
        'attitude_step',
    ]
    # A dwell whose angles nobody knows says nothing of the table.
    first, *others = on.evidence.segments
    unknown = replace(on.evidence, segments=(replace(first, angles=None), *others))
    assert not [f for f in families(replace(on, evidence=unknown)) if f.of_table]


def test_families_know_what_they_are() -> None:
    assert (CUBIC.of_table, TREND.of_table, WOBBLE.of_table) == (False, False, True)
    assert CUBIC.parameters == GYRO_CUBIC.parameters
    assert (CUBIC.changes, WOBBLE.changes, WOBBLE.parameters) == ((), (), ())
    assert TREND.changes == session_term('trend')
    assert TREND.parameters == ()
    delay = next(t for t in TERMS if t.name == 'delay')
    assert Family('delay', delay).held == {delay.kind}
    assert CUBIC.held == frozenset()
    # Of a warm-up half octaves from a sixteenth of the session to twice its length.
    halves = [2 ** (k / 2) for k in range(-8, 3)]
    assert shapes_of(WARM_UP, stated()) == pytest.approx(halves)
    assert shapes_of(TREND, stated()).tolist() == shapes_of(CUBIC, stated()).tolist() == [1.0]


def test_outputs_judge_what_they_feel() -> None:
    equations = stated()
    of_accels = equations.layout.channels > 2
    assert (OF_ACCELS.judged(equations) == of_accels).all()
    assert (CUBIC.judged(equations) == ~of_accels).all()
    for family in (TREND, WOBBLE):
        assert family.judged(equations).all()
        assert len(family.judged(equations)) == len(equations.outputs)


def test_drift_that_seems_absent_counts_in_full_beside_terms_of_the_session() -> None:
    equations = stated()
    there, absent = object(), object()
    scatter: Any = ExcessScatter(
        PositioningErrors(1e-5, 2e-5),
        np.zeros(6),
        (there,),
        (absent,),  # type: ignore[arg-type]
    )
    for family, extra in ((TREND, (there, absent)), (CUBIC, (there,)), (WOBBLE, (there,))):
        found = family.with_scatter(equations, scatter)
        assert found.extra == extra
        assert found.positioning is scatter.positioning
        assert found.held == family.held


def test_scatter_is_what_is_left_once_a_family_explains_what_it_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(scores_module, 'excess', lambda *given: calls.append(given))
    equations = stated(TableErrors(zeros=1e-4))
    state = equations.nominal()
    for family in (CUBIC, WOBBLE, WARM_UP):
        family.scatter(equations, state, 0.25)
    (with_term, longer), (with_error, same), (warming, drifted) = calls
    assert with_term.parameters == (*PARAMETERS, *GYRO_CUBIC.parameters)
    assert longer.tolist() == [*state[:24], 0, 0, 0, *state[24:]]
    # Of the table's errors it is free, 300 arcseconds, and the others are as stated.
    assert with_error.evidence.table.errors == TableErrors(zeros=1e-4, wobble=300 * ARCSEC)
    assert same is state
    assert (warming.changes, warming.shape) == (session_term('warm_up'), 0.25)
    # One step of the least squares from where it would be without.
    jacobian, residuals = warming.whitened(np.append(state, np.zeros(8)))
    step = np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    assert warming.predict(drifted) == pytest.approx(
        warming.predict(np.append(state, np.zeros(8)) + step), abs=1e-9
    )


def test_patterns_are_what_the_largest_useful_coefficients_do() -> None:
    equations = stated(TableErrors(zeros=1e-4))
    state = equations.nominal()
    found = columns_of([CUBIC, OF_ACCELS, WOBBLE, TREND, WARM_UP, STEP], equations, state)
    for family in (CUBIC, OF_ACCELS):
        ((columns, sizes),) = found[family]
        on, longer = with_parameters(equations, state, family.parameters)
        for k, parameter in enumerate(family.parameters):
            # A fiftieth of what any IMU may have.
            assert parameter.unit.limit is not None
            assert sizes[k] == pytest.approx(parameter.unit.limit / 50)
            moved = longer.copy()
            moved[24 + k] = sizes[k]
            by = on.predict(moved) - on.predict(longer)
            assert columns[:, k] == pytest.approx(by, abs=1e-9 * np.abs(by).max())
    ((columns, sizes),) = found[WOBBLE]
    assert sizes == pytest.approx(np.full(columns.shape[1], ARCMIN))
    wobbling = stated(TableErrors(wobble=ARCMIN))
    assert columns == pytest.approx(wobbling.table_error_effects(state))
    assert [len(found[f]) for f in (TREND, WARM_UP)] == [1, 11]
    assert len(found[STEP]) == len(shapes_of(STEP, equations))
    assert {columns.shape[1] for columns, _ in found[STEP]} == {6}
    ((columns, sizes),) = found[TREND]
    # From the first to the last biases may go by 0.1 deg/s and 0.1 g, scale factors by 0.1 %.
    drifting = replace(equations, changes=session_term('trend'))
    starts = [p.start for p in (*equations.evidence.segments, *equations.evidence.turns)]
    span = (max(starts) - min(starts)) * 1e-9
    whole = np.array([*[0.1 * DEG] * 3, *[1e5 * MICRO_G] * 3, 1e-3, 1e-3])
    assert sizes == pytest.approx(whole / span, rel=0.2)
    for k in range(8):
        moved = np.append(state, np.zeros(8))
        moved[-8 + k] = sizes[k]
        by = drifting.predict(moved) - equations.predict(state)
        assert columns[:, k] == pytest.approx(by, abs=1e-6 * np.abs(by).max())


def test_a_term_that_is_switched_on_begins_at_zero_beside_the_others() -> None:
    equations = stated()
    state = np.arange(float(equations.size)) + 1
    on, longer = with_parameters(equations, state, ACCEL_CUBIC.parameters)
    assert on.parameters == (*PARAMETERS, *ACCEL_CUBIC.parameters)
    assert longer.tolist() == [*range(1, 25), 0, 0, 0, *range(25, equations.size + 1)]


def test_the_limit_is_shared_by_all_that_is_open() -> None:
    assert _log_chance_limit([CUBIC] * 5) == pytest.approx(np.log(1e-3 / 5))
    assert _log_chance_limit([]) == pytest.approx(np.log(1e-3))


def test_what_follows_the_temperature_is_not_taken_for_a_drift_that_explains_as_much() -> None:
    chances = {CUBIC: -20.0, TREND: -30.2, THERMAL: -25.8, WARM_UP: -30.4}
    order = (CUBIC, TREND, WARM_UP, THERMAL)
    assert _likeliest(order, chances) is THERMAL
    # Beyond 4.5, half of a chi-square of nine, it is; of those alike the first of all.
    assert _likeliest(order, chances | {THERMAL: -25.6}) is TREND
    assert _likeliest(order, chances | {CUBIC: -31.0}) is CUBIC
    assert _likeliest((CUBIC, TREND), chances) is TREND


def test_errors_of_the_table_are_as_large_as_what_is_seen_by_students_t() -> None:
    model = _Model(evidence_of(), PARAMETERS)
    estimate = np.array([3e-5, 0.0, 4e-5])
    considered, size, seen = _assigned_sizes(model, WOBBLE, score(9.0, 2, estimate=estimate))
    # Two deviations' chance with two degrees of freedom, and the mean square of 5e-5 over both.
    wider = t.ppf(norm.cdf(2), 2) / 2
    assert considered == ()
    assert size == pytest.approx(wider * 5e-5 / np.sqrt(2))
    assert seen == pytest.approx(5e-5 / np.sqrt(2))
    # A term that the session determines is estimated, and so is what follows time.
    assert _assigned_sizes(model, SENSES, score(9.0, 2, estimate=estimate)) == ((), 0.0, 0.0)
    assert _assigned_sizes(model, TREND, score(9.0, 2, estimate=estimate)) == ((), 0.0, 0.0)
    considered, *sizes = _assigned_sizes(model, OF_ACCELS, score(9.0, 2, estimate=estimate))
    assert sizes == [0.0, 0.0]
    assert [p for p, _ in considered] == list(ACCEL_CUBIC.parameters)
    assert [v for _, v in considered] == pytest.approx([wider * 5e-5 / np.sqrt(2)] * 3)


def test_a_model_is_what_was_found_and_can_do_without_it() -> None:
    evidence = stated(TableErrors(zeros=1e-4)).evidence
    start = _Model(evidence, PARAMETERS)
    doubt = tuple((p, 1e-6) for p in ACCEL_CUBIC.parameters)
    model = start.with_found(
        [
            SignificantFamily(CUBIC, -9.0),
            SignificantFamily(TREND, -9.0),
            SignificantFamily(WOBBLE, -9.0, size=2e-5),
            SignificantFamily(OF_ACCELS, -9.0, considered=doubt),
        ]
    )
    assert model.parameters == (*PARAMETERS, *GYRO_CUBIC.parameters)
    assert model.changes == session_term('trend')
    assert model.considered == doubt
    assert model.evidence.table is not None
    assert model.evidence.table.errors == TableErrors(zeros=1e-4, wobble=2e-5)
    assert model.without(CUBIC).parameters == PARAMETERS
    assert model.without(CUBIC).changes == model.changes
    assert model.without(TREND).changes == ()
    assert model.without(TREND).parameters == model.parameters


def test_equations_take_on_what_a_model_has_and_keep_what_they_know() -> None:
    equations = replace(stated(), changes=session_term('trend'))
    state = np.arange(float(equations.size))
    more = _Model(equations.evidence, (*PARAMETERS, *GYRO_CUBIC.parameters), session_term('trend'))
    on, longer = more.on(equations, state)
    assert (on.parameters, on.changes) == (more.parameters, session_term('trend'))
    assert longer.tolist() == [*range(24), 0, 0, 0, *range(24, equations.size)]
    fewer = _Model(equations.evidence, PARAMETERS)
    off, shorter = fewer.on(equations, state)
    assert off.changes == ()
    assert shorter.tolist() == [*range(equations.size - 8)]
    # Coefficients of another course begin anew.
    other = _Model(equations.evidence, PARAMETERS, session_term('warm_up'))
    warming, begun = other.on(equations, equations.nominal())
    assert {c.course for c in warming.changes} == {Course.WARM_UP}
    assert len(begun) == warming.size


def estimated(**more: Any) -> Any:
    equations = more.pop('equations', stated())
    scatter = ExcessScatter(PositioningErrors(1e-5, 0.0), np.zeros(6))
    return SimpleNamespace(
        equations=equations,
        state=equations.nominal(),
        scatter=scatter,
        without_scatter=replace(equations, inflation=np.ones(len(equations.outputs))),
        downweighted_outputs=more.pop('down', 0),
        shares=dict,
        **more,
    )


def test_all_moves_are_back_and_nothing_set_aside_before_the_first_is_found() -> None:
    first = estimated()
    moves: Any = ()
    start = _Model(replace(first.equations.evidence, moves=moves), PARAMETERS)
    found = _restored(start, first)
    assert found.inflation is None
    assert found.evidence.moves is start.evidence.moves


def judged(monkeypatch: pytest.MonkeyPatch, scores: dict[Family, Score]) -> None:
    """Let families be these, with these tests."""
    monkeypatch.setattr(module, 'families', lambda _: tuple(scores))
    monkeypatch.setattr(module, 'columns_of', lambda found, *_: {f: ((f, f),) for f in found})
    residuals = SimpleNamespace(score=lambda family, _: scores[family])
    monkeypatch.setattr(module, 'WhitenedResiduals', SimpleNamespace(at=lambda *_: residuals))


def test_confirmed_is_what_is_significant_beside_the_others_with_rivals_close_by(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trial = estimated()
    start = _Model(trial.equations.evidence, PARAMETERS)
    monkeypatch.setattr(_Model, 'on', lambda *_: (trial.equations, trial.state))
    best = score(60.0, freedom=1e9, scale=2.0)
    near, far = (replace(best, statistic=s) for s in (42.1, 41.9))
    judged(monkeypatch, {CUBIC: best, SENSES: near, OF_ACCELS: far, WOBBLE: near})
    # A chi-square of nine, in the scale of what is there: 18; of the table nothing is a rival.
    (kept,) = _confirmed(start, trial, trial, [SignificantFamily(CUBIC, -1.0)])
    assert kept.log_p == best.log_p
    assert kept.alternatives == (SENSES,)
    # 16.3 is what three degrees of freedom have once in a thousand, 17.7 once in two thousand.
    judged(monkeypatch, {CUBIC: replace(best, statistic=2 * 17.5), SENSES: best})
    assert _confirmed(start, trial, trial, [SignificantFamily(CUBIC, -1.0)]) == ()


def test_what_spares_outputs_must_explain_the_session_better_than_they_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A unit that moved in its mount, or one of the moves later: both have three coefficients."""
    start = _Model(stated().evidence, PARAMETERS)
    monkeypatch.setattr(_Model, 'on', lambda *_: (trial.equations, trial.state))
    judged(monkeypatch, {CUBIC: score(90.0), SENSES: score(90.0)})
    both = [SignificantFamily(CUBIC, -1.0, against_outliers=3), SignificantFamily(SENSES, -1.0)]
    first, trial, sizes = estimated(down=3), estimated(), {}
    monkeypatch.setattr(module, '_akaike_criterion', lambda one, *_: sizes[id(one)])
    for size, names in ((0.1, ['gyro_asymmetry']), (-0.1, ['gyro_cubic', 'gyro_asymmetry'])):
        sizes = {id(first): 200.0, id(trial): 200.0 + size}
        kept = _confirmed(start, first, trial, both)
        assert [one.family.name for one in kept] == names


def test_families_are_tried_under_their_own_scatter_until_some_are_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = [Family(f'term {k}') for k in range(6)]
    equations = stated()
    plain = {f: score(100.0 - k, freedom=1e9) for k, f in enumerate(names)}
    # The fifth is nothing without scatter, the sixth is not tested.
    plain[names[4]] = score(16.2, freedom=1e9)
    plain[names[5]] = score(99.0, rank=0)
    monkeypatch.setattr(module, 'columns_of', lambda found, *_: {f: f.name for f in found})
    monkeypatch.setattr(module, 'scores_of', lambda *_: dict(plain))
    monkeypatch.setattr(Family, 'scatter', lambda *_: None)
    monkeypatch.setattr(Family, 'with_scatter', lambda *_: None)
    tried: list[str] = []

    def under(shown: str) -> dict[Family, Score]:
        tried.clear()

        def scored(family: Family, columns: str) -> Score:
            assert columns == family.name
            tried.append(family.name)
            return score(50.0 if family.name == shown else 1.0, freedom=1e9)

        residuals = SimpleNamespace(score=scored)
        monkeypatch.setattr(module, 'WhitenedResiduals', SimpleNamespace(at=lambda *_: residuals))
        return _under_own_scatter(equations, equations.nominal(), names)

    found = under('term 1')
    # Three at once; the fourth waits, and counts for nothing meanwhile.
    assert tried == ['term 0', 'term 1', 'term 2']
    assert [found[f].statistic for f in names] == [1.0, 50.0, 1.0, 0.0, 16.2, 99.0]
    found = under('none')
    assert tried == ['term 0', 'term 1', 'term 2', 'term 3']
    assert [found[f].statistic for f in names] == [1.0] * 4 + [16.2, 99.0]


def test_families_are_found_one_after_the_other_the_most_significant_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = estimated(down=3)
    start = _Model(first.equations.evidence, PARAMETERS)
    monkeypatch.setattr(module, 'families', lambda _: (CUBIC, SENSES, TREND))
    views: list[Any] = []

    def tests(equations: Any, _: Any, open_ones: Any) -> dict[Family, Score]:
        aside = equations.inflation is not None
        views.append((aside, [f.name for f in open_ones]))
        # The cubic term is significant only as long as nothing is set aside.
        cubic = score(1.0 if aside else 70.0)
        return {f: {CUBIC: cubic, SENSES: score(90.0)}.get(f, score(1.0)) for f in open_ones}

    monkeypatch.setattr(module, '_under_own_scatter', tests)
    monkeypatch.setattr(module, 'fit', lambda _, state: state)
    monkeypatch.setattr(_Model, 'on', lambda _, equations, state: (equations, state))
    found = _found_families(start, first, set())
    assert [(one.family, one.against_outliers) for one in found] == [(SENSES, 0), (CUBIC, 3)]
    assert [one.log_p for one in found] == [score(90.0).log_p, score(70.0).log_p]
    assert [names for _, names in views[::2]] == [
        ['gyro_cubic', 'gyro_asymmetry', 'trend'],
        ['gyro_cubic', 'trend'],
        ['trend'],
    ]
    assert [aside for aside, _ in views] == [False, True] * 3
    assert _found_families(start, first, {SENSES, CUBIC}) == ()


def test_a_view_that_comes_to_no_end_is_left_for_what_was_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[list[bool]] = []
    answers: list[Any] = []

    def refusing(_: Any, views: Any, __: Any) -> Any:
        asked.append([equations.inflation is None for equations, _ in views])
        if not (answer := answers.pop(0)):
            raise NotConverged('no end')
        return answer

    monkeypatch.setattr(module, '_significant', refusing)
    first = estimated(down=3)
    start = _Model(first.equations.evidence, PARAMETERS)
    found = ('found',)
    for given, wanted, answer in (
        ([found], [[True, False]], found),
        ([None, found], [[True, False], [False]], found),
    ):
        asked.clear()
        answers[:] = given
        assert _found_families(start, first, set()) == answer
        assert asked == wanted
    asked.clear()
    answers[:] = [None, None]
    with pytest.raises(NotConverged):
        _found_families(start, first, set())
    assert asked == [[True, False], [False]]
    # Where nothing was set aside there is one view of the session.
    answers[:] = [found]
    asked.clear()
    _found_families(start, estimated(down=0), set())
    assert asked == [[True]]


def test_what_is_not_confirmed_is_rejected_and_the_search_begins_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, trial = estimated(), estimated()
    tried: list[Any] = []

    def shown(_: Any, __: Any, rejected: set[Family]) -> Any:
        tried.append({f.name for f in rejected})
        return tuple(
            SignificantFamily(f, -9.0) for f in (CUBIC, SENSES, OF_ACCELS) if f not in rejected
        )

    def fitted(model: _Model) -> Any:
        if model.parameters == PARAMETERS:
            return first
        if len(model.parameters) == 33:
            raise NotObservable('too many')
        return trial

    monkeypatch.setattr(module, '_found_families', shown)
    monkeypatch.setattr(_Model, 'estimate', fitted)
    monkeypatch.setattr(
        module, '_confirmed', lambda *given: tuple(f for f in given[3] if f.family != SENSES)
    )
    monkeypatch.setattr(
        module,
        '_search_of',
        lambda last, kept, plain, weigh_drifts: (last, kept, plain, weigh_drifts),
    )
    monkeypatch.setattr(module, '_without_use', lambda *_: None)
    start = _Model(first.equations.evidence, PARAMETERS)
    found: Any = _searched(start, first, find_terms=True)
    # The last of three leaves the session open; of the other two one is not significant.
    assert tried == [set(), {'accel_cubic'}, {'accel_cubic', 'gyro_asymmetry'}]
    assert found == (trial, (SignificantFamily(CUBIC, -9.0),), first, True)
    assert _searched(start, first, find_terms=False) == (first, (), first, False)
    monkeypatch.setattr(module, '_found_families', lambda *_: ())
    assert _searched(start, first, find_terms=True) == (first, (), first, True)


def test_a_term_that_leaves_a_parameter_without_use_is_listed_and_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Level channels tell the bias from the square of 1 g, and lean by the table's errors."""
    evidence = evidence_of(noise=np.random.default_rng(2))
    start = _Model(evidence, PARAMETERS)
    quadratic = SignificantFamily(Family('accel_quadratic', ACCEL_QUADRATIC), -30.0)

    def trial(arcsec: float) -> Any:
        equations = Equations(
            evidence,
            start.with_found([quadratic]).parameters,
            positioning=PositioningErrors(stops=arcsec * ARCSEC),
        )
        return SimpleNamespace(equations=equations, state=equations.nominal())

    # By the walk alone, 1.9 ug a dwell, both biases are as sharp.
    assert module._without_use(start, trial(0.0), [quadratic]) is None
    costly = module._without_use(start, trial(30.0), [quadratic])
    assert costly is not None
    assert (costly.family, costly.parameter.name[:3]) == (quadratic.family, 'D_a')
    assert costly.ratio > 10

    first = start.estimate()
    monkeypatch.setattr(_Model, 'estimate', lambda _: trial(30.0))
    monkeypatch.setattr(
        module,
        '_found_families',
        lambda _, __, rejected: (quadratic,) if quadratic.family not in rejected else (),
    )
    monkeypatch.setattr(module, '_confirmed', lambda *given: given[3])
    search = _searched(start, first, find_terms=True)
    assert search.found == ()
    assert search.unobservable == (costly,)
    (sentence,) = findings(search)
    assert f'with it {costly.parameter.name} would have' in sentence


def test_a_term_beside_one_that_costs_a_parameter_is_not_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    costly = SignificantFamily(Family('gyro_cubic', GYRO_CUBIC), -50.0)
    other = SignificantFamily(Family('accel_quadratic', ACCEL_QUADRATIC), -20.0)
    start: Any = SimpleNamespace(with_found=lambda f: SimpleNamespace(on=lambda *_: (f, None)))
    trial: Any = SimpleNamespace(equations=(costly, other), state=None)
    limits = np.array([useful_limit(p) for p in PARAMETERS])
    limits[np.isinf(limits)] = 1.0
    deviations = {True: 2 * limits, False: limits / 3}
    monkeypatch.setattr(module, '_common_std', lambda one, _: deviations[costly in one])
    left_out = module._without_use(start, trial, trial.equations)
    assert left_out is not None and left_out.family == costly.family
    # Where neither alone does it, the less significant one is left out.
    monkeypatch.setattr(module, '_common_std', lambda one, _: deviations[bool(one)])
    left_out = module._without_use(start, trial, trial.equations)
    assert left_out is not None and left_out.family == other.family


def test_a_step_is_tried_where_nothing_else_converges_or_outputs_are_set_aside(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ended(down: int = 0, **more: Any) -> SearchResult:
        one = estimated(down=down)
        return SearchResult(
            one, (), {}, 1e-4, np.zeros((24, 24)), {}, {}, one, np.zeros((24, 24)), **more
        )

    sizes: dict[int, float] = {}
    monkeypatch.setattr(module, '_akaike_criterion', lambda one: sizes[id(one)])
    monkeypatch.setattr(_Model, 'estimate', lambda _: estimated())
    evidence, stepped = stated().evidence, ended()
    tried: list[bool] = []

    def with_a_step(_: Any) -> Any:
        tried.append(True)
        return stepped

    monkeypatch.setattr(module, '_with_a_step', with_a_step)
    likely = [False]
    monkeypatch.setattr(module, '_may_step', lambda *_: likely[0])

    def searched(answer: SearchResult | None, *, find_terms: bool = True) -> Any:
        def search(*_: Any, **__: Any) -> SearchResult:
            if answer is None:
                raise NotConverged('no end')
            return answer

        monkeypatch.setattr(module, '_searched', search)
        return search_terms(evidence, find_terms=find_terms)

    assert searched(None) is stepped
    with pytest.raises(NotConverged):
        searched(None, find_terms=False)
    tried.clear()
    sound = ended()
    assert searched(sound) is sound
    named = replace(ended(down=3), found=(SignificantFamily(STEP, -9.0),))
    assert searched(named) is named
    assert searched(aside := ended(down=3), find_terms=False) is aside
    assert searched(aside) is aside
    assert not tried
    likely[0] = True
    for other in (ended(down=3), ended(broken_off=True)):
        sizes = {id(other.estimate): 200.0, id(stepped.estimate): 199.9}
        found = searched(other)
        assert (found.estimate, found.before_search) == (stepped.estimate, other.estimate)
        sizes[id(stepped.estimate)] = 200.1
        assert searched(other) is other
    stepped = None  # type: ignore[assignment]
    assert searched(other) is other
    with pytest.raises(NotConverged):
        searched(None)


def test_an_explanation_is_as_large_as_its_chi_square_and_its_coefficients() -> None:
    equations = stated()
    state = equations.nominal()
    jacobian, residuals = equations.whitened(state)
    remains = residuals - jacobian @ np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
    of: Any = SimpleNamespace
    one = of(state=state, without_scatter=equations, downweighted_outputs=3)
    size = float(remains @ remains) + 2 * (24 + 3)
    assert _akaike_criterion(one) == pytest.approx(size, abs=1e-6)
    # Errors of the table have no parameters.
    assert _akaike_criterion(one, 3) == pytest.approx(size + 6, abs=1e-6)
    held = replace(equations, changes=session_term('step'), shape=1e-9)
    stepping = of(state=np.append(state, np.zeros(6)), without_scatter=held, downweighted_outputs=0)
    # At its very beginning a step has no effect, but six coefficients and an instant.
    size = float(remains @ remains) + 2 * (24 + 6 + 1)
    assert _akaike_criterion(stepping) == pytest.approx(size, rel=1e-3)


def test_a_step_in_an_interruption_is_one_of_few() -> None:
    equations = stated()
    instants = shapes_of(STEP, equations)
    assert tries_of(STEP, equations) == tries_of(TREND, equations) == []
    parts = [*equations.evidence.segments, *equations.evidence.turns]
    whole = (min(p.start for p in parts), max(p.end for p in parts))
    middle = whole[0] + round((whole[1] - whole[0]) * float(instants[5] + instants[6]) / 2)
    gap = ((middle - 1000, middle + 1000),)
    cut = replace(equations, evidence=replace(equations.evidence, interruptions=gap))
    tries = tries_of(STEP, cut)
    assert len(tries) == len(shapes_of(STEP, cut)) == len(instants) + 1
    # Half of the chance is for the one, half for all others.
    assert tries == [*[2 * len(instants)] * 6, 2, *[2 * len(instants)] * (len(instants) - 6)]
    scores = [score(20.0), score(19.0), score(10.0)]
    found = most_significant(scores, [100, 2, 2])
    assert (found.statistic, found.tries, found.chosen) == (19.0, 2, 1)


def test_a_search_that_comes_to_no_end_is_said_to_be_broken_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = estimated()

    def refused(*_: Any) -> Any:
        raise NotConverged('no end')

    monkeypatch.setattr(_Model, 'estimate', lambda _: first)
    whole = SearchResult(first, (), {}, 1e-4, np.zeros((24, 24)), {}, {}, first, np.zeros((24, 24)))
    monkeypatch.setattr(module, '_search_of', lambda *_, **__: whole)
    monkeypatch.setattr(module, '_found_families', lambda *_: ())
    assert findings(search_terms(first.equations.evidence)) == []
    monkeypatch.setattr(module, '_found_families', refused)
    (sentences,) = findings(search_terms(first.equations.evidence))
    assert 'did not converge' in sentences


def test_a_rival_counts_by_its_likelihood_and_by_how_far_parameters_are_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    equations, _ = with_parameters(stated(), stated().nominal(), GYRO_CUBIC.parameters)
    state = np.zeros(equations.size)
    state[:27] = np.arange(27)
    current: Any = SimpleNamespace(equations=equations, state=state)
    squares = iter((10.0, 12.0))
    monkeypatch.setattr(Equations, 'chi_square', lambda *_: next(squares))
    # By the rival every one of the 24 is larger by two, and what was found is zero.
    monkeypatch.setattr(module, 'fit', lambda _, start: start + 2.0)
    found = _by_alternatives(current, SignificantFamily(CUBIC, -9.0, alternatives=(SENSES,)))
    off = np.array([*[2.0] * 24, -24.0, -25.0, -26.0])
    # Likelihoods of exp(-10 / 2) and exp(-12 / 2).
    assert found == pytest.approx(np.outer(off, off) * np.exp(-6) / (np.exp(-5) + np.exp(-6)))
    monkeypatch.setattr(Equations, 'chi_square', lambda *_: 0.0)

    def refused(*_: Any) -> Any:
        raise NotConverged('no end')

    monkeypatch.setattr(module, 'fit', refused)
    assert not _by_alternatives(
        current, SignificantFamily(CUBIC, -9.0, alternatives=(SENSES,))
    ).any()


def test_what_rivals_and_drifts_would_make_is_a_share_of_its_own() -> None:
    doubt = np.diag([4.0, 0.0])
    known = Share(np.diag([1.0, 2.0]), np.array([5.0, 6.0]))
    parts = [estimated(), (), {}, 1e-4, doubt, {}, {}, estimated(), doubt]
    search = SearchResult(*parts)
    assert search.shares()[ErrorSource.TERMS].covariance.tolist() == doubt.tolist()
    search.estimate.shares = lambda: {ErrorSource.TERMS: known, ErrorSource.NOISE: known}
    both = search.shares()
    assert both[ErrorSource.TERMS].covariance.tolist() == [[5.0, 0.0], [0.0, 2.0]]
    assert both[ErrorSource.TERMS].freedom is known.freedom
    assert both[ErrorSource.NOISE] is known
    none = replace(search, undecided_covariance=np.zeros((2, 2)))
    assert none.shares() == {ErrorSource.TERMS: known, ErrorSource.NOISE: known}


def test_of_what_is_off_it_is_said_what_it_would_do(monkeypatch: pytest.MonkeyPatch) -> None:
    equations = stated(TableErrors(zeros=1e-4))
    state = equations.nominal()
    jacobian, _ = equations.whitened(state)
    absent = ('absent',)
    scatter: Any = ExcessScatter(PositioningErrors(0, 0), np.zeros(6), (), absent)  # type: ignore[arg-type]
    current: Any = SimpleNamespace(
        equations=equations, state=state, scatter=scatter, gain=np.linalg.pinv(jacobian)
    )
    every = (CUBIC, TREND, WOBBLE)
    monkeypatch.setattr(module, 'families', lambda _: (*every, SENSES))
    beside: list[Any] = []
    plain = scores_module.WhitenedResiduals.at(equations, state)

    def residuals(of: Any, _: Any) -> Any:
        beside.append(of.extra)
        return plain

    monkeypatch.setattr(module, 'WhitenedResiduals', SimpleNamespace(at=residuals))
    found = module._search_of(
        current, (SignificantFamily(SENSES, -9.0),), current, weigh_drifts=True
    )
    # Drifts are tested beside what seems absent; what was found is no more off.
    assert beside == [(), absent]
    assert list(found.scores) == list(every)
    assert found.alpha == pytest.approx(1e-3 / 3)
    assert (found.estimate, found.before_search) == (current, current)
    patterns = columns_of(every, equations, state)
    for family in (CUBIC, TREND):
        ((columns, sizes),) = patterns[family]
        # By how much the least squares move per SI unit of a coefficient.
        white = np.linalg.solve(np.linalg.cholesky(equations.covariance(state)), columns / sizes)
        wanted = (current.gain[:, : len(white)] @ white)[:24]
        assert found.leverage[family] == pytest.approx(wanted, rel=1e-6, abs=1e-9)
    assert WOBBLE not in found.leverage
    assert list(found.probability) == [TREND]
    drifts = module.undecided({TREND: [(found.scores[TREND], found.leverage[TREND])]}, 24)
    assert found.by_drifts == pytest.approx(drifts.covariance)
    assert found.undecided_covariance == pytest.approx(drifts.covariance)
    none = module._search_of(current, (), current, weigh_drifts=False)
    assert none.probability == {}
    assert not none.by_drifts.any()
    assert list(none.scores) == [*every, SENSES]
