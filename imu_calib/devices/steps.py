"""Steps from sample to sample, by a clock or a counter that starts anew at its modulus."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..stream import Floats

Indices = NDArray[np.int64]


@dataclass
class Finding:
    """A jump at an index; `by_arrival` where only the arrival tells how much time went by."""

    index: int
    seconds: float | None
    reason: str
    by_arrival: bool = False


@dataclass
class Steps:
    """(n,) ns from sample to sample, and where they had to be corrected."""

    nanoseconds: Floats
    findings: list[Finding] = field(default_factory=list)


def differences(
    values: Indices, previous: int, modulus: int | None, *, signed: bool = True
) -> Floats:
    """Return the (n,) steps of a number that starts anew at its modulus.

    Args:
        values: (n,) as sent.
        previous: The one before.
        modulus: None where it has none.
        signed: Whether a step of more than half the modulus is one back.

    """
    with np.errstate(over='ignore'):
        steps = np.diff(values, prepend=np.int64(previous))
    if modulus is not None and modulus < 2**63:
        steps = np.mod(steps, modulus)
        if signed:
            steps[steps > modulus // 2] -= modulus
    return steps.astype(np.float64)


def forward(steps: Floats, period: float | None, reason: str, begins: bool) -> Steps:
    """Leave the steps to the arrival that do not go forward."""
    back = steps <= 0
    back[0] &= not begins
    steps[back] = 1.0 if period is None else period
    return Steps(steps, [Finding(k, None, reason, True) for k in np.flatnonzero(back).tolist()])
