"""The selected runtime, checked, and its names."""

from typing import TYPE_CHECKING

from ..network import require, runtime

RUNTIME = runtime()
require(RUNTIME)

if TYPE_CHECKING or RUNTIME != 'rclpy':
    from .dds import *  # noqa: F403
    from .dds import __all__ as _names
else:
    from .ros import *  # noqa: F403
    from .ros import __all__ as _names

NAMES = _names
