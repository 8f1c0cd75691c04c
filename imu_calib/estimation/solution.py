"""Result of a method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.budget import Shares
from ..common.stream import Floats
from ..model.parameters import PARAMETERS, Parameter
from ..model.sensors import SensorModel
from ..model.session_terms import Changes
from .evidence import Evidence
from .search import SearchResult
from .term_tests import TermTest


@dataclass(frozen=True, eq=False)
class Residual:
    """Residuals of a static dwell."""

    position: str  #: Id of the plan's position.
    start: int  #: ns, IMU clock.
    value: Floats  #: (6,) rad/s and m/s^2.
    std: Floats  #: (6,) standard deviation of the static dwell's mean.

    @classmethod
    def of_each(cls, evidence: Evidence, values: Floats, std: Floats) -> tuple[Residual, ...]:
        """Return those of the dwells of a session, (s, 6) and their standard deviations."""
        return tuple(
            cls(str(segment.position), segment.start, value, deviation)
            for segment, value, deviation in zip(evidence.segments, values, std, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """An estimate of the parameters."""

    model: SensorModel  #: The sensor model.
    #: (n, n) in the order of `parameters`, SI units. NaN for a triad that was not estimated.
    covariance: Floats
    residuals: tuple[Residual, ...]  #: One per static dwell.
    azimuth: float  #: Heading of the table's zero by the gyros, rad; NaN where not determined.
    azimuth_std: float  #: Its standard deviation, rad.
    earth_up: float  #: Vertical Earth rate by the gyros, rad/s.
    earth_up_std: float  #: Its standard deviation, rad/s.
    condition: float  #: Condition number of the system solved, columns scaled to unit length.
    findings: tuple[str, ...]  #: Findings that the user must know, in sentences.
    #: (6,) standard deviation of drifting biases in the covariance, rad/s and m/s^2; None for a
    #: method that does not estimate it.
    bias_drift: Floats | None = None
    #: (n,) parameters of the rows of the covariance.
    parameters: tuple[Parameter, ...] = PARAMETERS
    #: The covariance by source, which adds up to it; None for a method that does not give it.
    shares: Shares | None = None
    #: Changes of the parameters during the session; None where not requested.
    changes: Changes | None = None
    #: Results for every term and error of the table; empty for a method without tests.
    tests: tuple[TermTest, ...] = ()
    #: (n, m + u) derivatives of the parameters by the outputs of dwells and turns, then by those of
    #: a skewed gyro in the u turns that it recorded; None for a method whose weights depend on the
    #: data.
    gain: Floats | None = None
    #: Result of the joint estimate, used for several units on a table; None for other methods, and
    #: for a session in progress.
    search: SearchResult | None = None

    def __post_init__(self) -> None:
        assert self.covariance.shape == (len(self.parameters),) * 2

    @property
    def std(self) -> Floats:
        """(n,) standard deviations of the parameters, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))
