"""The report as people look at it: on a phone, in the dark, on paper; a cube for each position."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import yaml
from browser import A4, contrasts, look_at, needs_chromium, opened, overfull, overlaps, width
from browser import browser as browser  # noqa: PLC0414
from sessions import at_one_rate, calibrate, quick_plan, session, stand

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.thermal import combine
from imu_calib.cli.main import main
from imu_calib.common.budget import ErrorSource, Share
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.rotations import rotations
from imu_calib.common.stream import at, iso
from imu_calib.reports.budget import budget_section
from imu_calib.reports.course import Stand, attitudes, cube, stands
from imu_calib.reports.html import bullets, paragraph
from imu_calib.reports.page import Contents, page, thermal_page
from imu_calib.reports.provenance import provenance
from imu_calib.segmentation.segmented import Rejected
from imu_calib.session.imu import load_imu

PLAN = at_one_rate(quick_plan('twelve_position', 20.0))
WIDTHS = (390, 820, 1400)


@pytest.fixture(scope='module')
def result():
    found = calibrate(session(PLAN, stand(), 1), PLAN)
    start = found.session.start or 0
    disturbed = Rejected(
        start + 10**9, start + 3 * 10**9, 'somebody knocked on the table ' * 4, '7'
    )
    return replace(found, labelled=replace(found.labelled, rejected=(disturbed,)))


def dated(calibration: Calibration, month: int, celsius: float) -> Calibration:
    temperature = {'mean': celsius, 'lowest': celsius - 0.4, 'highest': celsius + 0.6}
    where = {**calibration.provenance, 'recorded': f'2026-{month:02}-03T08:00:00Z'}
    moved = calibration.values + (celsius - 20) * calibration.std
    model = calibration.model.with_values(calibration.parameters, moved)
    return replace(calibration, model=model, provenance={**where, 'temperature': temperature})


@pytest.fixture(scope='module')
def at_temperatures(result):
    some = enumerate((-10.0, 5.0, 20.0, 50.0), 1)
    return [dated(result.calibration, month, celsius) for month, celsius in some]


@pytest.fixture(scope='module')
def pages(result, at_temperatures):
    imu, own = load_imu('fog_medium'), at_temperatures[0]
    others = {f'of_{c.provenance["recorded"][:7]}.yaml': c for c in at_temperatures[1:]}
    combined = combine(at_temperatures, ['a', 'b', 'c', 'd'])
    return {
        'whole': page(Contents(own, 'calibration.yaml', imu, result, others)),
        'alone': page(Contents(own, 'calibration.yaml')),
        'combined': thermal_page(combined, 'combined.yaml', imu),
    }


@pytest.fixture(scope='module', params=['whole', 'alone', 'combined'])
def shown(request, browser, pages, tmp_path_factory):
    path = tmp_path_factory.mktemp('layout') / f'{request.param}.html'
    path.write_text(pages[request.param], encoding='utf-8')
    with opened(browser, path) as found:
        yield found


@needs_chromium
def test_no_text_stands_on_another_and_no_page_is_wider_than_its_window(shown):
    for size in WIDTHS:
        look_at(shown, size)
        assert overlaps(shown) == [], size
        assert overfull(shown) == [], size
        assert width(shown) <= size
    look_at(shown, A4, paper=True)
    assert overlaps(shown) == []
    assert width(shown) <= A4


BEYOND = """
name => [...document.querySelectorAll(name)].flatMap(all => [...all.querySelectorAll('td, rect')])
  .filter(box => box.getClientRects().length)
  .map(box => box.getBoundingClientRect()).map(box => [box.left, box.right])
"""


@needs_chromium
def test_on_a_phone_budget_and_terms_are_seen_whole(browser, pages, tmp_path):
    path = tmp_path / 'whole.html'
    path.write_text(pages['whole'], encoding='utf-8')
    with opened(browser, path) as shown:
        for size in (390, 1400):
            look_at(shown, size)
            for name in ('.broad, .narrow', 'table.terms', 'table.budget'):
                places = shown.evaluate(BEYOND, name)
                assert len(places) > 24
                assert all(0 <= left <= right <= size for left, right in places), name
        look_at(shown, 390)
        cell = shown.locator('table.terms tbody tr').first.locator('td').nth(3)
        words = cell.evaluate("cell => getComputedStyle(cell, '::before').content")
        assert 'data-name' in words or 'chance' in words
        assert cell.get_attribute('data-name') == 'chance'
        scrolls = '[...document.querySelectorAll(".wide")].filter(w => w.querySelector(".budget"))'
        assert shown.evaluate(f'{scrolls}.map(w => w.scrollWidth - w.clientWidth)') == [0, 0]
        row = shown.locator('table.budget').nth(1).locator('tbody tr').first
        # Several numbers in a line, each with its name, and not a line for each.
        tops = row.locator('td').evaluate_all('all => all.map(c => c.getBoundingClientRect().top)')
        assert 1 < len(set(tops)) < len(tops)
        assert row.locator('td').last.evaluate("c => getComputedStyle(c, '::before').content")


@needs_chromium
def test_the_measurement_sees_texts_on_each_other(browser, tmp_path):
    path = tmp_path / 'bad.html'
    path.write_text(
        '<p style="width: 40px; white-space: nowrap">much too long a sentence</p>'
        '<svg width="200" height="50"><text x="9" y="20">one</text><text x="15" y="22">two</text>'
        '</svg>'
    )
    with opened(browser, path) as shown:
        look_at(shown, 390)
        assert overlaps(shown) == [('one', 'two')]
        assert overfull(shown) == ['much too long a sentence']


@needs_chromium
@pytest.mark.parametrize('dark', [False, True], ids=['light', 'dark'])
def test_every_text_is_read_in_the_dark_as_in_the_light(shown, dark):
    look_at(shown, 820, dark=dark)
    found = contrasts(shown)
    # WCAG 2.1, 1.4.3: 4.5 for letters of this size. Badges are white on colour in both.
    assert [t for t in found if t['ratio'] < 4.5] == []
    papers = [t['paper'] for t in found]
    assert np.median(papers) < 0.05 if dark else np.median(papers) > 0.8


@needs_chromium
def test_paper_is_white_in_the_dark_too(browser, pages, tmp_path):
    path = tmp_path / 'page.html'
    path.write_text(pages['alone'], encoding='utf-8')
    with opened(browser, path) as printed:
        look_at(printed, A4, dark=True, paper=True)
        assert min(t['ratio'] for t in contrasts(printed)) >= 4.5
        assert np.median([t['paper'] for t in contrasts(printed)]) == 1.0


def words(element: ET.Element) -> str:
    return ' '.join(t.strip() for t in element.itertext() if t.strip()).replace('\xa0', ' ')


def parsed(text: str) -> ET.Element:
    return ET.fromstring(text.removeprefix('<!DOCTYPE html>\n'))


def test_every_position_has_a_cube_that_points_as_the_plan_says(pages, result):
    captions = [words(f) for f in parsed(pages['whole']).iter('figcaption')]
    assert len(captions) == 12
    # Position 1 of the paper: X up, Y east, Z north (config/plans/twelve_position.yaml).
    assert captions[0].startswith('1 X up, Y east, Z north 22:1')
    assert all(re.search(r'\d\d:\d\d:\d\d, \d\d s$', c) for c in captions)
    letters = {'E': 'east', 'N': 'north', 'U': 'up', 'W': 'west', 'S': 'south', 'D': 'down'}
    asked = yaml.safe_load(named_file('plans', 'twelve_position').read_text())['positions']
    for position, stood in zip(PLAN.positions, stands(result), strict=True):
        (axes,) = [p['axes'] for p in asked if str(p['id']) == position.id]
        text = [letters[letter] for letter in axes]
        expected = ', '.join(f'{a} {w}' for a, w in zip('XYZ', text, strict=True))
        assert (stood.name, stood.words) == (position.id, expected)


def drawn(attitude: np.ndarray) -> dict[str, tuple[float, float]]:
    """Where the letters of a cube stand: right and up from its middle, px."""
    svg = ET.fromstring(cube(attitude, 'a cube'))
    return {
        str(t.text): (float(t.get('x', 0)) - 52, 52 - (float(t.get('y', 0)) - 4))
        for t in svg.iter('text')
    }


def test_a_cube_shows_up_above_east_at_the_right_and_north_behind():
    # X east, Y north, Z up, seen from the south-west and above.
    level = drawn(np.eye(3))
    assert level['Z'][1] > 25 and abs(level['Z'][0]) < 1
    assert level['X'][0] > 15 and level['Y'][0] < -10
    # What is behind stands higher.
    assert level['Y'][1] > 5
    # Upside down about X: Z below, Y to the south.
    over = drawn(np.diag([1.0, -1.0, -1.0]))
    assert over['Z'] == pytest.approx((-level['Z'][0], -level['Z'][1]), abs=0.1)
    assert over['X'] == pytest.approx(level['X'], abs=0.1)


def test_letters_of_a_cube_never_stand_on_each_other():
    rng = np.random.default_rng(3)
    for attitude in rotations(rng.normal(size=(300, 3)) * 2):
        places = list(drawn(attitude).values())
        for k, (x, y) in enumerate(places):
            for a, b in places[k + 1 :]:
                assert abs(x - a) >= 10 or abs(y - b) >= 10


def test_a_unit_of_which_only_up_is_known_says_so(result):
    first = result.labelled.segments[0]
    bare = replace(
        result, labelled=replace(result.labelled, segments=(replace(first, attitude=None),))
    )
    (one,) = stands(bare)
    assert isinstance(one, Stand) and not one.known and one.words == 'X up'
    assert 'The heading was not measured' in attitudes([one])


def test_provenance_is_words_and_units_and_no_dump(pages, result):
    rows = {}
    for line in parsed(pages['alone']).iter('tr'):
        cells = [words(c) for c in line]
        rows[cells[0]] = cells[1:]
    seen = result.calibration.provenance
    assert rows['begun'] == ['2026-01-03 08:00:00 UTC']
    assert rows['latitude'] == ['34.650°']
    assert rows['highest rate'] == [f'{np.rad2deg(seen["highest_rate"]):.4g} deg/s']
    assert rows['temperature of the unit'] == ['-10.00 °C, from -10.40 to -9.40 °C']
    walk = rows['random walk used']
    # rad/sqrt(s) to deg/sqrt(h): times 180 / pi and 60.
    assert float(walk[0]) == pytest.approx(np.rad2deg(seen['random_walk'][0]) * 60, rel=0.01)
    assert walk[3] == 'deg/√h' and walk[-1] == '(m/s)/√h'
    assert rows['closed form'][0].startswith('twelve_position: within ')
    text = words(parsed(provenance(result.calibration)))
    assert not re.search(r'\de-\d|\[|\{|_std|None', text)


def test_what_other_software_wrote_into_the_file_is_shown_too(result):
    foreign = replace(result.calibration, provenance={'fixture': {'screws': 4}, 'by': ['a', 'b']})
    assert words(parsed(provenance(foreign))) == 'Further fixture: screws 4 by a, b'


def test_dates_are_absolute(pages, result):
    text = words(parsed(pages['whole']))
    assert 'From 2023-11-14 22:13:20 to 22:' in text
    assert 'of_2026-02.yaml recorded 2026-02-03 08:00 UTC' in text
    # Below each small drawing the first and the last date.
    assert text.count('2026-01-03 2026-04-03') == 24
    assert (at(12_500_000_000), iso(5)) == ('12.500 s', None)


def test_a_combined_file_has_a_report(at_temperatures, tmp_path, capsys):
    path, made = tmp_path / 'combined.yaml', tmp_path / 'r.html'
    combined = imu_calib.combine(at_temperatures, path)
    # At some temperature a parameter is beyond its limit.
    assert main(['report', str(path), '--imu', 'fog_medium', '-o', str(made)]) == 3
    found = parsed(made.read_text(encoding='utf-8'))
    # That of a single calibration, over all sessions.
    assert any(words(p).startswith('Verdict: ') for p in found.iter('p'))
    headings = [words(th) for th in found.iter('th')]
    assert {'−10.0 °C', '5.0 °C', '20.0 °C', '50.0 °C'} <= set(headings)
    rows = {words(tr[0]): [words(td) for td in tr] for tr in found.iter('tr')}
    k, scale = 9, np.deg2rad(1) / 3600
    values = [c.values[k] / scale for c in combined.calibrations]
    shown = [float(cell.split(' ')[0].replace('−', '-')) for cell in rows['D_gx'][4:]]
    assert shown == pytest.approx(values, abs=0.005)
    assert imu_calib.report(combined, tmp_path / 'again.html', imu='fog_medium').is_file()
    capsys.readouterr()
    assert main(['report', str(path), 'some_bag', '-o', str(made)]) == 2
    assert 'leave some_bag out' in capsys.readouterr().err
    with pytest.raises(InputError, match='leave `compare` out'):
        imu_calib.report(path, made, compare=[at_temperatures[0]])


def test_every_source_of_uncertainty_can_be_drawn(result):
    budget = result.calibration.budget
    assert budget is not None
    large = Share.known(np.diag(np.diag(result.calibration.covariance)))
    for source in ErrorSource:
        more = budget.with_share(source, large)
        found = budget_section(replace(result.calibration, budget=more))
        assert source.heading in found[0]


def test_keywords_are_options_as_on_the_terminal():
    said = ['State `imu_topic`, or <none>.']
    expected = 'State <code>--imu-topic</code>, or &lt;none&gt;.'
    assert bullets(said) == f'<ul><li>{expected}</li></ul>'
    assert paragraph(said[0]) == f'<p>{expected}</p>'
