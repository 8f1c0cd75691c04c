"""The stateful compensator: the same bits however its topics are cut and interleaved."""

from dataclasses import replace

import numpy as np
import pytest
from calibrations import known, with_skew
from sessions import truth

from imu_calib.calibration.compensate import concatenated
from imu_calib.calibration.compensator import Compensator
from imu_calib.calibration.thermal import combine
from imu_calib.common.stream import ImuBlock, SkewBlock, TemperatureBlock

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
