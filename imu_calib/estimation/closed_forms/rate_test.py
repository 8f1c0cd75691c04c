"""Scale factors and misalignments of the gyros from whole turns about each axis.

Sources: Cao 2022, section 3.1; Luo 2018, eqs. (2-175) to (2-183); off-axis 2019, section 1.1.1;
with the corrections of docs/mathematics.md, 'Rate test'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.stream import Floats
from ..checks import no_turn_about
from ..evidence import Evidence, vertical_axis
from .methods_linear import BIAS, UNKNOWNS, ChannelSystem

_ONE_RATE = 0.2
"""Of the largest rate: spread below which a line has no determined slope."""


@dataclass(frozen=True, eq=False)
class RateTestEquations:
    """The turns of a session as equations for the gyros' responses.

    Attributes:
        outputs: (t, 3) mean gyro outputs, rad/s.
        inputs: (t,) rate about the vertical body axis, Earth included, rad/s.
        axes: (t,) which body axis was vertical.
        off_axis: (t, 3) rates of the other axes by the encoders, rad/s.
    """

    outputs: Floats
    inputs: Floats
    axes: Floats
    off_axis: Floats

    @classmethod
    def of(cls, evidence: Evidence) -> RateTestEquations:
        """Collect the turns of a session.

        Raises:
            NotObservable: An axis without turns.
        """
        axes, inputs, off = [], [], []
        for turn in evidence.turns:
            axis, sign = vertical_axis(turn.up, turn.position)
            rate = turn.rate() + evidence.site.up_rate
            axes.append(axis)
            inputs.append(sign * rate)
            off.append(rate * (turn.up - sign * np.eye(3)[axis]))
        for axis in range(3):
            if axis not in axes:
                raise no_turn_about(axis)
        outputs = np.array([t.statistics.mean[:3] for t in evidence.turns])
        return cls(outputs, np.array(inputs), np.array(axes), np.array(off))

    def add_to(self, system: ChannelSystem, axis: int, first: int) -> None:
        """Add the equation for the response to one axis.

        Turns at several rates or in both senses: the slope of the output on the input, independent
        of bias and vertical Earth rate. One sense at one rate (a turn by hand): output less bias
        over input, with the bias from elsewhere.

        Args:
            system: Equations of one channel.
            axis: Body axis.
            first: Index of the first turn among the system's outputs.
        """
        mine = np.flatnonzero(self.axes == axis)
        inputs = self.inputs[mine]
        centred = inputs - inputs.mean()
        coefficients = np.zeros(UNKNOWNS)
        weights = np.zeros(system.size)
        spread = float(centred @ centred)
        if np.sqrt(spread / len(mine)) > _ONE_RATE * np.abs(inputs).max():
            coefficients[axis] = 1.0
            weights[first + mine] = centred / spread
        else:
            coefficients[axis], coefficients[BIAS] = inputs.mean(), 1.0
            weights[first + mine] = 1 / len(mine)
        system.add(coefficients, weights)
