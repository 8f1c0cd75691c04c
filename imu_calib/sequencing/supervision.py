"""The calibrator as the sequencer knows it: whether it is there, and what it has from before."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InputError

CALIBRATOR = 'the calibrator (calibration/progress)'


class Supervision:
    """Whether a calibrator listens, and which steps it has from a session that is gone on with.

    Args:
        needed: Whether the table is led only while one listens.

    Attributes:
        heard: Whether the table may be led as far as the calibrator goes.

    """

    def __init__(self, *, needed: bool) -> None:
        self.needed = needed
        self.heard = not needed
        self._resumes = False
        self._done: frozenset[int] | None = None

    def resume(self) -> None:
        """Have the next start run what the calibrator lacks alone.

        Raises:
            InputError: No calibrator is listened to.

        """
        if not self.needed:
            raise InputError(
                'To resume a session the parameter supervised must be true: the calibrator says '
                'which steps it lacks.'
            )
        self._resumes = True

    def skip_done(self, seen: int, repeat_steps: Sequence[int]) -> None:
        """Take what the calibrator has from before; arguments as `Sequencer.skip_done`."""
        if self._resumes:
            self._done = frozenset(range(seen)) - frozenset(repeat_steps)

    def hear(self, present: bool) -> None:
        """Take whether the calibrator is there; to go on with a session what it has is needed."""
        self.heard = present and not (self._resumes and self._done is None)

    def left_out(self) -> frozenset[int]:
        """Return the steps that need not be run again, once: the next start runs all."""
        if not self._resumes or self._done is None:
            return frozenset()
        self._resumes = False
        return self._done
