"""The calibrator from the sequencer's view: its presence, and its data of an old session."""

from __future__ import annotations

from collections.abc import Sequence

from ..common.errors import InputError

CALIBRATOR = 'the calibrator (calibration/progress)'


class Supervision:
    """Presence of a calibrator, and the steps that it has from a session that is resumed.

    Args:
        needed: Whether the table is moved only while one is present.

    Attributes:
        present: Whether the calibrator, if needed, is present.
    """

    def __init__(self, *, needed: bool) -> None:
        self.needed = needed
        self.present = not needed
        self._resumes = False
        self._done: frozenset[int] | None = None

    def resume(self) -> None:
        """Make the next start run only the steps that the calibrator lacks.

        Raises:
            InputError: No calibrator is needed.
        """
        if not self.needed:
            raise InputError(
                'To resume a session the parameter supervised must be true: the calibrator reports '
                'which steps it lacks.'
            )
        self._resumes = True

    def skip_done(self, seen: int, repeat_steps: Sequence[int]) -> None:
        """Set the steps that the calibrator has already; arguments as `Sequencer.skip_done`."""
        if self._resumes:
            self._done = frozenset(range(seen)) - frozenset(repeat_steps)

    def set_present(self, present: bool) -> None:
        """Set whether the calibrator is present; to resume a session, its steps are needed too."""
        self.present = present and not (self._resumes and self._done is None)

    def take_skipped(self) -> frozenset[int]:
        """Return the steps to skip, once: the next start runs all."""
        if not self._resumes or self._done is None:
            return frozenset()
        self._resumes = False
        return self._done
