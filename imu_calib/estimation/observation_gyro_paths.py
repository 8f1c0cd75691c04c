"""Motion from one dwell to the next by the gyros of a model: a rotation and its derivatives.

Steps of joined samples include the coning of their directions (`segmentation/moves.py`); single
samples do not.

Sources: Bortz 1971, IEEE Trans. AES 7, 61, and Savage 1998, J. Guidance 21, 19, eq. (45), for the
rotation vector of an interval; the derivatives are those of docs/mathematics.md, 'Moves'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..common.rotations import product, rotations_last
from ..common.stream import Floats
from ..model.sensors import SensorModel


@dataclass(frozen=True, eq=False)
class GyroPath:
    """A motion from rest to rest by a model.

    Attributes:
        rates: (n, 3) mean rate of each interval about the body axes, rad/s.
        forces: (n, 3) specific force in its middle, m/s^2; zeros where not stated.
        seconds: (n,) its length, s.
        rotation: (3, 3) transforms the components of a vector fixed in inertial space from the
            start to the end.
        axes: (n, 3, 3) transforms components from the middle of an interval to the end.
        error_transfer: (n, 3, 3) transforms an error of the gyros' outputs over an interval, rad,
            to the error in the rotation of the body axes at the end.
    """

    rates: Floats
    forces: Floats
    seconds: Floats
    rotation: Floats
    axes: Floats
    error_transfer: Floats

    @classmethod
    def of_each(
        cls, motions: Sequence[tuple[Floats, Floats, Floats | None]], model: SensorModel
    ) -> tuple[GyroPath, ...]:
        """Integrate motions.

        The effect of gravity on the gyros is computed from the attitudes of the path itself: the
        accelerometers also measure the accelerations of the hand or the joint. All intervals are
        compensated at once: the result of each is bit-identical to that of a single call.

        Args:
            motions: Of each the (n, 3) rotation vectors of its intervals by the gyros, rad, their
                lengths (n,), s, and the (3,) specific force at rest at the end, body axes, m/s^2;
                None if not needed.
            model: The sensors.
        """
        if not motions:
            return ()
        seconds = [seconds for _, seconds, _ in motions]
        outputs = np.concatenate([turned / each[:, None] for turned, each, _ in motions])
        forces = [np.zeros_like(turned) for turned, *_ in motions]
        rates, middles, wholes = _integrated(outputs, seconds, model, forces)
        ends = np.cumsum([len(each) for each in seconds])[:-1]
        if any(force is not None for *_, force in motions):
            known = np.array([np.zeros(3) if force is None else force for *_, force in motions])
            each = np.repeat(known, [len(one) for one in seconds], axis=0).T
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

    def spread(self, walk: Floats) -> Floats:
        """Return the covariance of the rotation at the end by (3,) random walks, (3, 3) rad^2."""
        scaled = self.error_transfer * walk
        return np.asarray(np.einsum('nij,nkj,n->ik', scaled, scaled, self.seconds))


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
    _follow(passed, _order(tuple(counts)))
    after = np.concatenate([passed[..., 1:], np.eye(3)[..., None]], axis=-1)
    after[..., ends - 1] = np.eye(3)[..., None]
    return np.moveaxis(passed[..., ends - counts], -1, 0), after


@lru_cache(maxsize=16)
def _order(counts: tuple[int, ...]) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]:
    """Return which steps of motions of so many are multiplied by their next, in rounds.

    Pairs of neighbours are multiplied first, then those between: two products for each step, for
    any number of steps (Brent and Kung 1982, IEEE Trans. Comput. C-31, 260). Each round pairs the
    results of the one before.
    """
    follow = np.repeat(np.cumsum(counts), counts) - np.arange(sum(counts)) - 1
    turns = []
    while len(odd := np.flatnonzero(follow % 2)):
        turns.append((odd, np.flatnonzero((follow % 2 == 0) & (follow > 0))))
        follow = follow[odd] // 2
    return tuple(turns)


def _follow(steps: Floats, order: tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]) -> None:
    """Multiply each of (3, 3, n) steps, in place, by all that follow it, in an `_order`."""
    if not order:
        return
    (odd, between), *rest = order
    pairs = _with_next(steps, odd)
    _follow(pairs, tuple(rest))
    steps[..., odd] = pairs
    steps[..., between] = _with_next(steps, between)


def _with_next(steps: Floats, which: NDArray[np.intp]) -> Floats:
    # `take` is three times as fast as indexing.
    return product(steps.take(which + 1, axis=-1), steps.take(which, axis=-1))
