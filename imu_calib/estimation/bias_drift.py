"""Bias drift as a Gauss-Markov process, observed in the means and slopes of segments.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

STATED_TIME = 1000.0
"""Correlation time of the drift that a data sheet states, s, as in the simulation."""

_NODES = 8
"""Instants per segment at which the process is evaluated. A choice between accuracy and work."""


@dataclass(frozen=True, eq=False)
class BiasDrift:
    """Instants at which a process is evaluated: nodes in time, means and slopes over them."""

    nodes: Floats  #: (n, 8) instants of each segment, s.
    segment: NDArray[np.intp]  #: (k,) index of the segment of each mean or slope, all means first.
    weights: Floats  #: (k, 8) weights of the nodes of that segment.
    #: (k, 3, 3) responses of three outputs to three biases, for each mean or slope.
    responses: Floats

    @classmethod
    def over(
        cls, starts: Floats, durations: Floats, responses: Floats, with_slope: NDArray[np.bool_]
    ) -> BiasDrift:
        """Place nodes in n segments (s), whose means come first, then the slopes where used.

        `responses` (n, 3, 3) are derivatives of the outputs by constant biases. In a move the
        effect of biases rotates with the unit, so that it is not that of its duration alone.
        """
        grid = (np.arange(_NODES) + 0.5) / _NODES
        centred = grid - 0.5
        means = np.full((len(starts), _NODES), 1 / _NODES)
        slopes = np.outer(1 / durations, centred / (centred @ centred))
        every = np.arange(len(starts))
        identity = np.broadcast_to(np.eye(3), (int(np.sum(with_slope)), 3, 3))
        return cls(
            starts[:, None] + durations[:, None] * grid,
            np.concatenate([every, every[with_slope]]),
            np.vstack([means, slopes[with_slope]]),
            np.concatenate([responses, identity]),
        )

    @property
    def span(self) -> float:
        """Length of the session, s."""
        return max(float(np.ptp(self.nodes)), 1.0)

    @property
    def stated_time(self) -> float:
        """`STATED_TIME` as a fraction of the session."""
        return STATED_TIME / self.span

    def kernel(self, time: float) -> Floats:
        """Return the covariance of means and slopes of three channels for unit variance, (3k, 3k).

        The correlation time is a fraction of the session.
        """
        return self._of_outputs(self.one_channel(time * self.span))

    def about_mean(self) -> Floats:
        """Return `kernel` of a drift as data sheets state it, about its mean over the segments."""
        alone = self.one_channel(STATED_TIME)
        centred = alone - alone.mean(axis=0)
        return self._of_outputs(centred - centred.mean(axis=1)[:, None])

    def _of_outputs(self, alone: Floats) -> Floats:
        rows = self.responses.reshape(-1, 3)
        return np.asarray(np.kron(alone, np.ones((3, 3))) * (rows @ rows.T))

    def one_channel(self, time: float) -> Floats:
        """Return the covariance of one channel, (k, k), for a correlation time in s.

        From one segment to a later one the process decays with the time between them: the kernel is
        a product of a factor of each segment and one of that time.
        """
        nodes, weights = self.nodes[self.segment], self.weights
        first, last = nodes[:, 0], nodes[:, -1]
        until = (weights * np.exp((nodes - last[:, None]) / time)).sum(axis=1)
        since = (weights * np.exp((first[:, None] - nodes) / time)).sum(axis=1)
        between = first - last[:, None]
        later = between >= 0
        decayed = np.exp(-np.where(later, between, 0.0) / time)
        found = np.where(later, until[:, None] * decayed * since, 0.0)
        found += found.T
        one, other = np.nonzero(~(later | later.T))
        apart = np.abs(nodes[one][:, :, None] - nodes[other][:, None])
        found[one, other] = np.einsum(
            'ki,kij,kj->k', weights[one], np.exp(-apart / time), weights[other]
        )
        return found
