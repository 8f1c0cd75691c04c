"""The stateful compensator: the same bits however its topics are cut and interleaved."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibrations import known, with_skew
from sessions import truth

from imu_calib.calibration.compensate import concatenated
from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.thermal import combine, load_calibration
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock, SkewBlock, TemperatureBlock
from imu_calib.recordings.cdr import Malformed
from imu_calib.recordings.cdr_codec import ImuDecoder, encode_imu, encode_rates, rates_payloads

NS = 1_000_000_000
COUNT = 3000
STAMP = 1_700_000_000 * NS + np.arange(COUNT) * 5_000_000


def block(stamp=STAMP, seed=0):
    rng = np.random.default_rng(seed)
    pulses = np.rint(rng.normal(0, 99, (len(stamp), 6)))
    return ImuBlock(stamp, pulses[:, :3], pulses[:, 3:], 'imu_link')


def cut(whole, start, stop):
    if isinstance(whole, TemperatureBlock):
        return TemperatureBlock(whole.stamp[start:stop], whole.celsius[start:stop])
    if isinstance(whole, SkewBlock):
        return SkewBlock(whole.stamp[start:stop], whole.gyro[start:stop])
    return ImuBlock(
        whole.stamp[start:stop], whole.gyro[start:stop], whole.accel[start:stop], whole.frame_id
    )


def run(calibration, topics, seed=None):
    """Feed topics in step with each other, in random pieces where there is a seed."""
    compensator = Compensator(calibration)
    readings = []
    rng = np.random.default_rng(seed)
    # A temperature may arrive up to its half second late, a skewed sample any time before 50 ms.
    edges = STAMP[0] + np.arange(0, 17 * NS, 20_000_000 if seed is not None else 17 * NS)
    for edge in [*edges[1:].tolist(), 2**62]:
        pieces = []
        for k, topic in enumerate(topics):
            count = int(np.searchsorted(topic.stamp, edge))
            pieces.append(cut(topic, 0, count))
            topics = [*topics[:k], cut(topic, count, len(topic)), *topics[k + 1 :]]
        for piece in rng.permutation(np.array(pieces, dtype=object)) if seed else pieces:
            if seed is not None and len(piece) > 1:
                middle = int(rng.integers(0, len(piece)))
                readings += compensator.compensate_block(cut(piece, 0, middle))
                readings += compensator.compensate_block(cut(piece, middle, len(piece)))
            elif len(piece):
                readings += compensator.compensate_block(piece)
    readings += compensator.finish()
    stamps = np.concatenate([r.stamp for r in readings]) if readings else np.empty(0, np.int64)
    return compensator, stamps, concatenated([r.values for r in readings]) if readings else None


def at(celsius, scale=0.0, walk=1e-5):
    """The paper's unit at a temperature, its parameters moved by a share."""
    model = truth().model.vector() * (1 + scale)
    provenance = {
        'temperature': {'mean': celsius, 'lowest': celsius - 0.3, 'highest': celsius + 0.3},
        'random_walk': [walk] * 6,
    }
    return replace(known(model=type(truth().model).from_vector(model)), provenance=provenance)


@pytest.mark.parametrize('case', ['plain', 'skewed', 'thermal'])
def test_cuts_and_interleaving_carry_no_meaning(case):
    topics = [block()]
    calibration = known(random_walk=[1e-5] * 6)
    if case == 'skewed':
        calibration = known(model=with_skew())
        keep = np.delete(np.arange(COUNT), [100, 101, 2000])
        gyro = np.random.default_rng(1).normal(0, 99, COUNT)
        topics.append(SkewBlock(STAMP[keep], gyro[keep]))
    if case == 'thermal':
        calibration = combine([at(-20.0), at(20.0, 0.1)], ['cold', 'warm'])
        stamp = STAMP[0] + np.arange(16) * NS
        topics.append(TemperatureBlock(stamp, np.linspace(-25.0, 25.0, 16)))
    reference, stamps, values = run(calibration, topics[::-1])
    assert np.array_equal(stamps, STAMP)
    assert reference.waiting == reference.dropped == 0
    assert reference.alone == (3 if case == 'skewed' else 0)
    for seed in (1, 2):
        _, again, same = run(calibration, topics, seed)
        assert np.array_equal(again, STAMP)
        for name in ('rate', 'force', 'rate_covariance', 'force_covariance', 'marks'):
            assert np.array_equal(getattr(same, name), getattr(values, name)), name


def test_what_is_no_number_is_told_from_what_is_marked_otherwise():
    whole = block(STAMP[:4])
    accel = whole.accel.copy()
    accel[1] = np.nan
    compensator = Compensator(at(20.0))
    readings = (
        compensator.compensate_block(ImuBlock(whole.stamp, whole.gyro, accel))
        + compensator.finish()
    )
    found = np.concatenate([reading.numbers for reading in readings])
    assert found.tolist() == [True, False, True, True]


# What compensator_node does with one sample of a live stream, counted rather than timed


MOST_CALLS = 150
"""Of Python and C functions for one sample: 260 took 87 us hot on the machine of the benchmark
(benchmarks/compensator.py), 120 take 46 us; a tenth of a millisecond cold is what is promised."""


def messages(count: int) -> list[bytes]:
    """Samples at 1 kHz."""
    rng = np.random.default_rng(3)
    pulses = np.rint(rng.normal(0.0, 3.0, (count, 6)))
    stamp = 10**18 + np.arange(count) * 10**6
    return encode_imu(ImuBlock(stamp, pulses[:, :3], pulses[:, 3:], 'imu')).payloads()


def compensated(decoder: ImuDecoder, compensator: Compensator, payload: bytes) -> list[bytes]:
    """Do with a message what the node does."""
    given = []
    for block in decoder.decode([payload], Malformed()):
        for reading in compensator.compensate_block(block):
            v = reading.values
            si = ImuBlock(reading.stamp, v.rate, v.force, reading.frame_id)
            given += rates_payloads(si, v.rate_covariance, v.force_covariance)
    return given


def calls_of(function: Any, *arguments: Any) -> int:
    """Count the functions that a call calls, Python's and C's."""
    count = 0

    def note(_: Any, event: str, __: Any) -> None:
        nonlocal count
        count += event in {'call', 'c_call'}

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        function(*arguments)
    finally:
        sys.setprofile(before)
    return count


def test_a_live_sample_takes_few_calls():
    decoder = ImuDecoder()
    compensator = Compensator(load_calibration(named_file('truths', 'cao2022_table1')))
    *first, last = messages(100)
    for payload in first:
        compensated(decoder, compensator, payload)
    assert calls_of(compensated, decoder, compensator, last) < MOST_CALLS


def test_one_sample_is_given_as_among_many():
    """The way of one message writes the bytes that the way of many writes."""
    calibration = load_calibration(named_file('truths', 'cao2022_table1'))
    stream = messages(200)
    decoder, compensator = ImuDecoder(), Compensator(calibration)
    singly = [g for payload in stream for g in compensated(decoder, compensator, payload)]
    together: list[bytes] = []
    blocks = ImuDecoder().decode(stream, Malformed())
    for reading in Compensator(calibration).compensate_block(blocks[0]):
        v = reading.values
        block = ImuBlock(reading.stamp, v.rate, v.force, reading.frame_id)
        together += encode_rates(block, v.rate_covariance, v.force_covariance).payloads()
    assert singly == together
    assert len(singly) == len(stream)
