"""Sentences on sensors whose outputs are many times, or a fraction of, what they should be."""

from __future__ import annotations

from ..common.units import DEG, STANDARD_GRAVITY

TIMES = ' A wrong sample rate, or a wrong unit of time, has the same effect.'
"""For gyros: their rates times time are compared with turned angles."""
_RANGES = {
    2.0: 'Counts of half the range that the scale factor is for',
    0.5: 'Counts of twice the range that the scale factor is for',
}
_MISTAKES = {
    'gyros': {
        **_RANGES,
        1 / DEG: 'Rates in deg/s, stated as rad/s,',
        DEG: 'Rates in rad/s, stated as deg/s,',
    },
    'accelerometers': {
        **_RANGES,
        STANDARD_GRAVITY: 'Accelerations in m/s^2, stated as g,',
        1 / STANDARD_GRAVITY: 'Accelerations in g, stated as m/s^2,',
    },
}
"""Factor by which outputs are then too large."""
_NEAR = 0.1
"""Relative: scale factors of the cheapest units are 3 % off."""


def wrong_scale_sentences(scale: float, name: str) -> str:
    """Return sentences on what gives sensors so many times the response; empty if unknown."""
    near = [m for factor, m in _MISTAKES[name].items() if abs(scale / factor - 1) < _NEAR]
    return ''.join(f' {mistake} have that effect.' for mistake in near) + (
        TIMES if name == 'gyros' else ''
    )


def wrong_turns_sentences(scale: float, meaning: str) -> str:
    """Return sentences on gyros that turn gravity `scale` times as far as it turns.

    `meaning` says what contradicts what, without a stop.
    """
    return (
        f'The gyros turn gravity {scale:.3g} times as far as the accelerometers do: {meaning}.'
        f'{wrong_scale_sentences(scale, "gyros")}'
    )
