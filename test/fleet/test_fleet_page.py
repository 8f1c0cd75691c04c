"""The page on a catalogue: what it says, what it packs, and what a browser makes of it."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from dataclasses import replace
from datetime import datetime, timezone
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import A4, contrasts, needs_chromium, overfull, overlaps, width
from browser import browser as browser  # noqa: PLC0414

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS

pytest.importorskip('pyarrow')
pytest.importorskip('bokeh')

import fleets
from fleets import STD

from imu_calib.fleet import page_contents as packed
from imu_calib.fleet.attention import issues
from imu_calib.fleet.catalogue import Catalogue
from imu_calib.fleet.page import page, summary
from imu_calib.fleet.page_contents import Flag, Fleet
from imu_calib.fleet.recordings import Job
from imu_calib.fleet.task import TaskResult, failed

EVIL = '<script>hacked=1</script>"\'><img src=x onerror=hacked=1>'
SLASHED = 'B/1 %#?'
ODD = ('undated', 'alone', 'lost')
READY = 'html[data-ready=drawn]'


def add(catalogue: Path, key: int, **values: Any) -> None:
    """Add a row by hand: a calibration where it has values, else a failed recording."""
    row = failed(Job(f'rec_{key}'), f'{key + 10**9:032x}', '', 'It failed: <b>x</b>.', 2)
    parameters = values.pop('parameters', None)
    if parameters is not None:
        row |= {'status': 'calibrated', 'error': '', 'exit_code': 0}
        row |= dict(zip(PARAMETER_NAMES, parameters, strict=True))
        row |= {f'std_{n}': s for n, s in zip(PARAMETER_NAMES, STD.tolist(), strict=True)}
        row |= {'parameters': list(PARAMETER_NAMES), 'values': list(parameters)}
        row |= {'covariance': np.diag(STD**2).ravel().tolist(), 'findings': [EVIL], 'verdict': ''}
    row |= values
    text = 'id: unit\n' if row['status'] == 'calibrated' else ''
    assert Catalogue(catalogue).add([TaskResult(row['key'], row, text)]) == 1


@pytest.fixture(scope='module')
def made():
    return fleets.invented(60)


@pytest.fixture(scope='module')
def catalogue(made, tmp_path_factory):
    """Sixty units, and what a catalogue may hold besides."""
    folder = fleets.write(tmp_path_factory.mktemp('lab') / 'catalogue', made)
    some = (0.1 * STD).tolist()
    day = datetime(2026, 10, 1, tzinfo=timezone.utc)
    unit = {'imu': 'fog_medium', 'parameters': some}
    for key, (name, date) in enumerate(
        [(EVIL, day), (SLASHED, day), ('undated', None), ('alone', day), ('', day)]
    ):
        add(folder, key, serial=name, date=date, stand=EVIL, **unit)
    add(folder, 10, serial='lost', imu='fog_medium', date=None)
    add(folder, 11, serial='', imu='', date=day)
    file = folder / made.rows['calibration'][made.rows['serial'].index('A1007')]
    file.parent.mkdir(parents=True)
    file.write_text('id: A1007\n')
    file.with_suffix('.html').write_text('<title>its report</title>')
    return folder


@pytest.fixture(scope='module')
def written(catalogue):
    """The page as the command writes it."""
    path = catalogue.parent / 'pages' / 'fleet.html'
    path.parent.mkdir()
    limits = [word for kind in fleets.TYPES for word in ('--imu', kind)]
    assert main(['fleet', str(catalogue), '-o', str(path), '--on', '2026-11-22', *limits]) == 0
    return path


@pytest.fixture(scope='module')
def known(made):
    return fleets.fleet(made)


def unpacked(text: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """As the page's script does it, written from packed's description."""
    whole = zlib.decompress(base64.b64decode(text))
    (length,) = struct.unpack('<I', whole[:4])
    head = json.loads(whole[4 : 4 + length])
    kinds = {'Uint8Array': 'u1', 'Int8Array': 'i1', 'Int32Array': '<i4', 'Float32Array': '<f4'}
    arrays, place = {}, 4 + length
    for name, kind, count in head['arrays']:
        size = np.dtype(kinds[kind]).itemsize
        planes = np.frombuffer(whole, np.uint8, count * size, place).reshape(size, count)
        arrays[name] = np.ascontiguousarray(planes.T).view(kinds[kind]).ravel()
        place += count * size
    assert place == len(whole)
    return head['texts'], arrays


def test_numbers_are_packed_as_exactly_as_they_are_shown():
    rng = np.random.default_rng(5)
    std = 10.0 ** rng.uniform(-7, -5, (200, 3))
    values = 3.0 + std * rng.normal(size=std.shape)
    values[[0, 7], 1], std[7, 1] = np.nan, np.nan
    values[:, 2] = 1e30 * rng.normal(size=200)
    differences, steps = packed.packed_differences(values, std)
    codes, scales = packed.deviations(std)
    text = packed.pack(
        {'value': differences, 'std': codes, 's': packed.short(values)}, {'a': '\u00b5'}
    )
    texts, found = unpacked(text)
    assert texts == {'a': '\u00b5'}
    # The script's sums wrap at 32 bits.
    sums = np.cumsum(found['value'].reshape(3, -1), axis=1, dtype=np.int32)
    for k in range(3):
        fine = np.isfinite(values[:, k])
        error = np.abs(sums[k] * steps[k] - values[:, k])[fine]
        # A twentieth of the smallest deviation, as far as 31 bits reach.
        reach = np.abs(values[fine, k]).max() / 2**30
        assert error.max() <= max(packed.STEP * np.nanmin(std[:, k]) / 2 * 1.001, reach)
        low, ratio = scales[k]
        code = found['std'].reshape(3, -1)[k]
        back = low * np.exp(ratio * (code - 1.0))
        assert (code == 0).tolist() == np.isnan(std[:, k]).tolist()
        assert np.nanmax(np.abs(back / std[:, k] - 1)[code > 0]) < np.expm1(ratio / 2) * 1.01
    assert found['s'].reshape(200, 3)[:, 0] == pytest.approx(values[:, 0], rel=2.0**-12)
    assert packed.scores(np.array([np.nan, 0.0, 4.11, -90.0])).tolist() == [-128, 0, 82, -127]
    dates = np.array(['2026-03-01T12:34:56', 'NaT'], 'M8[s]')
    then = datetime(2026, 3, 1, 12, 34, tzinfo=timezone.utc).timestamp()
    assert packed.minutes(dates).tolist() == [then / 60, packed.NO_DAY]


def test_what_needs_a_person_is_said_with_numbers(known, made):
    found = {matter.title: matter for matter in issues(known)}
    assert list(found)[:2] == ['Failed recordings', 'Stands that are off']
    assert 'Stand west is off: it adds +5 ppm' in found['Stands that are off'].sentences[0]
    off = {unit.serial for unit in known.flagged(Flag.OFF_STAND)}
    assert off == {u.serial for u in known.history.units if u.stand[-1] == 'west'} and off
    assert (
        f'{len(off)} units have the newest calibration from a stand that is off'
        in (found['Stands that are off'].sentences[-1])
    )
    assert len(found['Stands that are off'].cases) == len(off)
    assert f'{len(off)} calibrated on a stand that is off' in summary(known)
    lost = found['Failed recordings']
    assert lost.sentences[0] == '1 of 361 recordings gave no calibration (0.28 %).'
    assert 'the recording ends after 3 of 12 positions' in lost.cases[0][-1]
    assert {unit.serial for unit in known.flagged(Flag.FAILED)} == made.failing == {'A1031'}
    assert {unit.serial for unit in known.flagged(Flag.STEP)} == made.stepping == {'A1023'}
    assert {unit.serial for unit in known.flagged(Flag.DRIFTS)} == made.drifting
    drifts = found['Drifting units']
    assert drifts.sentences[0].startswith('2 units drift significantly; by chance about 0.6 of 60')
    # 4 ppm a month were put in; 0.12 ppm is what 3 ppm a session leave of six in 30 months.
    slope = re.search(r'K_gx ([\d.]+) \u00b1 ([\d.]+) ppm', drifts.cases[0][1])
    # The interval of 95 %, as on the terminal.
    assert slope is not None and abs(float(slope[1]) - 4) < 2 * float(slope[2]) < 1
    drifting = known.flagged(Flag.DRIFTS)[0].history
    ends = (drifting.trend.high - drifting.trend.low)[0] / 2
    assert drifts.headings[1] == 'trend per month (95 %)'
    assert any(f'\u00b1 {ends / 1e-6:.2f}' in case[1] for case in drifts.cases)
    assert all(re.search(r'>20\d\d-\d\d-\d\d<', case[2]) for case in drifts.cases)
    assert 'D_ax +40 µg' in found['Steps'].cases[0][1]
    assert 'D_ax' in found['Out of control'].cases[0][2]


def test_what_is_due_depends_on_the_day(known):
    due = {u.serial: u.history.forecast.recalibrate for u in known.units if u.history is not None}
    order = sorted(due.values())
    day = order[20] + np.timedelta64(1, 's')
    later = Fleet(known.name, known.recordings, known.history, day, ahead=30.0)
    late = {u.serial for u in later.flagged(Flag.OVERDUE)}
    soon = {u.serial for u in later.flagged(Flag.DUE)}
    assert late == {s for s, d in due.items() if d < day} and len(late) == 21
    until = day + np.timedelta64(30, 'D')
    assert soon == {s for s, d in due.items() if day <= d <= until} and soon
    found = {matter.title: matter for matter in issues(later)}
    first = found['Overdue for recalibration']
    assert str(order[0])[:10] in first.cases[0][2] and len(first.cases) == 21
    assert '21 units were to be recalibrated from' in first.sentences[0]
    assert f'{len(soon)} unit' in found['Due for recalibration'].sentences[0]
    # Of many the first are written out, and the others are counted.
    assert '9 more are not listed here' in first.html()
    assert not known.flagged(Flag.OVERDUE)


def test_a_unit_that_is_outside_was_inside_until_no_date(known):
    first, *others = known.history.units
    newest = first.date[-1]
    due = replace(first.forecast, recalibrate=newest)
    history = replace(first, outside=('K_gx',), forecast=due)
    later = replace(
        known,
        history=replace(known.history, units=(history, *others)),
        today=newest.astype('M8[s]') + np.timedelta64(334 * 86400, 's'),
    )
    (unit,) = [u for u in later.units if (u.imu, u.serial) == (first.imu, first.serial)]
    assert Flag.OUTSIDE in unit.flags
    assert Flag.OVERDUE not in unit.flags and Flag.DUE not in unit.flags
    # Inside at its newest session, and even then with less than the probability that is asked for.
    inside = replace(history, outside=())
    later = replace(later, history=replace(known.history, units=(inside, *others)))
    matter = next(m for m in issues(later) if m.flag is Flag.OVERDUE)
    assert 'were inside' not in matter.sentences[0]
    assert 'from then on the forecast gives less than' in matter.sentences[0]


def test_a_stand_is_not_counted_among_units(known):
    units, off = summary(known).split('. ')
    assert units.startswith(f'{len(known.units)} units: ') and '1 stand' not in units
    assert off == '1 stand is off.'
    (shift,) = known.history.stands.shifts
    pair = replace(shift, identified=False, others=('east',))
    stands = replace(known.history.stands, shifts=(pair,))
    known = replace(known, history=replace(known.history, stands=stands))
    assert summary(known).split('. ')[1] == '2 stands differ.'


class Elements(HTMLParser):
    """Tags and attributes of a page, without what scripts hold."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_the_page_asks_nobody_and_runs_nothing_but_its_own(written):
    text = written.read_text(encoding='utf-8')
    elements = Elements(text).found
    scripts = [attributes for tag, attributes in elements if tag == 'script']
    assert [s.get('type') for s in scripts] == [
        'application/octet-stream', 'application/octet-stream', 'text/plain', None,
    ]  # fmt: skip
    assert not any(tag in ('img', 'link', 'iframe') for tag, _ in elements)
    assert not any('src' in attributes for _, attributes in elements)
    links = [a['href'] or '' for tag, a in elements if tag == 'a']
    assert links and all(link.startswith('#unit=') for link in links)
    policy = next(a for _, a in elements if a.get('http-equiv') == 'Content-Security-Policy')
    assert "default-src 'none'" in (policy['content'] or '')
    assert 'unsafe-inline' not in (policy['content'] or '').split('script-src')[1]
    assert '<script>hacked' not in text


def test_the_same_catalogue_gives_the_same_page(known):
    assert page(known) == page(replace(known))


def test_a_catalogue_of_failures_has_a_page(tmp_path, capsys):
    folder = tmp_path / 'catalogue'
    Catalogue(folder, create=True)
    path = imu_calib.fleet_report(folder, tmp_path / 'none.html')
    assert '0 units: 0 fine.' in path.read_text()
    add(folder, 1, serial='lost', imu='fog_medium')
    add(folder, 2, serial='', imu='')
    text = imu_calib.fleet_report(folder, path).read_text()
    assert '1 unit: 1 with a failed newest recording, 0 fine.' in text
    assert '<dt>types</dt><dd>1</dd>' in re.sub(r'\s+', '', text)
    assert '1 failed recording states no serial number.' in text
    assert 'It failed: &lt;b&gt;x&lt;/b&gt;.' in text
    # The command says what the page begins with.
    assert main(['fleet', str(folder), '-o', str(path)]) == 0
    output = capsys.readouterr().out
    assert output.startswith(
        '1 unit: 1 with a failed newest recording, 0 fine.\n2 recordings written'
    )


def test_units_of_simulated_data_are_said_to_be_that(tmp_path):
    folder = tmp_path / 'catalogue'
    Catalogue(folder, create=True)
    day = datetime(2026, 10, 1, tzinfo=timezone.utc)
    unit = {'imu': 'fog_medium', 'parameters': (0.1 * STD).tolist(), 'date': day}
    add(folder, 1, serial='real', **unit)
    add(folder, 2, serial='none', simulated=True, **unit)
    text = imu_calib.fleet_report(folder, tmp_path / 'fleet.html').read_text()
    assert '2 units: 1 simulated, 1 fine.' in text


def test_a_marginal_unit_needs_a_person_and_its_parameter_is_named(tmp_path):
    """The page counted a marginal unit and none that is fine, and said: Nothing."""
    folder = tmp_path / 'catalogue'
    Catalogue(folder, create=True)
    limits = imu_calib.load_imu('fog_medium').specification
    values = 0.1 * STD
    values[1] = limits.limit(PARAMETERS[1])
    day = datetime(2026, 10, 1, tzinfo=timezone.utc)
    add(folder, 1, serial='M1', imu='fog_medium', parameters=values.tolist(), date=day)
    text = imu_calib.fleet_report(folder, tmp_path / 'fleet.html', imu=['fog_medium']).read_text()
    assert '1 unit: 1 marginal, 0 fine.' in text
    section = text[text.index('What needs a person') :]
    assert '1 unit has a limit' in section
    (row,) = re.findall(r'<tr>(?:(?!</tr>).)*fog_medium/M1.*?</tr>', section)
    assert 'K_gy' in row and 'K_gx' not in row
    assert 'Nothing.' not in section


def test_a_unit_of_which_a_calibration_warns_needs_a_person(tmp_path):
    folder = tmp_path / 'catalogue'
    Catalogue(folder, create=True)
    day = datetime(2026, 10, 1, tzinfo=timezone.utc)
    unit = {'imu': 'fog_medium', 'parameters': (0.1 * STD).tolist(), 'date': day}
    add(folder, 1, serial='fine', **unit)
    add(folder, 3, serial='odd', **{**unit, 'date': datetime(2026, 11, 1, tzinfo=timezone.utc)})
    add(folder, 2, serial='odd', **{**unit, 'findings': ['Warning: Gravity is wrong.', 'A note.']})
    text = imu_calib.fleet_report(folder, tmp_path / 'fleet.html').read_text()
    assert '2 units: 1 with warnings, 1 fine.' in text
    needed = text[text.index('What needs a person') : text.index('<h3>On the catalogue')]
    assert 'Gravity is wrong.' in needed and 'A note.' not in needed and 'Nothing.' not in needed


def test_every_failed_recording_is_listed(made, tmp_path):
    folder = fleets.write(tmp_path / 'catalogue', made)
    early, late = (datetime(year, 1, 2, tzinfo=timezone.utc) for year in (2020, 2027))
    mine = {'serial': 'A1003', 'imu': 'mems_counts'}
    for key, date in enumerate((early, late, None)):
        add(folder, key, date=date, **(mine | {'serial': f'A100{3 + key}'}))
    add(folder, 9, date=early, error='It ended. Repeat it. K_gx is not observable.', **mine)
    text = imu_calib.fleet_report(folder, tmp_path / 'fleet.html').read_text()
    # Those of units that were calibrated since, too; one without a date may be the newest.
    for recording in ('rec_0', 'rec_1', 'rec_2', 'rec_9'):
        assert f'data-name="recording">{recording}</td>' in text
    assert '>It ended. Repeat it. ...<' in text
    assert '5 of 365 recordings gave no calibration' in text
    assert 'For 3 units it is the newest recording, or one without a date' in text
    for key in range(20, 30):
        add(folder, key, date=early, **mine)
    text = imu_calib.fleet_report(folder, tmp_path / 'fleet.html').read_text()
    assert '3 more are not listed here.' in text
    assert 'imu-calib catalogue catalogue --where &quot;status = &#x27;failed&#x27;&quot;' in text


def test_wrong_usage_gets_a_sentence(catalogue, tmp_path, capsys, monkeypatch):
    out = ['-o', str(tmp_path / 'page.html')]
    for words, errors in (
        ([str(tmp_path), *out], 'is not a catalogue'),
        ([str(catalogue), '-o', str(tmp_path / 'no' / 'page.html')], 'does not exist'),
        ([str(catalogue), *out, '--on', 'soon'], "--on: found 'soon', expected a date"),
        ([str(catalogue), *out, '--ahead', '-1'], 'expected 0 days or more'),
        ([str(catalogue), *out, '--where', 'nothing = 1'], 'nothing'),
    ):
        assert main(['fleet', *words]) == 2
        assert errors in ' '.join(capsys.readouterr().err.split())
    assert main(['fleet', str(catalogue), *out, '--where', "imu = 'none'"]) == 1
    errors = ' '.join(capsys.readouterr().err.split())
    assert "no row meets imu = 'none'. It has " in errors and ', fog_medium, mems' in errors
    assert not (tmp_path / 'page.html').exists()
    monkeypatch.setattr(
        'imu_calib.common.files.find_spec', lambda name: None if name == 'bokeh' else 1
    )
    with pytest.raises(InputError, match=r'needs bokeh.*\.\[fleet\]'):
        imu_calib.fleet_report(catalogue, tmp_path / 'page.html')
    # A missing folder comes before what would read it.
    monkeypatch.setattr('imu_calib.common.files.find_spec', lambda _: None)
    with pytest.raises(InputError, match='there is no such folder'):
        imu_calib.fleet_report(tmp_path / 'no', tmp_path / 'page.html')


# --- in a browser ---------------------------------------------------------------------------------


class Window:
    """A page in a browser, with all that it said and asked for."""

    def __init__(self, browser: Any, path: Path, size: int = 1280, **options: Any) -> None:
        window = browser.new_context(viewport={'width': size, 'height': 900}, **options)
        self.page = window.new_page()
        self.page.set_default_timeout(120_000)
        self.console: list[str] = []
        self.asked: list[str] = []
        self.page.on('console', lambda message: self.console.append(message.text))
        self.page.on('pageerror', lambda error: self.console.append(str(error)))
        self.page.on('request', lambda request: self.asked.append(request.url))
        self.url = path.resolve().as_uri()

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        self.page.context.close()

    def open(self, place: str = '') -> Any:
        self.page.goto(self.url + place)
        self.page.wait_for_selector(READY)
        return self.page

    def reset(self) -> Window:
        """As it opens: nothing filtered, sorted by status, no unit open."""
        if self.page.locator('#unit').is_visible():
            self.page.locator('#close').click()
        self.page.locator('#clear').click()
        for name in ('sessions', 'status'):
            self.page.locator(f'[data-column={name}] button').click()
        return self

    def column(self, name: str) -> list[str]:
        return list(self.page.locator(f'#unit-rows .of-{name}').all_inner_texts())

    def matching(self) -> str:
        return str(self.page.locator('#matching').inner_text())


def check_it_opens_without_a_word_and_without_a_network(shown: Window) -> None:
    assert shown.console == []
    assert shown.asked == [shown.url]
    # 60 units, those with odd names and the one whose recording failed; no unit without a number.
    assert shown.matching() == '65 of 65 units, 1 to 50 shown'
    assert len(shown.column('unit')) == 50
    assert shown.page.locator('#population-plot svg').count() > 0
    assert shown.page.locator('#months-plot svg').count() > 0


def check_what_is_worst_stands_first(shown: Window) -> None:
    first = shown.column('status')[0]
    assert first.startswith(('outside', 'overdue', 'failed'))
    assert {'A1031', 'lost'} <= set(shown.column('unit')[:8])


def check_columns_sort_both_ways_by_mouse_and_by_keys(shown: Window) -> None:
    head = shown.page.locator('[data-column=unit]')
    head.locator('button').click()
    up = shown.column('unit')
    assert head.get_attribute('aria-sort') == 'ascending'
    mine = [name for name in up if name.startswith('A')]
    assert mine == [f'A{1000 + k}' for k in range(len(mine))] and len(mine) > 40
    shown.page.keyboard.press('Enter')
    assert head.get_attribute('aria-sort') == 'descending'
    assert shown.column('unit')[:2] == ['undated', 'lost']
    shown.page.locator('[data-column=newest] button').click()
    dates = shown.column('newest')
    # What has no date was before all others.
    assert dates[:2] == ['', ''] and dates == sorted(dates)
    assert shown.page.locator('[aria-sort=ascending]').count() == 1


def check_units_are_filtered_by_text_type_stand_and_status(
    shown: Window, made: fleets.Invented
) -> None:
    page = shown.page
    page.locator('#text').fill('a100 MEMS')
    assert shown.column('unit') and set(shown.column('imu')) == {'mems_counts'}
    assert shown.matching().endswith('of 65 units that match "a100 MEMS"')
    page.locator('#clear').click()
    page.locator('#imu-filter').select_option(label='stim300')
    assert shown.matching() == '20 of 65 units that match stim300'
    page.locator('#stand-filter').select_option(label='west')
    assert set(shown.column('stand')) == {'west'} and set(shown.column('imu')) == {'stim300'}
    page.locator('#clear').click()
    page.locator('#flag-filter').select_option(value='DRIFTS')
    assert made.drifting <= set(shown.column('unit'))
    assert all('drifts' in status for status in shown.column('status'))
    page.locator('#flag-filter').select_option(value='FINE')
    assert set(shown.column('status')) == {'fine'}
    page.locator('#text').fill('no such unit')
    assert shown.matching().startswith('0 of 65 units') and shown.column('unit') == []


def check_pages_of_the_table_are_turned(shown: Window) -> None:
    first = shown.column('unit')
    shown.page.get_by_role('button', name='Next').click()
    assert shown.matching() == '65 of 65 units, 51 to 65 shown'
    assert len(set(first) | set(shown.column('unit'))) == 65
    assert shown.page.get_by_role('button', name='Next').is_disabled()
    shown.page.get_by_role('button', name='Previous').click()
    assert shown.column('unit') == first


def check_what_needs_a_person_leads_to_its_units(shown: Window, made: fleets.Invented) -> None:
    shown.page.locator('button.show[data-flag=DRIFTS]').click()
    assert made.drifting <= set(shown.column('unit'))
    assert shown.page.evaluate('document.activeElement.id') == 'flag-filter'
    shown.page.locator('.matter a', has_text='A1007').first.click()
    shown.page.wait_for_selector('#unit[data-drawn="A1007"]')


def check_a_unit_shows_its_course(shown: Window, made: fleets.Invented) -> None:
    page = shown.page
    link = page.locator('#unit-rows a', has_text='A1007')
    link.focus()
    page.keyboard.press('Enter')
    page.wait_for_selector('#unit[data-drawn="A1007"]')
    assert page.locator('#unit-name').inner_text() == 'A1007 mems_counts'
    # It drifts by K_gx, which is drawn first; six sessions, each a mark and a bar.
    assert page.locator('#course').get_attribute('data-parameter') == 'K_gx'
    # The course, the control charts, and T^2.
    assert page.locator('#course > div svg').count() >= 3
    last = made.values[made.rows['serial'].index('A1007') + 5]
    rows = page.locator('table.of-unit tbody tr').all_inner_texts()
    assert len(rows) == 24
    for name, row, value, std in zip(PARAMETER_NAMES, rows, last, STD, strict=True):
        cells = row.split('\t')
        unit = next(p.unit for p in fleets.PARAMETERS if p.name == name)
        shown_value = float(cells[1].replace('\u2212', '-'))
        # Half of the last digit shown, a tenth of a deviation at most, and half a packed step.
        assert cells[0] == name
        assert abs(shown_value - value / unit.scale) < 0.1 * std / unit.scale
        assert float(cells[2]) == pytest.approx(2 * std / unit.scale, rel=0.03)
    page.locator('table.of-unit .choose', has_text='D_ay').click()
    page.wait_for_selector('#course[data-parameter=D_ay]')
    assert page.locator('.choose[aria-pressed=true]', has_text='D_ay').count() == 1
    page.locator('#unit').press('Escape')
    assert not page.locator('#unit').is_visible()
    assert page.evaluate('document.activeElement.textContent') in ('A1007', 'mems_counts A1007')
    assert shown.console == []


def check_files_of_a_unit_are_linked_where_they_lie(shown: Window, written: Path) -> None:
    page = shown.page
    page.evaluate("location.hash = '#unit=mems_counts/A1007'")
    page.wait_for_selector('#unit[data-drawn="A1007"]')
    links = page.locator('table.recordings a')
    assert links.all_inner_texts() == ['calibration', 'report']
    for link in links.all():
        assert (written.parent / (link.get_attribute('href') or '')).is_file()


def check_names_are_text_and_nothing_else(shown: Window) -> None:
    page = shown.page
    page.locator('#text').fill('hacked')
    # Its stand has the name too, of all four.
    assert EVIL in shown.column('unit')
    page.locator('#unit-rows a', has_text='hacked').click()
    page.wait_for_selector('#unit[data-drawn]')
    assert page.locator('#unit-name').inner_text().startswith(EVIL)
    assert EVIL in page.locator('table.recordings').inner_text()
    page.evaluate("location.hash = ''")
    page.locator('#text').fill(SLASHED)
    page.locator('#unit-rows a').click()
    page.wait_for_selector(f'#unit[data-drawn="{SLASHED}"]')
    page.goto(shown.url + '#unit=%ZZ/%')
    assert page.evaluate('typeof hacked') == 'undefined'
    assert shown.console == [] and set(shown.asked) == {shown.url}


def check_units_with_little_behind_them_open(shown: Window, name: str) -> None:
    shown.page.locator('#text').fill(name)
    shown.page.locator('#unit-rows a').first.click()
    shown.page.wait_for_selector(f'#unit[data-drawn="{name}"]')
    text = shown.page.locator('#unit-body').inner_text()
    assert ('not calibrated' in text) == (name == 'lost')
    assert ('no date' in text) == (name != 'alone')
    assert shown.page.locator('#course > div').count() == (0 if name == 'lost' else 1)
    assert shown.console == []


@needs_chromium
def test_the_table_in_a_browser(browser, written, made):
    with Window(browser, written) as shown:
        shown.open()
        check_it_opens_without_a_word_and_without_a_network(shown)
        check_what_is_worst_stands_first(shown.reset())
        check_columns_sort_both_ways_by_mouse_and_by_keys(shown.reset())
        check_units_are_filtered_by_text_type_stand_and_status(shown.reset(), made)
        check_pages_of_the_table_are_turned(shown.reset())
        check_what_needs_a_person_leads_to_its_units(shown.reset(), made)


@needs_chromium
def test_units_in_a_browser(browser, written, made):
    with Window(browser, written) as shown:
        shown.open()
        check_a_unit_shows_its_course(shown, made)
        check_files_of_a_unit_are_linked_where_they_lie(shown.reset(), written)
        for name in ODD:
            check_units_with_little_behind_them_open(shown.reset(), name)
        check_names_are_text_and_nothing_else(shown.reset())


@needs_chromium
def test_no_text_stands_on_another(browser, written):
    for size, dark in ((390, True), (820, False), (1400, False), (1400, True)):
        scheme = 'dark' if dark else 'light'
        with Window(browser, written, size, color_scheme=scheme) as window:
            page = window.open('#unit=mems_counts/A1007')
            page.wait_for_selector('#unit[data-drawn="A1007"]')
            assert overlaps(page) == [], size
            assert overfull(page) == [], size
            assert width(page) <= size
            # WCAG 2.1, 1.4.3.
            assert [t for t in contrasts(page) if t['ratio'] < 4.5] == [], size
            assert window.console == []


@needs_chromium
def test_on_a_phone_every_value_has_its_heading(browser, written):
    with Window(browser, written, 390) as window:
        page = window.open()
        cells = page.locator('table.cases td:not(:first-child)')
        named = cells.evaluate_all(
            """cells => cells.map(cell => [cell.dataset.name,
                 getComputedStyle(cell, '::before').display != 'none'
                 && getComputedStyle(cell, '::before').content])"""
        )
        assert len(named) > 10
        assert all(name and content not in (False, 'none', 'normal') for name, content in named)


@needs_chromium
def test_paper_has_what_needs_a_person_and_every_unit(browser, written, tmp_path):
    pdfium = pytest.importorskip('pypdfium2')
    file = tmp_path / 'page.pdf'
    with Window(browser, written, A4, color_scheme='dark') as window:
        page = window.open()
        page.pdf(path=str(file), prefer_css_page_size=True)
        # On the screen again it is as it was.
        assert len(window.column('unit')) == 50
        page.emulate_media(media='print')
        assert overlaps(page) == [] and width(page) <= A4
        assert min(t['ratio'] for t in contrasts(page)) >= 4.5
    document = pdfium.PdfDocument(str(file))
    sheets = [sheet.get_textpage().get_text_range() for sheet in document]
    document.close()
    text = '\n'.join(sheets)
    # Small letters come out of a PDF with breaks between them.
    letters = ''.join(text.split())
    assert all(f'A{k}' in letters for k in range(1000, 1060))
    assert 'What needs a person' in sheets[0] and 'Stand west is off' in sheets[0]
    # The table begins a sheet.
    assert any(sheet.lstrip().startswith('Units') for sheet in sheets)
    assert 'Show all' not in text and 'Recordings a month' not in text


OPENS = 3.0
"""s: of processor, on this machine; alone on it a page opens in no more time."""


def thread_time(session: Any) -> float:
    """Processor time of the thread that runs a page, s: what others do does not count."""
    metrics = session.send('Performance.getMetrics')['metrics']
    return float(next(one['value'] for one in metrics if one['name'] == 'ThreadTime'))


@needs_chromium
def test_5000_units_open_in_three_seconds(browser, tmp_path):
    path = tmp_path / 'fleet.html'
    path.write_text(page(fleets.fleet(fleets.invented(5000))), encoding='utf-8')
    # 30 000 sessions of 150 bytes, and the library's 1.4 MB.
    assert path.stat().st_size < 8e6
    with Window(browser, path) as window:
        session = window.page.context.new_cdp_session(window.page)
        session.send('Performance.enable')
        shown = window.open()
        opened = thread_time(session)
        assert opened < OPENS
        assert window.matching() == '5000 of 5000 units, 1 to 50 shown'
        shown.locator('[data-column=unit] button').click()
        shown.locator('#text').fill('A5999')
        assert window.column('unit') == ['A5999']
        shown.locator('#unit-rows a').click()
        shown.wait_for_selector('#unit[data-drawn="A5999"]')
        assert thread_time(session) - opened < OPENS
        assert window.console == [] and window.asked == [window.url]
