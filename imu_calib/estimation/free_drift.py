"""Drifts of biases in a session in the hand: kinds, sizes, and what is said of them.

Source: docs/mathematics.md, 'Free positions'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ..common.units import DEG, STANDARD_GRAVITY, significant
from ..model.session_terms import session_term

TRENDS = {name: session_term(name) for name in ('trend:D_g', 'trend:D_a')}
"""Drifts that are tested: biases of either triad that change evenly."""
DRIFT_SHOWN = {'trend:D_g': 1e-3, 'trend:D_a': 1e-6}
"""Probability of chance below which an even drift is in the model, where the other triad has none.

Gyros at rest show theirs at each hold. That of accelerometers is told from their parameters by what
further holds and the turns leave. In halves of a published recording, of 11 to 13 holds whose
accelerometers scatter by up to 16 times their noise (docs/real_recordings.md, position), drifts of
1e-4 to 1e-6 were none: with them the other half fitted worse."""
LARGEST_DRIFT = {'trend:D_g': 1 * DEG, 'trend:D_a': 0.1 * STANDARD_GRAVITY}
"""Largest drift of a bias during a session, rad/s and m/s^2: chips that were just switched on."""


class DriftKind(Enum):
    """How biases drift."""

    EVEN = 'even'
    """Along a line: estimated."""
    WANDER = 'wander'
    """A random walk: in the covariance."""
    UNEVEN = 'uneven'
    """Otherwise: seen in the residuals."""


@dataclass(frozen=True)
class Drift:
    """A drift of the biases of a triad that a session shows.

    Attributes:
        name: Of the term: `trend:D_g` or `trend:D_a`.
        log_p: Natural logarithm of the probability by chance, or of the odds for a wander.
        largest: By how much a bias changes during the session, rad/s or m/s^2.
        kind: How.
    """

    name: str
    log_p: float
    largest: float
    kind: DriftKind = DriftKind.EVEN


def drift_words(drifts: Sequence[Drift]) -> list[str]:
    """Report drifts of biases, those of one kind in a sentence."""
    words = []
    for kind, how, what in (
        (
            DriftKind.EVEN,
            'drift evenly',
            'this is estimated, and the biases stated are those of its middle',
        ),
        (DriftKind.WANDER, 'wander', 'the standard deviations allow for it'),
        (DriftKind.UNEVEN, 'drift unevenly', _NOT_ESTIMATED),
    ):
        found = [one for one in drifts if one.kind is kind]
        if found:
            each = ' and '.join(_one_drift(one) for one in found)
            words.append(f'Biases {how} during the session, {each}: {what}. {_REMEDY}')
    return words


def _one_drift(found: Drift) -> str:
    gyros = found.name == 'trend:D_g'
    whose, unit, shown = (
        ('gyros', DEG, 'deg/s') if gyros else ('accelerometers', STANDARD_GRAVITY / 1000, 'mg')
    )
    by = f'of the {whose} by up to {significant(found.largest / unit)} {shown}'
    exponent = max(3, round(-found.log_p / np.log(10)))
    odds = f'by chance once in 10^{exponent} sessions'
    if found.kind is DriftKind.EVEN:
        return f'{by} ({found.name}, {odds})'
    return f'{by} ({odds})' if found.kind is DriftKind.UNEVEN else by


_NOT_ESTIMATED = (
    'no term describes this, and errors may exceed the standard deviations, which are widened by '
    'the scatter alone'
)
_REMEDY = (
    'Let the unit run until it is warm, keep the session short, and return to the first attitudes '
    'at its end.'
)
"""What helps against a drift, even or not."""
