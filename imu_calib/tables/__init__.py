"""Drivers of tables on a line: setpoints in, joint angles out, and a stop on every exit."""

from .ascii import BadReply, Move, Order, Reading, Refusal, Stop
from .control import Control, Status
from .follower import Follower
from .guard import Guard
from .line import Line, tcp_address
from .source import OneSource

__all__ = [
    'BadReply',
    'Control',
    'Follower',
    'Guard',
    'Line',
    'Move',
    'OneSource',
    'Order',
    'Reading',
    'Refusal',
    'Status',
    'Stop',
    'tcp_address',
]
