"""DONE is one message of one topic: what else must speak for it before a session ends."""

import pytest

from imu_calib.nodes.done import DoneWord

SAID = {'plan': 'short', 'steps': 14, 'commanded': 14, 'alone': True}


def test_done_counts_when_it_is_said_again_and_everything_speaks_for_it():
    word = DoneWord('short', 14)
    assert word.doubt(**SAID) == ''
    assert not word.is_repeated
    assert word.doubt(**SAID) == ''
    assert word.is_repeated


def test_done_that_its_leader_contradicts_is_said_once_again():
    word = DoneWord('short', 14)
    word.doubt(**SAID)
    word.deny()
    word.doubt(**SAID)
    assert not word.is_repeated


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
    word = DoneWord('short', 14)
    for _ in range(3):
        assert word.doubt(**{**SAID, **wrong}) == words
