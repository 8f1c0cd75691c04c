"""Timers on any clock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from .clock import Clock


class Timer:
    """Calls back once per period of its clock; missed calls are skipped."""

    def __init__(self, period_ns: int, callback: Callable[[], Any], clock: Clock) -> None:
        self.timer_period_ns = period_ns
        self.callback = callback
        self.clock = clock
        self._cancelled = False
        self._last = clock.nanoseconds()
        self._next = self._last + period_ns

    def cancel(self) -> None:
        """Stop the timer."""
        self._cancelled = True

    def reset(self) -> None:
        """Restart: the next call is one period from now."""
        self._cancelled = False
        self._last = self.clock.nanoseconds()
        self._next = self._last + self.timer_period_ns

    def time_until_next_call(self) -> int | None:
        """Return nanoseconds, None if it is stopped."""
        return None if self._cancelled else self._next - self.clock.nanoseconds()

    def execute(self) -> bool:
        """Call back if it is due; return whether it was."""
        now = self.clock.nanoseconds()
        if now < self._last:
            # The clock jumped back: simulated time restarted.
            self._next = now + self.timer_period_ns
        self._last = now
        if self._cancelled or now < self._next:
            return False
        behind = (now - self._next) // max(1, self.timer_period_ns)
        self._next += (behind + 1) * self.timer_period_ns
        self.callback()
        return True
