"""Ideal gyro outputs between dwells: by a table's joints, and by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..common.rotations import across, cross, rotation, rotation_vectors, rotations
from ..common.stream import Floats
from ..model.earth import Site
from ..model.sensors import SensorModel
from ..segmentation.segments import Segment
from ..segmentation.stream_facts import Move, VelocitySteps
from ..session.table import Course, Table, moving
from .evidence import UP

BY_HAND_MOVE = 2.0
"""Duration of a move from one dwell to the next, s. A choice: that of simulated hands
(`simulation/hand`)."""

_STEP = 0.01
"""Length of the steps of a move, s: no step turns by more than a degree at 100 deg/s."""

_SHORT_STEPS = 40
"""Steps of a turn by hand: at most 4.5 degrees each."""

_PARALLEL = 1e-6
"""Sine of the angle between two directions below which they define no axis: rounding of 1e-16 turns
the axis of so short a product by 1e-10."""


def joint_course(table: Table, origin: Floats, goal: Floats) -> Course:
    """Return the course of the joints at the table's limits."""
    limits = [(joint.max_rate, joint.max_acceleration) for joint in table.joints]
    rates, accelerations = zip(*limits, strict=True)
    return moving(origin.tolist(), goal.tolist(), rates, accelerations)


def ideal_move(
    before: Segment,
    after: Segment,
    course: Course,
    table: Table,
    truth: SensorModel,
    world: tuple[Floats, Floats],
) -> Move:
    """Return the ideal sensor outputs on the way from one dwell to the next.

    Args:
        before: The static dwell at its start.
        after: The static dwell at its end.
        course: Of the joints.
        table: The table.
        truth: The sensors.
        world: (3,) Earth rate and (3,) specific force in the frame of the attitudes, SI.
    """
    seconds = (after.start - before.end) * 1e-9
    knots = np.linspace(0.0, course.end, max(2, math.ceil(course.end / _STEP)) + 1)
    attitudes = table.attitude(course.at(knots)[0])
    # The attitude of the table at both ends, before and after.
    stood = (seconds - course.end) / 2
    attitudes = np.concatenate([attitudes[:1], attitudes, attitudes[-1:]])
    spans = np.array([stood, *np.diff(knots), stood])
    turned, velocity = _along(attitudes, spans, truth, world)
    pulse = before.statistics.pulse
    gained = VelocitySteps(velocity, np.zeros_like(velocity), pulse[3:], predicted=True)
    return Move(before.end, after.start, turned, spans, pulse[:3], velocity_steps=gained)


def _along(
    attitudes: Floats, spans: Floats, truth: SensorModel, world: tuple[Floats, Floats]
) -> tuple[Floats, Floats]:
    """Return the ideal sensor outputs through (n + 1, 3, 3) attitudes, (n,) seconds apart.

    Returns:
        (n, 3) angles, rad, and (n, 3) velocities, m/s.
    """
    earth, force = world
    steps = rotation_vectors(np.swapaxes(attitudes[:-1], 1, 2) @ attitudes[1:])
    middles = (attitudes[:-1] + attitudes[1:]) / 2
    rates = steps / spans[:, None] + np.einsum('i,nij->nj', earth, middles)
    gyro, accel = truth.predict(rates, np.einsum('i,nij->nj', force, middles))
    return gyro * spans[:, None], accel * spans[:, None]


def ideal_holds(segments: list[Segment]) -> list[Segment]:
    """Return holds with the same ups, each reached from the last by the shortest rotation."""
    found = segments[:1]
    for segment in segments[1:]:
        assert segment.attitude is not None
        shown = shortest(found[-1], segment.attitude[2])
        found.append(replace(segment, attitude=shown))
    return found


def next_hold(last: Segment, up: Floats, seconds: float) -> Segment:
    """Return a hold like another one, reached by the shortest rotation.

    Args:
        last: The hold before, in its attitude.
        up: (3,) in body axes, unit vector.
        seconds: Its duration.
    """
    start = last.end + nanoseconds(BY_HAND_MOVE)
    statistics = replace(last.statistics, duration=seconds, walk_gain=np.full(6, 1 / seconds))
    return replace(
        last,
        start=start,
        end=start + nanoseconds(seconds),
        statistics=statistics,
        attitude=shortest(last, up),
    )


def shortest(last: Segment, up: Floats) -> Floats:
    """Return the attitude (3, 3) with (3,) `up` up, by the shortest rotation."""
    assert last.attitude is not None
    rising = last.attitude[2]
    axis = cross(up, rising)
    sine, cosine = float(np.linalg.norm(axis)), float(up @ rising)
    if sine < _PARALLEL:
        # Half a turn may go about any level axis; rounding must not choose it.
        axis = across(np.round(rising, 9))[0]
    turn = rotation(axis / np.linalg.norm(axis), math.atan2(sine, cosine))
    return np.asarray(last.attitude @ turn)


def ideal_move_by_hand(before: Segment, after: Segment, truth: SensorModel, site: Site) -> Move:
    """Return the ideal gyro outputs of the shortest rotation between holds, at constant rate."""
    assert before.attitude is not None
    assert after.attitude is not None
    ends = np.array([before.attitude, after.attitude])
    turn = rotation_vectors(ends[0].T @ ends[1])
    parts = np.linspace(0.0, 1.0, _SHORT_STEPS + 1)[:, None] * turn
    attitudes = ends[0] @ rotations(parts)
    spans = np.full(_SHORT_STEPS, (after.start - before.end) * 1e-9 / _SHORT_STEPS)
    world = site.up_rate * UP, site.specific_force
    turned, _ = _along(attitudes, spans, truth, world)
    return Move(before.end, after.start, turned, spans, before.statistics.pulse[:3])


def nanoseconds(seconds: float) -> int:
    """Return seconds at the resolution of stamps."""
    return round(seconds * 1e9)
