"""Subscriptions to the topics of each of several units, for a board."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from .. import middleware as ros
from ..middleware import messages
from ..web.board import Board
from ..web.units import UnitsBoard
from . import qos


def listen_to_each(node: ros.Node, board: UnitsBoard) -> None:
    """Subscribe to calibration and calibration/progress of every unit.

    Args:
        node: The node that subscribes.
        board: Receives the messages.
    """
    for name, own in board.each.items():
        node.create_subscription(
            messages.CalibrationProgress,
            f'{name}/calibration/progress',
            partial(_take, own),
            qos.latched(),
        )
        node.create_subscription(
            messages.ImuCalibration, f'{name}/calibration', own.take_calibration, qos.latched()
        )


def _take(board: Board, message: Any) -> None:
    board.take_progress(message, time.monotonic())
