"""What stops a table: the emergency stop, a lost heartbeat, setpoints of two sources."""

from __future__ import annotations

import contextlib
import math
import os
import re
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ...common.errors import InputError
from ...common.files import user_path
from ...common.stream import Mode, Setpoint
from ...recordings.cdr import Malformed, Messages
from ...recordings.cdr_codec import decode_setpoints
from .. import middleware as ros
from ..middleware import Clock, ClockType, drain_sources, messages, open_drain
from ..network import domain_id
from . import qos
from .diagnostics import Diagnostics
from .parameters import declare
from .qos import names_of


class StopRecord:
    """A file that exists while a stop is pressed.

    An unreadable file counts as pressed, and so does a folder in which a stop could not be saved: a
    table whose stop cannot be saved must not start.

    Args:
        folder: Folder of the file; created if missing.
        key: Of the stand, for instance domain and full name of the node that runs the plan.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.path = folder / f'stop_{re.sub("[^A-Za-z0-9]+", "_", key).strip("_")}'
        self._trouble = ''
        self.pressed = self._is_pressed()

    @property
    def trouble(self) -> str:
        """Why the stop cannot be saved, in a sentence; empty if it can."""
        return self._trouble

    def press(self, why: str) -> None:
        """Save that the stop is pressed; if that fails, it stays pressed in this process."""
        if self.pressed and not self._trouble:
            return
        self.pressed = True
        when = datetime.now(timezone.utc).isoformat(timespec='seconds')
        self._try(lambda: _write(self.path, f'pressed {when}: {why}\n'))

    def release(self) -> None:
        """Delete the saved stop."""
        self._try(self._remove)
        if self._trouble:
            raise InputError(self._trouble)
        self.pressed = False

    def _is_pressed(self) -> bool:
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
        """Check that a file can be written here; a full or read-only disk raises OSError."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        probe = self.path.with_name(f'{self.path.name}.{os.getpid()}.probe')
        try:
            _write(probe, 'whether a stop can be kept here\n')
        finally:
            with contextlib.suppress(OSError):
                probe.unlink()

    def _try(self, work: Callable[[], None]) -> None:
        """Write or remove the file; keep a sentence on why that failed."""
        try:
            work()
        except OSError as error:
            self._trouble = (
                f'The emergency stop cannot be saved in {self.path.parent} '
                f'({error.strerror or error}): the table stays stopped. Make that folder writable '
                'or set state_folder to another one.'
            )
        else:
            self._trouble = ''


def _write(path: Path, text: str) -> None:
    """Write a file so that it survives a power failure.

    In place: it counts by being there, and half of it stops the table as the whole does, where a
    draft beside it (`files.write_whole`) would not.
    """
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
    """Return the folder of stops: as given, else the state folder of the XDG base directories."""
    base = os.environ.get('XDG_STATE_HOME', '')
    try:
        if given:
            return user_path(given)
        # The specification says that relative paths are ignored.
        root = Path(base) if base.startswith('/') else user_path('~/.local/state')
    except InputError:
        raise InputError(
            'Parameter state_folder: this user has no home folder in which a pressed stop could be '
            'saved; give a folder without ~.'
        ) from None
    return root / 'imu_calib'


class StopTopic:
    """Subscribes to a std_msgs/Bool topic with any quality of service.

    A reliable subscription does not match best-effort publishers, and a volatile one does not
    receive earlier messages of a latched publisher. Therefore there is one subscription that
    matches all, one of ROS's default, and one for each kind of publisher found; duplicate messages
    do no harm.
    """

    def __init__(self, node: Any, topic: str, callback: Callable[[bool], None]) -> None:
        self._node = node
        self._callback = callback
        self._stopping = False
        self.topic: str = node.resolve_topic_name(topic)  #: Full name.
        self._offered: set[tuple[Any, Any]] = set()
        self._listen(qos.sensor_data())
        # `ros2 topic pub --once` ends before the next check, and its one message may arrive before
        # a best-effort subscription knows of it; a reliable one is then sent it again.
        self._listen(qos.as_offered(qos.command()))

    def check(self) -> None:
        """Subscribe with each newly offered quality of service."""
        for publisher in self._node.get_publishers_info_by_topic(self.topic):
            self._listen(qos.as_offered(publisher.qos_profile))

    def _listen(self, profile: Any) -> None:
        """Subscribe with a quality of service, once for each."""
        kind = profile.reliability, profile.durability
        if kind in self._offered:
            return
        self._offered.add(kind)
        # A subscription that does not match a publisher is meant for another one.
        events = ros.SubscriptionEventCallbacks(incompatible_qos=lambda _: None)
        self._node.create_subscription(
            messages.Bool, self.topic, self._receive, profile, event_callbacks=events
        )

    @property
    def is_stopping(self) -> bool:
        """Whether a present publisher sent stop and has not cancelled it since."""
        return self._stopping and self._node.count_publishers(self.topic) > 0

    def _receive(self, message: Any) -> None:
        if message.data:
            self._stopping = True
        elif self._node.count_publishers(self.topic) < 2:
            # With two publishers the sender is unknown.
            self._stopping = False
        self._callback(bool(message.data))


class EmergencyStop:
    """The emergency stop of a node: pressed by a message, released only by `release`.

    `on_press` is called at every stop message, before the disk is written.
    """

    def __init__(self, node: Any, folder: Path, on_press: Callable[[], None]) -> None:
        name = node.get_fully_qualified_name()
        self._on_press = on_press
        self._pressed = (
            f'The emergency stop is on. Release it, then call {name}/release and {name}/start.'
        )
        self._released = f'The emergency stop is released; nothing moves before {name}/start.'
        self._record = StopRecord(folder, f'domain {domain_id()} {name}')
        self._topic = StopTopic(node, 'estop', self._receive)

    @property
    def obstacle(self) -> str:
        """The answer to a start while the stop is pressed."""
        return self._record.trouble or self._pressed

    @property
    def reason(self) -> str:
        """Why nothing may move, and what to do; empty if the stop is not pressed."""
        return self.obstacle if self._record.pressed else ''

    @property
    def record_path(self) -> str:
        """The file of the saved stop."""
        return str(self._record.path)

    def check(self) -> None:
        """Subscribe to new publishers of a stop."""
        self._topic.check()

    def release(self) -> str:
        """Release the stop; return the effect as text.

        Raises:
            InputError: It is not pressed, a publisher still sends stop, or the file cannot be
                deleted.
        """
        if not self._record.pressed:
            raise InputError('The emergency stop is not pressed.')
        if self._topic.is_stopping:
            raise InputError(
                f'A node still publishes stop on {self._topic.topic}: release it there first.'
            )
        self._record.release()
        return self._released

    def _receive(self, stop: bool) -> None:
        if stop:
            self._on_press()
            self._record.press(f'heard on {self._topic.topic}')


class Heartbeat:
    """Subscribes to std_msgs/Bool on `heartbeat` if the parameter stop_required is set.

    The table may move after true; it must not after false, or without messages. A false counts for
    the timeout at least, so that nobody who asks from time to time misses it. The subscription is
    best effort, to match every publisher, and volatile, so that earlier messages do not count.
    """

    def __init__(self, node: Any) -> None:
        words = (
            'Whether the table starts and moves only while a heartbeat comes: std_msgs/Bool, true, '
            'on the topic heartbeat.'
        )
        required = declare(node, 'stop_required', False, words)
        words = 'Longest silence of the heartbeat, s of the steady clock.'
        self._timeout = declare(node, 'heartbeat_timeout', 0.5, words, lower=0.05, upper=5.0)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._received_at = self._refused_at = -math.inf
        self._topic = node.resolve_topic_name('heartbeat')
        self.required = required
        if required:
            node.create_subscription(messages.Bool, 'heartbeat', self._receive, qos.sensor_data())

    @property
    def reason(self) -> str:
        """Why nothing may move, in a sentence; else empty."""
        if not self.required:
            return ''
        now = self._steady.now().nanoseconds * 1e-9
        if now - self._received_at > self._timeout:
            return (
                f'No heartbeat on {self._topic} for {self._timeout:g} s: the table stays stopped '
                'without one (stop_required).'
            )
        stops = now - self._refused_at <= self._timeout
        return f'The heartbeat on {self._topic} is false, which means stop.' if stops else ''

    def _receive(self, message: Any) -> None:
        self._received_at = self._steady.now().nanoseconds * 1e-9
        if not message.data:
            self._refused_at = self._received_at


# The setpoints that a table's driver follows: of one source, while a heartbeat is received.


class OneSource:
    """Pass the setpoints of one source; any other setpoint makes the table hold.

    A source controls the table from its first setpoint until its silence exceeds the timeout, after
    which the table has stopped; then another source may take over. Meanwhile a setpoint of another
    source is not followed: which of the two is right is unknown, so the table holds. HOLD is passed
    from all sources, since standing still is always safe. After such a hold nothing moves until the
    timeout has passed without a setpoint other than HOLD, so that a leader that did not notice
    cannot continue where it was.

    Args:
        timeout: Silence after which a source no longer controls the table, s: that of the driver's
            setpoints.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._source: bytes | None = None
        self._received_at = self._second_at = self._refused_at = -math.inf
        self._forbidden = ''
        self._followed: Setpoint | None = None
        self.reason = ''  #: Why setpoints are not followed, in sentences; otherwise empty.

    def forbid(self, why: str) -> Setpoint | None:
        """Set whether movement is forbidden.

        Returns:
            The HOLD that stops the motion being followed; None if there is none.
        """
        if self.reason == self._forbidden:
            self.reason = ''
        self._forbidden = why
        if not why:
            return None
        self.reason = why
        followed, self._followed = self._followed, None
        return None if followed is None else replace(followed, mode=Mode.HOLD)

    def checked(self, setpoint: Setpoint, source: bytes, steady: float) -> Setpoint:
        """Return the setpoint for the table: as received, or HOLD in its place."""
        if source != self._source and steady - self._received_at <= self._timeout:
            self._second_at = steady
        else:
            self._source, self._received_at = source, steady
        if setpoint.mode is Mode.HOLD:
            return self._stand(setpoint, steady)
        reason = self._objection(steady)
        if reason:
            self._refused_at, self.reason = steady, reason
            return self._stand(setpoint, steady)
        self._followed, self.reason = setpoint, ''
        return setpoint

    def _objection(self, steady: float) -> str:
        """Return why a movement is not followed; otherwise empty."""
        if self._forbidden:
            return self._forbidden
        if steady - self._second_at <= self._timeout:
            return (
                'Setpoints come from two sources: none is followed, and the table stands. End one '
                'of them.'
            )
        if steady - self._refused_at <= self._timeout:
            return (
                'The table stands until the setpoints of a refused motion stop. It follows again '
                f'after {self._timeout:g} s without them.'
            )
        return ''

    def _stand(self, setpoint: Setpoint, steady: float) -> Setpoint:
        self._followed = None
        self.reason = self.reason if self._objection(steady) else ''
        return replace(setpoint, mode=Mode.HOLD)


class FollowedSetpoints:
    """Receives setpoints and passes on those that the table must follow.

    Args:
        node: The driver.
        timeout: Silence after which the table stops, s, of the steady clock.
    """

    def __init__(self, node: Any, timeout: float) -> None:
        self._node = node
        self._gate = OneSource(timeout)
        self._heartbeat = Heartbeat(node)
        self._malformed = Malformed()
        self._unknown = 0
        self._drain = open_drain(
            node, messages.TurntableSetpoint, 'turntable/setpoint', qos.command()
        )

    def dispatch(self, follow: Callable[[Setpoint], None]) -> None:
        """Pass on new setpoints, and HOLD if the heartbeat is lost; to be called often."""
        stop = self._gate.forbid(self._heartbeat.reason)
        if stop is not None:
            follow(stop)
        now = time.monotonic()
        for payload, source in drain_sources(self._drain):
            for block in decode_setpoints(Messages.join([payload]), self._malformed):
                for setpoint in block.setpoints:
                    follow(self._gate.checked(setpoint, source or self._known(), now))

    def report(self, diagnostics: Diagnostics) -> None:
        """Report whose setpoints are followed, or why none are."""
        publishers = names_of(self._listed())
        diagnostics.report_fault(
            'source',
            self._gate.reason,
            'Setpoints of one source are followed.',
            publishers=', '.join(publishers) or 'none',
            heartbeat='required' if self._heartbeat.required else 'not required',
            malformed=f'{self._malformed.count} messages',
        )

    def _listed(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self._drain.topic_name))

    def _known(self) -> bytes:
        """Return the listed publisher as source, where the middleware gives none per message.

        With several publishers the source is unknown: each message then counts as from another.
        """
        listed = self._listed()
        if len(listed) == 1:
            return bytes(listed[0].endpoint_gid)
        self._unknown += 1
        return f'unknown {self._unknown}'.encode()
