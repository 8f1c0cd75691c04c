"""Two clocks: turns that the table's has timed, and how well the two are compared."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import other_sessions
import pytest
from evidence import evidence_of
from extent import ALL, again
from other_faults import warmed
from other_sessions import MEDIUM, NAVIGATION, errors, fed, recorded
from other_world import World
from sessions import gathered, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.compensate import Compensation
from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.calibration.thermal import combine
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Units
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.methods import method
from imu_calib.estimation.system import observe
from imu_calib.segmentation.clock import ClockFit, ClockSample, fit_clock
from imu_calib.segmentation.segmenter import clock_jumps
from imu_calib.segmentation.segments import Segment, Turn
from imu_calib.session.imu import StampingClock

PPM = 1e-6


def by_a_clock(evidence: Evidence, faster: float) -> Evidence:
    """The same session by an IMU whose clock counts (1 + faster) seconds a second.

    It counts the same pulses over more seconds: every mean output is smaller by so much.
    """

    def slower(part: Segment | Turn) -> Segment | Turn:
        found = part.statistics
        return replace(part, statistics=replace(found, mean=found.mean / (1 + faster)))

    return replace(
        evidence,
        segments=tuple(slower(s) for s in evidence.segments),
        turns=tuple(slower(t) for t in evidence.turns),
        clock=ClockFit(0.0, 0.0, 1e-9, faster, 1e-10, 30),
    )


@pytest.mark.parametrize('faster', [50 * PPM, -50 * PPM])
@pytest.mark.parametrize('name', ['twelve_position', 'six_position', 'joint'])
def test_the_clocks_rate_is_no_scale_factor(name, faster):
    plan = 'twelve_position' if name == 'joint' else name
    evidence = by_a_clock(evidence_of(plan, truth().model, known=True), faster)
    found = method(name)(evidence).model
    # 1e-10 of rate_std beside the 50 ppm that quartz may err leaves nothing of this size.
    assert found.gyro.error_matrix == pytest.approx(truth().model.gyro.error_matrix, abs=1e-2 * PPM)
    wanted = truth().model.accel.error_matrix
    assert found.accel.error_matrix == pytest.approx(wanted, abs=1e-2 * PPM)


@pytest.mark.parametrize('jump', [0.0, 0.2])
def test_the_deviations_of_offset_and_rate_are_those_of_their_errors(jump):
    rng = np.random.default_rng(4)
    motions, runs, scatter, rate = 14, 1000, 1e-4, 20 * PPM
    seconds = 50.0 * np.arange(motions)
    after = seconds > seconds.mean()
    ratios = []
    for _ in range(runs):
        true = 0.01 + rate * seconds + jump * after
        seen = true + scatter * rng.standard_normal(motions)
        fit = fit_clock([ClockSample(1e9 * t, o) for t, o in zip(seconds, seen, strict=True)])
        assert len(fit.jumps) == (jump > 0)
        ratios.append(
            [(fit.rate - rate) / fit.rate_std, (fit.offset - true.mean()) / fit.offset_std]
        )
    # Student's t, for the scatter is estimated too: its variance is f / (f - 2).
    freedom = motions - 2 - (jump > 0)
    square = np.mean(np.square(ratios), axis=0)
    # A thousand of them: 5 %, four deviations of that.
    assert square == pytest.approx([freedom / (freedom - 2)] * 2, rel=0.2)


@pytest.mark.parametrize(
    ('jump', 'words'),
    [(0.0, ''), (2e-5, ''), (1e-3, 'jump by +0.0010 s'), (-0.2, 'jump by -0.2000 s')],
)
def test_a_jump_is_said_where_the_stamps_resolve_it(jump, words):
    """A stream that was interrupted may have been stamped anew, or only have frozen."""
    rng = np.random.default_rng(6)
    seconds = 50.0 * np.arange(12)
    for _ in range(200):
        # Two samples a hundredth apart tell an offset to some ten microseconds.
        seen = 0.01 + jump * (seconds > 275) + 1e-5 * rng.standard_normal(12)
        motions = [ClockSample(1e9 * t, o) for t, o in zip(seconds, seen, strict=True)]
        fit = fit_clock(motions, [275_000_000_000])
        assert fit.jumps == pytest.approx((jump,), abs=6e-5)
        message = clock_jumps(fit)
        assert len(message) == bool(words)
        assert not words or words[:-3] in message[0]


NAMED = {
    'pulses 500 ppm': (NAVIGATION, 500 * PPM),
    'counts 50 ppm': (
        replace(NAVIGATION, counts=True, gyro_pulse=1e-6, accel_pulse=1e-5),
        50 * PPM,
    ),
    'counts 500 ppm': (
        replace(NAVIGATION, counts=True, gyro_pulse=1e-6, accel_pulse=1e-5),
        500 * PPM,
    ),
}


SOME = list(NAMED)[:: 1 if ALL else 2]


@pytest.mark.parametrize('name', SOME)
def test_parameters_are_by_the_clock_of_the_table(name):
    unit, faster = NAMED[name]
    world = World(dwell=15.0, clock=faster, offset=0.02)
    calibrator = fed(world, unit)
    found = calibrator.finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    # It would show: the scale factors are known to a tenth of what the clocks differ by.
    of_clock = found.std[:3] if unit.counts else found.std[12:15]
    assert of_clock.max() < 0.1 * faster
    clock = found.clock
    assert clock.name == 'stamps of other'
    assert abs(clock.faster - faster) < 4.5 * clock.std < 2 * PPM
    read = Calibration.from_yaml(found.to_yaml(), 'calibration.yaml')
    assert read.clock == clock
    # Compensated by the intervals between its stamps a unit at rest feels gravity.
    evidence = gathered(fed(world, unit))
    rest = evidence.segments[-1].statistics
    per = 1.0 if unit.counts else 0.01 * (1 + faster)
    pulses = np.array([unit.gyro_pulse] * 3 + [unit.accel_pulse] * 3)
    raw = (rest.mean * per / pulses)[None]
    felt = Compensation(read).apply(raw[:, :3], raw[:, 3:], np.array([0.01 * (1 + faster)]))
    size = float(np.linalg.norm(felt.force))
    noise = np.sqrt(rest.variance(evidence.walk)[3:].max())
    assert abs(size - world.gravity) < 4.5 * np.hypot(noise, world.gravity * found.std[12:15].max())


def test_numbers_that_no_clock_has_are_refused():
    for faster, std, words in ((0.2, 1e-6, 'faster: found 0.2'), (1e-6, -1.0, 'faster_std: found')):
        wrong = replace(truth(), clock=StampingClock('stamps', 'table', faster, std))
        with pytest.raises(InputError, match=words):
            Calibration.from_yaml(wrong.to_yaml(), 'calibration.yaml')


def test_firmware_is_told_by_which_clock_its_interval_is():
    known = replace(truth(), clock=StampingClock('stamps of A', 'clock of B', 40 * PPM, PPM))
    exported = EXPORTS['c'](ExportSource(known, Path('calibration.yaml')))
    assert 'divide an interval between them by 1.000040000' in exported.text
    assert any('40.0 ppm fast' in sentence for sentence in exported.findings)
    slow = replace(known, clock=replace(known.clock, faster=-40 * PPM))
    exported = EXPORTS['c'](ExportSource(slow, Path('calibration.yaml')))
    assert 'of a clock that is 40.00 ppm slow;' in exported.text
    assert any('that is 40.0 ppm slow:' in sentence for sentence in exported.findings)
    even = replace(known, clock=replace(known.clock, faster=-0.002 * PPM))
    exported = EXPORTS['c'](ExportSource(even, Path('calibration.yaml')))
    # Nobody corrects an interval by that.
    assert 'clock' not in exported.text
    assert not any('clock' in sentence for sentence in exported.findings)
    counts = replace(known, imu=replace(known.imu, units=Units.COUNTS))
    exported = EXPORTS['c'](ExportSource(counts, Path('calibration.yaml')))
    assert 'fast' not in ' '.join([exported.text, *exported.findings])


def test_intervals_of_sessions_that_are_combined_are_those_of_each():
    # One by the table's clock, 40 ppm slower than the stamps', one by the stamps' own.
    points = [
        replace(
            truth(),
            provenance={'temperature': {'mean': t, 'lowest': t, 'highest': t}},
            clock=clock,
        )
        for t, clock in (
            (0.0, StampingClock('stamps', 'table', 40 * PPM, 1 * PPM)),
            (10.0, None),
        )
    ]
    clock = combine(points, ['a', 'b']).at(2.5).clock
    assert clock.faster == pytest.approx(30 * PPM)
    assert clock.std == pytest.approx(0.75 * PPM)


def test_a_recording_by_another_clock_bears_a_calibration_out():
    made, seen = World(dwell=15.0, clock=500 * PPM), World(dwell=15.0, clock=-300 * PPM)
    calibrator = fed(made, NAVIGATION)
    found = calibrator.finish().calibration
    other = fed(seen, NAVIGATION, seed=5)
    setup = other._setup
    session = other._segmenter.finish()
    observed = observe(session, setup.imu, setup.site, setup.plan, setup.table, found.clock)
    assert verify(found, observed).verdict is Verdict.PASS
    # By the stamps' own seconds its pulses would be 300 ppm too many.
    stamped = observe(session, setup.imu, setup.site, setup.plan, setup.table)
    assert verify(found, stamped).verdict is Verdict.FAIL


# A crystal that warms stamps the samples: its clock bends against that of the table


UNITS = {'medium': MEDIUM, 'navigation': NAVIGATION, 'rates': replace(MEDIUM, counts=True)}


@pytest.mark.parametrize('ppm', [5, 20])
@pytest.mark.parametrize('grade', ['navigation', again('medium'), again('rates')])
def test_seconds_follow_the_curve(grade, ppm, monkeypatch):
    """Of 5 ppm nothing was said, and K_g was off by six deviations; 20 ppm were a warm-up."""

    def blocks(world, unit, seed):
        of_table, of_imu = recorded(world, unit, seed)
        return of_table, replace(of_imu, stamp=warmed(of_imu.stamp, ppm))

    monkeypatch.setattr(other_sessions, 'recorded', blocks)
    unit = UNITS[grade]
    found = fed(World(dwell=20.0), unit, find_terms=True).finish().calibration
    off = errors(found, unit)
    assert np.abs(off).max() < 4.5, np.round(off, 1)
    assert not found.parameters[24:]
    assert any('clocks of IMU and table drift unevenly' in one for one in found.findings)


def offsets(scatter: float, bend: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    time = np.sort(np.random.default_rng(seed).uniform(0, 600, 25))
    noise = scatter * np.random.default_rng(seed + 10**6).standard_normal(25)
    return time, 0.1 + 30e-6 * time + bend * np.exp(-time / 150) + noise


def test_the_rate_of_each_part_is_that_of_the_curve_there():
    time, offset = offsets(2e-6, 1e-3, 0)
    fit = fit_clock([ClockSample(1e9 * t, o) for t, o in zip(time, offset, strict=True)])
    for start in range(50, 500, 50):
        end = start + 40
        found = fit.rate + fit.rate_over((start + 0.1) * 1e9, (end + 0.1) * 1e9)
        true = 30e-6 + 1e-3 * (np.exp(-end / 150) - np.exp(-start / 150)) / 40
        assert found == pytest.approx(true, abs=5 * fit.bend.rate_std)
    assert fit.bend.rate_std < 0.2 * PPM


def test_even_clocks_do_not_bend_by_chance():
    for seed in range(500):
        time, offset = offsets(1e-5, 0.0, seed)
        samples = [ClockSample(1e9 * t, o) for t, o in zip(time, offset, strict=True)]
        assert fit_clock(samples).bend is None, seed
