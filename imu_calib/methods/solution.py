"""What a method returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..budget import Shares
from ..changes import Changes
from ..estimation.search import Search
from ..estimation.term_tests import TermTest
from ..model import PARAMETERS, Parameter, SensorModel
from ..stream import Floats


@dataclass(frozen=True, eq=False)
class Residual:
    """What a static dwell shows beyond the solution.

    Attributes:
        position: Id of the plan's position.
        start: ns, IMU clock.
        value: (6,) rad/s and m/s^2.
        std: (6,) standard deviation of the static dwell's mean.
    """

    position: str
    start: int
    value: Floats
    std: Floats


@dataclass(frozen=True, eq=False)
class Solution:
    """An estimate of the parameters.

    Attributes:
        model: The sensor model.
        covariance: (n, n) in the order of `parameters`, SI units. NaN for a triad that was not
            estimated.
        residuals: One per static dwell.
        azimuth: Heading of the table's zero that the gyros show, rad; NaN where they cannot.
        azimuth_std: Its standard deviation, rad.
        earth_up: Vertical Earth rate that the gyros show, rad/s.
        earth_up_std: Its standard deviation, rad/s.
        condition: Condition number of the system solved, columns scaled to unit length.
        findings: What a person should know, in sentences.
        bias_drift: (6,) standard deviation of drifting biases that the covariance allows for,
            rad/s and m/s^2; None for a method that knows of no such thing.
        parameters: (n,) what the rows of the covariance stand for.
        shares: The covariance by source, which adds up to it; None for a method that does not tell.
        changes: By which the parameters change during the session; None where none were asked for.
        tests: What the session says of every term and of the table's errors; empty for a method
            that knows none.
        gain: (n, m + u) derivatives of the parameters by the outputs of dwells and turns, then by
            those of a skewed gyro in the u turns that it saw; None for a method that weighs them
            by what they show.
        search: What the joint estimate found, from which several units on a table go on; None for
            other methods, and for a session that goes on.
    """

    model: SensorModel
    covariance: Floats
    residuals: tuple[Residual, ...]
    azimuth: float
    azimuth_std: float
    earth_up: float
    earth_up_std: float
    condition: float
    findings: tuple[str, ...]
    bias_drift: Floats | None = None
    parameters: tuple[Parameter, ...] = PARAMETERS
    shares: Shares | None = None
    changes: Changes | None = None
    tests: tuple[TermTest, ...] = ()
    gain: Floats | None = None
    search: Search | None = None

    def __post_init__(self) -> None:
        """Refuse a covariance of other parameters."""
        assert self.covariance.shape == (len(self.parameters),) * 2

    @property
    def std(self) -> Floats:
        """(n,) standard deviations of the parameters, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))
