"""The uncertainty budget of a calibration: contribution of each source to each parameter.

A covariance is a sum of shares, one for each source. The budget contains their standard deviations
and degrees of freedom, and the uncertainties expanded to 95 %.

Source: JCGM 100:2008 (GUM), 5.1.2, 5.2.2 and annex G; docs/mathematics.md, 'Uncertainty budget'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from .stream import Floats

PROBABILITY = 0.95  #: Level of confidence of the expanded uncertainties.

LEAST_FREEDOM = 1.0
"""Fewest degrees of freedom for a coverage factor: Student's t is not tabulated for fewer, and
factors beyond 12.7 are of no use."""

AS_STATED = 0.99
"""Share of the stated drift's variance above which it is as stated: to half a percent of its
deviation, less than the two digits of an uncertainty show."""


class ErrorSource(Enum):
    """A source of uncertainty; the value is its name in files."""

    evaluation: str
    """'A' by statistics of the session, 'B' by other means (GUM 2.3.2, 2.3.3)."""
    heading: str
    """Its name above a column, eleven letters at most."""
    words: str
    """Description of the source, and the origin of its size."""

    def __new__(cls, name: str, evaluation: str, heading: str, words: str) -> ErrorSource:
        """Make a member of a row below."""
        source = object.__new__(cls)
        source._value_ = name
        source.evaluation, source.heading, source.words = evaluation, heading, words
        return source

    NOISE = 'sensor_noise', 'A', 'noise', 'random walk of the sensors, from blocks of static dwells'
    QUANTISATION = 'quantisation', 'B', 'pulse', 'quantisation, from the pulse weight'
    BIAS_STATED = (
        'bias_instability',
        'B',
        'bias',
        'bias instability, as the IMU description states it',
    )
    BIAS_CALM = (
        'bias_drift_below_stated',
        'A',
        'calm-bias',
        'bias drift, less than the IMU description states, as the session shows it: a mean size, '
        'without degrees of freedom',
    )
    BIAS_FOUND = (
        'bias_drift',
        'A',
        'drift',
        'bias drift beyond what is stated, as the session shows it: a mean size, without degrees '
        'of freedom',
    )
    POSITIONING_STATED = 'positioning', 'B', 'position', 'positioning errors, as stated or assumed'
    POSITIONING_FOUND = (
        'positioning_found',
        'A',
        'position+',
        'positioning errors beyond that, found',
    )
    STOPS = 'stops_found', 'A', 'stops', 'attitude errors of the table at each stop, found'
    ENCODER_RATE = (
        'encoder_rate',
        'A',
        'turn-rate',
        "the table's rate, from the scatter of its encoder",
    )
    ENCODER_NOISE = 'encoder_noise', 'A', 'encoder', "attitudes, from the encoders' noise"
    AZIMUTH = (
        'azimuth',
        'B',
        'azimuth',
        "the table's azimuth: 1 arcmin where stated, else any heading",
    )
    TILT = 'tilt', 'B', 'tilt', "prior of the table's two tilts"
    ARM = 'lever_arm', 'B', 'lever-arm', 'priors of the lever arms of accelerometers'
    DELAY = 'delay', 'B', 'delay', 'delay of accelerometers after gyros'
    NORTH = 'unknown_north', 'B', 'north', 'horizontal Earth rate, unknown heading or left by turns'
    TABLE = 'table', 'B', 'table', 'axes, zeros and encoders of the table, as stated or assumed'
    CLOCK = (
        'clock',
        'A',
        'clock',
        'rate between the clocks of IMU and table, or sample interval by stamps alone',
    )
    TABLE_CLOCK = (
        'table_clock',
        'B',
        'table-clock',
        "the table's own clock, as its description states it",
    )
    GRAVITY = 'gravity', 'B', 'gravity', 'gravity at the site'
    LATITUDE = 'latitude', 'B', 'latitude', 'latitude of the site'
    SCATTER = 'scatter', 'A', 'scatter', 'scatter of the residuals beyond all that'
    TIME_CONSTANT = (
        'time_constant',
        'A',
        'warm-up',
        'time constant of a warm-up or instant of a step, by its likelihood',
    )
    TEMPERATURE = (
        'temperature',
        'B',
        'temperature',
        'temperature that moved, by the coefficients that the IMU description states',
    )
    TERMS = 'terms', 'A', 'terms', 'terms that the session does not determine or exclude'
    OTHER_UNITS = (
        'other_units',
        'A',
        'units',
        'what the other units on the table say of it, by their noise',
    )


@dataclass(frozen=True, eq=False)
class Share:
    """Contribution of a source to a covariance."""

    covariance: Floats  #: (n, n) SI units.
    freedom: Floats  #: (n,) degrees of freedom of its variances; infinite if taken as known.

    @classmethod
    def known(cls, covariance: Floats) -> Share:
        """Return a share whose size is taken as known (GUM G.4.3)."""
        return cls(covariance, np.full(len(covariance), np.inf))

    @classmethod
    def from_parts(cls, parts: Sequence[tuple[Floats, float]]) -> Share:
        """Add up independent parts: (n, n) covariances with the degrees of freedom of each."""
        variances = np.array([np.diag(covariance) for covariance, _ in parts])
        freedom = np.repeat(np.array([[f] for _, f in parts]), variances.shape[1], axis=1)
        added = np.sum([covariance for covariance, _ in parts], axis=0)
        return cls(np.asarray(added), effective_freedom(variances, freedom))


Shares = Mapping[ErrorSource, Share]  #: A covariance by source.


def total(shares: Shares) -> Floats:
    """Return the covariance (n, n) that the shares add up to."""
    return np.asarray(np.sum([share.covariance for share in shares.values()], axis=0))


def effective_freedom(variances: Floats, freedom: Floats) -> Floats:
    """Return the degrees of freedom of sums of variances, (n,).

    Args:
        variances: (k, n) of independent terms.
        freedom: (k, n) of each term; infinite if known.

    Source: Welch-Satterthwaite, GUM eq. (G.2b).
    """
    whole = variances.sum(axis=0)
    weight = np.divide(variances, whole, out=np.zeros_like(variances), where=whole > 0)
    doubt = np.sum(weight**2 / freedom, axis=0)
    return np.asarray(np.divide(1.0, doubt, out=np.full(len(whole), np.inf), where=doubt > 0))


@dataclass(frozen=True, eq=False)
class BudgetLine:
    """One source of a budget."""

    source: ErrorSource  #: The source.
    std: Floats  #: (n,) its contribution to the standard deviation of each parameter, SI units.
    freedom: Floats  #: (n,) degrees of freedom.


@dataclass(frozen=True, eq=False)
class Budget:
    """The uncertainties of n parameters by source; parameters not estimated are NaN."""

    lines: tuple[BudgetLine, ...]  #: Sources that contribute to any parameter.

    @classmethod
    def from_shares(cls, shares: Shares) -> Budget:
        """Return the budget of a covariance that is the sum of shares."""
        lines = []
        for source in ErrorSource:
            if source not in shares:
                continue
            # Differences of nearly equal covariances may leave rounding below zero.
            variance = np.diag(shares[source].covariance)
            std = np.sqrt(np.where(variance < 0, 0.0, variance))
            if np.nansum(std) > 0:
                lines.append(BudgetLine(source, std, shares[source].freedom))
        return cls(tuple(lines))

    def with_share(self, source: ErrorSource, share: Share) -> Budget:
        """Return the budget with another source, in the order of `ErrorSource`."""
        order = list(ErrorSource)
        added = Budget.from_shares({source: share}).lines
        lines = sorted((*self.lines, *added), key=lambda line: order.index(line.source))
        return Budget(tuple(lines))

    def scaled(self, factors: Floats) -> Budget:
        """Return the budget of parameters that are (n,) times as large."""
        scale = np.abs(factors)
        return Budget(tuple(BudgetLine(x.source, x.std * scale, x.freedom) for x in self.lines))

    @property
    def variances(self) -> Floats:
        """Variances (k, n) by source."""
        return np.array([line.std**2 for line in self.lines])

    @property
    def std(self) -> Floats:
        """Combined standard uncertainties (n,), GUM 5.1.2."""
        return np.asarray(np.sqrt(self.variances.sum(axis=0)))

    @property
    def freedom(self) -> Floats:
        """Effective degrees of freedom (n,)."""
        return effective_freedom(self.variances, np.array([line.freedom for line in self.lines]))

    @property
    def coverage_factor(self) -> Floats:
        """Factors (n,) from standard to expanded uncertainties: Student's t, GUM G.3.2."""
        from scipy.special import stdtrit

        freedom = np.maximum(self.freedom, LEAST_FREEDOM)
        return np.asarray(stdtrit(freedom, (1 + PROBABILITY) / 2))

    @property
    def expanded(self) -> Floats:
        """Expanded uncertainties (n,) at `PROBABILITY`."""
        return np.asarray(self.coverage_factor * self.std)

    @property
    def fractions(self) -> Floats:
        """Share (k, n) of each source in the variance of each parameter; zero for zero variance."""
        whole = np.nan_to_num(self.variances.sum(axis=0))
        nothing = np.zeros_like(self.variances)
        return np.asarray(np.divide(self.variances, whole, out=nothing, where=whole > 0))
