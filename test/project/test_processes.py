"""No process outlives its test: not a failed one, not an interrupted run, not a killed one."""

import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import processes
import pytest
from loopback import SUPPORT, until

pytestmark = pytest.mark.skipif(not sys.platform.startswith('linux'), reason='looks into /proc')

# A node of a stand: in a session of its own, with a child that nobody waits for.
TREE = """
import subprocess, sys, time
subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)  # WORD child'])
print('both', flush=True)
time.sleep(600)  # WORD
"""
TESTS = """
import os, subprocess, sys, time
import processes

processes.GRACE = 1.0

def tree():
    process = processes.start([sys.executable, '-c', TREE], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == 'both\\n'

def test_leaves(): tree()
def test_fails(): tree(); assert False
def test_hangs():
    tree()
    open('hangs', 'w').close()
    # A signal that comes just before a sleep begins is seen when it ends.
    while True: time.sleep(0.1)
def test_bare():
    command = [sys.executable, '-c', TREE]
    subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True).stdout.readline()
    assert False
def test_after(): pass
"""


class Run:
    """A run of pytest of its own over the tests above."""

    def __init__(self, folder):
        self.folder, self.word = folder, f'left-by-{folder.name}'
        tree = TREE.replace('WORD', self.word)
        (folder / 'test_inner.py').write_text(f'TREE = {tree!r}\n{TESTS}')

    def start(self, *tests, options=()):
        command = [sys.executable, '-m', 'pytest', '-p', 'conftest', '-c', '/dev/null', '-q']
        given = os.environ.get('PYTHONPATH', '')
        path = os.pathsep.join([str(SUPPORT.parent), str(SUPPORT), given])
        return processes.start(
            [*command, *options, *(f'test_inner.py::test_{name}' for name in tests)],
            cwd=self.folder,
            env={**os.environ, 'PYTHONPATH': path},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def left(self):
        """Return the command lines of this run's processes, found by their words alone."""
        found = []
        for folder in Path('/proc').glob('[0-9]*'):
            try:
                line = (folder / 'cmdline').read_bytes()
            except OSError:
                continue
            if self.word.encode() in line:
                found.append(line)
        return found

    def hangs(self):
        return (self.folder / 'hangs').exists()


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


def test_a_test_that_leaves_processes_fails_and_names_them(run):
    process = run.start('leaves', 'after')
    out, _ = process.communicate()
    assert process.returncode == 1
    assert 'Still running after the test, and killed:' in out
    assert f'# {run.word} child' in out
    assert '2 passed, 1 error' in out
    assert run.left() == []


@pytest.mark.parametrize(('how', 'options'), [('fails', ['-W', 'error']), ('bare', [])])
def test_a_failed_test_leaves_nothing_and_spoils_no_other(run, how, options):
    process = run.start(how, 'after', options=options)
    out, _ = process.communicate()
    assert '1 failed, 1 passed in' in out
    assert run.left() == []


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_that_a_signal_ends_leaves_nothing(run, number):
    process = run.start('hangs')
    assert until(run.hangs)
    # Popen returns a moment before Linux shows what the child was called with.
    assert until(lambda: len(run.left()) == 2)
    process.send_signal(number)
    process.communicate()
    assert until(lambda: run.left() == [])


@pytest.mark.skipif(find_spec('pytest_timeout') is None, reason='pytest-timeout is not installed')
@pytest.mark.parametrize('method', ['signal', 'thread'])
def test_a_test_that_hangs_is_ended_and_leaves_nothing(run, method):
    timeout = ['-p', 'timeout', '--timeout', '5', '--timeout-method', method]
    process = run.start('hangs', 'after', options=timeout)
    out, _ = process.communicate()
    assert 'Timeout' in out
    if method == 'signal':
        assert '1 failed, 1 passed in' in out
    assert until(lambda: run.left() == [])
