"""Whether compensated rates turn gravity as the accelerometers see it turn: else other units."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..common.rotations import cross
from ..common.stream import Floats, Stamps
from ..model.alignment import wrong_turns_sentences
from ..session.imu import SCALE_LIMIT, ImuSpec

_WINDOW = 0.2
"""s: of a turn by 1 rad/s, gravity moves by 2 m/s^2, far above the noise of any accelerometer."""
_ALIKE = 0.95
"""Correlation above which the two tell of one motion: other accelerations make it smaller. A
judgement: the other tenth of the squares changes the ratio by 5 %."""
_FEWEST = 10
"""Windows of 3 axes each; by chance so many are alike once in 10^14."""


@dataclass
class TurnsSeen:
    """How specific forces change, against how the rates turn them: f' = -w x f at one place.

    Attributes:
        windows: Number of windows of a fifth of a second.
        by_rates: Sum of squares of the changes by the rates, (m/s^2)^2.
        by_forces: The same of the changes themselves.
        common: Sum of their products.
    """

    windows: int = 0
    by_rates: float = 0.0
    by_forces: float = 0.0
    common: float = 0.0

    def take(self, stamp: Stamps, rate: Floats, force: Floats) -> None:
        """Add consecutive samples: (n,) stamps, ns, (n, 3) rates and forces, SI."""
        step = np.diff(stamp) * 1e-9
        if not len(step) or not (typical := float(np.median(step))) > 0:
            return
        length = max(1, round(_WINDOW / typical))
        change = -cross(rate, force)
        middle = (change[1:] + change[:-1]) / 2 * step[:, None]
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(middle), axis=0)])
        ends = np.arange(0, len(stamp), length)
        rated, forced = np.diff(total[ends], axis=0), np.diff(force[ends], axis=0)
        seconds = np.diff(stamp[ends]) * 1e-9
        # Not across gaps, where the rate is unknown.
        whole = (np.abs(seconds - length * typical) < typical) & np.isfinite(forced).all(axis=1)
        rated, forced = rated[whole], forced[whole]
        self.windows += len(rated)
        self.by_rates += float(np.vdot(rated, rated))
        self.by_forces += float(np.vdot(forced, forced))
        self.common += float(np.vdot(rated, forced))

    @property
    def scale(self) -> float | None:
        """Ratio of the rates to those that turn gravity; None if the motion does not show it."""
        both = math.sqrt(self.by_rates * self.by_forces)
        if self.windows < _FEWEST or not self.common > _ALIKE * both > 0:
            return None
        return math.sqrt(self.by_rates / self.by_forces)

    @property
    def contradict(self) -> bool:
        """Whether the rates are in other units than the forces."""
        scale = self.scale
        return scale is not None and not 1 / SCALE_LIMIT < scale < SCALE_LIMIT

    def contradiction(self, imu: ImuSpec) -> str:
        """Return why the samples are not those that a calibration is for, where they contradict.

        Args:
            imu: As the calibration describes it.
        """
        return wrong_turns_sentences(
            self.scale or math.nan,
            f'the samples are not in the units of the calibration ({imu.units.value})',
        )
