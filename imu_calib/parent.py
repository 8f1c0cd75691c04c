"""A process that does not outlive the one that started it, even if that one is killed."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

ENDS_WITH = 'IMU_CALIB_ENDS_WITH'
"""Environment variable: number of the process to end with."""

_SET_DEATH_SIGNAL = 1


def end_with_parent() -> None:
    """Ask the kernel for SIGTERM when the parent ends, where the environment says so.

    A node stops its table on SIGTERM. Linux only: prctl(2), PR_SET_PDEATHSIG.
    """
    parent = os.environ.get(ENDS_WITH)
    if parent is None or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGTERM)
    if str(os.getppid()) != parent:
        # It ended before the kernel was asked.
        os.kill(os.getpid(), signal.SIGTERM)
