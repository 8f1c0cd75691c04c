"""Samples that share a stamp, as drivers give them that stamp what one transfer brings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from other_sessions import MEDIUM, errors, fed
from other_world import World
from sessions import recut

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.common.files import named_file
from imu_calib.common.stream import Block, Floats, ImuBlock, Stamps, Units
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.segmentation.stamp_faults import SharedStamps
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan
from imu_calib.simulation.hand import as_planned
from imu_calib.simulation.options import ImuOptions

START = 1_700_000_000 * 10**9


def stamps(seconds: Floats) -> Stamps:
    return START + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


def taken(
    stamp: Stamps, values: Floats, rate: float | None = 100.0, cuts: tuple[int, ...] = ()
) -> tuple[Stamps, Floats, Stamps, SharedStamps]:
    """What becomes of a stream that comes in pieces."""
    shared = SharedStamps(rate)
    edges = [0, *cuts, len(stamp)]
    pieces = [shared.separate(stamp[a:b], values[a:b]) for a, b in pairwise(edges)]
    one, two, three = (np.concatenate(part) for part in zip(*pieces, strict=True))
    return one, two, three, shared


def transfers(count: int, size: int, rate: float, wait: float = 0.0) -> Floats:
    """When samples come so many at a time; all of half a second at once if one waits so long."""
    made = np.arange(1, count + 1) / rate
    came = made[np.minimum((np.arange(count) // size + 1) * size, count) - 1]
    held = came[count // 2] + wait
    return np.where((came >= came[count // 2]) & (came < held), held, came)


NOISE = np.random.default_rng(1).standard_normal((2000, 6))
PULSES = np.random.default_rng(2).poisson(0.2, (2000, 6)).astype(float)


@pytest.mark.parametrize('stated', [True, False])
@pytest.mark.parametrize('values', [NOISE, PULSES])
@pytest.mark.parametrize(('size', 'rate'), [(2, 100.0), (10, 100.0), (10, 1000.0), (50, 400.0)])
def test_samples_of_one_transfer_are_set_apart(
    size: int, rate: float, values: Floats, stated: bool
) -> None:
    """Also where coarse values of neighbours are often alike."""
    stamp = stamps(transfers(2000, size, rate, 0.3))
    apart, kept, repeats, shared = taken(stamp, values, rate if stated else None)
    # Before the first transfers have ended nothing tells how often neighbours are alike.
    assert len(repeats) <= (0 if values is NOISE else 2)
    assert len(apart) == 2000 - len(repeats)
    assert np.diff(apart).min() >= 1
    assert (apart - stamp[np.isin(values, kept).all(axis=1)][: len(apart)] >= 0).all()
    assert ' samples came with the stamp of the previous one, up to ' in shared.words()[0]


def test_what_comes_twice_is_dropped_and_what_is_too_much_is_not_set_apart() -> None:
    made = stamps(0.01 * np.arange(2000))
    for values in (NOISE, PULSES, np.zeros((2000, 6))):
        twice = np.sort(np.append(np.arange(2000), [7, 300, 301, 1500]))
        apart, _, repeats, shared = taken(made[twice], values[twice])
        assert apart.tolist() == made.tolist()
        assert repeats.tolist() == made[[7, 300, 301, 1500]].tolist()
        assert shared.words() == []
    # Two devices on one topic, and a sample too many: as far as the rate tells.
    both = np.repeat(np.arange(1000), 2)
    apart, _, repeats, shared = taken(made[both], NOISE)
    assert len(repeats) == 0
    assert shared.count <= 1
    one = np.sort(np.append(np.arange(1999), 900))
    assert taken(made[one], NOISE)[3].count == 0


def test_how_a_stream_was_cut_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    for trial in range(60):
        rate = float(rng.choice([50, 100, 400, 1000]))
        size = int(rng.choice([1, 2, 5, 20, 50]))
        came = transfers(2000, size, rate, 0.3 * (trial % 2))
        if trial % 3 == 0:
            came = np.floor(came / 0.0156) * 0.0156
        kept = np.sort(np.append(np.flatnonzero(rng.random(2000) > 0.01), rng.choice(2000, 20)))
        stamp, values = stamps(came[kept]), (NOISE, PULSES)[trial % 2][kept]
        whole = taken(stamp, values, rate)
        cuts = tuple(np.sort(rng.choice(len(stamp), 50, replace=False)).tolist())
        for one, other in zip(whole[:3], taken(stamp, values, rate, cuts)[:3], strict=True):
            assert (one == other).all()


# Sessions


def sharing(block: ImuBlock, size: int) -> ImuBlock:
    """What one transfer brings has the stamp of its last sample."""
    last = np.minimum((np.arange(len(block)) // size + 1) * size, len(block)) - 1
    return replace(block, stamp=block.stamp[last])


@pytest.mark.parametrize('size', [5, 20])
def test_a_session_of_a_second_simulation_is_as_good_as_without(
    monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    feed = Calibrator.add_block

    def share(self: Calibrator, block: Block) -> None:
        feed(self, sharing(block, size) if isinstance(block, ImuBlock) else block)

    monkeypatch.setattr(Calibrator, 'add_block', share)
    found = fed(World(), MEDIUM).finish().calibration
    off = errors(found, MEDIUM)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert len([f for f in found.findings if 'came with the stamp' in f]) == 1
    assert not [f for f in found.findings if 'left out' in f or 'missing' in f]


def by_hand(size: int) -> Iterator[ImuBlock]:
    """A unit that is turned by hand; how many samples share a stamp."""
    held = as_planned(load_plan('six_position_by_hand'), np.random.default_rng([5, 1]))
    blocks = list(held.blocks(HELD, TRUTH, SITE, ImuOptions(bias_instability=False), 5))
    whole = ImuBlock(
        np.concatenate([b.stamp for b in blocks]),
        np.concatenate([b.gyro for b in blocks]),
        np.concatenate([b.accel for b in blocks]),
    )
    yield sharing(whole, size)


SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
WALKS = TriadSpec(random_walk=0.1 * DEG / 60), TriadSpec(random_walk=0.03 / 60)
HELD = ImuSpec('held', Units.SI, 100.0, *WALKS)
TRUTH = Calibration.load(named_file('truths', 'mems_counts')).model


def test_a_session_in_the_hand_is_as_good_as_without() -> None:
    def solved(blocks: list[ImuBlock]) -> Calibration:
        calibrator = Calibrator(Setup(HELD, load_plan('six_position_by_hand'), None, SITE))
        for block in blocks:
            calibrator.add_block(block)
        return calibrator.finish().calibration

    alone, shared = solved(list(by_hand(1))), solved(list(by_hand(10)))
    assert len([f for f in shared.findings if 'up to 10 with one stamp' in f]) == 1
    assert len(shared.findings) == len(alone.findings) + 1
    assert np.abs((shared.values - alone.values) / alone.std)[:24].max() < 0.5
    # Live samples come a few at a time.
    pieces = [b for _, b in recut([('imu', b) for b in by_hand(10)], 3)]
    assert solved(pieces).to_yaml() == shared.to_yaml()
