"""How long the start of a session is waited for: as long as an old journal is read, and a bit."""

import time

import pytest

from imu_calib.cli.displays import Start
from imu_calib.cli.terminal import NodeReports
from imu_calib.common.errors import InputError

JOURNAL = 'calibrator_node: journal'
NOTHING = 'The stand does not start.'


@pytest.fixture
def clock(monkeypatch):
    """Return a list whose last number is the time of the steady clock."""
    times = [0.0]
    monkeypatch.setattr(time, 'monotonic', lambda: times[-1])
    return times


@pytest.fixture
def waiting(clock):
    reports = NodeReports(real=False)
    reports.nodes = ('calibrator_node', 'stand_node')
    return reports, Start(reports, 30.0)


def test_without_a_journal_that_is_read_the_wait_is_a_constant(clock, waiting):
    reports, start = waiting
    clock.append(20.0)
    reports.note(JOURNAL, 0, 'The journal is written to here.')
    start.check(NOTHING)
    assert start.words == ''
    clock.append(31.0)
    with pytest.raises(InputError, match=NOTHING):
        start.check(NOTHING)


def test_while_a_journal_is_read_the_wait_goes_on_and_says_so(clock, waiting):
    reports, start = waiting
    for percent in range(0, 100, 5):
        reports.note(JOURNAL, 0, f'The journal is read: {percent} %.')
        start.check(NOTHING)
        assert start.words == f'calibrator_node reads its journal: {percent} %.'
        clock.append(clock[-1] + 25.0)
        start.check(NOTHING)
    # Read, the nodes have as long as those of a new session.
    reports.note(JOURNAL, 1, 'The session is resumed from here, which holds 3 messages.')
    start.check(NOTHING)
    assert start.words == ''
    clock.append(clock[-1] + 29.0)
    start.check(NOTHING)
    clock.append(clock[-1] + 2.0)
    with pytest.raises(InputError, match=NOTHING):
        start.check(NOTHING)


def test_a_journal_that_is_read_no_further_is_named(clock, waiting):
    reports, start = waiting
    reports.note(JOURNAL, 0, 'The journal is read: 40 %.')
    start.check(NOTHING)
    clock.append(31.0)
    with pytest.raises(InputError, match=r'reads its journal: 40 %\. This has not changed'):
        start.check(NOTHING)
