"""Whose setpoints a driver follows: one source's, and none that something forbids."""

from dataclasses import replace

import pytest

from imu_calib.common.stream import Mode, Setpoint
from imu_calib.live.nodes.stop import OneSource

TIMEOUT = 0.5
GO = Setpoint(0, 'plan', 1, '1', Mode.POSITION, ('outer',), (1.0,), (), 0.0, 0.0)
HOLD = replace(GO, mode=Mode.HOLD)
A, B = b'one', b'two'


@pytest.fixture
def gate():
    return OneSource(TIMEOUT)


def test_setpoints_of_one_source_pass_as_they_came(gate):
    for k in range(20):
        assert gate.checked(replace(GO, stamp=k), A, 0.1 * k) == replace(GO, stamp=k)
    assert gate.reason == ''


@pytest.mark.parametrize('second', [GO, HOLD, replace(GO, mode=Mode.RATE)])
def test_a_second_source_makes_the_table_stand_whoever_speaks(gate, second):
    gate.checked(GO, A, 0.0)
    assert gate.checked(second, B, 0.1).mode is Mode.HOLD
    # The first one's too: nobody knows which of them is right.
    assert gate.checked(GO, A, 0.2).mode is Mode.HOLD
    assert 'two sources' in gate.reason


def test_of_two_that_go_on_neither_moves_the_table_and_neither_does_the_one_that_is_left(gate):
    for k in range(40):
        assert (gate.checked(GO, (A, B)[k % 2], 0.05 * k).mode is Mode.HOLD) == (k > 0)
    for k in range(40, 80):
        assert gate.checked(GO, B, 0.05 * k).mode is Mode.HOLD
    assert 'of a refused motion' in gate.reason


@pytest.mark.parametrize('pause', [HOLD, None])
def test_who_ceases_to_ask_for_a_movement_is_followed_again(gate, pause):
    gate.checked(GO, A, 0.0)
    gate.checked(GO, B, 0.1)
    gate.checked(GO, A, 0.2)
    for k in range(6):
        if pause is not None:
            assert gate.checked(pause, A, 0.3 + 0.1 * k) == pause
    assert gate.checked(GO, A, 0.2 + TIMEOUT + 0.2) == GO
    assert gate.reason == ''


def test_another_may_lead_when_the_first_has_been_silent_until_the_table_stopped(gate):
    gate.checked(GO, A, 0.0)
    assert gate.checked(GO, B, TIMEOUT + 0.01) == GO
    assert gate.checked(GO, A, TIMEOUT + 0.02).mode is Mode.HOLD


def test_a_source_that_holds_the_table_has_it(gate):
    gate.checked(HOLD, A, 0.0)
    assert gate.checked(GO, B, 0.3).mode is Mode.HOLD


def test_what_forbids_stops_once_and_nothing_goes_on_by_itself(gate):
    assert gate.forbid('No heartbeat.') is None
    assert gate.checked(GO, A, 0.0).mode is Mode.HOLD
    assert gate.reason == 'No heartbeat.'
    assert gate.forbid('') is None
    assert gate.reason == ''
    # It is still asked for: whoever leads has not seen the stop.
    assert gate.checked(GO, A, 0.1).mode is Mode.HOLD
    assert gate.checked(HOLD, A, 0.2) == HOLD
    assert gate.checked(GO, A, 0.7) == GO
    stop = gate.forbid('No heartbeat.')
    assert stop == HOLD
    assert gate.forbid('No heartbeat.') is None
    assert gate.checked(HOLD, A, 0.8) == HOLD
    assert gate.reason == 'No heartbeat.'


# The whole timeout counts, and no more: seconds after the last word of the cause.
WAITS = [(0.75 * TIMEOUT, Mode.HOLD), (0.99 * TIMEOUT, Mode.HOLD), (1.01 * TIMEOUT, GO.mode)]


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_another_leads_after_the_whole_timeout(gate, wait, mode):
    gate.checked(GO, A, 0.0)
    assert gate.checked(GO, B, wait).mode is mode


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_of_two_one_is_followed_after_the_whole_timeout_without_the_other(gate, wait, mode):
    gate.checked(HOLD, A, 0.0)
    gate.checked(HOLD, B, 0.1)
    # The first holds meanwhile: it is silent for less than the timeout.
    gate.checked(HOLD, A, 0.1 + wait / 2)
    assert gate.checked(GO, A, 0.1 + wait).mode is mode


@pytest.mark.parametrize(('wait', 'mode'), WAITS)
def test_what_was_refused_is_followed_after_the_whole_timeout_of_holding(gate, wait, mode):
    gate.forbid('No heartbeat.')
    gate.checked(GO, A, 0.0)
    gate.forbid('')
    gate.checked(HOLD, A, wait / 2)
    assert gate.checked(GO, A, wait).mode is mode
