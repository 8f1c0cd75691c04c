"""Result of a method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.budget import Shares
from ..common.stream import Floats
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import SensorModel
from ..model.session_terms import Changes
from .search import Search
from .term_tests import TermTest


@dataclass(frozen=True, eq=False)
class Residual:
    """Residuals of a static dwell.

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
        azimuth: Heading of the table's zero by the gyros, rad; NaN where not determined.
        azimuth_std: Its standard deviation, rad.
        earth_up: Vertical Earth rate by the gyros, rad/s.
        earth_up_std: Its standard deviation, rad/s.
        condition: Condition number of the system solved, columns scaled to unit length.
        findings: Findings that the user must know, in sentences.
        bias_drift: (6,) standard deviation of drifting biases in the covariance, rad/s and m/s^2;
            None for a method that does not estimate it.
        parameters: (n,) parameters of the rows of the covariance.
        shares: The covariance by source, which adds up to it; None for a method that does not give
            it.
        changes: Changes of the parameters during the session; None where not requested.
        tests: Results for every term and error of the table; empty for a method without tests.
        gain: (n, m + u) derivatives of the parameters by the outputs of dwells and turns, then by
            those of a skewed gyro in the u turns that it recorded; None for a method whose weights
            depend on the data.
        search: Result of the joint estimate, used for several units on a table; None for other
            methods, and for a session in progress.
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
        """Raise if the covariance is of other parameters."""
        assert self.covariance.shape == (len(self.parameters),) * 2

    @property
    def std(self) -> Floats:
        """(n,) standard deviations of the parameters, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))
