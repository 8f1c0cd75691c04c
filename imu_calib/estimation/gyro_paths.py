"""Motion from one dwell to the next by the gyros of a model: a rotation and its derivatives.

Steps of joined samples include the coning of their directions (`segmentation.moves`); single
samples do not.

Sources: Bortz 1971, IEEE Trans. AES 7, 61, and Savage 1998, J. Guidance 21, 19, eq. (45), for the
rotation vector of an interval; the derivatives are those of docs/mathematics.md, 'Moves'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import GENERATORS, cross, product, rotations, rotations_last
from ..common.stream import Floats
from ..model.sensors import SensorModel, delay, places
from ..model.terms import term
from ..segmentation.segmented import VelocitySteps


@dataclass(frozen=True, eq=False)
class GyroPath:
    """A motion from rest to rest by a model."""

    rates: Floats  #: (n, 3) mean rate of each interval about the body axes, rad/s.
    forces: Floats  #: (n, 3) specific force in its middle, m/s^2.
    seconds: Floats  #: (n,) its length, s.
    #: (3, 3) transforms the components of a vector fixed in inertial space from the start to the
    #: end.
    rotation: Floats
    axes: Floats  #: (n, 3, 3) transforms components from the middle of an interval to the end.
    #: (n, 3, 3) transforms an error of the gyros' outputs over an interval, rad, to the error in
    #: the rotation of the body axes at the end.
    error_transfer: Floats

    @classmethod
    def of_each(
        cls, motions: Sequence[tuple[Floats, Floats, Floats]], model: SensorModel
    ) -> tuple[GyroPath, ...]:
        """Integrate motions.

        The effect of gravity on the gyros is computed from the attitudes of the path itself: the
        accelerometers also measure the accelerations of the hand or the joint. All intervals are
        compensated at once: the result of each is bit-identical to that of a single call.

        Args:
            motions: Of each the (n, 3) rotation vectors of its intervals by the gyros, rad, their
                lengths (n,), s, and the (3,) specific force at rest at the end, body axes, m/s^2.
            model: The sensors.
        """
        if not motions:
            return ()
        seconds = [seconds for _, seconds, _ in motions]
        outputs = np.concatenate([turned / each[:, None] for turned, each, _ in motions])
        forces = [np.zeros_like(turned) for turned, *_ in motions]
        rates, middles, wholes = _integrated(outputs, seconds, model, forces)
        ends = np.cumsum([len(each) for each in seconds])[:-1]
        each = np.repeat([force for *_, force in motions], [len(s) for s in seconds], axis=0).T
        specific_force = each[0] * middles[0] + each[1] * middles[1] + each[2] * middles[2]
        forces = np.split(np.ascontiguousarray(specific_force.T), ends)
        if model.gyros_sense_force:
            rates, middles, wholes = _integrated(outputs, seconds, model, forces)
        # An error over an interval acts as one in its middle, to the second order of its angle.
        transfer = product(middles, np.asarray(np.linalg.inv(model.gyro.response))[..., None])
        first = (np.ascontiguousarray(np.moveaxis(each, -1, 0)) for each in (middles, transfer))
        parts = (np.split(each, ends) for each in (rates, *first))
        return tuple(
            cls(rate, specific_force, each, whole, axes, error)
            for rate, axes, error, specific_force, each, whole in zip(
                *parts, forces, seconds, wholes, strict=True
            )
        )

    @cached_property
    def timed_transfer(self) -> Floats:
        """`error_transfer` times the seconds: for errors of rates.

        Summed over courses it is the derivative of log(`rotation` S^T), for S near it, by additions
        to the outputs. These are subtracted from outputs: the path turns less by as much, and
        components of fixed vectors turn more.
        """
        return np.asarray(self.error_transfer * self.seconds[:, None, None])


def summed(matrices: Floats, products: Floats) -> Floats:
    """Return the sums of (n, 3, 3) matrices times (n, q) courses over the steps, (3, 3, q).

    The second index is the channel to whose output a course is added.
    """
    return np.asarray((matrices.reshape(-1, 9).T @ products).reshape(3, 3, -1))


def _integrated(
    outputs: Floats, seconds: list[Floats], model: SensorModel, forces: list[Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return rates (n, 3), rotations (3, 3, n) from the middle of each interval, the whole ones."""
    # Specific force matters only with g-sensitivity; terms are inverted for all outputs at once.
    specific_force = (
        np.zeros((1, 3)) if model.linear and not model.gyros_sense_force else np.vstack(forces)
    )
    _, accel = model.predict(np.zeros(3), specific_force)
    rates, _ = model.compensate(outputs, accel)
    counts = [len(each) for each in seconds]
    halves = rotations_last(rates * (np.concatenate(seconds) / -2)[:, None])
    wholes, after = propagated(product(halves, halves), counts)
    return rates, product(after, halves), wholes


def propagated(passed: Floats, counts: Sequence[int]) -> tuple[Floats, Floats]:
    """Transform fixed vectors through m motions, one after the other.

    Args:
        passed: (3, 3, n) rotations from the start of each interval to its end; overwritten.
        counts: (m,) number of intervals of each motion.

    Returns:
        (m, 3, 3) from the start of each motion to its end, and (3, 3, n) from the end of each
        interval to the end of its motion.
    """
    ends = np.cumsum(counts)
    _follow(passed, np.repeat(ends, counts) - np.arange(ends[-1]) - 1)
    after = np.concatenate([passed[..., 1:], np.eye(3)[..., None]], axis=-1)
    after[..., ends - 1] = np.eye(3)[..., None]
    return np.moveaxis(passed[..., ends - counts], -1, 0), after


def _follow(steps: Floats, follow: NDArray[np.intp]) -> None:
    """Multiply each of (3, 3, n) steps, in place, by those that follow it, (n,) of them.

    Pairs of neighbours are multiplied first, then those between: two products for each step, for
    any number of steps (Brent and Kung 1982, IEEE Trans. Comput. C-31, 260).
    """
    odd, between = np.flatnonzero(follow % 2), np.flatnonzero((follow % 2 == 0) & (follow > 0))
    if not len(odd):
        return
    pairs = _with_next(steps, odd)
    _follow(pairs, follow[odd] // 2)
    steps[..., odd] = pairs
    steps[..., between] = _with_next(steps, between)


def _with_next(steps: Floats, which: NDArray[np.intp]) -> Floats:
    # `take` is three times as fast as indexing.
    return product(steps.take(which + 1, axis=-1), steps.take(which, axis=-1))


# With C_i the rotation from the middle of step i to the end of the move, f_i its specific force by
# the model and t_i its length, all in the body axes at the end,
#
# v = sum of C_i f_i t_i, V_i = the sum before step i and half of its own.
#
# Rotations and rates are those of the move's `GyroPath`. Terms of specific force multiply gravity
# on the path, as everywhere, without the effects of pulses and lever arms.
# Source: docs/mathematics.md, 'Velocities of moves'; the strapdown equations of Savage 1998, J.
# Guidance 21, 208.

_CROSS = np.ascontiguousarray(np.moveaxis(GENERATORS, 0, -1))
"""[v] = _CROSS @ v, the cross product by a vector from the left: (3, 3, 3)."""

_ONE = np.zeros(1, dtype=np.intp)  #: Start index of a single motion.


@dataclass(frozen=True, eq=False)
class VelocityIncrement:
    """The specific force of a move by a model."""

    path: GyroPath  #: The rotation.
    model: SensorModel  #: The sensors.
    additions: Floats  #: (n, 3) outputs by biases and terms, m/s^2.
    specific_force: Floats  #: (n, 3) mean specific force of each step, m/s^2.
    steps: Floats  #: (n, 3) velocity of each step, body axes at the end, m/s.

    @classmethod
    def of_each(
        cls, gained: Sequence[VelocitySteps], paths: Sequence[GyroPath], model: SensorModel
    ) -> tuple[VelocityIncrement, ...]:
        """Follow several paths; all their steps are compensated at once."""
        if not gained:
            return ()
        rates, forces, axes, seconds = (
            np.concatenate([getattr(path, name) for path in paths])
            for name in ('rates', 'forces', 'axes', 'seconds')
        )
        velocity, means = (
            np.concatenate([getattr(g, n) for g in gained]) for n in ('velocity', 'mean')
        )
        alone = {name: found for name, found in model.terms.items() if term(name).triad == 'a'}
        terms = replace(model, terms=alone).extra(np.hstack([rates, forces]))[:, 3:]
        additions = terms + model.accel.bias
        outputs = velocity / seconds[:, None] - additions
        specific_force = np.einsum('ij,nj->ni', np.linalg.inv(model.accel.response), outputs)
        mean = np.einsum('ij,nj->ni', np.linalg.inv(model.gyro.response), means)
        half_way = specific_force + cross(mean, specific_force + cross(mean, specific_force) / 2)
        steps = np.einsum('nij,nj->ni', axes, half_way) * seconds[:, None]
        ends = np.cumsum([len(path.seconds) for path in paths])[:-1]
        parts = zip(
            paths, *(np.split(x, ends) for x in (additions, specific_force, steps)), strict=True
        )
        return tuple(cls(path, model, *mine) for path, *mine in parts)

    @cached_property
    def velocity(self) -> Floats:
        """v, (3,) m/s."""
        return np.asarray(self.steps.sum(axis=0))

    @cached_property
    def correction(self) -> Floats:
        """Correction of v for places and delay of the accelerometers, (3,) m/s.

        Linear in the places, and in the delay with the rotation of the axes meanwhile, up to the
        third order of the angle turned during the delay.
        """
        found = np.zeros(3)
        if (apart := places(self.model)).any():
            found += by_places([self])[0] @ apart.ravel()
        if seconds := delay(self.model):
            # The axes earlier by the delay, by the rate half way back.
            change = _change(self.path.rates, self.path.seconds)
            back = self.path.rates - change * (seconds / 2)
            turned = rotations(-back * seconds) - np.eye(3)
            specific_force = (
                np.einsum('nij,nj->ni', turned, self.specific_force) * self.path.seconds[:, None]
            )
            found += np.einsum('nij,nj->i', self.path.axes, specific_force)
        return found

    @cached_property
    def displacement(self) -> Floats:
        """(3,) the sum of V_i t_i, m: from the start to the end of the move."""
        return np.asarray(self.path.seconds @ self._velocities)

    @cached_property
    def _velocities(self) -> Floats:
        """V_i, (n, 3) m/s."""
        return np.asarray(np.cumsum(self.steps, axis=0) - self.steps / 2)

    @cached_property
    def turning(self) -> Floats:
        """Derivative of v by outputs of the gyros (rad/s) during a step, (n, 3, 3) m.

        A rotation of the axes at step i turns the velocity gained before; half of the whole
        rotation is removed from all of it: v is given in axes half way between those of the ends.
        """
        beyond = np.einsum('ijk,nk->nij', _CROSS, self.velocity / 2 - self._velocities)
        return np.asarray(beyond @ self.path.timed_transfer)

    @cached_property
    def _timed_axes(self) -> Floats:
        """Derivative of v by a specific force during a step, (n, 3, 3) s."""
        return np.asarray(self.path.axes * self.path.seconds[:, None, None])

    def integrated_courses(self, products: Floats) -> Floats:
        """Return the velocities by courses (n, q) added to each accelerometer, (3, 3, q) m/s."""
        answer = np.linalg.inv(self.model.accel.response)
        return np.asarray(answer.T @ summed(self._timed_axes, products))

    @cached_property
    def integrated_force(self) -> Floats:
        """The same by the whole specific force: for scale factors and misalignments."""
        return self.integrated_courses(self.specific_force)

    @cached_property
    def by_seconds(self) -> Floats:
        """The derivative of v by the lengths of the steps as shares of them, (3,) m/s.

        The pulses are constant, but the subtracted biases and terms grow.
        """
        specific_force = self.additions @ np.linalg.inv(self.model.accel.response).T
        return -np.asarray(np.einsum('nij,nj->i', self._timed_axes, specific_force))


def by_delay(increments: Sequence[VelocityIncrement]) -> Floats:
    """Return the correction of v for a delay s of the accelerometers, per s, (m, 3) m/s^2.

    They give f(t - s) for f(t), which is s times the sum of C (w x f) t over a move from rest to
    rest; this is minus that.
    """
    rates, axes, seconds, starts = _all_steps(increments)
    crossed = (
        cross(rates, np.concatenate([t.specific_force for t in increments])) * seconds[:, None]
    )
    return -np.asarray(np.add.reduceat(np.einsum('nij,nj->ni', axes, crossed), starts))


def by_places(increments: Sequence[VelocityIncrement]) -> Floats:
    """Return the correction of v for the places of the accelerometers, per m, (m, 3, 9) 1/s.

    In the order x, y, z of accelerometer x, then of y and z. Accelerometer i reads row i of (I + M)
    a_i, a_i = ([alpha] + [w][w]) r_i. From dwell to dwell integration by parts removes alpha: the
    integral of C P_i a_i is that of C (P_i [w] - [w] P_i) [w] r_i; this is minus that. A rate that
    changes by d within a step has a mean square of w^2 + d^2 / 12.
    """
    rates, axes, seconds, starts = _all_steps(increments)
    change = _change(rates, seconds, starts) * seconds[:, None] / np.sqrt(12)
    # The response P_i of accelerometer i alone is a column of (I + M)^-1 times a row of I + M.
    rows = increments[0].model.accel.response
    columns = np.linalg.inv(rows)
    both = np.stack([rates, change])
    # P_i [w] and P_i [w] [w], row by row.
    read = cross(rows, both[:, :, None])
    square = (both**2).sum(axis=(0, 2))[:, None, None]
    twice = ((both @ rows.T)[..., None] * both[:, :, None]).sum(axis=0) - square * rows
    timed = axes * seconds[:, None, None]
    turning = timed @ np.tensordot(both, GENERATORS @ columns, axes=1)
    left = np.concatenate([turning, -(timed @ columns)[None]])
    right = np.concatenate([read, twice[None]])
    found = np.empty((len(starts), 3, 3, 3))
    for k, (first, end) in enumerate(pairwise([*starts.tolist(), len(seconds)])):
        of_left, of_right = (x[:, first:end].reshape(-1, 3, 3) for x in (left, right))
        found[k] = np.swapaxes(of_left.transpose(2, 1, 0) @ of_right.transpose(1, 0, 2), 0, 1)
    return found.reshape(-1, 3, 9)


def _all_steps(
    increments: Sequence[VelocityIncrement],
) -> tuple[Floats, Floats, Floats, NDArray[np.intp]]:
    """Return rates, axes and seconds of all steps, and the start of each motion."""
    rates, axes, seconds = (
        np.concatenate([getattr(increment.path, name) for increment in increments])
        for name in ('rates', 'axes', 'seconds')
    )
    return rates, axes, seconds, np.cumsum([0, *(len(t.path.seconds) for t in increments[:-1])])


def _change(rates: Floats, seconds: Floats, starts: NDArray[np.intp] = _ONE) -> Floats:
    """Return the change of rates (n, 3), rad/s^2; each motion is from rest to rest."""
    ends, last = np.cumsum(seconds), np.append(starts[1:], len(seconds)) - 1
    middles = ends - seconds / 2
    before, after = np.roll(middles, 1), np.roll(middles, -1)
    before[starts], after[last] = (ends - seconds)[starts], ends[last]
    slower, faster = np.roll(rates, 1, axis=0), np.roll(rates, -1, axis=0)
    slower[starts] = faster[last] = 0.0
    return np.asarray((faster - slower) / (after - before)[:, None])
