"""Compare the joint estimate with the closed form of its plan: two solutions of the same data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..common.stream import Floats
from ..model.parameters import Parameter, indices_of
from .solution import Solution

_ONE_IN = 1e-3
"""Share of sessions in which the two contradict each other by chance. A choice."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of the closed form for the parameters of the joint estimate.

    Attributes:
        method: Name of the closed form.
        parameters: Estimated by both.
        difference: (n,) closed form less joint, in units of the larger of the two standard
            deviations. The difference of an estimate from the best one has a smaller deviation than
            the estimate itself (Hausman 1978, Econometrica 46, 1251).
        ratio: (n,) standard deviation of the joint estimate over that of the closed form.
        refusal: Why the closed form has no result, else empty; nothing is compared then.
    """

    method: str
    parameters: tuple[Parameter, ...]
    difference: Floats
    ratio: Floats
    refusal: str = ''

    @classmethod
    def of(cls, joint: Solution, closed: Solution, method: str) -> Comparison:
        """Compare the parameters estimated by both."""
        parameters = tuple(p for p in joint.parameters if p in closed.parameters)
        values = [s.model.values(parameters) for s in (joint, closed)]
        deviations = [s.std[indices_of(parameters, s.parameters)] for s in (joint, closed)]
        larger = np.maximum(deviations[0], deviations[1])
        off = values[1] - values[0]
        # Without noise both deviations are zero, and the difference is rounding.
        difference = np.divide(off, larger, out=np.zeros_like(off), where=larger > 0)
        ratio = np.divide(
            deviations[0], deviations[1], out=np.ones_like(off), where=deviations[1] > 0
        )
        return cls(method, parameters, difference, ratio)

    @classmethod
    def refused(cls, method: str, refusal: str) -> Comparison:
        """Note that the closed form has no result."""
        return cls(method, (), np.empty(0), np.empty(0), refusal)

    @property
    def furthest(self) -> tuple[str, float]:
        """Return the parameter that differs most, and by how many standard deviations."""
        k = int(np.argmax(np.abs(self.difference)))
        return self.parameters[k].name, float(np.abs(self.difference[k]))

    @property
    def tighter(self) -> float:
        """Share by which the joint estimate's deviations are smaller, in the geometric mean."""
        return 1 - float(np.exp(np.mean(np.log(self.ratio))))

    @property
    def disagrees(self) -> bool:
        """Whether any parameter differs by more than by chance in one of a thousand sessions."""
        return not self.refusal and self.furthest[1] > self._limit

    @property
    def _limit(self) -> float:
        """Standard deviations by which one of the parameters differs by chance in `_ONE_IN`."""
        return float(-scipy.special.ndtri(_ONE_IN / 2 / len(self.parameters)))

    def sentence(self) -> str:
        """Report the difference of the two, and the gain of the joint estimate."""
        if self.refusal:
            return f'closed form {self.method} has no answer: {self.refusal}'
        name, far = self.furthest
        agrees = 'differs by up to' if self.disagrees else 'agrees within'
        share = abs(self.tighter)
        gain = 'tighter' if self.tighter >= 0 else 'wider, for bias drift and positioning errors'
        return (
            f'closed form {self.method} {agrees} {far:.1f} standard deviations ({name}); '
            f'joint is {share:.0%} {gain}'
        )

    def finding(self) -> list[str]:
        """Report a contradiction between the two, if any."""
        if not self.disagrees:
            return []
        names = ', '.join(
            f'{p.name} ({off:+.1f})'
            for p, off in zip(self.parameters, self.difference, strict=True)
            if abs(off) > self._limit
        )
        return [
            f'The closed form {self.method} differs from the joint estimate by more than their '
            f'standard deviations allow: {names}. It allows neither for tilts nor for outliers, '
            'and gives short and long segments the same weight.'
        ]

    def document(self) -> dict[str, object]:
        """Return its entries in calibration.yaml."""
        if self.refusal:
            return {'method': self.method, 'refusal': self.refusal}
        pairs = zip(self.parameters, self.difference, strict=True)
        return {
            'method': self.method,
            'joint_std_over_closed_form': 1 - self.tighter,
            'difference_in_std': {p.name: round(float(off), 3) for p, off in pairs},
        }
