"""Repeat network requests whose connection is lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from ..common.errors import InputError

Result = TypeVar('Result')

TRIES = 3
"""Tries of a request: a connection may be lost once, but three times is an error."""
PAUSE = 0.5
"""s before the second try; doubled before the third: about the restart time of a server."""


def with_retries(url: str, request: Callable[[], Result]) -> Result:
    """Return the result of a request; repeat it if the connection is lost.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: No right to read, or the connection was lost `TRIES` times.
    """
    lost: Exception | None = None
    for again in range(TRIES):
        if again:
            time.sleep(PAUSE * 2 ** (again - 1))
        try:
            return request()
        except Exception as error:
            # Each protocol has its own exceptions for a lost connection.
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
    """Return the cause of an error: over HTTP, a lost server appears as a file that is not found.

    For a missing file on S3, the cause is the server's reply.
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
