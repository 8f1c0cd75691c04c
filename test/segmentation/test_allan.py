"""The Allan variance against published values, and its fit against streams of known noise."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import nnls
from sessions import at_one_rate, calibrate, paper_imu, quick_plan, session, stand

from imu_calib.common.stream import Floats, Units
from imu_calib.estimation.known_noise import known_noise
from imu_calib.reports.provenance import noise_table
from imu_calib.segmentation.allan import (
    Term,
    allan_sums,
    cluster_sizes,
    counter_share,
    pooled,
    second_differences,
    spread,
    unit_variances,
)
from imu_calib.segmentation.noise import _non_negative, session_noise
from imu_calib.segmentation.segments import Statistics
from imu_calib.segmentation.statistics import statistics_at_rest, to_samples
from imu_calib.session.imu import ChannelNoise, ImuSpec, TriadSpec

PERIOD = 0.01


def nist_data() -> Iterator[float]:
    """The 1000-point test suite of NIST SP 1065 (Riley 2008), section 12.4."""
    n = 1234567890
    for _ in range(1000):
        yield n / 2147483647
        n = 16807 * n % 2147483647


@pytest.mark.parametrize(
    ('clusters', 'deviation'), [(1, 2.922319e-1), (10, 9.159953e-2), (100, 3.241343e-2)]
)
def test_published_deviations_of_the_nist_test_suite(clusters, deviation):
    # NIST SP 1065, Table 31, overlapping Allan deviation.
    phase = np.concatenate([[0.0], np.cumsum(list(nist_data()))])
    total, count = second_differences(phase, clusters)
    assert np.sqrt(total / (2 * count * clusters**2)) == pytest.approx(deviation, rel=5e-7)


def test_overlapping_deviations_are_those_of_allantools():
    allantools = pytest.importorskip('allantools')
    increments = np.random.default_rng(3).normal(size=(3000, 2)).cumsum(axis=0) * PERIOD
    found = np.sqrt(allan_sums([increments], PERIOD).variance)
    assert len(found) == 10
    phase = np.concatenate([np.zeros((1, 2)), np.cumsum(increments - increments.mean(axis=0), 0)])
    for k, row in enumerate(found):
        # Beyond sixteen samples every sixteenth of a cluster is taken: overlap tells no more.
        step = max(1, 2**k // 16)
        for channel, deviation in enumerate(row):
            thinned = phase[::step, channel]
            _, expected, _, _ = allantools.oadev(
                thinned, rate=1 / (PERIOD * step), taus=[2**k * PERIOD]
            )
            assert deviation == pytest.approx(expected[0], rel=1e-9)


# For noise of rate Greenhall and Riley's algorithm takes the limit of large clusters.
@pytest.mark.parametrize(
    ('term', 'alpha', 'within'), [(0, 2, 1e-4), (1, 0, 0.14), (2, -1, 0.03), (3, -2, 0.02)]
)
def test_degrees_of_freedom_are_those_of_allantools(term, alpha, within):
    allantools = pytest.importorskip('allantools')
    freedom = [
        allantools.edf_greenhall(alpha=alpha, d=2, m=m, N=1001, overlapping=True)
        for m in (4, 8, 16)
    ]
    squares = np.eye(len(Term))[term]
    variance = unit_variances(cluster_sizes(5), 1.0) @ squares
    found = 2 * variance**2 / np.diag(spread([1, 2, 4, 8, 16], (1000,), 1.0, squares))
    assert found[2:] == pytest.approx(freedom, rel=within)


def test_the_spread_is_that_of_simulated_stretches():
    # Cross-covariances too: a thousand pairs of stretches of white rate noise.
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(1000):
        runs = [rng.normal(size=(n, 1)) for n in (200, 130)]
        rows.append(allan_sums(runs, 1.0).variance[:, 0])
    expected = spread([1, 2, 4, 8, 16, 32, 64], (200, 130), 1.0, np.array([0, 1.0, 0, 0, 0]))
    scale = np.sqrt(np.diag(expected))
    # 1 / sqrt(n / 2) = 4.5 % of a variance; correlations of chi-squared tails scatter more.
    assert np.cov(np.array(rows).T) / np.outer(scale, scale) == pytest.approx(
        expected / np.outer(scale, scale), abs=0.2
    )


def test_stretches_add_up_and_a_gap_joins_nothing():
    rng = np.random.default_rng(2)
    first, second = rng.normal(size=(500, 6)), rng.normal(size=(400, 6)) + 5.0
    both = allan_sums([first, second], PERIOD)
    added = pooled([allan_sums([first], PERIOD), allan_sums([second], PERIOD)])
    assert np.array_equal(both.squares, added.squares)
    assert both.lengths == added.lengths == (500, 400)
    # A step of 5 between the stretches would be seen at once.
    assert both.variance[0] == pytest.approx(np.full(6, 1 / PERIOD**2), rel=0.2)


def flicker(rng: np.random.Generator, count: int) -> Floats:
    """Rate noise with B = 1, by fractional differences (Kasdin 1995)."""
    k = np.arange(1, count)
    response = np.cumprod(np.concatenate([[1.0], (k - 0.5) / k]))
    size = 1 << (2 * count - 1).bit_length()
    spectrum = np.fft.rfft(response, size) * np.fft.rfft(rng.normal(size=2 * count), size)
    # The first half has not yet seen the whole past.
    return np.fft.irfft(spectrum, size)[count // 2 : count]


def statistics_of(rates: Floats, spec: ImuSpec) -> Statistics:
    """Of a stretch of (n, 6) rates or pulses."""
    stamp = np.arange(1, len(rates) + 1) * round(PERIOD * 1e9)
    samples = to_samples(stamp, rates, spec, PERIOD)
    return statistics_at_rest(samples, np.full(6, 1e-6))


SI = ImuSpec('si', Units.SI, 100.0, TriadSpec(), TriadSpec())
N, B, Q = 2e-5, 1.2e-5, 2e-6


def mixed_noise(seed: int) -> dict[str, ChannelNoise]:
    """Six channels of four stretches with quantisation, random walk and bias instability."""
    rng = np.random.default_rng(seed)
    stretches = []
    for _ in range(4):
        walk = rng.normal(size=(16384, 6)) * N / np.sqrt(PERIOD)
        wander = np.column_stack([flicker(rng, 32768) for _ in range(6)]) * B
        reading = np.diff(rng.normal(size=(16385, 6)), axis=0) * Q / PERIOD
        stretches.append(statistics_of(walk + wander + reading + 1e-3, SI))
    return session_noise(stretches, np.full(6, N))


def test_known_noise_is_found_within_its_deviations():
    found = [c for seed in range(4) for c in mixed_noise(seed).values()]
    for name, truth in (('random_walk', N), ('bias_instability', B), ('quantisation', Q)):
        values = [getattr(c, name) for c in found]
        errors = np.array([(v.value - truth) / v.std for v in values])
        # 24 channels: 1 / sqrt(48) = 0.14.
        assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.5, name
        assert np.mean([v.std for v in values]) < 0.35 * truth


def test_the_curve_is_flat_where_bias_instability_rules():
    rng = np.random.default_rng(5)
    rates = np.column_stack([flicker(rng, 131072) for _ in range(6)])
    floor = np.sqrt(allan_sums([rates * PERIOD], PERIOD).variance[4:10])
    # Over its coefficient B: IEEE Std 952, eq. C.10.
    flat = np.sqrt(2 * np.log(2) / np.pi)
    assert floor == pytest.approx(np.full((6, 6), flat), rel=0.15)


def test_noise_that_does_not_show_is_bounded_not_invented():
    rng = np.random.default_rng(6)
    white = [statistics_of(rng.normal(size=(8192, 6)) * 1e-4, SI) for _ in range(4)]
    for channel in session_noise(white, np.full(6, 1e-5)).values():
        # White rate of 1e-4 per sample is a walk of 1e-5; flat by then is 0.664 B.
        assert channel.random_walk.value == pytest.approx(1e-5, rel=0.03)
        assert channel.bias_instability.below < 1e-5
    values = [c.bias_instability.value for c in session_noise(white, np.full(6, 1e-5)).values()]
    assert values.count(None) >= 4


@pytest.mark.parametrize(('rate', 'walk'), [(0.02, 0.0), (0.3, 0.05), (9.81, 0.02), (0.007, 0.1)])
def test_what_the_steps_of_a_counter_add(rate, walk):
    rng = np.random.default_rng(7)
    true = rng.uniform(size=(400, 1)) + np.cumsum(
        rate + walk * rng.normal(size=(400, 3000)), axis=1
    )
    error = np.floor(true) - true
    for m in (1, 8, 64):
        d = error[:, 2 * m :] - 2 * error[:, m:-m] + error[:, : -2 * m]
        expected = counter_share(rate, walk**2, np.array([float(m)]))[0]
        # A hundred or more phases, each with a chi-squared of its own.
        assert expected == pytest.approx(np.mean(d**2), rel=0.1, abs=0.01)


def test_a_session_shows_the_noise_that_was_put_in_and_no_other():
    spec = paper_imu()
    plan = at_one_rate(quick_plan('twelve_position', 60.0))
    result = calibrate(session(plan, stand(), 3), plan)
    document = result.calibration.provenance['noise']
    seen = {name: ChannelNoise.from_document(entry) for name, entry in document.items()}
    assert list(seen) == ['gx', 'gy', 'gz', 'ax', 'ay', 'az']
    for name, channel in seen.items():
        triad = spec.gyro if name[0] == 'g' else spec.accel
        walk = channel.random_walk
        assert walk.value is not None and walk.std is not None
        assert abs(walk.value - triad.random_walk) < 4.5 * walk.std < 1.5 * triad.random_walk
        assert channel.quantisation.value == pytest.approx(triad.scale_factor / np.sqrt(12))
        # The accelerometers' pulse hides 0.01 (m/s)/pulse against 2e-4 (m/s)/sqrt(s): pulses timed.
        assert channel.timed is (name[0] == 'a')
        assert channel.document() == document[name]
    table = noise_table(result.calibration)
    stated = ' '.join(str(cell) for column in table.columns for cell in column.cells)
    assert '0.05 deg/sqrt(h)' in stated and '0.012 (m/s)/sqrt(h)' in stated


def test_of_the_terms_those_fit_best_that_take_no_negative_number():
    rng = np.random.default_rng(4)
    units, terms = unit_variances(cluster_sizes(12), 0.1), list(Term)
    covariance, kept = np.eye(len(units)), set()
    for _ in range(50):
        wanted = units @ (rng.standard_normal(len(terms)) / np.linalg.norm(units, axis=0))
        found, _, _ = _non_negative(units, wanted, covariance, terms)
        size = np.linalg.norm(units, axis=0)
        expected = nnls(units / size, wanted)[0]
        assert found * size == pytest.approx(expected, rel=1e-9, abs=1e-12)
        kept.add(int((found > 0).sum()))
    assert kept >= {1, 2, 3}


def test_a_channel_that_shows_nothing_is_left_out():
    rates = np.zeros((6000, 6))
    rates[:, 0] = np.random.default_rng(8).normal(size=6000)
    assert list(session_noise([statistics_of(rates, SI)], np.full(6, 0.1))) == ['gx']
    bare = replace(statistics_of(rates, SI), allan=None)
    assert session_noise([bare], np.full(6, 0.1)) == {}


def test_stretches_whose_blocks_differ_in_length_are_not_pooled():
    """Two lengths, half each: midway between them there is none."""
    rng = np.random.default_rng(11)
    pulses = np.round(np.cumsum(np.full((6000, 6), 0.03), axis=0))
    steps = np.diff(pulses, axis=0, prepend=0.0)
    triad = TriadSpec(scale_factor=1.0)
    coarse = ImuSpec('coarse', Units.PULSES, 100.0, triad, triad)
    plain = statistics_of(steps, coarse)

    def blocks_of(length):
        middle = length * (np.arange(12) + 0.5)
        mean = rng.normal(size=12) * 0.1 / np.sqrt(length)
        one = np.column_stack([mean, np.full(12, 1 / length), np.full(12, 1e-9), middle])
        return replace(plain, blocks=(one,) * 6)

    seen = session_noise([blocks_of(10.0), blocks_of(16.0)], np.full(6, 0.1))
    for channel in seen.values():
        assert channel.timed and channel.tau[0] == 16.0
        assert channel.deviation[0] == pytest.approx(0.1 / np.sqrt(16.0), rel=0.5)


def test_noise_that_few_blocks_tell_is_stated_a_deviation_larger():
    # Two dwells of four blocks: six degrees of freedom, and a variance known to sqrt(2 / 6).
    rng = np.random.default_rng(41)
    calls = []
    for _ in range(40):
        dwells = [rng.normal(size=(4000, 6)) * N / np.sqrt(PERIOD) for _ in range(2)]
        evidence = tuple(SimpleNamespace(statistics=statistics_of(d, SI)) for d in dwells)
        calls.append(known_noise(evidence, SI)[0] ** 2 / N**2)
    share = np.sqrt(2 / 6)
    mean, deviation = 1 + share, share * (1 + share) / np.sqrt(np.size(calls))
    assert abs(np.mean(calls) - mean) < 4.5 * deviation
