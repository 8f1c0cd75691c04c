"""Holds and turns of a session in a text file: written as found, edited by a person, obeyed.

The columns are `kind,start,end,attitude`: times in s after the first sample of the IMU.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from ..common.errors import InputError
from ..common.files import read_text, user_path, write_whole

_SHORTEST = 1.0  #: s: the settling of a shorter hold costs more than it gives.
_ROUNDED = 0.05  #: s: a hold that is found may be half a sample shorter, at 10 Hz or faster.
_HEADINGS = ('kind', 'start', 'end', 'attitude')


class SegmentKind(str, Enum):
    """Kind of a segment, as a file names it."""

    HOLD = 'hold'
    TURN = 'turn'


@dataclass(frozen=True)
class ListedSegment:
    """A hold or a turn in a file."""

    kind: SegmentKind  #: What it is.
    start: float  #: s after the first sample of the IMU.
    end: float  #: s, likewise.
    attitude: str = ''  #: For people: what is up.


@dataclass(frozen=True)
class ListedSegments:
    """The holds and turns to use, in order of time."""

    where: str  #: The file.
    segments: tuple[ListedSegment, ...]  #: All of them.
    lines: tuple[int, ...]  #: Line of each in the file.

    def of_kind(self, kind: SegmentKind) -> ListedSegments:
        """Return those of a kind."""
        kept = [k for k, one in enumerate(self.segments) if one.kind is kind]
        return replace(
            self,
            segments=tuple(self.segments[k] for k in kept),
            lines=tuple(self.lines[k] for k in kept),
        )

    def refusal(self, index: int, key: str, found: str, expected: str) -> InputError:
        """Return the refusal of a segment: its line, the key, what was found and expected."""
        return InputError(
            f'{self.where}, line {self.lines[index]}: {key}: found {found}, expected {expected}.'
        )


def write_segments(path: str | Path, segments: Sequence[ListedSegment]) -> None:
    """Write holds and turns to a file, times to a millisecond.

    Raises:
        InputError: It cannot be written, or is there: it may hold what a person edited.
    """
    if user_path(path).exists():
        raise InputError(
            f'{path} exists, and may hold edits of yours. Name another file, or remove it.'
        )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(_HEADINGS)
    for one in segments:
        writer.writerow([one.kind.value, f'{one.start:.3f}', f'{one.end:.3f}', one.attitude])
    write_whole(user_path(path), text.getvalue())


def read_segments(path: str | Path) -> ListedSegments:
    """Read holds and turns from a file."""
    file = user_path(path)
    try:
        rows = list(csv.reader(io.StringIO(read_text(file)), skipinitialspace=True, strict=True))
    except csv.Error as error:
        raise InputError(f'{file}: found no lines of columns ({error}).') from None
    headings = [name.strip() for name in rows[0]] if rows else []
    if missing := [name for name in _HEADINGS[:3] if name not in headings]:
        raise InputError(
            f'{file}, line 1: {missing[0]}: found the columns {", ".join(headings) or "none"}, '
            f'expected {", ".join(_HEADINGS)}, as `imu-calib info BAG --segments FILE` writes them.'
        )
    found = []
    for number, row in enumerate(rows[1:], start=2):
        if any(cell.strip() for cell in row):
            if any(row[len(headings) :]):
                raise InputError(
                    f'{file}, line {number}: found {len(row)} cells, expected '
                    f'{len(headings)}: write decimals with a point, not with a comma.'
                )
            cells = dict(zip(headings, map(str.strip, row), strict=False))
            found.append((_segment(f'{file}, line {number}', cells), number))
    found.sort(key=lambda one: one[0].start)
    listed = ListedSegments(
        str(file), tuple(one for one, _ in found), tuple(number for _, number in found)
    )
    if not found:
        raise InputError(f'{file}: found no segment, expected a hold in each line after the first.')
    for kind in SegmentKind:
        _refuse_overlaps(listed.of_kind(kind))
    return listed


def _segment(where: str, cells: dict[str, str]) -> ListedSegment:
    kinds = [kind.value for kind in SegmentKind]
    if cells.get('kind', '') not in kinds:
        raise InputError(
            f'{where}: kind: found {cells.get("kind", "")!r}, expected {" or ".join(kinds)}.'
        )
    start, end = (_seconds(where, key, cells.get(key, '')) for key in ('start', 'end'))
    if not end - start >= _SHORTEST - _ROUNDED:
        raise InputError(
            f'{where}: end: found {end:g}, expected {start + _SHORTEST:g} or more: '
            f'{_SHORTEST:g} s after the start.'
        )
    return ListedSegment(SegmentKind(cells['kind']), start, end, cells.get('attitude', ''))


def _seconds(where: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise InputError(
            f'{where}: {key}: found {text!r}, expected s after the first sample, 0 or more.'
        )
    return value


def _refuse_overlaps(listed: ListedSegments) -> None:
    """Refuse segments of one kind that begin before the one before them ends."""
    for k, (before, one) in enumerate(zip(listed.segments, listed.segments[1:], strict=False)):
        if one.start < before.end:
            raise listed.refusal(
                k + 1,
                'start',
                f'{one.start:g}',
                f'{before.end:g} or more: the {before.kind.value} of line {listed.lines[k]} ends '
                'there',
            )
