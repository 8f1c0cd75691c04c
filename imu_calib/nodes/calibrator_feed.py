"""What a live session feeds: the calibrator, once it is known whether there is a skewed gyro."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

from ..calibrator import Calibrator, HandCalibrator, Setup, calibrator_of
from ..cdr import Kind
from ..model import skewed_parameters
from ..stream import Block
from .intake import TopicIntake

_SKEW_AWAITED = 10.0
"""How much the IMU may say while a skewed gyro says nothing: s by its stamps and by the clock."""


class CalibratorFeed:
    """Holds blocks back until the calibrator can be made, and feeds it from then on.

    Args:
        setup: What is calibrated, and how.
        topics: Full topic names by what they carry; a skewed gyro is awaited where its topic is
            among them.

    Attributes:
        calibrator: None while it is awaited whether there is a skewed gyro.
        without_skew: Whether the session goes on without one.

    Raises:
        InputError: The method cannot solve the plan.

    """

    def __init__(self, setup: Setup, topics: Mapping[Kind, str]) -> None:
        self._setup = setup
        self._topics = topics
        self._began = time.monotonic()
        self._held: list[Block] = []
        self.without_skew = False
        # A plan that its method cannot solve is refused now, whenever it is begun with.
        calibrator_of(setup)
        self.calibrator: Calibrator | HandCalibrator | None = None
        if setup.imu.skewed is None or Kind.SKEW not in topics:
            self.begin(with_skew=False)

    def feed(self, block: Block, intakes: Mapping[Kind, TopicIntake]) -> str:
        """Feed a block, or hold it back; what is returned is as of `begin`.

        Whether there is a skewed gyro is decided as reprocessing will: by what has come of it.
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
        """Make the calibrator, and feed it with what has come in before.

        Returns:
            Why this is in vain, in sentences; empty where it is not.

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
