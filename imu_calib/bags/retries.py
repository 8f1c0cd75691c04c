"""Requests over a network, which are made again where the connection is lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from ..errors import InputError

Result = TypeVar('Result')

TRIES = 3
"""Of a request: a connection that is lost once is nothing, one that is lost three times is."""
PAUSE = 0.5
"""s before the second try; doubled before the third: a server that restarts takes about that."""


def tried(url: str, request: Callable[[], Result]) -> Result:
    """Return what a request gives; one whose connection is lost is made again.

    Raises:
        FileNotFoundError: There is nothing.
        InputError: No right to read, or the connection was lost `TRIES` times.

    """
    lost: Exception | None = None
    for again in range(TRIES):
        if again:
            time.sleep(PAUSE * 2 ** (again - 1))
        try:
            return request()
        except Exception as error:
            # Each protocol has errors of its own for a connection that is lost.
            lost = _behind(error)
            if isinstance(lost, FileNotFoundError):
                raise
            if _is_refusal(lost):
                raise InputError(
                    f'{url}: reading it is not permitted ({lost}). Credentials come from where the '
                    'protocol looks for them (AWS_PROFILE, AWS_ACCESS_KEY_ID and so on for s3).'
                ) from None
    raise InputError(
        f'{url}: not read after {TRIES} tries ({type(lost).__name__}: {lost}). Check the network, '
        'and run the command again.'
    ) from lost


def _behind(error: Exception) -> Exception:
    """Return what an error is about: over HTTP a server that is gone is a file that is not found.

    What S3 does not find has the server's answer behind it.
    """
    cause = error.__cause__
    found = isinstance(error, FileNotFoundError) and isinstance(cause, Exception)
    return error if not found or hasattr(cause, 'response') else cause  # type: ignore[return-value]


def _is_refusal(error: Exception) -> bool:
    return (
        isinstance(error, PermissionError)
        or 'Credentials' in type(error).__name__
        or getattr(error, 'status', None) in {401, 403}
    )
