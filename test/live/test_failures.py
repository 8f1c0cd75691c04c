"""Failures and situations: every row has a test that exists; and a stand whose processes hang."""

import ast
import os
import re
import signal
import time
from contextlib import contextmanager
from functools import cache

import pytest
from extent import again
from live import LEASE, MOVES, Stand, State, finishes, resumes, short_plan, stops
from loopback import CHECKOUT

DOCS = CHECKOUT / 'docs'
TEST = re.compile(r'`(test_\w+)::(test_\w+)`')


def rows(page):
    """Return the rows of a page's tables below their headings as lists of cells."""
    lines = (DOCS / page).read_text(encoding='utf-8').splitlines()
    cells = [[c.strip() for c in line.strip('|').split('|')] for line in lines if line[:1] == '|']
    rules = {k for k, row in enumerate(cells) if set(row[0]) == {'-'}}
    return [row for k, row in enumerate(cells) if not rules & {k, k + 1}]


@cache
def names_in(module):
    """Return the names of the tests of a file that are part of every run."""
    (file,) = (CHECKOUT / 'test').glob(f'*/{module}.py')
    tree = ast.parse(file.read_text(encoding='utf-8'))
    return {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and 'pytest.mark.repeats' not in [ast.unparse(mark) for mark in node.decorator_list]
    }


@pytest.mark.parametrize(
    ('page', 'least', 'width'), [('failures.md', 50, 5), ('situations.md', 40, 3)]
)
def test_every_row_of_a_page_has_tests_and_every_test_exists(page, least, width):
    found = rows(page)
    assert len(found) > least
    for row in found:
        assert len(row) == width, row
        assert all(row), row
        named = TEST.findall(row[-1])
        assert named, f'no test: {row[0]}'
        for module, name in named:
            assert name in names_in(module), f'{row[0]}: {module}::{name}'


@contextmanager
def hangs(stand, node, seconds):
    """Stop a process of a stand for so long, as a debugger or a machine without memory would."""
    number = stand.processes.number(node)
    os.kill(number, signal.SIGSTOP)
    try:
        end = time.monotonic() + seconds
        stand.wait(lambda: time.monotonic() > end, seconds + 1.0)
        yield
    finally:
        os.kill(number, signal.SIGCONT)


@pytest.mark.parametrize('seconds', [3.0, again(30.0)])
def test_every_node_may_hang_and_the_session_ends_in_the_true_parameters(tmp_path, seconds):
    """Of ten frames one is damaged besides, in the steps between."""
    # Joint states that cease are noticed before a calibrator that has nothing to say without them.
    waits = {'calibrator_timeout': 2.5, 'watchdog_timeout': 2.0}
    # Long and slow enough that steps are left for the last node while the others are missed, also
    # where the machine is busy and a call takes a second.
    plan = short_plan(tmp_path, dwell=6.0, rates=(120, -120))
    with Stand(tmp_path, '--speed', '60', plan=plan, turntable_node=waits) as stand:
        # Its frames wait in the line, and simulated time waits for them.
        assert stand.reaches(State.DWELLING, step=1)
        with hangs(stand, 'imu_node', seconds):
            pass
        # A move would be gone on with: a turn that was not led all the way is no turn.
        comes_to(stand, [State.TURNING], 2)
        with hangs(stand, 'turntable_node', seconds):
            # Nobody leads it: the table stops by itself.
            assert stand.table_stands(LEASE)
        stops(stand)
        resumes(stand)
        is_missed(stand, 'calibrator_node', seconds, [State.DWELLING], 'calibrator')
        resumes(stand)
        is_missed(stand, 'stand_node', seconds, MOVES, 'joint state')
        stand.fault('damage 10')
        assert stand.call('turntable_node/start')[0]
        assert stand.wait(lambda: stand.has_status('imu_node: stream', 'damaged'))
        stand.fault('clear')
        finishes(stand)


def is_missed(stand, node, seconds, phases, word):
    """Hang a node in one of the phases: the table stops, and the reason names what is missing."""
    comes_to(stand, phases, stand.state.step)
    stand.words.clear()
    with hangs(stand, node, seconds):
        assert stand.reaches(State.PAUSED, seconds=30), stand.state
    stops(stand)
    # The simulated table waits for a calibrator that hangs: joint states may cease first.
    assert any(one in stand.state.reason for one in {word, 'joint state'})


def comes_to(stand, phases, step):
    """Wait for one of the phases at a step or a later one; go on where a peer was missed."""
    newest = len(stand.states) - 1

    def there():
        if stand.state.phase == State.PAUSED:
            # A busy machine may pause the table more than once, and refuse a start meanwhile.
            stand.call('turntable_node/start')
        return any(s.phase in phases and s.step >= step for s in stand.states[newest:])

    assert stand.wait(there), stand.state
