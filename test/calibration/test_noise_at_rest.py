"""Noise of a unit at rest: coefficients, intervals and notes against noise made here."""

import re
from typing import Any

import numpy as np
import pytest
import yaml

from imu_calib.calibration.noise_at_rest import (
    KINDS,
    NOISE_EXPORTS,
    NoiseAtRest,
    export_noise,
    noise_at_rest,
)
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.stream import Floats, ImuBlock, Units
from imu_calib.segmentation.allan import (
    AllanAccumulator,
    Term,
    fully_overlapping_sums,
    own_spread,
    spread,
    unit_variances,
)
from imu_calib.segmentation.long_rest import LongRest, LongRestReader
from imu_calib.session.imu import ImuSpec, TriadSpec

PERIOD = 0.01
SI = ImuSpec('si', Units.SI, 100.0, TriadSpec(), TriadSpec())
START = 1_700_000_000_000_000_000
UP = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])


def made(
    rng: np.random.Generator,
    count: int,
    walk: float = 0.0,
    instability: float = 0.0,
    quantisation: float = 0.0,
    rate_walk: float = 0.0,
    ramp: float = 0.0,
) -> Floats:
    """Six channels of noise as IEEE Std 952-1997, annex C, defines it; SI units."""
    rates = rng.normal(size=(count, 6)) * walk / np.sqrt(PERIOD)
    rates += np.diff(rng.normal(size=(count + 1, 6)), axis=0) * quantisation / PERIOD
    rates += np.cumsum(rng.normal(size=(count, 6)), axis=0) * rate_walk * np.sqrt(PERIOD)
    rates += ramp * PERIOD * np.arange(count)[:, None]
    if instability:
        # Half differences (Kasdin 1995, eq. 104): S(f) = 1 / (2 pi f) for a unit variance.
        k = np.arange(1, 2 * count)
        response = np.cumprod(np.concatenate([[1.0], (k - 0.5) / k]))
        size = 1 << (4 * count - 1).bit_length()
        spectrum = np.fft.rfft(response, size)[:, None]
        spectrum = spectrum * np.fft.rfft(rng.normal(size=(2 * count, 6)), size, axis=0)
        rates += np.fft.irfft(spectrum, size, axis=0)[count : 2 * count] * instability
    return np.asarray(rates)


def read(values: Floats, imu: ImuSpec = SI, stamp: Any = None, **kind: Any) -> LongRest:
    if stamp is None:
        stamp = START + np.arange(len(values)) * round(PERIOD * 1e9)
    reader = LongRestReader(imu, **kind)
    for k in range(0, len(values), 5000):
        rows = slice(k, k + 5000)
        reader.add_block(ImuBlock(stamp[rows], values[rows, :3], values[rows, 3:]))
    return reader.finish()


def found(values: Floats, imu: ImuSpec = SI, stamp: Any = None) -> NoiseAtRest:
    return noise_at_rest(read(values, imu, stamp), 'unit')


def test_default_overlap_costs_a_tenth_of_a_deviation_and_full_overlap_nothing():
    rng = np.random.default_rng(1)
    values = rng.normal(size=(20_000, 40))
    accumulator = AllanAccumulator(40)
    accumulator.add(values)
    mine, full = accumulator.sums(1.0), fully_overlapping_sums([values], 1.0)
    phase = np.concatenate([np.zeros((1, 40)), np.cumsum(values, axis=0)])
    white = np.eye(len(Term))[Term.RANDOM_WALK]
    deviations = np.sqrt(own_spread(mine.factors.astype(int).tolist(), mine.lengths, 1.0, white))
    assert np.array_equal(mine.factors, full.factors)
    for k, m in enumerate(mine.factors.astype(int).tolist()):
        second = phase[2 * m :] - 2 * phase[m:-m] + phase[: -2 * m]
        expected = (second**2).mean(axis=0) / (2 * m**2)
        assert full.variance[k] == pytest.approx(expected, rel=1e-9)
        off = (mine.variance[k] - expected) / deviations[k]
        # Forty channels: 1 / sqrt(80) = 11 % of a root mean square.
        assert np.sqrt(np.mean(off**2)) < 0.1 * 1.3
        assert m >= 32 or np.allclose(off, 0.0, atol=1e-9)


def test_full_overlap_is_that_of_allantools():
    allantools = pytest.importorskip('allantools')
    values = made(np.random.default_rng(2), 30_000, 1e-3, rate_walk=1e-5) + UP
    rest = read(values, full_overlap=True)
    for c in range(6):
        tau, expected, _, _ = allantools.oadev(
            values[:, c], rate=1 / PERIOD, data_type='freq', taus=rest.sums.taus
        )
        assert tau == pytest.approx(rest.sums.taus, rel=1e-9)
        assert np.sqrt(rest.sums.variance[:, c]) == pytest.approx(expected, rel=1e-9)


def test_a_stream_is_summed_the_same_however_it_is_cut():
    values = np.random.default_rng(3).normal(size=(50_000, 2))
    whole, parts = AllanAccumulator(2), AllanAccumulator(2)
    whole.add(values)
    for piece in np.split(values, [7, 31, 900, 17_000, 17_001, 45_678]):
        parts.add(piece)
    assert np.array_equal(whole.sums(1.0).counts, parts.sums(1.0).counts)
    assert whole.sums(1.0).squares == pytest.approx(parts.sums(1.0).squares, rel=1e-9)


@pytest.mark.parametrize('kind', ['noise', 'warming', 'jump', 'stuck'])
def test_sums_of_large_pieces_keep_their_digits(kind):
    rng, n = np.random.default_rng(5), 103_000
    values = rng.normal(size=(n, 2))
    values += {
        # A hundred times the noise within a piece; a turn of 90 degrees; a frozen output.
        'noise': 0.0,
        'warming': 1e2 * np.arange(n)[:, None] / 33_000,
        'jump': 1e4 * (np.abs(np.arange(n) - 40_000) < 300)[:, None],
        'stuck': 0.1 - values,
    }[kind]
    accumulator = AllanAccumulator(2)
    accumulator.add(values)
    mine, full = accumulator.sums(1.0), fully_overlapping_sums([values], 1.0)
    every = mine.factors <= 28
    assert np.all(mine.squares >= 0)
    assert np.array_equal(mine.counts[every], full.counts[every])
    # What is stuck differs by rounding alone.
    assert mine.squares[every] == pytest.approx(full.squares[every], rel=1e-7, abs=1e-15 * n)


def test_a_ramp_spreads_the_variances_as_simulated():
    # E = R^2 tau^2 / 2 (IEEE Std 952-1997, eq. C.18), and noise times the constant difference.
    rng, ramp, rows = np.random.default_rng(4), 2e-2, []
    for _ in range(600):
        accumulator = AllanAccumulator(1)
        accumulator.add(rng.normal(size=(600, 1)) + ramp * np.arange(600)[:, None])
        rows.append(accumulator.sums(1.0).variance[-8:, 0])
    sizes = accumulator.sums(1.0).factors.astype(int).tolist()
    squares = np.array([0, 1.0, 0, 0, ramp**2])
    expected = spread(sizes, (600,), 1.0, squares)[-8:, -8:]
    mean = (unit_variances(np.array(sizes, float), 1.0) @ squares)[-8:]
    deviation = np.sqrt(np.diag(expected))
    assert np.mean(rows, axis=0) == pytest.approx(mean, abs=4.5 * deviation.max() / np.sqrt(600))
    # 1 / sqrt(n / 2) = 6 % of a variance.
    assert np.cov(np.transpose(rows)) / np.outer(deviation, deviation) == pytest.approx(
        expected / np.outer(deviation, deviation), abs=0.27
    )


@pytest.mark.parametrize(
    'truth',
    [
        {'walk': 1e-3, 'quantisation': 1e-5, 'instability': 4e-4},
        {'walk': 1e-3, 'rate_walk': 3e-4},
        {'walk': 1e-3, 'ramp': 4e-6},
    ],
)
def test_what_is_determined_lies_within_its_deviation_of_the_truth(truth):
    count, names = 1 << 17, dict(zip(KEYWORDS, KINDS, strict=True))
    channels = [
        channel
        for seed in range(8)
        for channel in found(made(np.random.default_rng(seed), count, **truth)).channels.values()
    ]
    assert all(channel.is_described for channel in channels)
    for keyword, kind in names.items():
        seen = [kind.coefficient(channel.noise) for channel in channels]
        true = truth.get(keyword, 0.0)
        if true:
            errors = [(s.value - true) / (s.std or np.nan) for s in seen if s.value is not None]
            # 48 channels: 1 / sqrt(96) = 10 %.
            assert len(errors) > 40
            # That of a ramp holds also where a rate random walk is part of it, and here none is.
            least = 0.2 if keyword == 'ramp' else 0.6
            assert least < np.sqrt(np.mean(np.square(errors))) < 1.4, kind.name
        else:
            # Two deviations on one side: 2 % of 48.
            assert sum(s.value is not None for s in seen) <= 5, kind.name
        # A limit of 95 %: sqrt(0.95 * 0.05 / 48) = 3 %.
        assert np.mean([s.below >= true for s in seen]) > 0.95 - 4.5 * 0.03


KEYWORDS = ('quantisation', 'walk', 'instability', 'rate_walk', 'ramp')


def test_intervals_hold_the_true_deviation_in_two_of_three():
    true = {'walk': 1e-3, 'rate_walk': 1e-4}
    inside = []
    for seed in range(10):
        for one in found(made(np.random.default_rng(100 + seed), 20_000, **true)).channels.values():
            squares = np.array([0, true['walk'] ** 2, 0, true['rate_walk'] ** 2, 0])
            variance = unit_variances(one.tau / PERIOD, PERIOD) @ squares
            inside.append((one.low**2 < variance) & (variance < one.high**2))
    share = np.mean(inside, axis=0)
    # Sixty channels: sqrt(0.68 * 0.32 / 60) = 6 %; times of one channel are alike.
    assert share.min() > 0.68 - 4.5 * 0.06
    assert abs(share.mean() - 0.683) < 0.09


def test_a_low_pass_filter_is_left_out_of_the_fit_and_named():
    values = made(np.random.default_rng(5), 1 << 17, walk=1e-3)
    kernel = np.exp(-np.arange(60) / 4.0)
    filtered = np.column_stack([np.convolve(v, kernel / kernel.sum(), 'same') for v in values.T])
    noise = found(filtered)
    for one in noise.channels.values():
        walk = one.noise.random_walk
        assert one.fitted_from > PERIOD and one.is_described
        assert walk.value is not None and walk.std is not None
        # A filter of gain 1 keeps the random walk.
        assert abs(walk.value - 1e-3) < 4.5 * walk.std < 3e-4
    assert any('fitted from' in sentence for sentence in noise.findings)


def test_a_counter_shows_the_walk_beneath_its_pulses():
    rng, pulse, walk = np.random.default_rng(6), 4e-5, 2e-5
    triad = TriadSpec(scale_factor=pulse)
    imu = ImuSpec('counter', Units.PULSES, 100.0, triad, triad)
    rates = made(rng, 1 << 17, walk=walk) + 3.3e-3
    counts = np.diff(np.floor(np.cumsum(rates * PERIOD, axis=0) / pulse), axis=0)
    for one in found(counts, imu).channels.values():
        seen = one.noise.random_walk
        assert one.noise.quantisation.value == pytest.approx(pulse / np.sqrt(12))
        assert seen.value is not None and seen.std is not None
        assert abs(seen.value - walk) < 4.5 * seen.std < walk


def test_a_movement_is_said_with_its_time_and_no_average_spans_it():
    count = 120_000
    values = made(np.random.default_rng(7), count, walk=1e-4) + UP
    values[60_000:60_100, 0] += 0.1
    values[60_050:, 3] += 0.2
    rest = read(values)
    assert len(rest.sums.lengths) == 2
    (sentence,) = rest.findings
    assert 'moved or shaken once at 2023-11-14 22:23:2' in sentence
    assert '60' in sentence and 'turned by 1.2 deg' in sentence
    quiet = np.sqrt(rest.sums.variance[:, 3])
    assert quiet == pytest.approx(1e-4 / np.sqrt(rest.sums.taus), rel=1.0)


def test_a_unit_that_is_turned_again_and_again_is_refused():
    values = made(np.random.default_rng(8), 20_000, walk=1e-4) + UP
    values[:, 0] += np.sin(np.arange(20_000) * PERIOD)
    with pytest.raises(
        NotObservable, match=r'does not lie still: it is moved in [0-9]+ % of the sec'
    ):
        read(values)


def test_too_short_a_rest_is_refused():
    with pytest.raises(NotObservable, match='too short for an Allan deviation'):
        read(made(np.random.default_rng(8), 2000, walk=1e-4) + UP)


@pytest.mark.parametrize('last', [1, 50, 150, 250, 350])
def test_a_short_rest_after_the_last_whole_piece_is_no_movement(last):
    values = made(np.random.default_rng(3), 12_000 + last, walk=1e-4) + UP
    assert read(values).findings == ()


def test_a_unit_without_any_noise_gives_a_table_without_rows():
    assert found(np.zeros((12_000, 6)) + UP).to_dataframe().empty


def test_the_table_is_in_the_units_of_data_sheets():
    noise = found(made(np.random.default_rng(4), 20_000, walk=1e-4) + UP)
    table = noise.to_dataframe()
    walk = noise.channels['gx'].noise.random_walk.value
    assert walk is not None
    # 1 rad/sqrt(s) is 180/pi 60 deg/sqrt(h).
    assert table.loc[('gx', 'random_walk'), 'value'] == pytest.approx(walk * 180 / np.pi * 60)
    assert table.loc[('gx', 'random_walk'), 'unit'] == 'deg/sqrt(h)'


def test_lost_doubled_and_false_samples_do_not_change_the_curve():
    rng = np.random.default_rng(9)
    values = made(rng, 100_000, walk=1e-4) + UP + 1e-3
    stamp = START + np.arange(len(values)) * 10_000_000
    spoiled = values.copy()
    spoiled[rng.integers(100, 99_900, 20)] = 0.0
    kept = np.sort(rng.choice(len(values), 99_500, replace=False))
    kept = np.sort(np.concatenate([kept, kept[1000:1010]]))
    kept = kept[(kept < 70_000) | (kept > 70_500)]
    clean, rest = read(values), read(spoiled[kept], stamp=stamp[kept])
    assert len(rest.sums.lengths) == 2
    said = ' '.join(rest.findings)
    for word in ('false', 'duplicates', 'interrupted: 5.0 s', 'are filled in'):
        assert word in said
    rows = len(rest.sums.counts)
    assert rest.sums.variance[:40] == pytest.approx(clean.sums.variance[:40], rel=0.05)
    assert rows > 60 and rest.sums.period == pytest.approx(PERIOD, rel=1e-9)


def test_the_interval_is_that_of_the_stamps_and_not_of_the_data_sheet():
    values = made(np.random.default_rng(10), 30_000, walk=1e-3)
    late = START + np.arange(30_000) * 11_000_000
    rest = read(values, stamp=late + np.random.default_rng(1).integers(0, 500_000, 30_000))
    assert rest.sums.period == pytest.approx(0.011, rel=1e-6)
    # Rates keep their deviation, and the first point is at one sample.
    assert np.sqrt(rest.sums.variance[0]) == pytest.approx(np.full(6, 1e-2), rel=0.03)


def test_filters_get_what_they_ask_for():
    truth = {'walk': 1e-3, 'rate_walk': 1e-4}
    noise = found(made(np.random.default_rng(11), 1 << 17, **truth))
    kalibr = yaml.safe_load(export_noise(noise, 'kalibr').text)
    assert kalibr['gyroscope_noise_density'] == pytest.approx(1e-3, rel=0.02)
    assert kalibr['accelerometer_random_walk'] == pytest.approx(1e-4, rel=0.3)
    assert kalibr['update_rate'] == 100.0
    chain = yaml.safe_load(export_noise(noise, 'openvins').text.replace('%YAML:1.0', ''))
    assert chain['imu0']['accelerometer_noise_density'] == kalibr['accelerometer_noise_density']
    vins = yaml.safe_load(export_noise(noise, 'vins').text.replace('%YAML:1.0', ''))
    # Its step adds dt^2 n^2 / 2 to a velocity, white noise N^2 dt.
    assert vins['acc_n'] ** 2 * PERIOD**2 / 2 == pytest.approx(
        kalibr['accelerometer_noise_density'] ** 2 * PERIOD
    )
    assert vins['gyr_w'] ** 2 * PERIOD**2 == pytest.approx(
        kalibr['gyroscope_random_walk'] ** 2 * PERIOD
    )
    messages = yaml.safe_load(export_noise(noise, 'robot_localization').text)
    covariance = np.reshape(messages['angular_velocity_covariance'], (3, 3))
    assert covariance == pytest.approx(np.eye(3) * 1e-6 / PERIOD, rel=0.02, abs=1e-12)
    assert set(NOISE_EXPORTS) == {'kalibr', 'openvins', 'vins', 'robot_localization'}
    with pytest.raises(InputError, match='expected one of kalibr'):
        export_noise(noise, 'imucal')


def test_a_limit_is_exported_as_one():
    noise = found(made(np.random.default_rng(12), 20_000, walk=1e-3))
    exported = export_noise(noise, 'kalibr')
    assert any('upper limit (95 %)' in note for note in exported.findings)
    below = [one.noise.rate_random_walk.below for one in noise.channels.values()]
    assert yaml.safe_load(exported.text)['gyroscope_random_walk'] == pytest.approx(max(below[:3]))


def test_opencv_reads_the_files_of_openvins_and_vins_fusion(tmp_path):
    noise = found(made(np.random.default_rng(11), 1 << 14, walk=1e-3, rate_walk=1e-4))
    texts = {name: export_noise(noise, name).text for name in ('openvins', 'vins')}
    # Both read by OpenCV, which refuses rows of a matrix that are not farther in than its key.
    for text in texts.values():
        assert re.findall(r'^( *)\w+:\n\1-', text, re.MULTILINE) == []
    cv2 = pytest.importorskip('cv2')
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    vins = cv2.FileStorage(str(tmp_path / 'vins'), cv2.FILE_STORAGE_READ)
    expected = yaml.safe_load(texts['vins'].replace('%YAML:1.0', ''))
    for key in ('acc_n', 'gyr_n', 'acc_w', 'gyr_w', 'g_norm'):
        assert vins.getNode(key).real() == expected[key]
    openvins = cv2.FileStorage(str(tmp_path / 'openvins'), cv2.FILE_STORAGE_READ)
    chain = openvins.getNode('imu0')
    for key, value in yaml.safe_load(texts['openvins'].replace('%YAML:1.0', ''))['imu0'].items():
        node = chain.getNode(key)
        if isinstance(value, list):
            rows = range(len(value))
            assert [[node.at(i).at(j).real() for j in rows] for i in rows] == value, key
        else:
            assert (node.string() if isinstance(value, str) else node.real()) == value, key
