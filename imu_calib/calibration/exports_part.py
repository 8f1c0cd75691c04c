"""Formats of other software for a calibration: one module per format."""

from __future__ import annotations

from collections.abc import Callable

from . import c_header, imucal, ros
from . import exports as kalibr
from .exported import Exported, ExportSource

EXPORTS: dict[str, Callable[[ExportSource], Exported]] = {
    'ros': ros.export_ros,
    'kalibr': kalibr.export_kalibr,
    'imucal': imucal.export_imucal,
    'c': c_header.export_c_header,
}

__all__ = ['EXPORTS', 'ExportSource', 'Exported']
