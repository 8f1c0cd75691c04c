"""The terminal: consoles, progress bars, and formats of numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.table import Table

from ..common.parallel import Show, silent

_WIDTH_OF_A_FILE = 160
"""Characters of a line in a file: wide enough for every table."""


def as_options(sentence: str) -> str:
    """Return a sentence with the names of keywords, as `imu_topic`, as options, --imu-topic."""
    return re.sub(r'`([a-z_]+)`', lambda name: f'--{name[1].replace("_", "-")}', sentence)


class _Console(Console):
    """Prints options in place of the suite's keywords."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as rich does."""
        super().print(*(as_options(o) if isinstance(o, str) else o for o in objects), **options)


class _Output(_Console):
    """Lets `dispatch` end a command whose output is no longer read."""

    def on_broken_pipe(self) -> None:
        """Raise the error again: rich would end the process with exit code 1.

        Raises:
            BrokenPipeError: Always.
        """
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
    OUTPUT.width = _WIDTH_OF_A_FILE
_WIDEST = 10_000
"""Characters of a line, more than any table has."""
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


def sentence_list(title: str, sentences: tuple[str, ...] | list[str]) -> None:
    """Print sentences below a title; nothing without sentences."""
    if not sentences:
        return
    OUTPUT.print(f'\n{title}', style='bold')
    for sentence in sentences:
        OUTPUT.print(f'  - {sentence}', markup=False)
