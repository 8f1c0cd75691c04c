"""DONE is one message of one topic: what else must speak for it before a session ends."""

import pytest

from imu_calib.live.nodes.calibrator_node import DoneCheck

STATE = {'plan': 'short', 'steps': 14, 'commanded': 14, 'alone': True}


def test_done_counts_when_it_is_said_again_and_everything_speaks_for_it():
    check = DoneCheck('short', 14)
    assert check.refusal(**STATE) == ''
    assert not check.is_repeated
    assert check.refusal(**STATE) == ''
    assert check.is_repeated


def test_done_that_its_leader_contradicts_is_said_once_again():
    check = DoneCheck('short', 14)
    check.refusal(**STATE)
    check.deny()
    check.refusal(**STATE)
    assert not check.is_repeated


@pytest.mark.parametrize(
    ('wrong', 'words'),
    [
        ({'plan': ''}, 'it names the plan (none), not short'),
        ({'plan': 'long'}, 'it names the plan long, not short'),
        ({'steps': 0}, 'it has 0 steps, plan short has 14'),
        ({'commanded': 3}, 'step 4 to 14 of short was never commanded'),
        ({'commanded': 13}, 'step 14 of short was never commanded'),
        ({'alone': False}, 'more than one node publishes the state'),
    ],
)
def test_done_that_something_speaks_against_is_doubted(wrong, words):
    check = DoneCheck('short', 14)
    for _ in range(3):
        assert check.refusal(**{**STATE, **wrong}) == words
