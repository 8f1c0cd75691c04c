"""The imperfect simulator: against plain loops that share no code with it, and closed forms."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from other_world import DEG, Flaw, World, applied, attitude, rotation_vector, times, transposed
from sessions import SITE, at_one_rate, quick_plan, truth

from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Floats, ImuBlock, JointBlock, Stamps
from imu_calib.common.units import ARCSEC, DEG_H, MICRO_G
from imu_calib.model.sensors import SensorModel
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import Plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import (
    BiasStep,
    Delivery,
    Shake,
    StandOptions,
    ThermalDrift,
    Warming,
    WarmUp,
    load_imperfections,
    read_imperfections,
)
from imu_calib.simulation.stand import SimulatedStand
from imu_calib.simulation.true_table import TableSizes, TrueJoint, TrueTable

TABLE = load_table('three_axis')
PLAN = quick_plan('twelve_position', 5.0)
EXACT = StandOptions(positioning_error=0.0, bias_instability=False, rate_error=0.0)


BRIEF = at_one_rate(PLAN)


def stand(
    options: StandOptions, model: SensorModel | None = None, plan: Plan = PLAN
) -> SimulatedStand:
    spec = load_imu('fog_medium')
    return SimulatedStand(plan, TABLE, spec, model or truth().model, SITE, options, 1)


@cache
def imu(options: StandOptions, *, perfect: bool = False) -> tuple[Stamps, Floats]:
    """All samples of a brief session: stamps and six columns."""
    model = SensorModel() if perfect else None
    stream = stand(options, model, BRIEF).blocks()
    blocks = [b for _, b in stream if isinstance(b, ImuBlock)]
    rows = [np.hstack([b.gyro, b.accel]) for b in blocks]
    return np.concatenate([b.stamp for b in blocks]), np.vstack(rows)


def joints(stand: SimulatedStand) -> tuple[Floats, Floats]:
    """Times and readings of a session's joint states."""
    blocks = [b for _, b in stand.blocks() if isinstance(b, JointBlock)]
    stamp = np.concatenate([b.stamp for b in blocks]) - stand.options.start_time
    return stamp * 1e-9, np.vstack([b.position for b in blocks])


# The table as it truly is.

WOBBLE = ((3e-4, -2e-4), (1e-4, 2e-4)), ((-1e-4, 4e-4), (2e-4, -3e-4))
ENCODER = (2e-4, 3e-4), (-1e-4, 2e-4)
LEAN = (4e-4, -3e-4)


def flawed(joint: int) -> tuple[TrueJoint, Flaw]:
    """A joint with every flaw, in the package's words and in those of the plain loops."""
    scale = joint + 1.0
    wobble = tuple(tuple((scale * c, scale * s) for c, s in w) for w in WOBBLE)
    encoder = tuple((scale * c, scale * s) for c, s in ENCODER)
    lean = (0.0, 0.0) if joint == 0 else LEAN
    axis = TABLE.joints[joint].axis
    true = TrueJoint(axis, 1e-3 * scale, encoder, wobble, lean)
    flaw = Flaw(
        1e-3 * scale,
        lean,
        tuple((*w[0], *w[1]) for w in wobble),
        (*encoder[0], *encoder[1]),
    )
    return true, flaw


@pytest.fixture(scope='module')
def crooked():
    """One table with all flaws, large ones, in both simulations."""
    pairs = [flawed(j) for j in range(3)]
    options = replace(EXACT, true=TrueTable(tuple(t for t, _ in pairs)), tilt=(2e-4, 0.0))
    world = World(
        latitude=SITE.latitude,
        gravity=SITE.gravity,
        tilt=(2e-4, 0.0),
        flaws=tuple(f for _, f in pairs),
    )
    return stand(options), world


def test_a_crooked_table_stands_as_the_plain_loops_say(crooked):
    session, world = crooked
    instants = np.linspace(0.0, session.duration, 200)
    readings, _ = session._table.read(instants)
    found = session.motion.attitude(instants)
    for k, reading in enumerate(readings):
        wanted = np.array(attitude(tuple(reading), world))
        # Encoders resolve 3e-7 rad, and directions across a leaning axis lean by 5e-4 of 1e-3.
        assert np.abs(found[k] - wanted).max() < 3e-6, instants[k]
    # All of it shows: the smallest flaw is a hundred times the tolerance.
    square = TABLE.attitude(readings)
    assert np.abs(found - square).max() > 1e-3


def test_the_gyros_of_a_crooked_table_feel_the_turn_of_its_attitudes(crooked):
    session, _ = crooked
    turning = next(v for v in session.visits if v.step.rates.any())
    edges = turning.begin + 1.5 + 0.01 * np.arange(400)
    angle, velocity = session.motion.increments(edges, SITE, np.zeros(3))
    attitudes = session.motion.attitude(edges)
    middles = session.motion.attitude((edges[1:] + edges[:-1]) / 2)
    earth, up = SITE.earth_rate, SITE.specific_force
    for k in range(len(edges) - 1):
        before, after = (tuple(map(tuple, attitudes[k + j])) for j in range(2))
        turned = np.array(rotation_vector(times(transposed(before), after)))
        middle = transposed(tuple(map(tuple, middles[k])))
        wanted = turned + 0.01 * np.array(applied(middle, tuple(earth)))
        # An interval of a tenth of a degree: the rotation vector of a steady turn is its integral
        # but for the wobble, which turns with 1e-3 of the rate.
        assert np.abs(angle[k] - wanted).max() < 1e-9
        assert np.abs(velocity[k] / 0.01 - applied(middle, tuple(up))).max() < 1e-4


def test_sizes_are_standard_deviations():
    sizes = TableSizes(zeros=1e-4, orthogonality=2e-4, wobble=(3e-4, 4e-4), encoder=(5e-4, 6e-4))
    drawn = [TrueTable.drawn(TABLE, sizes, seed) for seed in range(400)]
    zeros = np.array([[j.zero for j in t.joints] for t in drawn])
    leans = np.array([[j.lean for j in t.joints] for t in drawn])
    # At any angle an error has the stated size: cosine and sine share the variance.
    wobble = np.array([[j.wobble for j in t.joints] for t in drawn])
    encoder = np.array([[j.encoder for j in t.joints] for t in drawn])
    # A standard deviation of 1200 draws is known to 2 %, of 2400 to 1.4 %; four of that.
    assert zeros.std() == pytest.approx(1e-4, rel=0.08)
    assert not leans[:, 0].any()
    assert leans[:, 1:].std() == pytest.approx(2e-4, rel=0.08)
    for n, size in enumerate(sizes.wobble):
        assert np.sqrt((wobble[:, :, :, n] ** 2).sum(-1).mean()) == pytest.approx(size, rel=0.08)
    for n, size in enumerate(sizes.encoder):
        assert np.sqrt((encoder[:, :, n] ** 2).sum(-1).mean()) == pytest.approx(size, rel=0.08)
    assert TrueTable.drawn(TABLE, sizes, 3) == drawn[3]


def test_joints_arrive_wrong_until_they_move_again():
    session = stand(replace(EXACT, stop_error=10 * ARCSEC))
    missed = []
    for visit in session.visits:
        at_rest = np.array([visit.rest + 0.2, visit.end - 0.2])
        missed.append(session._table.angles(at_rest) - session._table.read(at_rest)[0])
        assert np.ptp(missed[-1], axis=0).max() < 1e-12
    hidden = np.array([m[0] for m in missed])
    angles = np.array([session._table.read(np.array([v.end - 0.2]))[0][0] for v in session.visits])
    moved = np.vstack([np.zeros(3, bool), np.abs(np.diff(angles, axis=0)) > 1e-3])
    stayed = np.abs(np.diff(hidden, axis=0, prepend=hidden[:1])) < 1e-9
    # Whole turns are motions, too: encoders that count on show them.
    assert (stayed == ~moved).all()
    drawn = hidden[moved]
    assert len(drawn) > 30
    assert drawn.std() == pytest.approx(10 * ARCSEC, rel=4 / math.sqrt(2 * len(drawn)))


def test_the_table_leans_anew_at_every_stop():
    session = stand(replace(EXACT, stop_tilt=20 * ARCSEC, stop_heading=5 * ARCSEC))
    exact = stand(EXACT)
    off = []
    for visit in session.visits:
        instants = np.linspace(visit.rest + 0.01, visit.end - 0.01, 4)
        lean = session.motion.attitude(instants) @ exact.motion.attitude(instants).transpose(
            0, 2, 1
        )
        assert np.ptp(lean, axis=0).max() < 1e-12
        off.append(rotation_vector(tuple(map(tuple, lean[0]))))
    east, north, up = np.array(off).T
    tolerance = 4 / math.sqrt(2 * len(off))
    assert np.hypot(east.std(), north.std()) == pytest.approx(
        math.sqrt(2) * 20 * ARCSEC, rel=tolerance
    )
    assert up.std() == pytest.approx(5 * ARCSEC, rel=tolerance)


def test_encoders_are_noisy_and_ramps_are_long():
    session = stand(replace(EXACT, encoder_noise=7 * ARCSEC, acceleration=20 * DEG))
    instants, readings = joints(session)
    visit = session.visits[1]
    resting = (instants > visit.rest + 0.1) & (instants < visit.end - 0.1)
    noise = readings[resting].std(axis=0)
    assert noise == pytest.approx(7 * ARCSEC, rel=4 / math.sqrt(2 * resting.sum()))
    assert np.diff(session._table._track.rate, axis=0).any()
    assert np.abs(session._table._track.acceleration).max() == pytest.approx(20 * DEG)


# Samples on their way.


def test_what_is_delivered_does_not_depend_on_how_blocks_are_cut():
    delivery = Delivery(
        bunch=3, late=0.02, delay=0.03, lost=0.02, twice=0.02, frozen_every=20.0, frozen_for=2.0
    )
    options = replace(EXACT, delivery=delivery, imu_stamp_jitter=1e-3, bias_instability=False)
    whole = imu(options)
    cut = imu(replace(options, block_length=0.37))
    assert (whole[0] == cut[0]).all()
    # The values of long and of short blocks differ by the rounding of the integrals.
    assert (whole[1] == cut[1]).mean() > 0.999


def test_other_imperfections_leave_noise_and_counts_as_they_were():
    stamps, counts = imu(EXACT)
    late, same = imu(replace(EXACT, delivery=Delivery(late=0.01, delay=0.02, bunch=4)))
    assert (same == counts).all()
    assert (late >= stamps).all()
    _, fewer = imu(replace(EXACT, delivery=Delivery(lost=0.01)))
    kept = np.isin(stamps, imu(replace(EXACT, delivery=Delivery(lost=0.01)))[0])
    assert (counts[kept] == fewer).all()


def test_samples_are_lost_and_sent_twice_by_their_shares():
    stamps, counts = imu(EXACT)
    after, _ = imu(replace(EXACT, delivery=Delivery(lost=0.02)))
    lost, n = len(stamps) - len(after), len(stamps)
    assert lost == pytest.approx(0.02 * n, abs=4 * math.sqrt(0.02 * n))
    after, values = imu(replace(EXACT, delivery=Delivery(twice=0.02)))
    again = np.flatnonzero(np.diff(after) == 0)
    assert len(again) == pytest.approx(0.02 * n, abs=4 * math.sqrt(0.02 * n))
    assert (values[again] == values[again + 1]).all()
    assert (np.delete(values, again, axis=0) == counts).all()


def test_bunches_are_stamped_when_their_last_sample_is_there():
    stamps, _ = imu(EXACT)
    bunched, _ = imu(replace(EXACT, delivery=Delivery(bunch=4)))
    whole = len(stamps) // 4 * 4
    wait = (bunched - stamps)[:whole].reshape(-1, 4)
    # Three intervals for the first, none for the last; they come off the queue 20 us apart.
    assert np.abs(wait - [30_000_000, 20_020_000, 10_040_000, 60_000]).max() <= 1


def test_a_late_sample_holds_up_those_behind():
    stamps, _ = imu(EXACT)
    late, _ = imu(replace(EXACT, delivery=Delivery(late=0.01, delay=0.05)))
    wait = (late - stamps) * 1e-9
    assert (np.diff(late) >= 20_000 - 1).all()
    held_up = wait > 1e-6
    # One in a hundred by five samples in the mean, and those that queue: mean wait of each queue's
    # samples falls by an interval from one to the next.
    assert 0.03 < held_up.mean() < 0.1
    falling = wait[1:] - wait[:-1]
    queued = held_up[1:] & held_up[:-1] & (falling < 0)
    # Some of those behind are late themselves.
    assert np.isclose(falling[queued], -0.01 + 20e-6, atol=2e-9).mean() > 0.98


def test_a_frozen_device_repeats_one_sample_and_loses_what_it_counted():
    stamps, counts = imu(EXACT)
    delivery = Delivery(frozen_every=60.0, frozen_for=3.0)
    same_stamps, frozen = imu(replace(EXACT, delivery=delivery))
    assert (same_stamps == stamps).all()
    changed = (frozen != counts).any(axis=1)
    # Some samples of a freeze are what they would have been anyhow.
    places = np.flatnonzero(changed)
    freezes = np.split(places, np.flatnonzero(np.diff(places) > 300) + 1)
    assert len(freezes) >= 2
    for places in freezes:
        first, last = int(places[0]), int(places[-1])
        assert 290 < last - first < 301
        assert (frozen[first - 1 : last + 1] == frozen[first - 1]).all()


# What warms up, and what shakes.


def test_biases_fade_step_and_follow_the_temperature_as_stated():
    quiet = replace(EXACT, noise=False, quantise=False)
    stamps, still = imu(quiet, perfect=True)
    seconds = (stamps - stamps[0]) * 1e-9
    spec = load_imu('fog_medium')
    per_sample = 0.01 / np.repeat([spec.gyro.scale_factor, spec.accel.scale_factor], 3)
    fading = WarmUp((0.1 * DEG_H, 0.0, -0.2 * DEG_H), 50 * MICRO_G, 120.0)
    _, warm = imu(replace(quiet, warm_up=fading), perfect=True)
    start = np.array([0.1 * DEG_H, 0.0, -0.2 * DEG_H, *(3 * [50 * MICRO_G])])
    wanted = start * np.exp(-seconds / 120.0)[:, None] * per_sample
    # The first interval begins within a sample of time zero: 0.01 s of 120.
    assert np.abs(warm - still - wanted).max() < 2e-4 * np.abs(wanted).max()
    step = BiasStep(30.0, (0.1 * DEG_H, 0.0, -0.2 * DEG_H), 50 * MICRO_G)
    _, stepped = imu(replace(quiet, bias_step=step), perfect=True)
    after = start * (seconds > 30.0)[:, None] * per_sample
    # But for the sample in which it comes.
    apart = np.abs(seconds - 30.0) > 0.015
    assert np.abs(stepped - still - after)[apart].max() < 2e-4 * np.abs(after).max()
    drift = ThermalDrift(gyro_bias=1 * DEG_H, accel_bias=(MICRO_G, 0.0, 0.0))
    ramp = replace(quiet, warming=Warming(ramp=0.01), thermal_drift=drift)
    _, hot = imu(ramp, perfect=True)
    rise = 0.01 * seconds[:, None] * np.array([*(3 * [DEG_H]), MICRO_G, 0.0, 0.0]) * per_sample
    assert np.abs(hot - still - rise).max() < 2e-4 * np.abs(rise).max()


def test_a_unit_above_the_reference_is_one_of_other_parameters():
    scale = (1e-5, -2e-5, 3e-5)
    drift = ThermalDrift(1 * DEG_H, scale, (2 * MICRO_G, 0.0, MICRO_G), 4e-6)
    quiet = replace(EXACT, noise=False, quantise=False)
    warm = replace(quiet, warming=Warming(offset=5.0), thermal_drift=drift)
    model = truth().model

    def samples(options, model):
        blocks = [b for _, b in stand(options, model, BRIEF).blocks() if isinstance(b, ImuBlock)]
        return np.vstack([np.hstack([b.gyro, b.accel]) for b in blocks])

    wanted = samples(warm, model)
    np.testing.assert_allclose(samples(quiet, drift.on(model, 5.0)), wanted, rtol=1e-9, atol=1e-9)
    assert np.abs(samples(quiet, model) - wanted).max() > 1e-3


def test_a_floor_shakes_as_hard_as_stated_and_goes_nowhere():
    shake = Shake(rate=1e-3, force=0.02, lowest=5.0, highest=40.0)
    shaken, still = (stand(o).motion for o in (replace(EXACT, shake=shake), EXACT))
    edges = 1e-3 * np.arange(60_001)
    off = np.hstack(shaken.increments(edges, SITE, np.zeros(3)))
    off -= np.hstack(still.increments(edges, SITE, np.zeros(3)))
    # At 1 kHz an interval averages 40 Hz by 0.3 %; over a minute the tones beat by some 2 %.
    rms = np.sqrt((off**2).mean(axis=0)) * 1000
    assert rms == pytest.approx([1e-3] * 3 + [0.02] * 3, rel=0.05)
    # Angle and velocity ring about zero: what remains is an amplitude, 1e-3 / (2 pi 5).
    assert np.abs(off.sum(axis=0))[:3].max() < 4 * 1e-3 / (2 * math.pi * 5)


# The file.


def read(text: str) -> StandOptions:
    return read_imperfections(Section.parse(text, 'wrong.yaml'), EXACT, TABLE, 7)


def test_a_file_that_says_nothing_changes_nothing():
    assert read('{}') == EXACT


def test_a_file_of_the_first_version_is_read():
    text = 'table: {positioning: {joints: 1 arcsec, tilt: 2 arcsec, heading: 3 arcsec}}'
    assert read(text.replace('positioning', 'arrivals')) == read(text) != EXACT


def test_the_shipped_file_holds_every_key():
    options = load_imperfections('laboratory', EXACT, TABLE, 7)
    assert options.true == TrueTable.drawn(
        TABLE,
        TableSizes(
            zeros=10 * ARCSEC,
            orthogonality=3 * ARCSEC,
            wobble=(0.5 * ARCSEC, 0.5 * ARCSEC),
            encoder=(0.5 * ARCSEC, 0.5 * ARCSEC),
        ),
        7,
    )
    assert options.tilt == pytest.approx((5 * ARCSEC, -3 * ARCSEC))
    assert options.stop_error == pytest.approx(ARCSEC)
    assert options.acceleration == pytest.approx(100 * DEG)
    assert options.imu_stamp_jitter == pytest.approx(2e-4)
    assert options.delivery == Delivery(late=1e-3, delay=5e-3, lost=1e-4, twice=1e-4)
    assert options.clock_rate_error == pytest.approx(20e-6)
    assert options.vibration.force == pytest.approx(5e3 * MICRO_G)
    assert options.shake.rate == pytest.approx(0.005 * DEG)
    assert options.warming.ramp == pytest.approx(2 / 3600)
    assert options.warm_up.time_constant == 600.0


def test_a_hand_has_no_table():
    section = Section.parse('table: {zeros: 3 arcsec}', 'wrong.yaml')
    with pytest.raises(InputError, match='held by hand'):
        read_imperfections(section, EXACT, None, 0)


def test_the_true_table_is_written_beside_the_described_one(tmp_path):
    true = TrueTable.drawn(TABLE, TableSizes(zeros=1e-3, wobble=(1e-5, 0.0)), 5)
    true.save(tmp_path / 'true_table.yaml', TABLE)
    written = Section.load(tmp_path / 'true_table.yaml')
    assert written.text('table') == 'three_axis'
    outer = written.sections('joints')[0]
    assert float(outer.text('zero').split()[0]) * DEG == pytest.approx(true.joints[0].zero)
    assert float(outer.section('wobble').texts('lean')[0].split()[0]) == 0.0
    wobble = outer.section('wobble').items('errors')[0]
    cosine = true.joints[0].wobble[0][0][0]
    assert float(wobble['cos_1'].split()[0]) * ARCSEC == pytest.approx(cosine)


def test_the_command_writes_both_truths_and_refuses_what_it_cannot_simulate(tmp_path, capsys):
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text('table: {zeros: 30 arcsec}\nsamples: {lost: 1 %}\n', encoding='utf-8')
    stated = ('--imperfections', str(wrong), '--seed', '4')
    session = tmp_path / 'session'
    assert main(['simulate', 'static_six', '-o', str(session), *stated]) == 0
    assert 'true_table.yaml' in capsys.readouterr().out
    written = Section.load(session / 'true_table.yaml').sections('joints')
    drawn = TrueTable.drawn(TABLE, TableSizes(zeros=30 * ARCSEC), 4)
    for joint, true in zip(written, drawn.joints, strict=True):
        assert float(joint.text('zero').split()[0]) * DEG == pytest.approx(true.zero)
    by_hand = ['simulate', 'six_position_by_hand', '-o', str(tmp_path / 'hand'), *stated]
    assert main(by_hand) == 2
    assert 'held by hand' in capsys.readouterr().err
    named = ['simulate', 'static_six', '-o', str(tmp_path / 'no'), '--imperfections', 'nothing']
    assert main(named) == 2
    assert 'there are: laboratory' in capsys.readouterr().err
