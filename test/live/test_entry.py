"""How every node's program begins."""

import sys

import pytest
from installed import needs_nodes
from loopback import CHECKOUT, completed

from imu_calib.live.nodes import programs

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
how = sys.argv.pop()
sys.exit(entry.entry_point(main) if how == 'node' else main())
"""


def heaps(how):
    done = completed([sys.executable, '-c', THREADS, how], check=True, cwd=CHECKOUT)
    return int(done.stdout)


def test_the_threads_of_a_node_take_memory_from_one_heap():
    needs_nodes()
    """What lies free in one heap is no other's: a calibrator would grow with each session."""
    if heaps('plain') == 1:
        pytest.skip('this C library has one heap for all threads')
    assert heaps('node') == 1


@pytest.mark.parametrize('program', ['imu_node', 'turntable_node'])
def test_a_program_says_how_it_is_called_and_refuses_stray_words(program):
    def answer(*words):
        module = f'imu_calib.live.nodes.{program}'
        command = [sys.executable, '-m', module, *words]
        return completed(command, cwd=CHECKOUT)

    needs_nodes()
    asked = answer('--help')
    assert asked.returncode == 0
    assert f'usage: {program} [--ros-args' in asked.stdout
    stray = answer('stand', '--ros-args', '-p', 'use_sim_time:=false')
    assert stray.returncode == 2
    assert f"{program}: found 'stand', expected --ros-args" in stray.stderr


def test_words_of_ros_are_not_stray():
    ros = ['--ros-args', '-p', 'port:=x', '-r', '__ns:=/a', '--']
    assert programs.answered('imu_node', ros) is None
    assert programs.answered('imu_node', [*ros, 'more']) == 2
