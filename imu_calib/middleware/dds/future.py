"""A result that comes later."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


class Future:
    """rclpy's Future without await."""

    def __init__(self) -> None:
        self._done = self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Tell whether the result is there, or will never be."""
        return self._done or self._cancelled

    def cancelled(self) -> bool:
        """Tell whether it was cancelled."""
        return self._cancelled

    def cancel(self) -> None:
        """Give it up."""
        if not self._done:
            self._cancelled = True
            self._call()

    def result(self) -> Any:
        """Return the result, None before it is there; raise the exception set instead."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """Return the exception set instead of a result."""
        return self._exception

    def set_result(self, result: Any) -> None:
        """Set the result."""
        self._result, self._done = result, True
        self._call()

    def set_exception(self, exception: BaseException) -> None:
        """Set an exception instead of a result."""
        self._exception, self._done = exception, True
        self._call()

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call back with this future once it is done, at once where it is."""
        if self.done():
            callback(self)
        else:
            self._callbacks.append(callback)

    def _call(self) -> None:
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)
