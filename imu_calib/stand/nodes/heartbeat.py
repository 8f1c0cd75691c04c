"""A heartbeat that is required to start, and whose loss stops the table."""

from __future__ import annotations

import math
from typing import Any

from ..middleware import Clock, ClockType, messages
from . import qos
from .declared import declare


class Heartbeat:
    """Subscribes to std_msgs/Bool on `heartbeat` if the parameter stop_required is set.

    The table may move after true; it must not after false, or without messages. A false counts for
    the timeout at least, so that nobody who asks from time to time misses it. The subscription is
    best effort, to match every publisher, and volatile, so that earlier messages do not count.

    Args:
        node: Declares stop_required and heartbeat_timeout.
    """

    def __init__(self, node: Any) -> None:
        required = declare(
            node,
            'stop_required',
            False,
            'Whether every motion requires a heartbeat on the topic heartbeat (std_msgs/Bool).',
        )
        self._timeout = declare(
            node,
            'heartbeat_timeout',
            0.5,
            'Longest silence of the heartbeat on the steady clock, s.',
            lower=0.05,
            upper=5.0,
        )
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
                f'No heartbeat on {self._topic} for {self._timeout:g} s: the table is stopped, and '
                'nothing starts without one (stop_required).'
            )
        stops = now - self._refused_at <= self._timeout
        return f'The heartbeat on {self._topic} is false, which means stop.' if stops else ''

    def _receive(self, message: Any) -> None:
        self._received_at = self._steady.now().nanoseconds * 1e-9
        if not message.data:
            self._refused_at = self._received_at
