"""Statements of conformity by a decision rule stated in the certificate.

Source: ILAC-G8:09/2019, 4.2; JCGM 106:2012, 8; ISO/IEC 17025:2017, 7.8.6.
"""

from __future__ import annotations

from enum import Enum


class Rule(Enum):
    """How the uncertainty is taken into account in a decision on a limit."""

    SIMPLE = 'simple_acceptance'
    GUARDED = 'guard_band'
    GUARDED_BOTH = 'guard_band_both'

    @property
    def words(self) -> str:
        """The rule and its risk, as text."""
        return _WORDS[self]


_WORDS = {
    Rule.SIMPLE: (
        'Simple acceptance (ILAC-G8:09/2019, 4.2.1): pass where the value lies within its limits, '
        'else fail. A value at a limit is accepted, or rejected, wrongly with a probability of up '
        'to 50 %.'
    ),
    Rule.GUARDED: (
        'Guard band w = U (ILAC-G8:09/2019, 4.2.2): pass where the value lies within its limits '
        'by at least the expanded uncertainty U, else fail. An item that passes is beyond a limit '
        'with a probability of at most 2.5 %.'
    ),
    Rule.GUARDED_BOTH: (
        'Guard band w = U on both sides (ILAC-G8:09/2019, 4.2.3): pass where the value lies within '
        'its limits by at least the expanded uncertainty U, fail where it lies beyond by more '
        'than U; between, conditional pass within the limits and conditional fail beyond. Pass '
        'and fail are wrong with a probability of at most 2.5 %.'
    ),
}


class Conformity(Enum):
    """The statement on a value, in the terms of the DCC."""

    PASS = 'pass'
    CONDITIONAL_PASS = 'conditionalPass'
    CONDITIONAL_FAIL = 'conditionalFail'
    FAIL = 'fail'

    @property
    def words(self) -> str:
        """The statement as text."""
        return {'conditionalPass': 'conditional pass', 'conditionalFail': 'conditional fail'}.get(
            self.value, self.value
        )


WORST_LAST = (
    Conformity.PASS,
    Conformity.CONDITIONAL_PASS,
    Conformity.CONDITIONAL_FAIL,
    Conformity.FAIL,
)


def decide(value: float, expanded: float, limit: float, rule: Rule) -> Conformity:
    """Return the statement on a value with a limit on both sides of zero.

    Args:
        value: The estimate.
        expanded: Its expanded uncertainty, in the same unit.
        limit: Largest amount allowed.
        rule: Decision rule.
    """
    amount = abs(value)
    guard = 0.0 if rule is Rule.SIMPLE else expanded
    if amount <= limit - guard:
        return Conformity.PASS
    if rule is not Rule.GUARDED_BOTH or amount > limit + guard:
        return Conformity.FAIL
    return Conformity.CONDITIONAL_PASS if amount <= limit else Conformity.CONDITIONAL_FAIL
