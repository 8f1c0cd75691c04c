"""Sentences for people on a result, ordered by what they mean for its numbers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .budget import Budget, ErrorSource
from .units import counted

_WARNING = 'Warning: '
"""Start of a sentence on which a number depends; in files and messages, too."""


class Finding(str):
    """A sentence for people on a result.

    Attributes:
        effect: How far it moves a parameter, or widens its standard deviation, at most, in standard
            deviations of that parameter.
        sources: Sources of uncertainty whose size it explains: their share in the budget gives the
            effect.
        lost: Whether it says which data a person would have to record again.
    """

    effect: float
    sources: tuple[ErrorSource, ...]
    lost: bool

    def __new__(
        cls, text: str, *sources: ErrorSource, effect: float = 0.0, lost: bool = False
    ) -> Finding:
        """Make one of a sentence."""
        found = super().__new__(cls, text)
        found.effect, found.sources, found.lost = effect, sources, lost
        return found

    def followed_by(self, text: str) -> Finding:
        """Return the finding with another sentence."""
        return Finding(f'{self} {text}', *self.sources, effect=self.effect, lost=self.lost)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the attributes in copies of other processes."""
        return _restored, (str(self), self.sources, self.effect, self.lost)


def _restored(text: str, sources: tuple[ErrorSource, ...], effect: float, lost: bool) -> Finding:
    return Finding(text, *sources, effect=effect, lost=lost)


def with_full_stop(text: str) -> Finding:
    """Return a sentence on data with its full stop; what it says of a loss stays."""
    return Finding(f'{text}.', lost=isinstance(text, Finding) and text.lost)


def warning(text: str, *sources: ErrorSource, effect: float = 0.0) -> Finding:
    """Return a finding on which a number depends: it may be wrong by more than its deviation."""
    return Finding(f'{_WARNING}{text}', *sources, effect=effect)


def is_warning(text: str) -> bool:
    """Return whether a sentence is a warning; those of files are known by their first word."""
    return text.startswith(_WARNING)


def without_label(text: str) -> str:
    """Return a sentence without the word that marks a warning."""
    return text.removeprefix(_WARNING)


def how_many(findings: Sequence[str]) -> str:
    """Return the numbers of warnings and of notes, in words."""
    warnings = sum(map(is_warning, findings))
    return f'{counted(warnings, "warning")}, {counted(len(findings) - warnings, "note")}'


def by_effect(findings: Iterable[str], budget: Budget | None = None) -> tuple[str, ...]:
    """Return findings without repetitions: warnings, lost data, then by effect, the largest first.

    Args:
        findings: In the order that those of one effect keep.
        budget: Of the result; None if the method gives none.
    """

    def place(text: str) -> tuple[bool, bool, float]:
        effect, lost = 0.0, False
        if isinstance(text, Finding):
            shares = 0.0 if budget is None else widening(budget, text.sources)
            effect, lost = max(text.effect, shares), text.lost
        return not is_warning(text), not lost, -effect

    return tuple(sorted(dict.fromkeys(findings), key=place))


def widening(budget: Budget, sources: Iterable[ErrorSource]) -> float:
    """Return by how much sources widen a standard deviation at most, of what it is without them.

    Infinite where a parameter has no other uncertainty.
    """
    chosen = set(sources)
    mine = np.array([line.source in chosen for line in budget.lines], dtype=bool)
    if not mine.any():
        return 0.0
    own, others = (np.nan_to_num(budget.variances[rows]).sum(axis=0) for rows in (mine, ~mine))
    ratio = np.divide(own, others, out=np.where(own > 0, np.inf, 0.0), where=others > 0)
    return float(np.sqrt(1 + ratio.max()) - 1)
