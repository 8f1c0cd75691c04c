"""Bias drift as a Gauss-Markov process, observed in the means of segments.

Source: docs/mathematics.md, 'Joint estimate'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.stream import Floats

STATED_TIME = 1000.0
"""Correlation time of the drift that a data sheet states, s, as in the simulation."""

_NODES = 8
"""Instants per segment at which the process is evaluated. A choice between accuracy and work."""


@dataclass(frozen=True, eq=False)
class BiasDrift:
    """Instants at which a process is evaluated: nodes in time, and means over them."""

    nodes: Floats  #: (n, 8) instants of each segment, s.
    responses: Floats  #: (n, 3, 3) responses of three outputs to three biases.

    @classmethod
    def over(cls, starts: Floats, durations: Floats, responses: Floats) -> BiasDrift:
        """Place nodes in n segments (s).

        `responses` (n, 3, 3) are derivatives of the outputs by constant biases. In a move the
        effect of biases rotates with the unit, so that it is not that of its duration alone.
        """
        grid = (np.arange(_NODES) + 0.5) / _NODES
        return cls(starts[:, None] + durations[:, None] * grid, responses)

    @property
    def span(self) -> float:
        """Length of the session, s."""
        return max(float(np.ptp(self.nodes)), 1.0)

    @property
    def stated_time(self) -> float:
        """`STATED_TIME` as a fraction of the session."""
        return STATED_TIME / self.span

    def kernel(self, time: float) -> Floats:
        """Return the covariance of means of three channels for unit variance, (3n, 3n).

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

    def entering(self, project: Floats) -> Floats:
        """Return the factors (3, r, n) of the segments' biases in means projected by (3n, r)."""
        parts = project.T.reshape(project.shape[1], -1, 3)
        return np.asarray(np.einsum('rni,nic->crn', parts, self.responses[: parts.shape[1]]))

    def projected(self, time: float, entering: Floats) -> Floats:
        """Return `kernel` projected on means, (r, r), by their factors (3, r, n).

        Channels drift independently: only the kernel of one is needed.
        """
        drifting = entering @ self.one_channel(time * self.span)
        return np.asarray(np.hstack(list(drifting)) @ np.hstack(list(entering)).T)

    def one_channel(self, time: float) -> Floats:
        """Return the covariance of one channel, (n, n), for a correlation time in s.

        From one segment to a later one the process decays with the time between them: the kernel is
        a product of a factor of each segment and one of that time.
        """
        first, last = self.nodes[:, 0], self.nodes[:, -1]
        until = np.exp((self.nodes - last[:, None]) / time).mean(axis=1)
        since = np.exp((first[:, None] - self.nodes) / time).mean(axis=1)
        between = first - last[:, None]
        later = between >= 0
        decayed = np.exp(-np.where(later, between, 0.0) / time)
        found = np.where(later, until[:, None] * decayed * since, 0.0)
        found += found.T
        one, other = np.nonzero(~(later | later.T))
        apart = np.abs(self.nodes[one][:, :, None] - self.nodes[other][:, None])
        found[one, other] = np.exp(-apart / time).mean(axis=(1, 2))
        return np.asarray(found)
