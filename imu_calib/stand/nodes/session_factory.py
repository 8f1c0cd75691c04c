"""Create the sessions of a calibrator, each time with a new journal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ...recordings.rosbag2 import Kind
from ...recordings.writer import Journal
from ...session.metadata import mount_description, unit_description
from .parameters import StatedUnit
from .sessions import Sessions
from .turntable_state import STATE_TYPE


class SessionFactory:
    """Opens journals, one after the other, and the sessions of all units with each.

    Args:
        units: What is calibrated.
        description: Set-up that every journal contains.
        journal: Folder of the first; later ones have a number at the end of their names.
        state: Full name of turntable/state; None without a table.
        progress: Called now and then with the read share of a journal that is resumed, 0 to 1.
    """

    def __init__(
        self,
        units: Sequence[StatedUnit],
        description: Mapping[str, str],
        journal: Path,
        state: str | None,
        progress: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._units = units
        self._description = description
        self._journal = journal
        self._state = state
        self._progress = progress
        self._count = 0

    def begin(self, common: Mapping[Kind, str], of_units: Sequence[Mapping[Kind, str]]) -> Sessions:
        """Begin sessions, or resume those in the journal.

        Args:
            common: Full names of the table's topics by content.
            of_units: The same of each unit.

        Raises:
            InputError: The journal cannot be written, or holds another set-up.
        """
        path = self._journal
        if self._count:
            path = path.with_name(f'{path.name}_{self._count + 1}')
        self._count += 1
        kinds = {topic: kind for names in (common, *of_units) for kind, topic in names.items()}
        journal = Journal(path, self._described(of_units), kinds, self._progress)
        if self._state is not None:
            journal.add_latched_topic(self._state, STATE_TYPE)
        return Sessions(self._units, of_units, journal, common)

    def _described(self, of_units: Sequence[Mapping[Kind, str]]) -> dict[str, str]:
        """Return the set-up, with that of each of several units."""
        description = dict(self._description)
        for unit, topics in zip(self._units, of_units, strict=True):
            if unit.name:
                topic = topics[Kind.IMU]
                description |= unit_description(topic, unit.imu, unit.setup.serial_number)
                if unit.mount is not None:
                    description |= mount_description(topic, unit.mount)
        return description
