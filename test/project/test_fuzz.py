"""benchmarks/fuzz.py: a few inputs of each target, and that it finds what it looks for."""

import sys

import numpy as np
import pytest
from loopback import CHECKOUT

sys.path.insert(0, str(CHECKOUT / 'benchmarks'))

import fuzz

# A name of a benchmark may be that of a library, which other tests look for.
sys.path.pop(0)


@pytest.fixture(scope='module')
def targets(tmp_path_factory):
    pytest.importorskip('rosbags')
    return list(fuzz.targets(tmp_path_factory.mktemp('bags')))


def test_a_few_damaged_inputs_of_every_target_end_as_they_may(targets):
    assert len(targets) > 20
    for target in targets:
        assert fuzz.run(target, seed=2, first=0, count=4) == 4, target.name


def test_sound_inputs_are_read(targets):
    for target in targets:
        for content in target.sound:
            target.feed(content)


@pytest.mark.parametrize(
    'feed',
    [
        lambda data: {}[data],
        lambda data: np.ones(20 << 20, np.uint8),
        lambda data: list(range(10**6)) * 3,
    ],
    ids=['an exception', 'an array', 'a list'],
)
def test_what_is_not_allowed_is_found(feed, capsys):
    target = fuzz.Target('broken', [b'sound'], feed)
    assert fuzz.run(target, seed=1, first=7, count=1) == -1
    assert 'broken: input 7 of seed 1' in capsys.readouterr().out


def test_the_same_seed_makes_the_same_inputs():
    calls = []
    for _ in range(2):
        inputs = []
        target = fuzz.Target('kept', [bytes(100)], inputs.append)
        assert fuzz.run(target, seed=3, first=0, count=50) == 50
        calls.append(inputs)
    assert calls[0] == calls[1]
    assert len(set(calls[0])) > 40


def test_an_input_that_does_not_end_is_broken_off_and_kept(tmp_path, capsys):
    def endless(_):
        while True:
            pass

    target = fuzz.Target('endless one', [b'sound'], endless)
    assert 'broken off after 0.05 s' in fuzz.trouble(target, b'sound', longest=0.05)
    broken = fuzz.Target('broken one', [b'sound'], lambda data: {}[data])
    assert fuzz.run(broken, seed=1, first=0, count=3, keep=tmp_path) == -3
    assert len(list(tmp_path.iterdir())) == 3
    assert 'broken one: input 2 of seed 1' in capsys.readouterr().out
