"""Reasons against starting a plan, and reasons for a stop."""

from __future__ import annotations

_NO_FEEDBACK = 'There are no joint states from the table.'


class Obstacles:
    """Obstacles to starting a plan.

    Attributes:
        emergency: Reply to a start during the emergency stop; else empty.
        feedback: Fault of the joint states; empty while they are valid.
        calibrator: Fault of the calibrator; empty without.
    """

    def __init__(self) -> None:
        self.emergency = ''
        self.feedback = _NO_FEEDBACK
        self.calibrator = ''
        self._forbidden: dict[str, str] = {}

    def forbid(self, what: str, why: str) -> bool:
        """Set who forbids motion and why; empty: no longer. Return whether this is new."""
        if why == self._forbidden.get(what, ''):
            return False
        if not why:
            del self._forbidden[what]
            return False
        self._forbidden[what] = why
        return True

    @property
    def forbidden(self) -> str:
        """Why others forbid motion, in sentences; otherwise empty."""
        return ' '.join(self._forbidden.values())


class Reasons:
    """Reason for a stop, and events since.

    Attributes:
        reason: Why the table stopped, or goes home without the calibrator's reply; else empty.
        fault: Whether there was a fault since the last start, not a requested stop.
    """

    def __init__(self) -> None:
        self.reason = ''
        self.fault = False
        self._remarks: dict[str, str] = {}

    def begin(self, reason: str = '', *, fault: bool = False) -> None:
        """Reset, and set a new reason."""
        self.reason, self.fault = reason, fault
        self._remarks.clear()

    def remark(self, what: str, text: str) -> None:
        """Add a fault that occurred at rest, once by its name."""
        self.fault = True
        self._remarks[what] = text

    @property
    def words(self) -> str:
        """Return all of it in sentences."""
        remarks = [text for text in self._remarks.values() if text != self.reason]
        return ' '.join([*filter(None, [self.reason]), *remarks])
