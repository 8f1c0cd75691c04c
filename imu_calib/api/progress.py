"""How long work tells how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeAlias


class Show(Protocol):
    """Takes what is done, the total, and perhaps another text."""

    def __call__(self, done: int, total: int, changed: str = ...) -> None:
        """Show it."""


Progress: TypeAlias = Callable[[str], AbstractContextManager[Show]]
"""Opened with what is done ('reading'); gives what is called as it is done."""


@contextmanager
def silent(_text: str) -> Iterator[Show]:
    """Show nothing."""

    def show(done: int, total: int, changed: str = '') -> None:
        """Take it, and show nothing."""

    yield show
