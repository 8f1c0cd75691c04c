"""The journal of a live session, and what is wrong with it at the moment."""

from __future__ import annotations

from ..bags import Journal
from ..cdr import Messages
from ..errors import InputError
from .shared import JournalPart


class JournalKeeper:
    """Writes a journal; what a full disk refuses is held in memory and tried again.

    Attributes:
        journal: The recording.
        trouble: Why it does not take what it is given, else empty.

    """

    def __init__(self, journal: Journal | JournalPart) -> None:
        self.journal = journal
        self.trouble = ''

    def write(self, topic: str, type_name: str, messages: Messages, now: int) -> None:
        """Keep serialised messages that came in at `now`, host time in ns."""
        try:
            self.journal.write(topic, type_name, messages, now)
        except InputError as error:
            # Held in memory, and written with the next flush that succeeds.
            self.trouble = str(error)

    def flush(self) -> bool:
        """Secure what came in; return whether the memory still takes what the disk does not."""
        try:
            self.journal.flush()
        except InputError as error:
            self.trouble = str(error)
        else:
            self.trouble = ''
        return not self.journal.overfull

    def close(self, *, finished: bool) -> bool:
        """Close the journal; return whether all of it is on the disk.

        Args:
            finished: Whether it is kept to be looked into alone; else it can be gone on with.

        """
        try:
            self.journal.close(finished=finished)
        except InputError as error:
            self.trouble = str(error)
            return False
        return True
