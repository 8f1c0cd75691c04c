"""The terminal: consoles, progress bars, text that fits, warnings and notes, reports of nodes."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from textwrap import fill
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ..common.errors import InputError
from ..common.progress import Show, silent
from ..common.units import as_options, counted
from ..live.rules import Severity

if TYPE_CHECKING:
    from ..calibration.calibration import Calibration

WIDEST_LINE = 100
"""Characters of a line of text, at most; of tables, too, where the output is a file."""


class _Console(Console):
    """Prints options in place of the suite's keywords."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does."""
        super().print(*(as_options(o) if isinstance(o, str) else o for o in objects), **options)


class _Output(_Console):
    """Lets `dispatch` end a command whose output is no longer read."""

    def on_broken_pipe(self) -> None:
        """Raise the error again: rich would end the process with exit code 1."""
        raise  # noqa: PLE0704 - called where it is handled

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does; in files without the blanks that fill the last column."""
        if self.is_terminal or not any(isinstance(one, Table) for one in objects):
            super().print(*objects, **options)
            return
        with self.capture() as shown:
            super().print(*objects, **options)
        lines = shown.get().split('\n')
        self.file.write('\n'.join(line.rstrip() for line in lines))
        self.file.flush()


class _Errors(_Console):
    """Prints nothing where stderr takes no more: the exit code still shows the outcome."""

    def on_broken_pipe(self) -> None:
        """Continue without output."""
        self.quiet = True

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does; of a full disk nothing is said, since there is no place for it."""
        try:
            super().print(*objects, **options)
        except OSError:
            self.quiet = True


# Names by users are not emoji codes, even between colons.
OUTPUT = _Output(soft_wrap=True, highlight=False, emoji=False)
if not OUTPUT.is_terminal:
    OUTPUT.width = WIDEST_LINE
_WIDEST = 10_000  #: Characters of a line, more than any table has.
ERRORS = _Errors(stderr=True, soft_wrap=True, highlight=False, emoji=False)


@contextmanager
def progress_bar(text: str) -> Iterator[Show]:
    """Show a bar on stderr, removed when done; nothing if stderr is not a terminal.

    Yields:
        A function to call with the amount done, the total, and optionally another text.
    """
    if not ERRORS.is_terminal:
        with silent(text) as show_nothing:
            yield show_nothing
        return
    # Loaded only for a bar: it takes as long as the rest of the terminal.
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=ERRORS, transient=True) as bar:
        task = bar.add_task(text, total=None)

        def show(done: int, total: int, changed: str = text) -> None:
            bar.update(task, completed=done, total=total, description=changed)

        yield show


def print_whole(table: Table) -> None:
    """Print a table at its own width: a narrow terminal wraps it, and no cell is cut."""
    wide = _Output(
        file=OUTPUT.file,
        width=_WIDEST,
        soft_wrap=True,
        highlight=False,
        force_terminal=OUTPUT.is_terminal,
    )
    wide.print(table)


# Reports of the nodes on the terminal: at once, and each sentence once.

_STANDS = 1.0
"""s after which a report is not transient: at the start every node lacks something briefly."""

_STARTS = 5.0
"""The same for simulated hardware: only a busy machine can delay the start, not a missing
device."""

_NEEDED = {'imu_node: port': 0.5, 'imu_node: format': 0.0}
"""Reports that end a session when they have lasted this long, s: another program may still be
closing the port. A silent device may still begin to send."""

_ENDS_IT = frozenset({'turntable_node: plan', 'calibrator_node: calibration'})
"""Faults of these end the command, which reports them itself."""


_PASSED_ON = 'The calibrator has failed: '
"""Beginning of what turntable_node passes on of it: the command's own error says the same."""


class NothingComes(InputError):
    """The device is missing, or differs from its description."""


_STYLES = {Severity.OK: 'green', Severity.WARN: 'yellow', Severity.ERROR: 'red'}


@dataclass
class _NodeState:
    """The last report on one part of a node, its start, and what of it was shown."""

    level: Severity
    text: str
    since: float
    shown: str = ''


class NodeReports:
    """Receives /diagnostics, and shows important reports on the standard error output.

    Args:
        real: Whether there is hardware that could be missing.
    """

    def __init__(self, *, real: bool) -> None:
        #: Names of the monitored nodes: others may be in the domain.
        self.nodes: Collection[str] = ('imu_node',)
        self._real = real
        self._patience = _STANDS if real else _STARTS
        self._parts: dict[str, _NodeState] = {}
        self._came = False

    def receive(self, message: Any) -> None:
        """Note each status of a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            came = any(v.key == 'bytes' and v.value != '0' for v in status.values)
            self.note(status.name, status.level[0], status.message, came=came)

    def note(self, name: str, level: int, text: str, *, came: bool = False) -> None:
        """Note a report on one part of a node; `came`: whether bytes have come from the device."""
        if name.partition(': ')[0] not in self.nodes or name in _ENDS_IT:
            return
        if name.startswith('turntable_node: ') and text.startswith(_PASSED_ON):
            return
        level = Severity(min(level, Severity.ERROR))
        before = self._parts.get(name)
        if before is None or before.level is not level:
            shown = '' if before is None else before.shown
            self._parts[name] = _NodeState(level, text, time.monotonic(), shown)
        else:
            before.text = text
        self._came |= came

    def text(self, name: str) -> str:
        """Return the last report on a part of a node; empty before the first."""
        part = self._parts.get(name)
        return '' if part is None else part.text

    def show(self) -> None:
        """Show new reports.

        Raises:
            NothingComes: The device does not open, or its data does not match the files.
        """
        now = time.monotonic()
        for name, part in self._parts.items():
            stands = now - part.since
            if part.level is Severity.WARN and stands < self._patience:
                continue
            if part.level is Severity.OK and (not part.shown or stands < _STANDS):
                continue
            # Each of several units is needed like a single one.
            own = name.rpartition('/')[2]
            lost = self._real and part.level is Severity.ERROR and own in _NEEDED
            if lost and not (self._came and own == 'imu_node: port'):
                if stands >= _NEEDED[own]:
                    raise NothingComes(part.text)
                continue
            if part.text != part.shown:
                node = name.partition(': ')[0]
                style = _STYLES[part.level]
                ERRORS.print(f'{node}: {part.text}', style=style, markup=False)
                part.shown = '' if part.level is Severity.OK else part.text


_MARK = '  - '
_HEADING = 2  #: Lines of a title and the empty one above it.
ROOM = 6
"""Lines of warnings and notes with which a result of 24 parameters fits a screen of 40."""
_SHOWN = 5
"""Warnings and notes that are shown without --verbose, and all warnings. A choice: the first ones
change the numbers most."""


def show_calibration(
    calibration: Calibration,
    truth: Calibration | None = None,
    *,
    verbose: bool,
    budget: bool = False,
) -> None:
    """Print the parameters, the data and the verdicts; with `verbose` all that the file holds."""
    # Loaded here: most commands show no calibration.
    from ..reports.assessment import assess, summary
    from ..reports.provenance import details, overview

    print_parts(overview(calibration, truth, budget=budget))
    if (limits := calibration.imu.specification) is not None:
        print_text(summary(assess(calibration, limits)))
    if verbose:
        print_parts(details(calibration, truth))


def sentence_list(title: str, sentences: tuple[str, ...] | list[str]) -> None:
    """Print sentences below a title; nothing without sentences."""
    if not sentences:
        return
    OUTPUT.print(f'\n{title}', style='bold')
    for sentence in sentences:
        print_text(sentence, _MARK)


def list_lines(sentences: Sequence[str]) -> int:
    """Return the number of lines that `sentence_list` prints."""
    if not sentences:
        return 0
    return _HEADING + sum(len(_filled(text, _MARK)) for text in sentences)


def print_text(text: str, mark: str = '') -> None:
    """Print text in lines that fit; lines after the first are set in below the mark."""
    for line in _filled(text, mark):
        OUTPUT.print(line, markup=False)


def _filled(text: str, mark: str) -> list[str]:
    return [
        shown
        for line in as_options(text).split('\n')
        for shown in fill(
            line,
            min(OUTPUT.width, WIDEST_LINE),
            initial_indent=mark,
            subsequent_indent=' ' * len(mark),
            break_long_words=False,
            break_on_hyphens=False,
        ).split('\n')
    ]


def print_parts(parts: Iterable[Table | str]) -> None:
    """Print tables and text, one below the other."""
    for part in parts:
        if isinstance(part, str):
            print_text(part)
        else:
            OUTPUT.print(part)


def print_findings(findings: Sequence[str], *, verbose: bool, room: int | None = None) -> None:
    """Print warnings and notes, the most important first: without `verbose` the first five.

    Warnings are never left out. Where there are none, those notes are shown that fit into `room`
    lines, the first in any case.
    """
    # Loaded here, with numpy: help and wrong usage need none.
    from ..common.finding import is_warning, without_label

    warnings = [without_label(text) for text in findings if is_warning(text)]
    notes = [text for text in findings if not is_warning(text)]
    sentence_list('Warnings', warnings)
    shown = notes if verbose else notes[: max(_SHOWN - len(warnings), 0)]
    if room is not None and not verbose and not warnings:
        taken = list(accumulate(len(_filled(text, _MARK)) for text in notes))
        # All of them need no line that says how many more there are.
        if taken and taken[-1] > room + 1:
            shown = shown[: max(sum(lines <= room for lines in taken), 1)]
        else:
            shown = notes
    sentence_list('Notes', shown)
    if len(shown) < len(notes):
        rest = len(notes) - len(shown)
        OUTPUT.print(f'  {f"{rest} more" if shown else counted(rest, "note")}: --verbose')
