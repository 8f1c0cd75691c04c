"""Contents of recordings, and of files that you write: imu-calib info, schema."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table as Rows

from ..api.inspect import Inspection, inspect_streams, topics
from ..common.files import share_folder
from ..common.units import DEG, DEG_H, PPM, STANDARD_GRAVITY, counted
from ..reports.plain_table import plain_table
from ..session.keywords import Inspected
from ..session.segments_file import write_segments
from . import options
from .outcome import (
    WRONG_INPUT,
    CommandResult,
    add_json_option,
    add_verbose_option,
    write_text,
)
from .terminal import OUTPUT, list_lines, progress_bar, sentence_list

if TYPE_CHECKING:
    from ..api.stream_contents import StreamContents


def add_info_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.epilog = (
        'Exit code 2, after the topics: it is not stated how the streams are to be read (latitude, '
        'units, which topic); --topics asks for no more than the topics.'
    )
    options.add_bag(parser)
    parser.add_argument(
        '--topics',
        action='store_true',
        help='list topics alone; of an .mcap behind a URL the summary is read, and no more',
    )
    options.add_statements(parser, Inspected)
    parser.add_argument(
        '--segments',
        dest='segments_output',
        metavar='FILE.csv',
        help='write the holds and turns found; edit them for calibrate --segments',
    )
    add_verbose_option(parser)
    add_json_option(parser)


def run_info(arguments: argparse.Namespace) -> CommandResult:
    """Show the contents of a recording, what it can calibrate, and contradictions."""
    stated = options.stated(arguments)
    outside = topics(arguments.bag, stated, progress_bar)
    _show_topics(outside)
    if arguments.topics:
        sentence_list('Lost', outside.lost)
        return CommandResult(outside.to_dict())
    found = inspect_streams(arguments.bag, outside, stated, progress_bar)
    _show_clocks(found, verbose=arguments.verbose)
    if found.streams is None:
        sentence_list('Lost', outside.lost)
        message = f'{found.missing_input} Until then the topics alone are shown.'
        return CommandResult(found.to_dict(), WRONG_INPUT, message)
    _show(found.streams, verbose=arguments.verbose)
    sentence_list('To calibrate', [found.missing_input] if found.missing_input else [])
    if arguments.segments_output is not None:
        write_segments(arguments.segments_output, found.streams.segments)
        OUTPUT.print(f'\nsegments written to {arguments.segments_output}', markup=False)
    return CommandResult(found.to_dict())


def _show_topics(found: Inspection) -> None:
    rows = plain_table(('topic', 'type', 'messages', 'rate, Hz'), 'llrr')
    for topic in found.topics:
        rate = '-' if topic.rate is None else f'{topic.rate:.1f}'
        rows.add_row(topic.name, topic.type, str(topic.messages), rate)
    OUTPUT.print(rows)
    units = f', of {", ".join(found.units)}' if found.units else ''
    units += ', simulated' if found.simulated else ''
    OUTPUT.print(f'\n{found.seconds:.1f} s, {counted(found.files, "file")}{units}', markup=False)
    if found.compensated:
        OUTPUT.print(
            f'compensated by {found.compensated}: the compensated stream is in SI', markup=False
        )


def _show_clocks(found: Inspection, *, verbose: bool) -> None:
    """Show durations and rates by header stamps and by log times, where they contradict."""
    steps = [
        f'{clock.topic}: log times step by {by:+.1f} s at {at:.1f} s'
        for clock in found.clocks
        for at, by in clock.log_steps
    ]
    wrong = [f'{c.topic}: {c.contradiction}' for c in found.clocks if c.contradiction]
    if not found.clocks or not (verbose or wrong or steps):
        return
    headings = ('topic', 'by stamps: s', 'Hz', 'by log: s', 'Hz', 'stamps faster, ppm')
    rows = plain_table(headings, 'lrrrrr')
    for clock in found.clocks:
        faster = '-'
        if clock.faster is not None and clock.faster_std is not None:
            faster = f'{clock.faster / PPM:+.0f} +- {max(clock.faster_std / PPM, 1):.0f}'
        rows.add_row(
            clock.topic,
            f'{clock.seconds:.3f}',
            '-' if clock.rate is None else f'{clock.rate:.5g}',
            f'{clock.log_seconds:.3f}',
            '-' if clock.log_rate is None else f'{clock.log_rate:.5g}',
            faster,
        )
    OUTPUT.print()
    OUTPUT.print(rows)
    sentence_list('Clocks', [*wrong, *steps])


_ROWS, _TURNS = 20, 8
"""Dwells and turns, and turns if there are as many dwells, that fit a screen with the rest."""
_LISTED = 3  #: Lines of sentences below them that fit, too.


def _show(contents: StreamContents, *, verbose: bool) -> None:
    OUTPUT.print('\ntimes: s from the start of the recording\n')
    rows, turns = _dwells(contents), _turns(contents)
    lists = {
        'Problems': contents.contradictions,
        'Left out': contents.left_out,
        'Lost': contents.lost,
    }
    fitting = _ROWS - max(0, sum(map(list_lines, lists.values())) - _LISTED)
    # Of turns some are mostly left out already: they make room.
    room = _ROWS - min(len(turns), _TURNS) if turns else max(fitting, 1)
    _show_rows(_OF_DWELLS, 'rrrrlrl', rows, None if verbose else room)
    if verbose:
        OUTPUT.print()
        OUTPUT.print(_outputs(contents))
    if turns:
        OUTPUT.print()
        room = max(fitting - min(len(rows), room), 1)
        _show_rows(_OF_TURNS, 'rrrlrrl', turns, None if verbose else room)
    else:
        OUTPUT.print('\nno whole turns')
    plan = f'plan {contents.plan}' if contents.plan else 'no plan'
    sentence = contents.summary
    if contents.missing is not None:
        missing = ', '.join(contents.missing)
        sentence = f'missing of {plan}: {missing}' if missing else 'complete'
    OUTPUT.print(f'\n{plan}: {sentence}', markup=False)
    if contents.latitude is not None:
        seen, std = contents.latitude
        OUTPUT.print(f'the gyros show a latitude of {seen:.1f} +- {std:.1f} deg at rest')
    for title, sentences in lists.items():
        sentence_list(title, sentences)


def _show_rows(
    headings: Sequence[str], sides: str, rows: Sequence[Sequence[str]], most: int | None
) -> None:
    OUTPUT.print(plain_table(headings, sides, rows[:most]))
    if left := len(rows) - len(rows[:most]):
        OUTPUT.print(f'{left} more: --verbose')


_OF_DWELLS = ('dwell', 'at, s', 'for, s', 'left out', 'up, deg', 'heading, deg', 'position')
_OF_TURNS = ('turn', 'at, s', 'for, s', 'up, deg', 'rate, deg/s', 'turns', 'position')


def _dwells(contents: StreamContents) -> list[list[str]]:
    """List every static dwell: start, duration, attitude, and position in the plan."""
    return [
        [
            str(k + 1),
            f'{dwell.at:.1f}',
            f'{dwell.seconds:.1f}',
            str(dwell.missing),
            dwell.up,
            '-' if dwell.heading is None else f'{dwell.heading:.2f}',
            dwell.position or '-',
        ]
        for k, dwell in enumerate(contents.dwells)
    ]


def _outputs(contents: StreamContents) -> Rows:
    """List the mean outputs of every dwell."""
    unit, scale, places = ('deg/s', DEG, 5) if contents.by_hand else ('deg/h', DEG_H, 2)
    headings = ('dwell', 'fx, g', 'fy, g', 'fz, g', 'wx', 'wy', f'wz, {unit}')
    rows = plain_table(headings, 'r' * 7)
    for k, dwell in enumerate(contents.dwells):
        rows.add_row(
            str(k + 1),
            *(f'{v / STANDARD_GRAVITY:.4f}' for v in dwell.mean[3:]),
            *(f'{v / scale:.{places}f}' for v in dwell.mean[:3]),
        )
    return rows


def _turns(contents: StreamContents) -> list[list[str]]:
    """List every measurement of whole turns: start, axis, rate, number of turns."""
    return [
        [
            str(k + 1),
            f'{turn.at:.1f}',
            f'{turn.seconds:.1f}',
            turn.up,
            f'{turn.rate / DEG:+.3f}',
            str(turn.turns),
            turn.position or '-',
        ]
        for k, turn in enumerate(contents.turns)
    ]


def add_schema_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    schemas = sorted(p.stem for p in (share_folder() / 'config' / 'schemas').glob('*.json'))
    parser.add_argument('kind', choices=schemas, help='kind of file')


def run_schema(arguments: argparse.Namespace) -> None:
    """Print the JSON Schema of a file that you write, for your editor (docs/files)."""
    file = share_folder() / 'config' / 'schemas' / f'{arguments.kind}.json'
    write_text(file.read_text(encoding='utf-8'))
