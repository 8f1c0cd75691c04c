"""Files of rows that commands write, .csv or .json by their ending."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from ..api.files import output_path
from ..common.errors import InputError
from ..common.files import write_by
from .outcome import finite

_ENDINGS = ('.csv', '.json')


def row_file(stated: str | None) -> Path | None:
    """Return the requested file, or None."""
    if stated is None:
        return None
    path = output_path(stated)
    if path.suffix not in _ENDINGS:
        raise InputError(f'{path}: found {path.suffix or "no ending"}, expected .csv or .json.')
    return path


def write_rows(
    path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]], whole: Any
) -> None:
    """Write rows to a .csv file, or their source as plain values to a .json file."""

    def write(file: IO[bytes]) -> None:
        text = io.TextIOWrapper(file, encoding='utf-8', newline='')
        if path.suffix == '.json':
            json.dump(finite(whole), text, indent=1, allow_nan=False)
        else:
            writer = csv.DictWriter(text, columns)
            writer.writeheader()
            for row in rows:
                writer.writerow(
                    {k: json.dumps(v) if isinstance(v, list) else v for k, v in finite(row).items()}
                )
        text.detach()

    write_by(path, write)
