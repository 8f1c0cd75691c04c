"""Declare, describe and check parameters of a node in one call; all are read-only."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ...common.errors import InputError
from ...common.files import user_path
from ..middleware import FloatingPointRange, IntegerRange, Node, ParameterDescriptor


def declare(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    lower: float | None = None,
    upper: float | None = None,
) -> Any:
    """Declare a parameter and return its value.

    Args:
        node: Declares the parameter.
        name: Of the parameter.
        default: Value if none is given; its type is the parameter's.
        description: A sentence with the unit, for `ros2 param describe` and docs/parameters.md.
        lower: Smallest accepted value, None for no limit.
        upper: Largest accepted value, None for no limit.
    """
    described = ParameterDescriptor(description=description, read_only=True)
    ranged = lower is not None or upper is not None
    if ranged and isinstance(default, float):
        low, high = -math.inf if lower is None else lower, math.inf if upper is None else upper
        described.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]
    elif ranged:
        low, high = -(2**62) if lower is None else lower, 2**62 if upper is None else upper
        described.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    try:
        value = node.declare_parameter(name, default, described).value
    except Exception as error:
        # The two runtimes raise the same error for a wrong type, different ones for a wrong range.
        raise InputError(f'Parameter {name}: {error}') from error
    if ranged and not math.isfinite(value):
        # A time that never ends is no watchdog, and NaN is within the range for rclpy.
        raise InputError(f'Parameter {name}: found {value}, expected a finite number.')
    return value


def declare_autostart(node: Node) -> bool:
    """Declare whether a managed node activates itself, and return it."""
    words = 'Configure and activate at the start; false: a lifecycle manager does (rclpy alone).'
    return bool(declare(node, 'autostart', True, words))


def declare_path(node: Node, name: str, default: str, description: str) -> Path:
    """Declare the path of what a session writes, and return it.

    Nodes of different namespaces that are started in one folder write into folders of their own:
    the default lies below the namespace, and an empty value stands for it.
    """
    below = str(Path(node.get_namespace().strip('/'), default))
    return user_path(declare(node, name, below, description) or below)
