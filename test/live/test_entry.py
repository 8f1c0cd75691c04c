"""How every node's program begins."""

import subprocess
import sys

import pytest
from installed import needs_nodes
from loopback import CHECKOUT

THREADS = """
import ctypes, sys, tempfile, threading
from imu_calib.live import middleware
from imu_calib.live.nodes import programs as entry

libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p


def main():
    # All threads hold memory at the same time.
    together, held = threading.Barrier(4), []

    def work():
        together.wait()
        held.extend(bytes(100_000) for _ in range(20))
        together.wait()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with tempfile.NamedTemporaryFile() as file:
        stream = ctypes.c_void_p(libc.fopen(file.name.encode(), b'w'))
        libc.malloc_info(0, stream)
        libc.fclose(stream)
        print(file.read().count(b'<heap nr'))


middleware.run = lambda node, ends: node()
sys.exit(entry.entry_point(main) if sys.argv[1] == 'node' else main())
"""


def heaps(how):
    done = subprocess.run(
        [sys.executable, '-c', THREADS, how], capture_output=True, text=True, check=True,
        cwd=CHECKOUT,
    )  # fmt: skip
    return int(done.stdout)


def test_the_threads_of_a_node_take_memory_from_one_heap():
    needs_nodes()
    """What lies free in one heap is no other's: a calibrator would grow with each session."""
    if heaps('plain') == 1:
        pytest.skip('this C library has one heap for all threads')
    assert heaps('node') == 1
