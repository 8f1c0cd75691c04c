"""Check the first bytes of the IMU before anything starts: whether it is present and as described.

The nodes would detect this too, but later: they load slowly and must discover each other.
"""

from __future__ import annotations

import time

from ..live.devices.format import FrameFormat
from ..live.devices.health import Reception
from ..live.devices.source import Baud, DeviceReader, steady_time
from ..live.rules import Severity
from ..session.imu import ImuSpec
from .terminal import NodeReports

_ROUND = 0.02
"""Between two checks, s: too short to be noticed."""
_LONGEST = 3.0
"""Longest wait, s: longer than a host may take to answer (2 s). The nodes wait for slower ones."""


def listen(
    port: str,
    frames: FrameFormat,
    imu: ImuSpec,
    baud: Baud,
    reports: NodeReports,
    node: str = 'imu_node',
) -> None:
    """Read a port until the device is confirmed, or its silence or another device is reported.

    Raises:
        InputError: The port is invalid.
        NothingComes: It does not open, or its data does not match the files.
    """
    # imu_node continues with the present state of the device.
    source = DeviceReader(port, time.time_ns, baud.rate, commands=frames.commands, restarts=False)
    reception = Reception(frames, imu, live=source.live)
    source.start()
    deadline = time.monotonic() + _LONGEST
    try:
        while time.monotonic() < deadline and not _decided(source, reception, reports, node):
            time.sleep(_ROUND)
    finally:
        source.stop()


def _decided(source: DeviceReader, reception: Reception, reports: NodeReports, node: str) -> bool:
    """Take new bytes, and show messages; return whether the check is complete."""
    state, now, steady = source.state, time.time_ns(), steady_time() * 1e-9
    chunks = source.pop_chunks()
    if chunks:
        reception.decode_chunks(chunks, now, steady)
    silent = came = False
    for status in reception.statuses(state, now, steady):
        came |= status.figures.get('bytes', '0') != '0'
        silent |= status.part == 'stream' and status.severity is Severity.ERROR
        reports.note(f'{node}: {status.part}', status.severity, status.text, came=came)
    reports.show()
    if state.ended:
        # A short recording: no more data will come.
        return reception.health.has_frames and not chunks
    return reception.health.judged or (state.open and silent and not came)
