"""imu-calib info: what is in a recording, and what it can calibrate."""

from __future__ import annotations

import argparse
from collections import Counter

from rich.table import Table as Rows

from ..bags import open_recording
from ..calibrator import Setup
from ..errors import ImuCalibError
from ..segmentation.labelling import label
from ..segmentation.segmenter import Segmenter
from ..segmentation.session import Segmented
from ..session import COMPENSATED
from ..units import DEG, DEG_H, STANDARD_GRAVITY
from . import options
from .calibrate import Offline, open_offline
from .terminal import OUTPUT, progress_bar, sentence_list

_SAME_UP = 0.999
"""Cosine of 2.6 deg: turns about axes that are closer are of the same position. A judgement: the
positions of a rate test are 90 deg apart."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = commands.add_parser('info', help='what is in a recording', description=__doc__)
    parser.add_argument('bag', help='folder of rosbag2, or one .mcap or .db3 file')
    options.add_session_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print topics, then segments where plan, IMU and site are known."""
    with open_recording(arguments.bag) as recording:
        rows = Rows(box=None, pad_edge=False, header_style='bold')
        for heading in ('topic', 'type', 'messages', 'rate, Hz'):
            rows.add_column(heading, justify='left' if heading in {'topic', 'type'} else 'right')
        seconds = 0.0
        if recording.start_ns is not None and recording.end_ns is not None:
            seconds = (recording.end_ns - recording.start_ns) * 1e-9
        for topic in recording.topics:
            rate = f'{topic.count / seconds:.1f}' if topic.count and seconds > 0 else '-'
            rows.add_row(
                topic.name, topic.type, str(topic.count if topic.count is not None else '?'), rate
            )
        OUTPUT.print(rows)
        OUTPUT.print(f'\n{seconds:.1f} s, {len(recording.files)} file(s)')
        if (by := recording.custom_data.get(COMPENSATED)) is not None:
            OUTPUT.print(f'compensated by {by}: the compensated stream is in SI', markup=False)
    try:
        offline = open_offline(arguments)
    except ImuCalibError as error:
        OUTPUT.print(f'\nNot looked into: {error}', markup=False)
        return
    with offline.recording:
        session = _segment(offline)
    _show_segments(session, offline.setup)
    sentence_list('Lost', [*offline.recording.losses, *session.losses])


def _segment(offline: Offline) -> Segmented:
    segmenter = Segmenter(offline.setup.imu, offline.setup.table)
    with progress_bar('reading') as show:
        for _, block in offline.recording.read(offline.streams.kinds(), show):
            segmenter.feed(block)
    return segmenter.finish()


def _show_segments(session: Segmented, setup: Setup) -> None:
    labelled = label(session, setup.plan, setup.table)
    rows = Rows(box=None, pad_edge=False, header_style='bold')
    headings = (
        'position',
        'at, s',
        'for, s',
        'missing',
        'fx, g',
        'fy, g',
        'fz, g',
        'wx',
        'wy',
        'wz, deg/h',
    )
    for heading in headings:
        rows.add_column(heading, justify='left' if heading == 'position' else 'right')
    zero = min((s.start for s in labelled.segments), default=0)
    for segment in labelled.segments:
        s = segment.statistics
        rows.add_row(
            str(segment.position),
            f'{(segment.start - zero) * 1e-9:.1f}',
            f'{s.duration:.1f}',
            str(s.missing),
            *(f'{v / STANDARD_GRAVITY:.4f}' for v in s.mean[3:]),
            *(f'{v / DEG_H:.2f}' for v in s.mean[:3]),
        )
    OUTPUT.print()
    OUTPUT.print(rows)
    turns = Counter((t.position, round(t.rate() / DEG, 2)) for t in labelled.turns)
    listed = ', '.join(f'{rate:+g} deg/s at {name}' for name, rate in turns)
    OUTPUT.print(f'\nwhole turns: {listed or "none"}', markup=False)
    found = {s.position for s in labelled.segments}
    missing = [p.id for p in setup.plan.positions if p.dwell > 0 and p.id not in found]
    missing += [
        f'the turns at {p.id}'
        for p in setup.plan.positions
        if p.rate_test and not any(t.up @ p.up > _SAME_UP for t in labelled.turns)
    ]
    text = f'missing of plan {setup.plan.name}: {", ".join(missing)}' if missing else 'complete'
    OUTPUT.print(f'plan {setup.plan.name}: {text}')
    left_out = [f'{r.position or "?"}: {r.reason}' for r in labelled.rejected]
    sentence_list('Left out', [*left_out, *labelled.notes])
