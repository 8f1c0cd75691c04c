"""imu-calib batch: calibrate many recordings into a catalogue."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager

from ..common.errors import NotObservable
from ..common.parallel import MEMORY
from ..common.progress import Show
from ..common.units import counted
from ..fleet.batch import batch
from ..fleet.sentences import listed
from ..session.keywords import Session
from . import options
from .outcome import CommandResult
from .terminal import ERRORS, OUTPUT, progress_bar


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument(
        'sources',
        nargs='+',
        metavar='SOURCE',
        help='recordings, folders of some, patterns, manifests (.csv, .yaml), URLs (s3://...)',
    )
    parser.add_argument(
        '-o',
        '--output',
        required=True,
        dest='catalogue',
        metavar='CATALOGUE',
        help='folder of the catalogue',
    )
    options.add_scheduler_option(parser)
    parser.add_argument(
        '--workers',
        type=int,
        metavar='N',
        help='workers on this machine (default: one for each core)',
    )
    parser.add_argument(
        '--memory',
        default=MEMORY,
        metavar='SIZE',
        help='memory of each worker on this machine (default: %(default)s)',
    )
    parser.add_argument(
        '--retry',
        action='store_true',
        help='run failed recordings again, and those calibrated with other options since',
    )
    options.add_statements(parser, Session)
    options.add_imus_option(parser)
    parser.epilog = (
        'Exit code 1: a recording, or a unit of one, gave no calibration; its row says why '
        '(imu-calib catalogue CATALOGUE --where "status = \'failed\'").'
    )
    parser.set_defaults(run=run)


def _say_where(dashboard: str) -> None:
    ERRORS.print(f'dashboard: {dashboard}', markup=False)


def run(arguments: argparse.Namespace) -> CommandResult:
    """Calibrate, and print the results."""

    @contextmanager
    def begun(text: str) -> Iterator[Show]:
        arguments.closing_line = (
            f'What was done is in {arguments.catalogue}: the same command continues from there.'
        )
        try:
            with progress_bar(text) as show:
                yield show
        except KeyboardInterrupt:
            ERRORS.print('Ending the workers, which takes some seconds. What was done is kept.')
            raise

    if arguments.imus is not None:
        options.refuse_with_imus(arguments, 'imu', 'serial', 'imu_topic')
    keywords = options.keywords(batch, arguments)
    done = batch(
        arguments.sources, arguments.catalogue, **keywords, progress=begun, connected=_say_where
    )
    units = done.calibrated + done.failed + done.known + done.repeated
    several = '' if units == done.recordings else f' of {units} units'
    counts = {'failed': done.known_failed, 'superseded': done.known_superseded}
    before = ', '.join(f'{count} {word}' for word, count in counts.items() if count)
    before = f' ({before})' if before else ''
    OUTPUT.print(
        f'{counted(done.recordings, "recording")}{several} in {done.seconds:.1f} s: '
        f'{done.calibrated} calibrated, {done.failed} failed, {done.known} done before{before}'
    )
    for names in done.alike:
        OUTPUT.print(f'{listed(names)} are the same recording, which counts once', markup=False)
    if done.convertible:
        count = len(done.convertible)
        endings = ', '.join(sorted({path.suffix.lower() for path in done.convertible}))
        are = 'is no recording' if count == 1 else 'are no recordings'
        OUTPUT.print(
            f'{counted(count, "file")} ({endings}) {are}; imu-calib convert makes recordings of '
            'text files and of bags of ROS 1, and imu-calib info FILE says the way for others'
        )
    OUTPUT.print(f'written to {done.catalogue}', markup=False)
    if done.known_superseded:
        OUTPUT.print(
            f'{done.known_superseded} of them were calibrated with other options '
            'since, and those results count: --retry goes back to these options'
        )
    failed = done.failed + done.known_failed
    if not failed:
        return CommandResult()
    reasons = f'imu-calib catalogue {done.catalogue} --where "status = \'failed\'"'
    message = f'{failed} without a calibration; {reasons} lists the reasons.'
    if done.known_failed:
        message += f' {done.known_failed} failed before and did not change: --retry repeats them.'
    return CommandResult(exit_code=NotObservable.exit_code, message=message)
