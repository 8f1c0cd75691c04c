"""The first bytes of the IMU, before anything starts: whether it is there, and as described.

The nodes would find out as well, but take their time to load and to find each other.
"""

from __future__ import annotations

import time

from ..devices import Baud, FrameFormat, Reception, Severity, Source, steady_time
from ..imu import ImuSpec
from .words import Words

_ROUND = 0.02
"""Between two looks, s: too little to be noticed."""

_LONGEST = 3.0
"""Longest wait, s: longer than a host may take to answer (2 s). What is slower still is left to the
nodes, which go on waiting."""


def listen(
    port: str,
    frames: FrameFormat,
    imu: ImuSpec,
    baud: Baud,
    words: Words,
    node: str = 'imu_node',
) -> None:
    """Listen until the device is known to be the one described, or silent, which is said.

    Args:
        port: As of `Source`; it is free again at the end.
        frames: The format of the device's frames.
        imu: What its numbers mean.
        baud: Of a serial port.
        words: Shows what there is to say.
        node: In whose name.

    Raises:
        InputError: The port is none.
        NothingComes: It does not open, or what comes is not what the files say.

    """
    # imu_node goes on with the device as it is.
    source = Source(port, time.time_ns, baud.rate, commands=frames.commands, restarts=False)
    reception = Reception(frames, imu, live=source.live)
    source.start()
    deadline = time.monotonic() + _LONGEST
    try:
        while time.monotonic() < deadline and not _decided(source, reception, words, node):
            time.sleep(_ROUND)
    finally:
        source.stop()


def _decided(source: Source, reception: Reception, words: Words, node: str) -> bool:
    """Take in what has come, and show what there is to say; say whether that is all."""
    state, now, steady = source.state, time.time_ns(), steady_time() * 1e-9
    chunks = source.take()
    if chunks:
        reception.take(chunks, now, steady)
    silent = came = False
    for word in reception.statuses(state, now, steady):
        came |= word.figures.get('bytes', '0') != '0'
        silent |= word.part == 'stream' and word.severity is Severity.ERROR
        words.note(f'{node}: {word.part}', word.severity, word.text, came=came)
    words.show()
    if state.ended:
        # A short recording: no more than this will come of it.
        return reception.health.heard and not chunks
    return reception.health.judged or (state.open and silent and not came)
