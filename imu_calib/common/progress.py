"""How long work reports its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeAlias


class Show(Protocol):
    """Takes the amount done, the total, and optionally another text."""

    def __call__(self, done: int, total: int, changed: str = ...) -> None:
        """Show it."""


Progress: TypeAlias = Callable[[str], AbstractContextManager[Show]]
"""Opened with the name of the work ('reading'); yields the function to call with its progress."""


@contextmanager
def silent(_text: str) -> Iterator[Show]:
    """Show nothing."""

    def show(done: int, total: int, changed: str = '') -> None:
        """Do nothing."""

    yield show
