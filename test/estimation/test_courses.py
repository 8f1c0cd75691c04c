"""What changes during a session: its mean over each part, against sums over a thousand instants."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats
from imu_calib.estimation.modulation import (
    LEAST_RISE,
    check_temperature,
    columns,
    courses,
    instant_of,
    interrupted,
    outermost,
    rates,
    reference,
    seconds_of,
    shapes,
    spans,
    stated_changes,
    temperatures,
    warms,
)
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.session_terms import Change, Course
from imu_calib.segmentation.course import Temperature

NS = 10**9
EPOCH = 1_700_000_000 * NS
PARTS = [(0.0, 40.0), (50.0, 90.0), (100.0, 112.0), (40.0, 50.0)]
"""Two rests, a turn and a move, s."""
WHOLE = 112.0
TAU = 0.25
FINE = 100_000


def course_of_temperature() -> Temperature:
    """From 20 to 22 degrees within 60 s, then constant."""
    points = np.array([[EPOCH, 20.0], [EPOCH + 60 * NS, 22.0], [EPOCH + 120 * NS, 22.0]])
    return Temperature(21.5, 20.0, 22.0, points)


def stamps(*every: SimpleNamespace) -> Any:
    return np.array([(part.start, part.end) for part in every]).T


def session(temperature: Temperature | None = None) -> Any:
    first, second, turn, move = (
        SimpleNamespace(start=EPOCH + round(a * NS), end=EPOCH + round(b * NS)) for a, b in PARTS
    )
    return SimpleNamespace(
        parts=[first, second, turn],
        instants=stamps(first, second, turn, move),
        layout=SimpleNamespace(segment=np.array([0, 1, 1, 2, 3])),
        temperature=temperature,
        interruptions=(),
    )


def at(course: Course, seconds: Floats) -> Floats:
    """The course itself, but for what is the same all along."""
    if course is Course.TREND:
        return seconds
    if course is Course.WARM_UP:
        return np.exp(-seconds / (TAU * WHOLE))
    if course is Course.STEP:
        return np.where(seconds > TAU * WHOLE, 1.0, 0.0)
    return np.interp(seconds, [0.0, 60.0], [20.0, 22.0])


def instants(begin: float, end: float) -> Floats:
    return begin + (np.arange(FINE) + 0.5) * (end - begin) / FINE


def test_parts_are_timed_from_the_first() -> None:
    starts, ends = spans(session())
    assert starts.tolist() == [a for a, _ in PARTS]
    assert ends.tolist() == [b for _, b in PARTS]


@pytest.mark.parametrize('course', [Course.TREND, Course.WARM_UP, Course.STEP])
def test_a_course_is_its_mean_over_a_part_less_that_over_the_session(course: Course) -> None:
    usual = at(course, instants(0.0, WHOLE)).mean()
    wanted = [at(course, instants(*part)).mean() - usual for part in PARTS]
    found = courses(session(), course, TAU)
    # A step is off by half of one of the hundred thousand instants.
    np.testing.assert_allclose(
        found, wanted, rtol=1e-8, atol=1e-5 if course is Course.STEP else 1e-8
    )


def test_a_temperature_counts_from_the_sessions_mean() -> None:
    held = session(course_of_temperature())
    means = [at(Course.THERMAL, instants(*part)).mean() for part in PARTS]
    np.testing.assert_allclose(temperatures(held), means, rtol=1e-9)
    assert reference(held) == 21.5
    found = courses(held, Course.THERMAL, TAU)
    np.testing.assert_allclose(found, np.array(means) - 21.5, atol=1e-8)


def test_a_rate_is_by_how_much_a_course_rises_over_a_part() -> None:
    held = session(course_of_temperature())
    assert rates(held, Course.TREND, TAU).tolist() == [1.0] * 4
    for k, (begin, end) in enumerate(PARTS):
        first, last = at(Course.WARM_UP, np.array([begin, end]))
        wanted = (last - first) / (end - begin)
        assert rates(held, Course.WARM_UP, TAU)[k] == pytest.approx(wanted, rel=1e-12)
        middle = (begin + end) / 2
        early, late = (
            at(Course.THERMAL, instants(*half)).mean() for half in ((begin, middle), (middle, end))
        )
        wanted = (late - early) / ((end - begin) / 2)
        assert rates(held, Course.THERMAL, TAU)[k] == pytest.approx(wanted, abs=1e-8)


def test_the_rate_of_a_step_is_that_of_the_line_through_it() -> None:
    held = session()
    for k, part in enumerate(PARTS):
        seconds = instants(*part)
        wanted = np.polyfit(seconds - seconds.mean(), at(Course.STEP, seconds), 1)[0]
        assert rates(held, Course.STEP, TAU)[k] == pytest.approx(wanted, abs=1e-6)


def test_a_step_is_tried_where_parts_begin_and_in_their_middle() -> None:
    held = session()
    # Two dwells or turns lie before it, and two after.
    assert not len(shapes(held, Course.STEP))
    last = SimpleNamespace(start=EPOCH + 120 * NS, end=EPOCH + 132 * NS)
    held.parts.append(last)
    held.instants = np.insert(held.instants, 3, stamps(last).T, axis=1)
    assert (shapes(held, Course.STEP) * 132.0).tolist() == pytest.approx([100.0])
    assert not interrupted(held).any()
    # A stream that was silent from the 91st second to the 99th, and one before the session.
    held.interruptions = tuple(
        (EPOCH + a * NS, EPOCH + b * NS) for a, b in ((-20, -10), (91, 99), (99, 103))
    )
    assert (shapes(held, Course.STEP) * 132.0).tolist() == pytest.approx([95.0, 100.0])
    assert interrupted(held).tolist() == [True, True]
    held.interruptions = held.interruptions[:2]
    assert interrupted(held).tolist() == [True, False]
    # One that is on may be in the second part, or in the last but one.
    assert (outermost(held) * 132.0).tolist() == pytest.approx([40.0, 120.0])
    assert shapes(held, Course.TREND).tolist() == [1.0]
    assert instant_of(held, 0.5) == EPOCH + 66 * NS
    assert seconds_of(held, 0.5) == 66.0


def test_a_coefficient_acts_through_the_parameters_that_it_changes() -> None:
    derivatives = np.arange(5.0 * len(PARAMETERS)).reshape(5, -1) ** 2
    changes = [
        Change(Course.TREND, 'first', (PARAMETERS[3],)),
        Change(Course.WARM_UP, 'both', (PARAMETERS[0], PARAMETERS[7])),
    ]
    held = session()
    for course in (courses, rates):
        found = columns(held, changes, derivatives, PARAMETERS, TAU, course)
        for row, part in enumerate([0, 1, 1, 2, 3]):
            trend = course(held, Course.TREND, TAU)[part] * derivatives[row, 3]
            both = derivatives[row, 0] + derivatives[row, 7]
            fading = course(held, Course.WARM_UP, TAU)[part] * both
            assert found[row].tolist() == pytest.approx([trend, fading], rel=1e-14)


def test_what_follows_a_temperature_needs_one_that_moves() -> None:
    with pytest.raises(NotObservable, match='no temperature'):
        temperatures(session())
    assert not warms(session())
    # Between the means of the parts: the first has 20.67 degrees, the last 22.
    assert warms(session(course_of_temperature()))
    check_temperature(session(course_of_temperature()))
    points = np.array([[EPOCH, 20.0], [EPOCH + 112 * NS, 20.0 + LEAST_RISE]])
    slow = session(Temperature(20.2, 20.0, 20.5, points))
    assert not warms(slow)
    with pytest.raises(
        NotObservable, match=r'moves by 0\.38 K \(from 20\.09 to 20\.47 degC\), expected 0\.5 K'
    ):
        check_temperature(slow)
    level = np.array([[EPOCH, 20.0], [EPOCH + 90 * NS, 20.0], [EPOCH + 90 * NS + 1, 20.5]])
    assert warms(session(Temperature(20.2, 20.0, 20.5, level)))


def test_each_scale_factor_and_bias_has_what_the_data_sheet_states_of_its_kind() -> None:
    stated = np.array([[1e-5, 2e-7], [3e-5, 4e-4]])
    changes, sizes = stated_changes(PARAMETERS, stated)
    found = {change.name: size for change, size in zip(changes, sizes.tolist(), strict=True)}
    wanted = {f'K_g{axis}': 1e-5 for axis in 'xyz'} | {f'D_g{axis}': 2e-7 for axis in 'xyz'}
    wanted |= {f'K_a{axis}': 3e-5 for axis in 'xyz'} | {f'D_a{axis}': 4e-4 for axis in 'xyz'}
    assert found == wanted
    assert all(c.course is Course.THERMAL for c in changes)
    assert [c.parameters[0].name for c in changes] == [c.name for c in changes]
