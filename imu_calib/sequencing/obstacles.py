"""Why a table may not be led, and why one that was led stands."""

from __future__ import annotations

_NO_FEEDBACK = 'There are no joint states from the table.'


class Obstacles:
    """What keeps a plan from being started.

    Attributes:
        emergency: What a start is answered while the emergency stop is on; else empty.
        feedback: What is wrong with the joint states; empty while they are sound.
        calibrator: What keeps the calibrator from taking a session in; empty where nothing does.

    """

    def __init__(self) -> None:
        self.emergency = ''
        self.feedback = _NO_FEEDBACK
        self.calibrator = ''
        self._forbidden: dict[str, str] = {}

    def forbid(self, what: str, why: str) -> bool:
        """Take who forbids to lead the table, and why; empty: no longer. Return whether anew."""
        if why == self._forbidden.get(what, ''):
            return False
        if not why:
            del self._forbidden[what]
            return False
        self._forbidden[what] = why
        return True

    @property
    def forbidden(self) -> str:
        """Why others forbid to lead the table, in sentences; empty where none does."""
        return ' '.join(self._forbidden.values())


class Reasons:
    """Why the table stands, and what has happened to it since.

    Attributes:
        reason: Why it stands, or goes home without the calibrator's word; else empty.
        fault: Whether something went wrong since the last start, and the stop was not asked for.

    """

    def __init__(self) -> None:
        self.reason = ''
        self.fault = False
        self._remarks: dict[str, str] = {}

    def begin(self, reason: str = '', *, fault: bool = False) -> None:
        """Forget what was, and give a new reason."""
        self.reason, self.fault = reason, fault
        self._remarks.clear()

    def remark(self, what: str, text: str) -> None:
        """Add what went wrong while it stood, once by its name."""
        self.fault = True
        self._remarks[what] = text

    @property
    def words(self) -> str:
        """All of it in sentences."""
        remarks = [text for text in self._remarks.values() if text != self.reason]
        return ' '.join([*filter(None, [self.reason]), *remarks])
