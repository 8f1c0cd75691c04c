"""Compensation against the model it inverts, and its covariances against what samples scatter."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from calibrations import known, with_g, with_skew
from sessions import paper_imu, truth

from imu_calib.calibration.compensate import Compensation, Mark, concatenated, noise_gains
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Units
from imu_calib.common.units import DEG, MICRO_G
from imu_calib.model.sensors import SensorModel, Triad, parameters_of
from imu_calib.model.terms import G_SENSITIVITY, named_terms
from imu_calib.session.imu import ImuSpec, TriadSpec, load_imu

TAU = 0.01
PULSE = np.array([7.8 / 3600 * DEG, 0.01])


def inputs(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 3)), 9.8 * rng.normal(size=(count, 3))


@pytest.mark.parametrize('units', list(Units))
def test_the_outputs_are_the_inputs_that_the_model_was_given(units):
    scale = PULSE if units is not Units.SI else np.ones(2)
    spec = ImuSpec('any', units, None, TriadSpec(scale[0]), TriadSpec(scale[1]))
    rate, force = inputs(1000)
    gyro, accel = with_g().predict(rate, force)
    width = TAU if units.per_interval else 1.0
    result = Compensation(known(spec, with_g())).apply(
        gyro * width / scale[0], accel * width / scale[1], np.full(1000, TAU)
    )
    # Twelve digits of a double's fifteen.
    assert result.rate == pytest.approx(rate, abs=1e-11)
    assert result.force == pytest.approx(force, abs=1e-10)
    assert not result.marks.any()


def test_a_worked_case_by_hand():
    # 5 % more scale and a bias of 0.1 on X; 200 pulses of 0.01 m/s in 1/4 s are 8 m/s^2, so
    # f_x = (8 - 0.1) / 1.05 = 7.523809...; the gyro z feels 2e-3 rad/s per m/s^2 along X.
    matrix, sensitivity = np.diag([0.05, 0.0, 0.0]), np.zeros((3, 3))
    sensitivity[2, 0] = 2e-3
    accel = Triad(matrix, np.array([0.1, 0.0, 0.0]))
    spec = ImuSpec('any', Units.PULSES, None, TriadSpec(1e-3), TriadSpec(0.01))
    calibration = known(spec, SensorModel(Triad(), accel, sensitivity))
    result = Compensation(calibration).apply(
        np.array([[0.0, 0.0, 5.0]]), np.array([[200.0, 0.0, 0.0]]), np.array([0.25])
    )
    assert result.force[0] == pytest.approx([7.9 / 1.05, 0, 0], rel=1e-12)
    assert result.rate[0] == pytest.approx([0, 0, 0.02 - 2e-3 * 7.9 / 1.05], rel=1e-12)


@pytest.mark.parametrize('model', [truth().model, with_g(), with_skew()])
def test_a_sample_has_the_same_bits_alone_and_among_many(model):
    skewed = model.skewed is not None
    rng = np.random.default_rng(1)
    compensation = Compensation(known(model=model, random_walk=[1e-5] * 6), skewed=skewed)
    assert (compensation._single is None) == skewed
    gyro, accel, interval = rng.normal(size=(2000, 3)), rng.normal(size=(2000, 3)), np.full(2000, 1)
    interval = interval * rng.uniform(0.009, 0.011, 2000)
    fourth = rng.normal(size=(2000, 1)) if skewed else None
    whole = compensation.apply(gyro, accel, interval, fourth)
    edges = np.unique(np.concatenate([np.arange(60), rng.integers(0, 2000, 30), [2000]]))
    parts = concatenated(
        [
            compensation.apply(
                gyro[a:b], accel[a:b], interval[a:b], None if fourth is None else fourth[a:b]
            )
            for a, b in pairwise(edges)
        ]
    )
    for name in ('rate', 'force', 'rate_covariance', 'force_covariance', 'marks'):
        assert np.array_equal(getattr(parts, name), getattr(whole, name)), name


@pytest.mark.parametrize('accelerometers', [True, False])
@pytest.mark.parametrize('units', list(Units))
def test_a_sample_alone_is_marked_and_doubted_as_among_many(units, accelerometers):
    # Ranges in SI: the ends of 16 bits come before them.
    spec = ImuSpec('any', units, None, TriadSpec(1e-3, range=40.0), TriadSpec(1e-2, range=400.0))
    model = with_g()
    calibration = known(spec, model, random_walk=[1e-5] * 6, highest_rate=3.0)
    count = len(calibration.parameters)
    root = np.random.default_rng(8).normal(size=(count, count)) * 1e-5
    square = root.T @ root
    if not accelerometers:
        unknown = np.array([p.triad == 'a' for p in calibration.parameters])
        square[unknown] = square[:, unknown] = np.nan
    compensation = Compensation(replace(calibration, covariance=square))
    gyro, accel = inputs(100, seed=9)
    gyro, accel = (1000 * gyro, 100 * accel) if units is not Units.SI else (gyro, accel)
    wild = [np.nan, np.inf, -np.inf, 32767, -32768, 41.0, 41e3, 410.0]
    fast = [3.5 if units is Units.SI else 3500.0] * 3
    for row, value in enumerate([*wild, *fast]):
        gyro[row, row % 3] = accel[row + 20, row % 3] = value
    interval = np.random.default_rng(10).uniform(0.9, 1.1, 100)
    whole = compensation.apply(gyro, accel, interval)
    rows = [slice(k, k + 1) for k in range(100)]
    alone = concatenated([compensation.apply(gyro[r], accel[r], interval[r]) for r in rows])
    for name in ('rate', 'force', 'rate_covariance', 'force_covariance', 'marks'):
        assert np.array_equal(getattr(alone, name), getattr(whole, name), equal_nan=True), name
    assert {0, Mark.NO_NUMBER, Mark.RATE} < set(whole.marks.tolist())
    assert (whole.force_covariance[:, 0] < 0).all() != accelerometers


def test_the_covariance_is_the_scatter_of_calibrations_drawn_from_theirs():
    # Any positive definite covariance of 33 parameters, and 4000 units drawn from it.
    rng = np.random.default_rng(2)
    model = with_g()
    parameters = parameters_of([G_SENSITIVITY])
    root = rng.normal(size=(33, 33)) * np.where([p.column is None for p in parameters], 1e-4, 1e-6)
    root *= np.where(np.arange(33) >= 24, 0.1, 1.0)
    calibration = replace(known(model=model), covariance=root.T @ root)
    rate, force = np.array([[0.7, -0.3, 0.2]]), np.array([[3.0, -8.0, 5.0]])
    gyro, accel = model.predict(rate, force)
    counts = gyro * TAU / PULSE[0], accel * TAU / PULSE[1]
    compensated = Compensation(calibration).apply(*counts, np.array([TAU]))
    drawn = []
    for offset in rng.normal(size=(4000, 33)) @ root:
        values = model.values(parameters) + offset
        other = replace(
            SensorModel.from_vector(values[:24]), g_sensitivity=values[24:].reshape(3, 3)
        )
        drawn.append(np.hstack(other.compensate(gyro, accel))[0])
    found = np.cov(np.array(drawn).T)
    quantum = np.repeat((PULSE / TAU) ** 2 / 6, 3)
    inverse = np.linalg.inv(model.accel.response)
    by_pulse = inverse @ np.diag(quantum[3:]) @ inverse.T
    stated = compensated.force_covariance.reshape(3, 3) - by_pulse
    scale = np.sqrt(np.outer(np.diag(found)[3:], np.diag(found)[3:]))
    # 4000 draws tell a variance to sqrt(2 / 4000) = 2.2 %.
    assert np.abs(stated - found[3:, 3:]).max() < 5 * 0.022 * scale.max()
    response = np.linalg.inv(model.gyro.response)
    through = response @ model.g_sensitivity @ inverse
    by_pulse = response @ np.diag(quantum[:3]) @ response.T
    by_pulse += through @ np.diag(quantum[3:]) @ through.T
    stated = compensated.rate_covariance.reshape(3, 3) - by_pulse
    assert np.abs(stated - found[:3, :3]).max() < 5 * 0.022 * np.diag(found)[:3].max()


def test_noise_passes_through_the_slopes_of_curved_outputs():
    parameters = parameters_of(named_terms('gyro_cubic,accel_quadratic,accel_cubic'))
    # A tenth to a third of the slope at these inputs: far more than any sensor bends.
    size = {'gyro_cubic': 0.2, 'accel_quadratic': 8e-3, 'accel_cubic': 1e-3}
    bent = [size[p.kind.value.key] * (1 + 0.1 * p.row) for p in parameters[24:]]
    model = SensorModel().with_values(parameters, np.array([*truth().model.vector(), *bent]))
    inputs = np.array([0.7, -0.3, 0.2, 3.0, -8.0, 5.0])

    def outputs(x):
        return np.hstack(model.predict(x[None, :3], x[None, 3:]))[0]

    step = 1e-5 * np.eye(6)
    slopes = np.array([(outputs(inputs + h) - outputs(inputs - h)) / 2e-5 for h in step]).T
    gyro, accel = model.predict(inputs[None, :3], inputs[None, 3:])
    compensated = Compensation(known(model=model)).apply(
        gyro * TAU / PULSE[0], accel * TAU / PULSE[1], np.array([TAU])
    )
    inverse = np.linalg.inv(slopes)
    # A pulse count's error at either end of the sample is even over one pulse.
    wanted = inverse @ np.diag(np.repeat((PULSE / TAU) ** 2 / 6, 3)) @ inverse.T
    for found, part in (
        (compensated.rate_covariance, wanted[:3, :3]),
        (compensated.force_covariance, wanted[3:, 3:]),
    ):
        assert found.reshape(3, 3) == pytest.approx(part, rel=1e-6, abs=1e-9 * part.max())


def test_the_noise_of_a_sample_is_walk_and_pulse():
    walk = np.array([2e-5] * 3 + [2e-3] * 3)
    spec = ImuSpec('any', Units.PULSES, None, TriadSpec(1e-7), TriadSpec(1e-4))
    calibration = known(spec, SensorModel(), random_walk=walk.tolist())
    rng = np.random.default_rng(3)
    count = 20_000
    # An accumulating counter, as hardware counts: the whole part of a sum that goes on.
    true = np.hstack([np.full((count, 3), 1e-4), np.full((count, 3), 9.8)]) * TAU
    total = np.cumsum(true + walk * np.sqrt(TAU) * rng.normal(size=(count, 6)), axis=0)
    pulse = np.repeat([1e-7, 1e-4], 3)
    counted = np.diff(np.floor(total / pulse), axis=0, prepend=0.0)[1:]
    result = Compensation(calibration).apply(
        counted[:, :3], counted[:, 3:], np.full(count - 1, TAU)
    )
    variances = np.concatenate([result.rate_covariance[0, ::4], result.force_covariance[0, ::4]])
    found = np.concatenate([result.rate.var(axis=0), result.force.var(axis=0)])
    # 20000 samples tell a variance to 1 %.
    assert found == pytest.approx(variances, rel=0.05)


def test_four_gyros_are_better_than_three_and_contradict_a_bad_one():
    model, count = with_skew(), 20_000
    rng = np.random.default_rng(4)
    rate, force = inputs(count, 4)
    gyro, accel = model.predict(rate, force)
    fourth = model.skewed.predict(rate)
    sigma = 1e-3
    spec = ImuSpec('any', Units.SI, None, TriadSpec(), TriadSpec(), TriadSpec())
    calibration = known(spec, model, random_walk=[sigma * TAU**0.5] * 3 + [0.0] * 3)
    noisy = [x + sigma * rng.normal(size=x.shape) for x in (gyro, fourth)]
    interval = np.full(count, TAU)
    three = Compensation(calibration).apply(noisy[0], accel, interval)
    four = Compensation(calibration, skewed=True).apply(noisy[0], accel, interval, noisy[1])
    for result in (three, four):
        variances = result.rate_covariance[0, ::4]
        assert ((result.rate - rate) ** 2).mean(axis=0) == pytest.approx(variances, rel=0.05)
    # A fourth axis along (1, 1, 1) / sqrt(3) takes a sixth of the variance: 1 - (1/3) / 2.
    assert np.mean(four.rate_covariance[0, ::4] / three.rate_covariance[0, ::4]) == pytest.approx(
        5 / 6, rel=0.01
    )
    # The parity direction of I and s is (s, -1) / sqrt(2): unit noise stays unit noise.
    assert four.parity.std() == pytest.approx(sigma, rel=0.03)
    assert not (four.marks & Mark.PARITY).any()
    noisy[0][:, 1] += 0.1
    bad = Compensation(calibration, skewed=True).apply(noisy[0], accel, interval, noisy[1])
    assert (bad.marks & Mark.PARITY).all()


def test_what_is_out_of_range_is_marked_and_has_no_covariance():
    spec = replace(
        paper_imu(),
        gyro=replace(paper_imu().gyro, range=2.0),
        accel=replace(paper_imu().accel, range=40.0),
    )
    calibration = known(spec, SensorModel(), highest_rate=1.0)
    pulses = np.array([0.5, 1.5, 2.0, np.nan]) * TAU / spec.gyro.scale_factor
    gyro = np.outer(pulses, [1.0, 0.0, 0.0])
    accel = np.zeros((4, 3))
    accel[1, 2] = 40.0 * TAU / spec.accel.scale_factor
    result = Compensation(calibration).apply(gyro, accel, np.full(4, TAU))
    assert result.marks.tolist() == [
        0,
        Mark.RATE | Mark.ACCEL_RANGE,
        Mark.RATE | Mark.GYRO_RANGE,
        Mark.NO_NUMBER,
    ]
    assert (result.rate_covariance[:, 0] == -1).tolist() == [False, False, True, True]
    assert (result.force_covariance[:, 0] == -1).tolist() == [False, True, False, True]


@pytest.mark.parametrize('count', [1, 3])
def test_the_end_of_a_range_is_a_thousandth_below_its_stated_value(count):
    """ADCs clip slightly early, and ranges are stated to three digits."""
    scale = 1e-4
    spec = ImuSpec(
        'any', Units.COUNTS, None, TriadSpec(scale, range=2.0), TriadSpec(scale, range=20.0)
    )
    for share, gyro, accel in ((0.9985, 0, 0), (0.9995, Mark.GYRO_RANGE, Mark.ACCEL_RANGE)):
        rates, forces = np.zeros((count, 3)), np.zeros((count, 3))
        rates[-1, 1] = -share * 2.0 / scale
        result = Compensation(known(spec)).apply(rates, forces, np.full(count, TAU))
        assert result.marks[-1] == gyro
        assert (result.rate_covariance[-1, 0] == -1) == bool(gyro)
        rates[-1, 1], forces[-1, 2] = 0.0, share * 20.0 / scale
        result = Compensation(known(spec)).apply(rates, forces, np.full(count, TAU))
        assert result.marks[-1] == accel


def test_one_pulse_of_a_fast_counter_is_no_end_of_a_range_and_no_high_rate():
    # At 20 kHz a pulse of the paper's unit is 200 m/s^2, or 43 deg/s.
    tau = 5e-5
    spec = replace(
        paper_imu(),
        gyro=replace(paper_imu().gyro, range=0.5),
        accel=replace(paper_imu().accel, range=98.0),
    )
    calibration = known(spec, SensorModel(), highest_rate=0.1)
    gyro = np.array([[1.0, 0, 0], [0, 0, 0], [0, 2.0, 0], [0, 0, 0]])
    accel = np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 0], [0, 0, 2.0]])
    result = Compensation(calibration).apply(gyro, accel, np.full(4, tau))
    assert result.marks.tolist() == [0, 0, Mark.RATE | Mark.GYRO_RANGE, Mark.ACCEL_RANGE]
    singly = Compensation(calibration).apply(gyro[:1], accel[:1], np.array([tau]))
    assert singly.marks.tolist() == [0]


def test_an_adc_at_the_end_of_its_codes_is_marked_without_any_range():
    spec = ImuSpec('any', Units.COUNTS, None, TriadSpec(1e-3), TriadSpec(1e-3))
    gyro = np.array([[-32768.0, 0, 0], [32766.0, 0, 0]])
    result = Compensation(known(spec, SensorModel())).apply(gyro, np.zeros((2, 3)), np.ones(2))
    assert result.marks.tolist() == [Mark.GYRO_RANGE, 0]


def test_a_word_of_32_bits_passes_the_largest_codes_of_shorter_ones_without_a_mark():
    spec = replace(load_imu('adis16470'), sample_rate=None)
    gyro = np.array([[-32768.0, 8388607.0, 0], [2.0**31, 0, 0]])
    accel = np.array([[32767.0, 8388608.0, 5e5], [0, 0, 2.0**31]])
    compensation = Compensation(known(spec, SensorModel()))
    marks = [Mark(0), Mark.GYRO_RANGE | Mark.ACCEL_RANGE]
    assert compensation.apply(gyro, accel, np.ones(2)).marks.tolist() == marks
    alone = [compensation.apply(gyro[k:][:1], accel[k:][:1], np.ones(1)) for k in (0, 1)]
    assert [one.marks.item() for one in alone] == marks


def test_accelerometers_that_were_not_calibrated_are_no_estimate():
    square = np.zeros((24, 24))
    square[12:], square[:, 12:] = np.nan, np.nan
    calibration = replace(known(), covariance=square)
    result = Compensation(calibration).apply(np.zeros((2, 3)), np.ones((2, 3)), np.full(2, TAU))
    assert (result.force_covariance[:, 0] == -1).all()
    assert (result.rate_covariance[:, 0] > 0).all()
    assert np.isfinite(result.rate_covariance).all()


def test_a_model_that_cannot_be_inverted_is_refused():
    flat = SensorModel(Triad(np.diag([0.0, 0.0, -1.0]), np.zeros(3)))
    with pytest.raises(NotObservable, match='singular'):
        Compensation(known(model=flat))


def test_gravity_of_the_paper_to_a_fraction_of_a_micro_g():
    # Whole pulses over ten minutes at rest: the mean is off by at most one pulse of 600 s.
    count = 60_000
    force = np.array([0.0, 0.0, 9.8])
    _, accel = truth().model.predict(np.zeros(3), force)
    counted = np.diff(np.floor(np.outer(np.arange(count + 1), accel * TAU / 0.01)), axis=0)
    result = Compensation(known()).apply(np.zeros((count, 3)), counted, np.full(count, TAU))
    assert np.abs(result.force.mean(axis=0) - force).max() < 0.01 / (count * TAU) * 1.2 + MICRO_G


def test_noise_grows_by_the_longest_row_of_the_inverse():
    """White noise of equal size in three outputs makes of (I + M)^-1 times them its rows' norms."""
    gyro = np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 0.25]])
    accel = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = noise_gains(SensorModel(Triad(gyro, np.zeros(3)), Triad(accel, np.zeros(3))))
    # x is its output less that of y, which is twice as large as y's output.
    wanted = max(np.hypot(1.0, 1.0), 2.0, 0.8), max(2.0, np.hypot(1.0, 1.0), 1.0)
    assert found == pytest.approx(wanted)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((100_000, 3)) @ np.linalg.inv(np.eye(3) + accel).T
    assert noise.std(axis=0).max() == pytest.approx(found[1], rel=0.01)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('nonlinear', [False, True])
@pytest.mark.parametrize('value', [1e300, -1e160, np.inf])
def test_values_whose_squares_cannot_be_computed_are_no_numbers(value, nonlinear):
    model = SensorModel()
    if nonlinear:
        terms = parameters_of(named_terms('gyro_cubic,accel_quadratic'))
        model = model.with_values(terms, np.full(len(terms), 1e-5))
    spec = ImuSpec('any', Units.SI, None, TriadSpec(), TriadSpec())
    compensation = Compensation(known(spec, model, random_walk=[1e-5] * 6))
    for column in range(6):
        raw = np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 9.8], (3, 1))
        raw[1, column] = value
        whole = compensation.apply(raw[:, :3], raw[:, 3:], np.full(3, TAU))
        alone = compensation.apply(raw[1:2, :3], raw[1:2, 3:], np.full(1, TAU))
        assert whole.marks.tolist() == [0, Mark.NO_NUMBER, 0] and alone.marks == Mark.NO_NUMBER
        assert (whole.rate_covariance[:, 0] == -1).tolist() == [False, True, False]
        for kept in (whole.rate, whole.force, whole.rate_covariance, whole.force_covariance):
            assert np.isfinite(kept[[0, 2]]).all()
