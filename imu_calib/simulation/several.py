"""A simulated stand with several units: one table, one motion, and an IMU for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.stream import Block, Floats
from ..model.earth import Site
from ..model.sensors import SensorModel
from ..session.imu import ImuSpec
from ..session.plan import Plan
from ..session.table import Table
from .imu import SimulatedImu
from .motion import Motion
from .options import StandOptions
from .stand import SKEW_TOPIC, SimulatedStand


@dataclass(frozen=True, eq=False)
class SimulatedUnit:
    """A unit on the table.

    Attributes:
        topic: Of its samples.
        spec: Units, scale factors and noise.
        model: The true model, to be found by a calibration.
        mount: (3, 3) columns are its body axes in those that the table mounts.
        lever: From the centre of rotation to its accelerometers, in its body axes, m.
        seed: Of its noise: the same seed gives the same bits, independent of other units. None: for
            a unit that is alone, derived from the stand's.
    """

    topic: str
    spec: ImuSpec
    model: SensorModel
    mount: Floats
    lever: tuple[float, float, float]
    seed: int | None

    def moved(self, motion: Motion) -> Motion:
        """Return the motion of the table in this unit's axes."""
        if np.array_equal(self.mount, np.eye(3)):
            return motion
        inward, shaking = self.mount.T, motion.shaking
        if shaking is not None:
            own = (shaking.angle @ self.mount, shaking.velocity @ self.mount)
            shaking = replace(shaking, angle=own[0], velocity=own[1])
        ringing = tuple(
            replace(ring, angle=inward @ ring.angle, velocity=inward @ ring.velocity)
            for ring in motion.ringing
        )
        return replace(motion, mount=motion.mount @ self.mount, ringing=ringing, shaking=shaking)


class SeveralOnTable(SimulatedStand):
    """A `SimulatedStand` with several units, to which the errors of the table are common.

    The options of an IMU (clock, delivery, thermal drift) apply to each, except the lever arm.

    Args:
        plan: The plan that is run.
        table: Its description.
        units: At least one.
        site: Site of the stand.
        options: Of the stand; the defaults if not given.
        seed: Of the table's randomness.

    Raises:
        InputError: The table cannot run the plan, or an option is out of range.
    """

    def __init__(
        self,
        plan: Plan,
        table: Table,
        units: Sequence[SimulatedUnit],
        site: Site,
        options: StandOptions | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(plan, table, units[0].spec, units[0].model, site, options, seed)
        self._units = []
        for unit in units:
            own = replace(self.options, lever=unit.lever)
            rng = np.random.default_rng([unit.seed or 0, 1])
            imu = SimulatedImu(unit.spec, unit.model, site, own, rng, epoch=self.options.start_time)
            self._units.append((unit.topic, imu, unit.moved(self.motion)))

    def _sampled(self, end: float) -> Iterator[tuple[str, Block]]:
        for topic, imu, motion in self._units:
            yield topic, imu.advance(motion, end)
            if imu.skewed is not None:
                yield sibling_topic(topic, SKEW_TOPIC), imu.skewed


def sibling_topic(topic: str, other: str) -> str:
    """Return the topic of the same unit, named like the last part of another topic.

    >>> sibling_topic('/left/imu/pulses', 'imu/skew')
    '/left/imu/skew'
    """
    return f'{topic.rpartition("/")[0]}/{other.rpartition("/")[2]}'
