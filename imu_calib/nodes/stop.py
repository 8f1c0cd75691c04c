"""The emergency stop: heard from every kind of publisher, kept across restarts."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from .. import middleware as ros
from ..errors import InputError
from ..middleware import messages
from ..middleware.domain import domain_id
from ..paths import user_path
from . import qos


class StopRecord:
    """A file that exists while a stop is pressed.

    Whatever cannot be looked at counts as pressed, and so does a folder in which a stop could not
    be kept: a table that could not be kept stopped is not started.

    Args:
        folder: Takes the file; made where it is missing.
        key: Of the stand, for instance domain and full name of the node that leads it.

    """

    def __init__(self, folder: Path, key: str) -> None:
        self.path = folder / f'stop_{re.sub("[^A-Za-z0-9]+", "_", key).strip("_")}'
        self._trouble = ''
        self.pressed = self._look()

    @property
    def trouble(self) -> str:
        """Why the stop cannot be kept, in a sentence; empty where it can."""
        return self._trouble

    def press(self, why: str) -> None:
        """Keep that the stop is pressed; where that fails it stays pressed in this process."""
        if self.pressed and not self._trouble:
            return
        self.pressed = True
        when = datetime.now(timezone.utc).isoformat(timespec='seconds')
        self._try(lambda: _write(self.path, f'pressed {when}: {why}\n'))

    def release(self) -> None:
        """Forget the stop.

        Raises:
            InputError: The file cannot be removed, or a stop could not be kept again.

        """
        self._try(self._remove)
        if self._trouble:
            raise InputError(self._trouble)
        self.pressed = False

    def _look(self) -> bool:
        self._try(self._probe)
        return bool(self._trouble) or self._exists()

    def _exists(self) -> bool:
        try:
            self.path.lstat()
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def _remove(self) -> None:
        if self._exists():
            self.path.unlink()
        self._probe()
        _sync(self.path.parent)

    def _probe(self) -> None:
        """Make sure that a file can be written here; a full or read-only disk raises OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        probe = self.path.with_name(f'{self.path.name}.{os.getpid()}.probe')
        try:
            _write(probe, 'whether a stop can be kept here\n')
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()

    def _try(self, work: Callable[[], None]) -> None:
        try:
            work()
        except OSError as error:
            self._trouble = (
                f'The emergency stop cannot be saved in {self.path.parent} '
                f'({error.strerror or error}): the table stays stopped. Make that folder writable, '
                'or give another one as parameter state_folder.'
            )
        else:
            self._trouble = ''


def _write(path: Path, text: str) -> None:
    """Write a file such that it outlives a power cut."""
    with path.open('w', encoding='utf-8') as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    _sync(path.parent)


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def state_folder(given: str) -> Path:
    """Return where stops are kept: as given, else where the XDG base directories put state.

    Raises:
        InputError: The home folder of the user is not known.

    """
    base = os.environ.get('XDG_STATE_HOME', '')
    try:
        if given:
            return user_path(given)
        # The specification has relative paths ignored.
        root = Path(base) if base.startswith('/') else user_path('~/.local/state')
    except InputError:
        raise InputError(
            'Parameter state_folder: this user has no home folder in which a pressed stop could be '
            'saved; give a folder without ~.'
        ) from None
    return root / 'imu_calib'


class StopTopic:
    """Hears a std_msgs/Bool topic whatever its publishers offer.

    A reliable subscription does not match best-effort publishers, and a volatile one does not get
    what a latched publisher said before. So beside the one that matches all there is one for every
    kind of publisher that comes; hearing a message twice does no harm.

    Attributes:
        topic: Full name.

    """

    def __init__(self, node: Any, topic: str, callback: Callable[[bool], None]) -> None:
        self._node = node
        self._callback = callback
        self._says_stop = False
        self.topic: str = node.resolve_topic_name(topic)
        self._offered: set[tuple[Any, Any]] = set()
        self._listen(qos.sensor_data())

    def look(self) -> None:
        """Subscribe to what publishers offer that is not subscribed to yet."""
        for publisher in self._node.get_publishers_info_by_topic(self.topic):
            self._listen(qos.as_offered(publisher.qos_profile))

    def _listen(self, profile: Any) -> None:
        kind = profile.reliability, profile.durability
        if kind in self._offered:
            return
        self._offered.add(kind)
        # A subscription that does not match a publisher is not the one that is meant for it.
        events = ros.SubscriptionEventCallbacks(incompatible_qos=lambda _: None)
        self._node.create_subscription(
            messages.Bool, self.topic, self._hear, profile, event_callbacks=events
        )

    @property
    def says_stop(self) -> bool:
        """Whether a publisher that is there said stop, and did not take it back since."""
        return self._says_stop and self._node.count_publishers(self.topic) > 0

    def _hear(self, message: Any) -> None:
        if message.data:
            self._says_stop = True
        elif self._node.count_publishers(self.topic) < 2:
            # Of two publishers it is unknown which of them said so.
            self._says_stop = False
        self._callback(bool(message.data))


class EmergencyStop:
    """The emergency stop of a node: pressed by a message, released by `release` alone.

    Args:
        node: Whose; its domain and full name say which stand it is.
        folder: Keeps a pressed stop.
        on_press: Called before the disk is waited for, whenever somebody says stop.

    """

    def __init__(self, node: Any, folder: Path, on_press: Callable[[], None]) -> None:
        name = node.get_fully_qualified_name()
        self._on_press = on_press
        self._pressed = (
            'The emergency stop is on. Release the emergency stop, then call '
            f'{name}/release; nothing moves before the next {name}/start.'
        )
        self._released = f'The emergency stop is released; nothing moves before {name}/start.'
        self._record = StopRecord(folder, f'domain {domain_id()} {name}')
        self._topic = StopTopic(node, 'estop', self._hear)

    @property
    def obstacle(self) -> str:
        """What a start is answered while the stop is pressed."""
        return self._record.trouble or self._pressed

    @property
    def words(self) -> str:
        """Why nothing may move, and what to do; empty where the stop is not pressed."""
        return self.obstacle if self._record.pressed else ''

    @property
    def kept_in(self) -> str:
        """The file that keeps it."""
        return str(self._record.path)

    def look(self) -> None:
        """See who may say stop."""
        self._topic.look()

    def release(self) -> str:
        """Take the stop back; return what that means, in words.

        Raises:
            InputError: It is not pressed, somebody still says stop, or the file stays.

        """
        if not self._record.pressed:
            raise InputError('The emergency stop is not pressed.')
        if self._topic.says_stop:
            raise InputError(
                f'A publisher on {self._topic.topic} still says stop: release it there first.'
            )
        self._record.release()
        return self._released

    def _hear(self, stop: bool) -> None:
        if stop:
            self._on_press()
            self._record.press(f'heard on {self._topic.topic}')
