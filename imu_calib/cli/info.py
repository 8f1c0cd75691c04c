"""imu-calib info: what is in a recording, and what it can calibrate."""

from __future__ import annotations

import argparse
from collections import Counter

from rich.table import Table as Rows

from ..api.calibrating import Opened, open_session
from ..bags import Recording, open_recording
from ..calibrator import Calibrator, Setup
from ..errors import ImuCalibError, NotObservable
from ..estimation.fit import check_observable
from ..metadata import COMPENSATED
from ..observation.equations import Equations
from ..plan import Plan
from ..segmentation.alone import up_seen
from ..segmentation.labelling import Labelled, label
from ..segmentation.naming import heading, up_words
from ..segmentation.segmented import Segmented
from ..segmentation.segmenter import Segmenter
from ..turntable import TURN
from ..units import DEG, DEG_H, STANDARD_GRAVITY
from . import options
from .terminal import OUTPUT, progress_bar, sentence_list

_SAME_UP = 0.999
"""Cosine of 2.6 deg: turns about axes that are closer are of the same position. A judgement: the
positions of a rate test are 90 deg apart."""

_WORDS = {'topic', 'type', 'up', 'position'}
_PASSING = 'on the way'
_UNUSED = 'not used'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('bag', help='folder of rosbag2, or one .mcap or .db3 file')
    options.add_session_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print topics, then segments where plan, IMU and site are known."""
    with open_recording(arguments.bag) as recording:
        rows = _table('topic', 'type', 'messages', 'rate, Hz')
        seconds = 0.0
        if recording.start_ns is not None and recording.end_ns is not None:
            seconds = (recording.end_ns - recording.start_ns) * 1e-9
        counts = _counts(recording)
        for topic in recording.topics:
            count = counts[topic.name]
            rate = f'{count / seconds:.1f}' if count and seconds > 0 else '-'
            rows.add_row(topic.name, topic.type, str(count), rate)
        OUTPUT.print(rows)
        OUTPUT.print(f'\n{seconds:.1f} s, {len(recording.files)} file(s)')
        if (by := recording.custom_data.get(COMPENSATED)) is not None:
            OUTPUT.print(f'compensated by {by}: the compensated stream is in SI', markup=False)
    try:
        opened = open_session(arguments.bag, options.stated(arguments))
    except ImuCalibError as error:
        OUTPUT.print(f'\nNot looked into: {error}', markup=False)
        return
    with opened.recording:
        session = _segment(opened)
    _show_segments(session, opened.setup)
    sentence_list('Lost', [*opened.recording.losses, *session.losses])


def _counts(recording: Recording) -> Counter[str]:
    """Return how many messages each topic has: as the recording says, else by counting them.

    What was cut off has no summary, which its recorder would have written at the end.
    """
    counts = Counter({t.name: t.count for t in recording.topics if t.count is not None})
    if len(counts) == len(recording.topics):
        return counts
    counts.clear()
    with progress_bar('counting') as show:
        for topic, messages, _ in recording.messages(show):
            counts[topic.name] += len(messages)
    return counts


def _segment(opened: Opened) -> Segmented:
    segmenter = Segmenter(opened.setup.imu, opened.setup.table)
    for block in opened.blocks(progress_bar):
        segmenter.feed(block)
    return segmenter.finish()


def _show_segments(session: Segmented, setup: Setup) -> None:
    labelled = label(session, setup.plan, setup.table)
    zero = session.start or 0
    OUTPUT.print()
    OUTPUT.print(_rests(session, labelled, setup.plan, zero))
    OUTPUT.print()
    OUTPUT.print(_outputs(session))
    if labelled.turns:
        OUTPUT.print()
        OUTPUT.print(_turns(labelled, setup.plan, zero))
    else:
        OUTPUT.print('\nno whole turns')
    if setup.plan.is_stated:
        _show_missing(labelled, setup.plan)
    else:
        OUTPUT.print(f'\nno plan: {_what_is_told(session, labelled, setup)}', markup=False)
    left_out = [
        f'{r.position or f"at {(r.start - zero) * 1e-9:.1f} s"}: {r.reason}'
        for r in labelled.rejected
    ]
    sentence_list('Left out', [*left_out, *labelled.notes])


def _what_is_told(session: Segmented, labelled: Labelled, setup: Setup) -> str:
    """Say whether a session without a plan determines all parameters, or what it lacks."""
    try:
        parameters = setup.parameters
        evidence = Calibrator(setup).evidence(labelled, session)
        check_observable(Equations(evidence, parameters))
    except NotObservable as error:
        return f'the attitudes decide. {error}'
    return f'the attitudes and turns determine all {len(parameters)} parameters'


def _table(*headings: str) -> Rows:
    """Begin a table: words are flush left, numbers flush right."""
    rows = Rows(box=None, pad_edge=False, header_style='bold')
    for text in headings:
        rows.add_column(text, justify='left' if text in _WORDS else 'right')
    return rows


def _rests(session: Segmented, labelled: Labelled, plan: Plan, zero: int) -> Rows:
    """List every rest: when, how long, how the unit stood, and what the plan calls it."""
    rows = _table('rest', 'at, s', 'for, s', 'missing', 'up', 'heading, deg', 'position')
    names = {s.start: str(s.position) for s in labelled.segments}
    known = {p.id for p in plan.positions}
    passing = {s.start for s in labelled.passing}
    by_plan = {s.start: s.attitude for s in labelled.segments}
    for k, segment in enumerate(session.segments):
        attitude = segment.attitude if segment.attitude is not None else by_plan.get(segment.start)
        name = names.get(segment.start)
        if name is None:
            name = _PASSING if segment.start in passing else _UNUSED
        elif name not in known:
            name = '-'
        rows.add_row(
            str(k + 1),
            f'{(segment.start - zero) * 1e-9:.1f}',
            f'{segment.statistics.duration:.1f}',
            str(segment.statistics.missing),
            up_words(up_seen(segment) if attitude is None else attitude[2]),
            '-' if attitude is None else f'{round(heading(attitude) / DEG, 2) % 360:.2f}',
            name,
        )
    return rows


def _outputs(session: Segmented) -> Rows:
    """List what the sensors read at every rest."""
    rows = _table('rest', 'fx, g', 'fy, g', 'fz, g', 'wx', 'wy', 'wz, deg/h')
    for k, segment in enumerate(session.segments):
        mean = segment.statistics.mean
        rows.add_row(
            str(k + 1),
            *(f'{v / STANDARD_GRAVITY:.4f}' for v in mean[3:]),
            *(f'{v / DEG_H:.2f}' for v in mean[:3]),
        )
    return rows


def _turns(labelled: Labelled, plan: Plan, zero: int) -> Rows:
    """List every measurement of whole turns: when, about what, how fast, how many."""
    rows = _table('turn', 'at, s', 'for, s', 'up', 'rate, deg/s', 'turns', 'position')
    known = {p.id for p in plan.positions}
    for k, turn in enumerate(labelled.turns):
        rows.add_row(
            str(k + 1),
            f'{(turn.start - zero) * 1e-9:.1f}',
            f'{turn.statistics.duration:.1f}',
            up_words(turn.up),
            f'{turn.rate() / DEG:+.3f}',
            f'{abs(turn.angle) / TURN:.0f}',
            turn.position if turn.position in known else '-',
        )
    return rows


def _show_missing(labelled: Labelled, plan: Plan) -> None:
    found = {s.position for s in labelled.segments}
    missing = [p.id for p in plan.positions if p.dwell > 0 and p.id not in found]
    missing += [
        f'the turns at {p.id}'
        for p in plan.positions
        if p.rate_test and not any(t.up @ p.up > _SAME_UP for t in labelled.turns)
    ]
    text = f'missing of plan {plan.name}: {", ".join(missing)}' if missing else 'complete'
    OUTPUT.print(f'\nplan {plan.name}: {text}')
