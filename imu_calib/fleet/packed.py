"""Arrays and texts as one compressed text for the page's script.

    zlib( length of the head, 4 bytes | head, JSON | arrays, one after the other )

in base64. The head lists the arrays with type and length, and contains the texts. The bytes of an
array are stored in planes, lowest first: neighbours are similar and compress well. Numbers have
only the precision that is shown: a page on 5000 units is read over network drives and on phones.
"""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats
from .results import Dates

NO_DAY = -(2**31)
"""Code of a missing date."""
STEP = 0.05
"""Resolution in stated deviations: of values, and of normal scores. A judgement: a pixel."""
_CODES = 254
"""Codes of a standard deviation, in equal ratios: 2 % each for a range of a factor of 100."""
_MANTISSA = 12
"""Bits kept of other numbers: relative precision 1e-4."""
_KINDS = {'u1': 'Uint8Array', 'i1': 'Int8Array', 'i4': 'Int32Array', 'f4': 'Float32Array'}


def pack(arrays: Mapping[str, NDArray[Any]], texts: Mapping[str, object]) -> str:
    """Return packed arrays of uint8, int8, int32 or float32 with texts (JSON values)."""
    head: dict[str, object] = {'texts': texts}
    listed, parts = [], []
    for name, array in arrays.items():
        flat = np.ascontiguousarray(array).reshape(-1)
        listed.append([name, _KINDS[flat.dtype.str[1:]], len(flat)])
        planes = flat.astype(flat.dtype.newbyteorder('<')).view(np.uint8)
        parts.append(planes.reshape(-1, flat.dtype.itemsize).T.tobytes())
    head['arrays'] = listed
    # JSON has no NaN; a page with one would not open.
    header = json.dumps(head, ensure_ascii=False, separators=(',', ':'), allow_nan=False)
    coded = header.encode('utf-8', 'replace')
    content = struct.pack('<I', len(coded)) + coded + b''.join(parts)
    return base64.b64encode(zlib.compress(content, 6)).decode('ascii')


def distinct(texts: Sequence[str]) -> tuple[list[str], NDArray[np.int32]]:
    """Return the distinct texts, and the index of each text."""
    places: dict[str, int] = {}
    index = [places.setdefault(text, len(places)) for text in texts]
    return list(places), np.array(index, np.int32)


def minutes(dates: Dates) -> NDArray[np.int32]:
    """Return dates as minutes since 1970."""
    content = dates.astype('M8[m]')
    counted = np.clip(content.astype(np.int64), NO_DAY + 1, 2**31 - 1)
    return np.where(np.isnat(content), NO_DAY, counted).astype(np.int32)


def short(values: Floats) -> NDArray[np.float32]:
    """Return numbers with the shown digits, so that they compress well."""
    with np.errstate(over='ignore'):
        found = np.ascontiguousarray(values, np.float32)
    drop = 23 - _MANTISSA
    bits = found.view(np.uint32)
    rounded = (bits + np.uint32(1 << (drop - 1))) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    # Rounding the bits of infinity or NaN would change them to other values.
    return np.where(np.isfinite(found), rounded.view(np.float32), found)


def scores(values: Floats) -> NDArray[np.int8]:
    """Return normal scores in steps, -128 for none; larger ones are at the chart's edge."""
    steps = np.clip(np.nan_to_num(values, nan=0.0) / STEP, -127, 127).round()
    return np.where(np.isnan(values), -128, steps).astype(np.int8)


def deviations(std: Floats) -> tuple[NDArray[np.uint8], list[list[float]]]:
    """Return standard deviations as codes by equal ratios.

    Args:
        std: (n, m) NaN or zero for none.

    Returns:
        (m, n) codes, 0 for none; for each column [smallest, logarithm of the ratio of two codes].
    """
    codes = np.zeros(std.shape[::-1], np.uint8)
    scales = []
    for k, column in enumerate(std.T):
        known = np.isfinite(column) & (column > 0)
        if not known.any():
            scales.append([1.0, 0.0])
            continue
        low, high = float(column[known].min()), float(column[known].max())
        ratio = np.log(high / low) / (_CODES - 1)
        steps = np.log(column[known] / low) / ratio if ratio > 0 else np.zeros(known.sum())
        codes[k, known] = 1 + np.rint(steps).astype(np.uint8)
        scales.append([low, float(ratio)])
    return codes, scales


def packed_differences(values: Floats, std: Floats) -> tuple[NDArray[np.int32], list[float]]:
    """Return values in steps of a share of their smallest deviation, as differences.

    Args:
        values: (n, m); values that are not finite repeat the previous one.
        std: (n, m) their standard deviations.

    Returns:
        (m, n) differences, whose sums wrap at 32 bits; and the step of each column.
    """
    found = np.zeros(values.shape[::-1], np.int32)
    steps = []
    for k, (column, deviation) in enumerate(zip(values.T, std.T, strict=True)):
        known = np.isfinite(column)
        filled = np.where(known, column, 0.0)
        meant = np.isfinite(deviation) & (deviation > 0)
        reach = float(np.abs(filled).max(initial=0.0))
        step = max(
            STEP * float(deviation[meant].min()) if meant.any() else 0.0, reach / (2**31 - 2)
        )
        steps.append(step or 1.0)
        counted = np.rint(filled / steps[-1]).astype(np.int64)
        last = np.maximum.accumulate(np.where(known, np.arange(len(column)), -1))
        held = np.where(last >= 0, counted[np.maximum(last, 0)], 0)
        found[k] = np.diff(held, prepend=0).astype(np.int64).astype(np.uint32).view(np.int32)
    return found, steps
