"""Files of rows that commands write, .csv or .json by their ending."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..api.outputs import output_path
from ..errors import InputError
from .outcome import finite

_ENDINGS = ('.csv', '.json')


def row_file(stated: str | None) -> Path | None:
    """Return the requested file, or None.

    Raises:
        InputError: It has another ending, exists or cannot be written.
    """
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
    with path.open('w', encoding='utf-8', newline='') as file:
        if path.suffix == '.json':
            json.dump(finite(whole), file, indent=1, allow_nan=False)
            return
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for row in rows:
            writer.writerow(
                {k: json.dumps(v) if isinstance(v, list) else v for k, v in finite(row).items()}
            )
