"""The formats of `imu-calib export`, by name."""

from __future__ import annotations

from collections.abc import Callable

from .c_header import export_c_header
from .exports import (
    Exported,
    ExportSource,
    export_imucal,
    export_kalibr,
    export_ros,
)

EXPORTS: dict[str, Callable[[ExportSource], Exported]] = {
    'ros': export_ros,
    'kalibr': export_kalibr,
    'imucal': export_imucal,
    'c': export_c_header,
}
