"""What motion adds to samples is taken off them, and what that leaves unknown is stated."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
from apart_and_late import LATE, PLACES, QUIET, known
from other_sessions import EPOCH
from other_world import DEG, Stop, Unit, World, record

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.compensate import Compensation, concatenated
from imu_calib.calibration.compensator import Compensator, Reading
from imu_calib.common.stream import ImuBlock

SHORT = World(
    dwell=1.0,
    program=tuple(
        Stop(tuple(np.array(angles) * DEG))
        for angles in ((0, 0, 0), (80, 0, 0), (80, -110, 0), (80, -110, 70))
    ),
)


def compensated(unit: Unit, calibration: Calibration, sizes: Sequence[int] = (10**6,)) -> Reading:
    recording = record(SHORT, unit, 0)
    stamps = EPOCH * 10**9 + np.rint(np.array(recording.imu_stamps) * 1e9).astype(np.int64)
    gyro, accel = np.array(recording.gyro), np.array(recording.accel)
    compensator, readings, first = Compensator(calibration), [], 0
    for size in cycle(sizes):
        if first >= len(stamps):
            break
        part = slice(first, first + size)
        readings += compensator.compensate_block(ImuBlock(stamps[part], gyro[part], accel[part]))
        first += size
    readings += compensator.finish()
    assert compensator.waiting == 0
    values = concatenated([reading.values for reading in readings])
    return Reading(np.concatenate([reading.stamp for reading in readings]), values, '')


def test_compensation_takes_off_what_motion_adds():
    # At the arm all three are together: where places are zero along their own axes.
    together = replace(QUIET, places=((0.11, -0.05, 0.08),) * 3, late=0.0)
    wanted = compensated(together, known(terms=False)).values.force
    residuals = compensated(QUIET, known(terms=False)).values.force - wanted
    freed = compensated(QUIET, known(terms=True)).values
    off = freed.force - wanted
    gained, drifted = (np.abs(np.cumsum(part, axis=0) * 0.01).max() for part in (off, residuals))
    # Where a joint starts within a sample it is half right; what is gained on the way is.
    assert drifted > 5e-3
    assert gained < 0.02 * drifted
    at_rest = np.abs(residuals).max(axis=1) < 1e-9
    assert np.abs(off[at_rest]).max() < 0.1
    # What is not known of them is in the covariance of forces, while it moves alone.
    plain = compensated(QUIET, known(terms=False)).values
    more = (freed.force_covariance - plain.force_covariance)[:, [0, 4, 8]]
    moves = np.linalg.norm(freed.rate, axis=1) > 10 * DEG
    # A tenth of T and the P each: of 0.8 ms and some centimetres at a rad per second.
    assert np.sqrt(more[moves].max()) == pytest.approx(9e-3, rel=0.7)
    assert more.min() > -1e-15
    assert np.sqrt(more[20]).max() < 1e-6


def test_a_force_is_as_unknown_as_the_rate_that_places_make_of_it():
    whole = known(terms=True)
    narrow = replace(whole, imu=replace(whole.imu, gyro=replace(whole.imu.gyro, range=20 * DEG)))
    found, sound = compensated(QUIET, narrow).values, compensated(QUIET, whole).values
    clipped = found.rate_covariance[:, 0] < 0
    assert 0.1 < clipped.mean() < 0.9
    assert (found.force_covariance[clipped, 0] == -1).all()
    assert (found.force_covariance[~clipped, 0] >= 0).all()
    # Those beside an unknown rate change by the other side, or not at all.
    inner = ~(clipped | np.roll(clipped, 1) | np.roll(clipped, -1))
    assert np.array_equal(found.force[inner], sound.force[inner])


def test_samples_have_the_same_bits_however_they_come():
    whole = compensated(QUIET, known(terms=True))
    pieces = compensated(QUIET, known(terms=True), (1, 7, 1, 1, 300, 2))
    assert pieces.stamp.tolist() == whole.stamp.tolist()
    for name in ('rate', 'force', 'force_covariance'):
        one, other = getattr(pieces.values, name), getattr(whole.values, name)
        assert one.tobytes() == other.tobytes(), name


def test_the_noise_of_a_change_passes_through_places_and_delay():
    """Parameters that are known: what is added is by the noise of the two samples beside."""
    sure = [replace(c, covariance=0 * c.covariance) for c in (known(True), known(False))]
    tau, rng = 0.01, np.random.default_rng(1)
    stamps = EPOCH * 10**9 + np.arange(3) * 10_000_000
    outputs = rng.integers(-99, 99, (3, 6)).astype(float)
    found = []
    for calibration in sure:
        compensator = Compensator(calibration)
        readings = compensator.compensate_block(ImuBlock(stamps, outputs[:, :3], outputs[:, 3:]))
        readings += compensator.finish()
        found.append(concatenated([r.values for r in readings]).force_covariance)
    noise = Compensation(sure[0]).noise(np.array([tau]))[0]
    apart = np.square(PLACES).sum(axis=1) * noise[:3].mean() + LATE**2 * noise[3:]
    # A difference over two intervals in the middle, over one at both ends.
    twice = 2 / np.array([tau, 2 * tau, tau]) ** 2
    added = (found[0] - found[1]).reshape(3, 3, 3)
    wanted = twice[:, None, None] * np.diag(apart)
    assert added == pytest.approx(wanted, rel=1e-6, abs=1e-6 * wanted.max())


def test_samples_across_a_gap_are_not_beside_each_other():
    # One interval is missing: by how much the unit turned faster meanwhile nobody saw.
    rng, half = np.random.default_rng(2), 20
    number = np.arange(2 * half) + (np.arange(2 * half) >= half)
    stamps = EPOCH * 10**9 + number * 10_000_000
    outputs = np.cumsum(rng.integers(-99, 99, (2 * half, 6)), axis=0).astype(float)

    def forces(rows):
        compensator = Compensator(known(terms=True))
        readings = compensator.compensate_block(
            ImuBlock(stamps[rows], outputs[rows, :3], outputs[rows, 3:])
        )
        readings += compensator.finish()
        return concatenated([r.values for r in readings]).force

    whole = forces(slice(None))
    apart = np.vstack([forces(slice(half)), forces(slice(half, None))])
    assert whole == pytest.approx(apart, abs=1e-9)
