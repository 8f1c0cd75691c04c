"""What compensator_node does with one sample of a live stream, counted rather than timed."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.thermal import load_calibration
from imu_calib.common.files import named_file
from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr import Malformed
from imu_calib.recordings.cdr_codec import ImuDecoder, encode_imu, encode_rates, rates_payloads

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


def test_a_live_sample_takes_few_calls() -> None:
    decoder = ImuDecoder()
    compensator = Compensator(load_calibration(named_file('truths', 'cao2022_table1')))
    *first, last = messages(100)
    for payload in first:
        compensated(decoder, compensator, payload)
    assert calls_of(compensated, decoder, compensator, last) < MOST_CALLS


def test_one_sample_is_given_as_among_many() -> None:
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
