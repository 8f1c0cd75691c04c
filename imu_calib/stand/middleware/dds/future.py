"""A result that comes later."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


class Future:
    """rclpy's Future without await, exceptions and cancelling."""

    def __init__(self) -> None:
        self._done = False
        self._result: Any = None
        self._callbacks: list[Callable[[Future], Any]] = []

    def done(self) -> bool:
        """Return whether the result is available."""
        return self._done

    def result(self) -> Any:
        """Return the result, None before it is available."""
        return self._result

    def set_result(self, result: Any) -> None:
        """Set the result."""
        self._result, self._done = result, True
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call back with this future when it is done, or now if it is."""
        if self._done:
            callback(self)
        else:
            self._callbacks.append(callback)
