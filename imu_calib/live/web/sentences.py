"""Sentences on the present activity, the remaining time, and the required action."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime

from ...common.finding import is_warning, without_label
from ...common.units import DEG, counted
from ...reports.convergence import ends_at, in_words
from ..rules import Phase, Severity
from .board import NOT_BEGUN, SessionOutcome, Snapshot, TableState, silence

_WHOLE = 2.0
"""Ratio to real time from which a session is called faster. A choice: it is said in whole
numbers."""
_ENDS = {
    SessionOutcome.FAILED: (Severity.ERROR, 'No calibration'),
    SessionOutcome.PARTLY: (Severity.ERROR, 'Not every unit is calibrated'),
    SessionOutcome.INCOMPLETE: (Severity.WARN, 'Done, but positions are missing'),
    SessionOutcome.DONE: (Severity.OK, 'The calibration is done'),
}


_NAMES = {
    'imu_node': "the IMU's receiver",
    'turntable_node': "the table's control",
    'ascii_table_node': "the table's line",
    'calibrator_node': 'the calibrator',
    'compensator_node': 'the compensation',
    'stand_node': 'the simulated stand',
    'hand_node': 'the simulated hand',
    'web_node': 'this page',
    'imu/pulses': "the IMU's stream",
    'imu/skew': "the skewed gyro's stream",
    'imu/temperature': "the IMU's temperature",
    'turntable/joint_states': "the stream of the table's angles",
    'turntable/state': "the table's report",
    'turntable/setpoint': "the table's commands",
}
"""Nodes and topics, and what they are to a person at the stand."""
_NAMED = re.compile(rf'(?:(?P<of>/?\w+(?:/\w+)*)/|/)?\b(?P<name>{"|".join(_NAMES)})\b')
"""With the namespace, which tells units apart."""
_IN_WORDS = [
    (re.compile(pattern), words)
    for pattern, words in {
        'oint state(s?)': r'oint angle\1',
        '(?<=: )turntable state$': 'report of the table',
        '(?<=: )lifecycle$': 'operation',
        '(?<=: )quality of service$': 'delivery',
        'call ~/reset(?: of calibrator_node)?': 'reset the calibrator',
        'best effort': 'without repetition',
        r'(?<!\w)/clock\b': "the stand's clock",
        r'(?<!\w)/estop\b': 'the line of the stop',
        r'then call \S+/release and \S+/start': 'then release and start the table',
        'publisher': 'sender',
        'published': 'sent',
        'publishes': 'sends',
        'publish': 'send',
        r'\bnode(s?)\b': r'program\1',
        '`': '',
    }.items()
]
"""Words of ROS in the sentences of the nodes."""


def in_plain_words(text: str) -> str:
    """Return a sentence of a node, or the name of its part, without the names of ROS.

    Examples:
        >>> in_plain_words('calibrator_node: joint states')
        'The calibrator: joint angles'
        >>> in_plain_words('/imu/pulses is silent, but the table is not.')
        "The IMU's stream is silent, but the table is not."
    """
    for pattern, words in _IN_WORDS:
        text = pattern.sub(words, text)
    return _NAMED.sub(_named, text)


def _named(found: re.Match[str]) -> str:
    of = f' of {found["of"].strip("/")}' if found['of'] else ''
    words = f'{_NAMES[found["name"]]}{of}'
    begins = found.start() == 0 or found.string[: found.start()].endswith('. ')
    return words[0].upper() + words[1:] if begins else words


@dataclass(frozen=True)
class Headline:
    """The headline of the page."""

    level: Severity  #: Severity.
    now: str  #: Present activity, a few words.
    detail: str = ''  #: Reason or required action, in lines; may be empty.


def headline(shown: Snapshot) -> Headline:
    """Return the present activity."""
    if shown.outcome in _ENDS:
        return _last_headline(shown)
    if shown.calibrator_silent:
        return Headline(
            Severity.ERROR,
            'The calibrator is silent',
            f'{silence(shown.calibrator_silent)} The table is stopped without it.',
        )
    if not shown.expected.table:
        return _hand_headline(shown)
    if shown.table is None:
        return Headline(
            Severity.WARN, 'Waiting for the table', 'Nothing has come from its control yet.'
        )
    if shown.table_silent:
        return Headline(
            Severity.ERROR,
            "The table's control is silent",
            f'{silence(shown.table_silent)} A table without commands stops by itself.',
        )
    return _table_headline(shown, shown.table)


def _last_headline(shown: Snapshot) -> Headline:
    """Return the outcome, of a result with its warnings and the number of its notes."""
    level, words = _ENDS[shown.outcome]
    if shown.outcome is not SessionOutcome.DONE:
        return Headline(level, words, shown.outcome_text)
    findings = shown.outcome_text.splitlines()
    lines = [without_label(text) for text in findings if is_warning(text)]
    if lines:
        level, words = Severity.WARN, f'{words}, with {counted(len(lines), "warning")}'
    if notes := len(findings) - len(lines):
        lines.append(f'{counted(notes, "note is", "notes are")} in the report.')
    return Headline(level, words, '\n'.join(lines))


def _hand_headline(shown: Snapshot) -> Headline:
    if not shown.progress:
        return Headline(Severity.WARN, 'Waiting', 'Nothing has come from the calibrator yet.')
    return Headline(Severity.OK, shown.progress)


def _table_headline(shown: Snapshot, table: TableState) -> Headline:
    where = f'position {table.position}' if table.position else 'its start'
    if table.phase is Phase.PAUSED:
        return Headline(Severity.WARN, 'The table has stopped', table.reason)
    if table.phase is Phase.ABORTED:
        return Headline(Severity.ERROR, 'The plan was aborted', table.reason)
    if table.phase is Phase.DONE:
        return Headline(Severity.OK, 'The plan is done', 'The result is being computed.')
    if table.phase is Phase.IDLE:
        return Headline(Severity.OK, 'Nothing moves', table.reason or 'The plan is not started.')
    words = {
        Phase.MOVING: f'The table moves to {where}',
        Phase.SETTLING: f'The table comes to rest at {where}',
        Phase.TURNING: f'The table turns at {where}',
        Phase.DWELLING: f'The table stands still at {where}',
    }
    return Headline(Severity.OK, words[table.phase], _doing(shown, table))


def _doing(shown: Snapshot, table: TableState) -> str:
    """Return the action of a step as text."""
    if table.phase is Phase.TURNING:
        rates = [
            f'{name} {rate / DEG:.3g} deg/s'
            for name, rate in zip(table.joints, table.rates, strict=False)
            if abs(rate) > 0.01 * DEG
        ]
        turned = f'{table.turns_done:.1f} turns done'
        return f'{", ".join([*rates, turned])}.'
    steps = shown.expected.steps
    if table.phase is Phase.DWELLING and table.step < len(steps):
        return steps[table.step].words
    return ''


def time_left(shown: Snapshot, now: datetime) -> tuple[str, str]:
    """Return the remaining time, and the time of its end or the basis of the estimate."""
    if shown.outcome is not SessionOutcome.OPEN:
        return '0 s', f'it took {in_words(shown.elapsed)}'
    if not shown.expected.table:
        return 'as you hold it', f'{in_words(shown.elapsed)} so far'
    remaining = shown.wall_seconds_left
    if shown.table is None or shown.silent or math.isnan(remaining):
        return 'time left not known', ''
    if shown.table.phase in NOT_BEGUN:
        return 'the whole plan', 'once it is started'
    if shown.table.phase is Phase.PAUSED:
        return in_words(remaining), 'once it goes on'
    text = f'ends at {ends_at(remaining, now)}'
    if shown.speed > _WHOLE:
        text += f' ({shown.speed:.0f} times real time)'
    return in_words(remaining), text


def joint_words(table: TableState) -> list[tuple[str, str, str]]:
    """Return name, angle and rate of every joint, as text."""
    return [
        (name, f'{_rounded(angle / DEG, 3)}\u00a0deg', f'{_rounded(rate / DEG, 2)} deg/s')
        for name, angle, rate in zip(table.joints, table.angles, table.rates, strict=False)
    ]


def _rounded(value: float, places: int) -> str:
    """Return a number without the sign of a zero."""
    return f'{round(value, places) + 0.0:.{places}f}'
