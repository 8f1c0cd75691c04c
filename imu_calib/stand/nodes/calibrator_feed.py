"""Feed a live session's calibrator once the presence of a skewed gyro is known."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

from ...calibration.calibrator import Calibrator, calibrator_of
from ...calibration.hand import HandCalibrator
from ...common.stream import Block
from ...estimation.methods import Setup
from ...model.parameters import skewed_parameters
from ...recordings.rosbag2 import Kind
from .intake import TopicIntake

_SKEW_AWAITED = 10.0
"""Longest time for which IMU samples come without the skewed gyro: s, by stamps and by the
clock."""


class CalibratorFeed:
    """Holds blocks back until the calibrator can be created, then feeds it.

    Args:
        setup: What is calibrated, and how.
        topics: Full topic names by content; a skewed gyro is expected if its topic is among them.

    Attributes:
        calibrator: None while the presence of a skewed gyro is unknown.
        without_skew: Whether the session continues without a skewed gyro.

    Raises:
        InputError: The method cannot solve the plan.
    """

    def __init__(self, setup: Setup, topics: Mapping[Kind, str]) -> None:
        self._setup = setup
        self._topics = topics
        self._began = time.monotonic()
        self._held: list[Block] = []
        self.without_skew = False
        # Refuse a plan that the method cannot solve now, before the calibrator is created.
        calibrator_of(setup)
        self.calibrator: Calibrator | HandCalibrator | None = None
        if setup.imu.skewed is None or Kind.SKEW not in topics:
            self.begin(with_skew=False)

    def feed(self, block: Block, intakes: Mapping[Kind, TopicIntake]) -> str:
        """Feed a block, or hold it back; return as `begin`.

        The received samples decide on the skewed gyro, as in reprocessing.
        """
        if self.calibrator is not None:
            self.calibrator.feed(block)
            return ''
        self._held.append(block)
        imu = intakes[Kind.IMU]
        if intakes[Kind.SKEW].count:
            return self.begin(with_skew=True)
        if imu.oldest is not None and imu.newest is not None:
            spanned = (imu.newest - imu.oldest) * 1e-9
            if min(spanned, time.monotonic() - self._began) > _SKEW_AWAITED:
                return self.begin(with_skew=False)
        return ''

    def begin(self, *, with_skew: bool) -> str:
        """Create the calibrator, and feed it with the blocks received before.

        Returns:
            Why the session cannot succeed, in sentences; else empty.
        """
        self.without_skew = not with_skew
        imu = self._setup.imu if with_skew else replace(self._setup.imu, skewed=None)
        self.calibrator = calibrator_of(replace(self._setup, imu=imu))
        held, self._held = self._held, []
        for block in held:
            self.calibrator.feed(block)
        if with_skew or not held or self._setup.method_name != 'skewed':
            return ''
        lost = ', '.join(p.name for p in skewed_parameters(1))
        return (
            f'There are no messages on {self._topics[Kind.SKEW]}, but there are on '
            f'{self._topics[Kind.IMU]}: {lost} cannot be determined. Let the driver publish it '
            '(imu_node: a device file with the field skew), and call ~/reset.'
        )
