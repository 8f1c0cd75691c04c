"""The order of a session's outputs in its equations; it is defined in this module only.

Six for each dwell (gyros x y z, accelerometers x y z), then three for each turn (gyros), then three
for each move (angles), then three for each turn whose accelerometers are used, then three for each
move whose accelerometers are used (velocities).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..common.stream import Floats

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class OutputLayout:
    """The layout of a session's outputs."""

    dwells: int  #: Their number.
    turns: int = 0  #: Likewise.
    moves: int = 0  #: Likewise.
    turns_with_accels: tuple[int, ...] = ()  #: Turns whose accelerometers are used.
    moves_with_accels: tuple[int, ...] = ()  #: Moves whose accelerometers are used.

    def __len__(self) -> int:
        threes = self.turns + self.moves + len(self.turns_with_accels) + len(self.moves_with_accels)
        return 6 * self.dwells + 3 * threes

    @cached_property
    def dwell(self) -> Indices:
        """Of the dwells, (s, 6): gyros, then accelerometers."""
        return np.arange(6 * self.dwells).reshape(-1, 6)

    @cached_property
    def turn(self) -> Indices:
        """Of the turns' gyros, (t, 3)."""
        return 6 * self.dwells + np.arange(3 * self.turns).reshape(-1, 3)

    @cached_property
    def move(self) -> Indices:
        """Of the moves' angles, (m, 3)."""
        return 6 * self.dwells + 3 * self.turns + np.arange(3 * self.moves).reshape(-1, 3)

    @cached_property
    def turn_accels(self) -> Indices:
        """Of the turns' accelerometers, (f, 3)."""
        before = 6 * self.dwells + 3 * (self.turns + self.moves)
        return before + np.arange(3 * len(self.turns_with_accels)).reshape(-1, 3)

    @cached_property
    def velocity(self) -> Indices:
        """Of the moves' velocities, (v, 3)."""
        count = 3 * len(self.moves_with_accels)
        return len(self) - count + np.arange(count).reshape(-1, 3)

    @cached_property
    def moving(self) -> Indices:
        """Of all outputs of moves: angles, velocities."""
        return np.concatenate([self.move.ravel(), self.velocity.ravel()])

    @cached_property
    def gyros(self) -> Indices:
        """Of all outputs of gyros, in groups of three: dwells, turns, moves."""
        return np.concatenate([self.dwell[:, :3].ravel(), self.turn.ravel(), self.move.ravel()])

    @cached_property
    def accels(self) -> Indices:
        """Of all outputs of accelerometers, in groups of three: dwells, turns, moves."""
        parts = (self.dwell[:, 3:], self.turn_accels, self.velocity)
        return np.concatenate([part.ravel() for part in parts])

    @cached_property
    def _turns_with_accels(self) -> Indices:
        return np.array(self.turns_with_accels, dtype=np.intp)

    @cached_property
    def _moves_with_accels(self) -> Indices:
        return np.array(self.moves_with_accels, dtype=np.intp)

    @cached_property
    def channels(self) -> Indices:
        """Channel of each output, 0 to 5; an axis of a move counts as one."""
        result = np.empty(len(self), dtype=np.intp)
        result[self.dwell] = np.arange(6)
        result[self.turn] = result[self.move] = np.arange(3)
        result[self.turn_accels] = result[self.velocity] = np.arange(3, 6)
        return result

    @cached_property
    def segment(self) -> Indices:
        """Index of each output's dwell, turn or move: numbered through in this order."""
        result = np.empty(len(self), dtype=np.intp)
        result[self.dwell] = np.arange(self.dwells)[:, None]
        result[self.turn] = self.dwells + np.arange(self.turns)[:, None]
        moves = self.dwells + self.turns + np.arange(self.moves)[:, None]
        result[self.move] = moves
        result[self.turn_accels] = self.dwells + self._turns_with_accels[:, None]
        result[self.velocity] = moves[self._moves_with_accels]
        return result

    def joined(self, dwell: Floats, turn: Floats, move: Floats) -> Floats:
        """Return values (s, 6, ...), (t, 6, ...), (m, 6, ...) in the order of the outputs.

        Accelerometers of turns and moves that are not used are left out. Of moves the angles come
        first, then the velocities.
        """
        parts = (
            (dwell, self.dwell),
            (turn[:, :3], self.turn),
            (move[:, :3], self.move),
            (turn[self._turns_with_accels, 3:], self.turn_accels),
            (move[self._moves_with_accels, 3:], self.velocity),
        )
        return np.concatenate([part.reshape(at.size, *dwell.shape[2:]) for part, at in parts])
