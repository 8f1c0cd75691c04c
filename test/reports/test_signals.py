"""The signals in the report: few means of any session, dwells and turns on them, enlarged."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import browser as browser  # noqa: PLC0414
from browser import contrasts, look_at, needs_chromium, opened, overfull, overlaps, width

import imu_calib
from imu_calib.common.stream import Floats, ImuBlock, Stamps
from imu_calib.common.units import DEG
from imu_calib.segmentation.course import SignalMeans, Signals


@pytest.fixture(scope='module')
def result(tmp_path_factory):
    bag = tmp_path_factory.mktemp('signals') / 'bag'
    imu_calib.simulate('free_positions', bag, imu='mems_counts', latitude=48.1, seed=2)
    return imu_calib.calibrate(bag)


@pytest.fixture(scope='module')
def page(result, tmp_path_factory):
    return imu_calib.report(result, tmp_path_factory.mktemp('page') / 'report.html')


def means(stamp: Stamps, values: Floats, cut: int) -> Signals:
    collected = SignalMeans()
    for k in range(0, len(stamp), cut):
        part = slice(k, k + cut)
        collected.add_block(ImuBlock(stamp[part], values[part, :3], values[part, 3:]))
    return collected.finish()


@pytest.mark.parametrize(('samples', 'size'), [(500, 1), (1999, 1), (2000, 2), (70_000, 64)])
def test_a_session_of_any_length_is_as_many_means(samples, size):
    stamp = np.arange(samples, dtype=np.int64) * 10_000_000
    values = np.random.default_rng(1).normal(size=(samples, 6))
    found = means(stamp, values, 4096)
    assert found.size == size
    assert len(found.stamp) == samples // size
    expected = values[: len(found.stamp) * size].reshape(-1, size, 6).mean(axis=1)
    np.testing.assert_allclose(found.mean, expected, atol=1e-12)
    # The stamp of each is one of its samples.
    assert (found.stamp // 10_000_000 // size == np.arange(len(found.stamp))).all()
    cut = means(stamp, values, 77)
    np.testing.assert_allclose(cut.mean, found.mean, atol=1e-12)
    np.testing.assert_array_equal(cut.stamp, found.stamp)


def element(page: Path, kind: str) -> ET.Element:
    tree = ET.fromstring(page.read_text(encoding='utf-8').removeprefix('<!DOCTYPE html>\n'))
    return next(e for e in tree.iter() if e.get('class') == kind)


def test_holds_lie_where_they_were(page, result):
    plots = [e for e in element(page, 'film').iter('svg') if e.get('preserveAspectRatio')]
    assert len(plots) == 2
    across = float((plots[0].get('viewBox') or '').split()[2])
    session = result.session
    for plot in plots:
        bands = [e for e in plot.iter('rect') if e.get('class') == 'band static']
        assert len(bands) == len(session.segments)
        for band, hold in zip(bands, session.segments, strict=True):
            begins = (hold.start - (session.start or 0)) * 1e-9 / session.duration
            assert float(band.get('x', '')) / across == pytest.approx(begins, abs=1e-5)
            lasts = (hold.end - hold.start) * 1e-9 / session.duration
            assert float(band.get('width', '')) / across == pytest.approx(lasts, abs=1e-5)


def test_curves_are_in_the_units_of_their_titles(result, tmp_path):
    imu, session = result.calibration.imu, result.session
    stamp = (session.start or 0) + np.linspace(0, session.duration * 1e9, 5).astype(np.int64)
    # 30 deg/s about x, and 5 m/s^2 along z, in counts.
    mean = np.zeros((5, 6))
    mean[:, 0] = 30 * DEG / imu.gyro.scale_factor
    mean[:, 5] = 5.0 / imu.accel.scale_factor
    shown = replace(result, signals=Signals(stamp, mean, 1))
    film = element(imu_calib.report(shown, tmp_path / 'page.html'), 'film')
    for plot, (low, high) in zip(
        (e for e in film if e.get('class') == 'plot'), ((0, 30), (0, 5)), strict=True
    ):
        labels = {
            float((e.text or '').replace('\u2212', '-')): float(
                re.findall(r'[\d.]+', e.get('style', ''))[0]
            )
            for e in plot.iter('span')
        }
        (one, other), *_ = [sorted(labels.items())[:2]]
        slope = (other[1] - one[1]) / (other[0] - one[0])
        heights = [
            float(re.findall(r'M[\d.]+ ([\d.]+)', e.get('d', ''))[0]) for e in plot.iter('path')
        ]
        values = sorted(one[0] + (height - one[1]) / slope for height in heights)
        # Positions are written to a tenth of a hundredth of the height.
        assert values[-1] == pytest.approx(high, abs=0.02 * high)
        assert values[0] == pytest.approx(low, abs=0.02 * high)


def test_a_page_without_signals_is_as_before(result, tmp_path):
    path = imu_calib.report(replace(result, signals=None), tmp_path / 'page.html')
    assert 'class="film"' not in path.read_text(encoding='utf-8')
    assert 'Course of the session' in path.read_text(encoding='utf-8')


def test_the_page_stays_small(page):
    assert page.stat().st_size < 300_000


@pytest.fixture
def shown(browser, page):
    with opened(browser, page) as found:
        yield found


@needs_chromium
@pytest.mark.parametrize('size', [390, 1400])
def test_the_plot_is_enlarged_in_its_window_alone(shown, size):
    look_at(shown, size)
    film, window = shown.locator('.film'), shown.locator('.window')
    before = film.bounding_box()['width']
    ticks = shown.locator('.times span:visible').count()
    shown.locator('label[for=zoom-16]').click()
    within = window.bounding_box()['width']
    assert film.bounding_box()['width'] == pytest.approx(16 * within, rel=0.01)
    assert film.bounding_box()['width'] > 8 * before
    assert shown.locator('.times span:visible').count() > 8 * ticks
    assert shown.locator('.names span:visible').count() > 20
    assert width(shown) <= size
    # The title stays in view when the plot is pushed aside.
    window.evaluate('window => { window.scrollLeft = 2000; }')
    assert 0 <= shown.locator('.heading').first.bounding_box()['x'] < size / 2


@needs_chromium
@pytest.mark.parametrize('factor', [1, 4, 16])
@pytest.mark.parametrize('dark', [False, True], ids=['light', 'dark'])
def test_it_is_read_at_every_width_on_a_phone_and_in_the_dark(shown, factor, dark):
    look_at(shown, 390, dark=dark)
    shown.locator(f'label[for=zoom-{factor}]').click()
    assert overlaps(shown) == []
    assert overfull(shown) == []
    assert [t for t in contrasts(shown) if t['ratio'] < 4.5] == []
