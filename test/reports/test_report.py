"""The report: one file whose numbers are the calibration's, that asks nobody for anything."""

import json
import re
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from loopback import completed
from sessions import at_one_rate, calibrate, paper_imu, quick_plan, session, stand, truth

from imu_calib.api.documents import report
from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.units import ARCMIN, DEG_H, MICRO_G, PPM
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS, ParameterKind
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.reports.assessment import Assessed, assess, limits_tables, summary
from imu_calib.reports.budget import budget_section
from imu_calib.reports.charts import Axis
from imu_calib.reports.html import bullets
from imu_calib.reports.noise import noise_notes
from imu_calib.reports.page import Contents, _residuals, page, terms_section
from imu_calib.reports.provenance import provenance, verdict_line
from imu_calib.reports.repeatability import (
    RepeatedParameter,
    Variation,
    repeatability_notes,
    repeatability_table,
    repeated,
)
from imu_calib.reports.tables import TERM_HEADINGS
from imu_calib.segmentation.segmented import Rejected
from imu_calib.session.imu import (
    NOT_ESTIMATED,
    ChannelNoise,
    Coefficient,
    ImuSpec,
    Specification,
    Verdict,
    judge,
    load_imu,
    read_imu,
)

BROWSER = next(filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'chrome'))), None)
FIRST = datetime(2026, 1, 1, tzinfo=timezone.utc)
UNITS = {'ppm': PPM, 'arcmin': ARCMIN, 'deg/h': DEG_H, 'µg': MICRO_G}
PLAN = at_one_rate(quick_plan('twelve_position', 20.0))


@pytest.fixture(scope='module')
def result():
    """A short session; a stretch of it was not sound."""
    found = calibrate(session(PLAN, stand(), 1), PLAN)
    start = found.session.start or 0
    disturbed = Rejected(start + 10**9, start + 3 * 10**9, 'somebody <knocked> on the table', '7')
    return replace(found, labelled=replace(found.labelled, rejected=(disturbed,)))


def moved(calibration: Calibration, by: float) -> Calibration:
    """A calibration of another session: each parameter is off by some of its deviations."""
    values = calibration.values + by * calibration.std
    return replace(calibration, model=calibration.model.with_values(calibration.parameters, values))


@pytest.fixture(scope='module')
def contents(result):
    imu = load_imu('fog_medium')
    calibration = result.calibration
    dated = [
        replace(moved(calibration, by), provenance={**calibration.provenance, 'recorded': day})
        for by, day in ((-1.0, '2026-01-01T00:00:00Z'), (1.0, '2026-03-01T00:00:00Z'))
    ]
    return Contents(calibration, 'c.yaml', imu, result, {'b.yaml': dated[0], 'd.yaml': dated[1]})


@pytest.fixture(scope='module')
def text(contents):
    return page(contents)


def parsed(text: str) -> ET.Element:
    return ET.fromstring(text.removeprefix('<!DOCTYPE html>\n'))


def words(element: ET.Element) -> str:
    return ' '.join(t.strip() for t in element.itertext() if t.strip())


def parameter_rows(text: str) -> dict[str, list[str]]:
    tables = [t for t in parsed(text).iter('table') if 'parameters' in t.get('class', '')]
    rows = [[words(cell) for cell in row] for t in tables for row in t.findall('tbody/*')]
    return {row[0]: row[1:] for row in rows}


def test_all_parameters_are_there_with_the_numbers_of_the_calibration(text, result):
    rows, calibration = parameter_rows(text), result.calibration
    assert tuple(rows) == PARAMETER_NAMES
    for name, value, std in zip(rows, calibration.values, calibration.std, strict=True):
        shown, bar, scale = rows[name][1].replace('−', '-'), rows[name][2], UNITS[rows[name][3]]
        places = len(shown.partition('.')[2])
        assert float(shown) == pytest.approx(value / scale, abs=0.51 * 10**-places)
        assert float(bar) == pytest.approx(2 * std / scale, abs=0.51 * 10**-places)
        assert float(bar) > 0


def test_the_angles_between_input_axes_are_there(text, result):
    (table,) = [t for t in parsed(text).iter('table') if t.get('class') == 'angles']
    rows = [[words(cell) for cell in row] for row in table.findall('tbody/*')]
    groups = result.calibration.free_of_frame
    assert len(rows) == 9
    assert [row[0] for row in rows[::3]] == [f'{g.group.words} {g.group.names[0]}' for g in groups]
    for row, value in zip(rows, np.concatenate([g.values for g in groups]), strict=True):
        places = len(row[1].partition('.')[2])
        shown = float(row[1].replace('−', '-'))
        assert shown == pytest.approx(value / ARCMIN, abs=0.51 * 10**-places)


def test_verdicts_stand_beside_the_limits_of_the_specification(text):
    # Truth of Table 1 against fog_medium.yaml: E_azy 7.55 arcmin of 6, K_gx 1927 ppm of 3000.
    rows = parameter_rows(text)
    assert rows['E_azy'][4] == '±6' and rows['E_azy'][-1] == 'fail'
    assert rows['K_gx'][4] == '±3000' and rows['K_gx'][-1] == 'pass'
    (body,) = parsed(text).findall('body')
    head = words(body)
    assert re.search(r'fail \d+ of 24 parameters within the specification, \d+ marginal', head)


@pytest.mark.parametrize(
    ('value', 'std', 'verdict'),
    [
        (0.8, 0.1, Verdict.PASS),  # 0.8 + 2 x 0.1 reaches the limit and no further
        (0.81, 0.1, Verdict.MARGINAL),
        (-1.0, 0.0, Verdict.PASS),
        (-1.0, 0.1, Verdict.MARGINAL),
        (1.2, 0.1, Verdict.MARGINAL),
        (-1.21, 0.1, Verdict.FAIL),
        (1.0 + 1e-12, 0.0, Verdict.FAIL),
        (0.0, 0.6, Verdict.MARGINAL),
    ],
)
def test_verdicts_at_the_limit(value, std, verdict):
    assert judge(value, std, 1.0) is verdict


def test_without_a_specification_no_verdict_is_given(contents):
    bare = replace(contents, imu=paper_imu_without_limits(), others=None)
    assert 'no file of the IMU with a specification was given' in page(bare)
    assert list(parameter_rows(page(bare))) == list(PARAMETER_NAMES)
    assert 'class="badge' not in page(bare)


def paper_imu_without_limits() -> ImuSpec:
    return replace(paper_imu(), specification=None)


def shown_tests(result: Result, tests: dict[str, object]) -> str:
    """Return the section on terms of a result with other tests of them."""
    provenance = {**result.calibration.provenance, 'tests_of_terms': tests}
    return ' '.join(terms_section(replace(result.calibration, provenance=provenance)))


def test_terms_of_the_session_have_units_of_their_own(result):
    tested = {
        'state': 'off',
        'log10_p': -0.3,
        'found_from': [1e-9, 1e-9, 5e-10, 5e-8, 5e-8, 5e-8, 1e-8, None],
        'would_move': {'K_g': {'parameter': 'K_gz', 'by': 360.0}},
    }
    shown = shown_tests(result, {'trend': tested})
    assert 'parameters that drift evenly with time' in shown
    # 1e-9 rad/s^2, 5e-8 m/s^3 and 1e-8 1/s; of K_a nothing is seen.
    assert 'D_g 0.74 deg/h per h, D_a 18 µg per h, K_g 36 ppm per h<' in shown
    assert 'K_gz: 0.1 ppm for 1 ppm per h' in shown


def test_a_trend_of_chosen_biases_is_shown_as_a_trend(result):
    # As sessions in the hand write it: 1e-8 m/s^3 would move D_ax by 2e-5 m/s^2.
    tested = {
        'state': 'off',
        'found_from': [1e-8, 1e-8, 5e-9],
        'would_move': {'D_ax': {'parameter': 'D_ax', 'by': 2000.0}},
    }
    shown = shown_tests(result, {'trend:D_a': tested})
    assert 'parameters that drift evenly with time' in shown
    assert 'D_a 3.7 µg per h<' in shown
    assert 'D_ax: 0.56 µg for 1 µg per h' in shown


def test_what_was_not_used_is_named_with_its_reason(text):
    cells = [[words(c) for c in row] for row in parsed(text).iter('tr')]
    assert ['7', '22:13:21', '1.0', '2.0', 'somebody <knocked> on the table'] in cells
    titles = [words(t) for t in parsed(text).iter('title')]
    assert any('somebody <knocked>' in t for t in titles)


def test_every_stretch_is_on_the_time_line(text, result):
    blocks = [e.get('class') for e in parsed(text).iter('rect') if 'block' in str(e.get('class'))]
    assert blocks.count('block static') == len(result.labelled.segments) == 12
    assert blocks.count('block turn') == len(result.labelled.turns) == 6
    assert blocks.count('block rejected') == 1


def test_thousands_of_rejected_stretches_do_not_swell_the_page(contents):
    result = contents.result
    start = result.session.start or 0
    many = tuple(
        Rejected(start + k * 10**8, start + k * 10**8 + 5 * 10**7, 'the sensor is saturated', '7')
        for k in range(5000)
    )
    swollen = replace(result, labelled=replace(result.labelled, rejected=many))
    found = page(replace(contents, result=swollen))
    assert len(found.encode()) < 500_000
    assert 'and 4960 more' in found


def test_the_page_asks_nobody_for_anything_and_is_small(text, contents):
    names = {e.tag for e in parsed(text).iter()}
    assert not names & {'script', 'link', 'img', 'iframe', 'object', 'image', 'use', 'a'}
    attributes = {key for e in parsed(text).iter() for key in e.attrib}
    assert not attributes & {'src', 'href', 'action', 'data', 'background', 'onload'}
    assert not re.search(r'https?:|//[a-z]|url\(|@import', text)
    policies = [e.get('content', '') for e in parsed(text).iter('meta') if e.get('http-equiv')]
    assert len(policies) == 1 and policies[0].startswith("default-src 'none';")
    assert len(text.encode()) < 300_000
    assert page(contents) == text


def test_findings_are_texts_whatever_they_hold(contents):
    nasty = replace(contents.calibration, findings=('<script>alert(1)</script> & "so"',))
    found = page(replace(contents, calibration=nasty))
    assert [words(e) for e in parsed(found).iter('li')] == ['<script>alert(1)</script> & "so"']


def test_a_calibration_alone_gives_a_report_too(contents, tmp_path):
    path = tmp_path / 'c.yaml'
    contents.calibration.save(path)
    assert main(['report', str(path), '-o', str(tmp_path / 'r.html')]) == 0
    found = (tmp_path / 'r.html').read_text(encoding='utf-8')
    assert list(parameter_rows(found)) == list(PARAMETER_NAMES)
    assert 'Course of the session' not in found and 'Allan deviation' in found


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """A recording that says nothing of itself."""
    folder = tmp_path_factory.mktemp('recording') / 'bag'
    with RecordingWriter(folder, {}) as writer:
        for topic, block in session('six_position', stand(), 2):
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)
    return folder


def test_calibration_and_recording_on_the_command_line(recording, tmp_path, capsys):
    said = ['--plan', 'six_position', '--imu', 'fog_medium', '--latitude', '34.65']
    said += ['--azimuth', '0']
    made, report = str(tmp_path / 'c.yaml'), tmp_path / 'r.html'
    assert main(['calibrate', str(recording), *said, '-o', made]) == 0
    # Three of the paper's parameters are beyond the limits that the example states.
    assert main(['report', made, str(recording), *said, '-o', str(report)]) == 3
    found = report.read_text(encoding='utf-8')
    assert 'Course of the session' in found and 'residual / std' in found
    capsys.readouterr()
    # Another latitude gives other numbers: no report that mixes the two.
    said[5] = '30'
    assert main(['report', made, str(recording), *said, '-o', str(report)]) != 0
    other = Calibration.load(Path(made))
    replace(other, provenance={**other.provenance, 'sha256': 'f' * 64}).save(Path(made))
    assert main(['report', made, str(recording), *said, '-o', str(report)]) == 2
    assert 'is not the recording that' in capsys.readouterr().err.replace('\n', ' ')


def test_spread_and_drift_of_a_hand_worked_case():
    # 1, 2, 3 on days 0, 1, 2, each +-0.1: slope 1 +- 0.1 / sqrt(2), spread 1, chi-squared 200.
    row = RepeatedParameter(
        PARAMETERS[0], np.array([1.0, 2.0, 3.0]), np.full(3, 0.1), np.array([0.0, 1.0, 2.0])
    )
    assert row.spread == pytest.approx(1.0) and row.stated == pytest.approx(0.1)
    assert row.drift == pytest.approx((1.0, 0.1 / np.sqrt(2)))
    assert row.chance == pytest.approx(np.exp(-100), rel=1e-9)
    assert replace(row, days=None).drift is None
    # Off the line by 0.5, -1, 0.5 the deviation grows by sqrt(chi-squared of one) = sqrt(150).
    bent = replace(row, value=np.array([1.5, 1.0, 3.5]))
    assert bent.drift == pytest.approx((1.0, 0.1 / np.sqrt(2) * np.sqrt(150)))


@pytest.mark.parametrize(
    ('values', 'days', 'variation'),
    [
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0, 1, 2, 3, 4, 5], Variation.DRIFTS),
        ([0.0, 0.1, 0.0, 5.0, 5.1, 5.0], [0, 1, 2, 3, 4, 5], Variation.STEPS),
        # Nothing was measured in between, and two dates show no course.
        ([0.0, 0.1, 5.0, 5.1], [0, 1, 300, 301], Variation.CHANGES),
        ([0.0, 5.0], [0, 300], Variation.SCATTERS),
        ([0.0, 5.0, 0.1, 4.9], [0, 1, 2, 3], Variation.SCATTERS),
        ([0.0, 0.1, -0.1, 0.0], [0, 1, 2, 3], Variation.REPEATS),
    ],
)
def test_a_drift_and_a_step_are_named_where_the_values_tell_them_apart(values, days, variation):
    size = len(values)
    row = RepeatedParameter(
        PARAMETERS[0], np.array(values), np.full(size, 0.1), np.array(days, float), FIRST
    )
    assert row.variation is variation
    (words,) = re.findall(r'badge \w+">(\w+)<', repeatability_table([row]))
    assert words == variation.value[0]
    notes = repeatability_notes([row])
    assert ('Stepping between two dates: K_gx (2026-01-03 to 2026-01-04).' in notes) is (
        variation is Variation.STEPS
    )
    assert ('as a drift or a step explains: K_gx.' in notes) is (variation is Variation.CHANGES)


def test_only_calibrations_of_one_unit_are_compared(contents):
    own = contents.calibration
    foreign = replace(own, imu=replace(own.imu, id='another'))
    with pytest.raises(InputError, match=r"b\.yaml: is of unit 'another', expected 'fog_medium'"):
        repeated([own, foreign], ['a.yaml', 'b.yaml'])
    one, two = replace(own, serial_number='A1'), replace(own, serial_number='A2')
    with pytest.raises(InputError, match=r'b\.yaml: serial_number: found A2, expected A1'):
        repeated([one, two], ['a.yaml', 'b.yaml'])
    with pytest.raises(InputError, match=r'b\.yaml: is the same calibration as a\.yaml'):
        repeated([own, two], ['a.yaml', 'b.yaml'])
    again = moved(own, 1.0)
    assert repeated([own, again], ['a.yaml', 'b.yaml'])
    with pytest.raises(
        InputError, match=r't\.yaml: states no standard deviations, as a truth does'
    ):
        repeated([own, truth()], ['a.yaml', 't.yaml'])
    with pytest.raises(InputError, match=r'c\.yaml: is the same calibration as b\.yaml'):
        repeated([own, again, again], ['a.yaml', 'b.yaml', 'c.yaml'])
    scaled = replace(own, imu=replace(own.imu, accel=replace(own.imu.accel, scale_factor=0.02)))
    with pytest.raises(InputError, match='nominal scale factors'):
        repeated([own, scaled], ['a.yaml', 'b.yaml'])
    undated = replace(again, provenance={**own.provenance, 'recorded': None})
    assert repeated([own, undated], ['a', 'b'])[0].days is None
    wrong = replace(again, provenance={**own.provenance, 'recorded': 'yesterday'})
    with pytest.raises(InputError, match='recorded: found'):
        repeated([own, wrong], ['a', 'b'])


def test_a_report_is_not_called_a_pdf(contents, tmp_path):
    with pytest.raises(InputError, match='the page is HTML, expected a name'):
        report(contents.calibration, tmp_path / 'r.pdf')
    assert not (tmp_path / 'r.pdf').exists()


def test_compare_may_be_repeated(contents, tmp_path):
    files = [tmp_path / f'{name}.yaml' for name in 'abc']
    for by, file in enumerate(files):
        moved(contents.calibration, float(by)).save(file)
    first, *others = map(str, files)
    asked = [word for other in others for word in ('--compare', other)]
    assert main(['report', first, *asked, '-o', str(tmp_path / 'r.html')]) == 0
    assert '3 calibrations;' in (tmp_path / 'r.html').read_text(encoding='utf-8')


def test_the_recording_dates_the_calibration(result):
    # The simulated stand begins at 1.7e9 s after the epoch.
    assert result.calibration.provenance['recorded'] == '2023-11-14T22:13:20Z'


SPECIFIED = 'id: a\nunits: si\nspecification: {gyro: {bias: 1 deg/h}, accelerometer: {%s}}'


def test_a_specification_is_read_in_si():
    spec = read_imu(Section.parse(SPECIFIED % 'scale_factor_error: 500 ppm', 'my.yaml'))
    assert spec.specification == Specification(
        {
            (ParameterKind.BIAS, 'g'): pytest.approx(DEG_H),
            (ParameterKind.SCALE_FACTOR_ERROR, 'a'): pytest.approx(5e-4),
        }
    )


def test_axes_stand_at_round_numbers():
    assert [t for _, t in Axis(-1.1, 2.2).ticks()] == [
        '−1.0',
        '−0.5',
        '0',
        '0.5',
        '1.0',
        '1.5',
        '2.0',
    ]
    assert [t for _, t in Axis.decades([0.02, 30.0]).ticks()] == ['0.01', '0.1', '1', '10', '100']
    assert Axis.decades([0.02, 30.0]).share(1.0) == pytest.approx(0.5)


def browse(path: Path, folder: Path, *arguments: str) -> tuple[str, set[str]]:
    """Open a page without a network; return what the console says, and what was asked for."""
    log = folder / 'net.json'
    done = completed(
        [
            str(BROWSER),
            '--headless',
            '--no-sandbox',
            '--disable-gpu',
            '--no-first-run',
            '--disable-background-networking',
            '--host-resolver-rules=MAP * ~NOTFOUND',
            f'--user-data-dir={folder / "profile"}',
            '--enable-logging=stderr',
            f'--log-net-log={log}',
            *(arguments or ('--dump-dom',)),
            path.as_uri(),
        ],
        timeout=120,
        check=True,
    )
    asked = set(
        re.findall(r'"url":"(\w+://[^/"?]+)', json.dumps(log.read_text()).replace('\\', ''))
    )
    # The browser asks for its own updates, whatever the page.
    own = re.compile(r'google|gvt1|googleapis')
    console = '\n'.join(line for line in done.stderr.splitlines() if ':CONSOLE' in line)
    return console, {url for url in asked if not own.search(url)}


needs_browser = pytest.mark.skipif(BROWSER is None, reason='chromium is not installed')


@needs_browser
def test_a_browser_shows_it_without_an_error_or_a_request(text, tmp_path):
    path, printed = tmp_path / 'report.html', tmp_path / 'report.pdf'
    path.write_text(text, encoding='utf-8')
    console, asked = browse(path, tmp_path, f'--print-to-pdf={printed}', '--no-pdf-header-footer')
    assert (console, asked) == ('', set())
    sizes = re.findall(rb'/MediaBox \[([\d. ]+)\]', printed.read_bytes())
    # A4 is 595 by 842 points.
    assert {tuple(round(float(v)) for v in s.split()) for s in sizes} == {(0, 0, 595, 842)}
    assert 3 <= len(sizes) <= 7


@needs_browser
def test_the_browser_would_tell_of_a_request_and_of_an_error(tmp_path):
    path = tmp_path / 'bad.html'
    path.write_text('<img src="http://elsewhere.invalid/a.png"><script>nothing()</script>')
    console, asked = browse(path, tmp_path)
    assert 'nothing is not defined' in console
    assert asked == {'http://elsewhere.invalid'}


def test_the_title_is_the_serial_number_and_without_one_the_type(contents):
    def title(serial_number):
        calibration = replace(contents.calibration, serial_number=serial_number)
        return page(replace(contents, calibration=calibration)).partition('<h1>')[2]

    assert title('A-17').startswith('A-17</h1>')
    assert title('').startswith('fog_medium</h1>')


def test_the_verdict_of_the_terminal_stands_under_the_title(contents):
    told = replace(contents.calibration, findings=('Warning: Tilted.', 'A note.'))
    head = page(replace(contents, calibration=told)).partition('<section')[0]
    assert f'<p>{verdict_line(told)}</p>' in head


def test_units_are_set_alike_on_the_page(contents):
    told = 'Scatter of 3 +- 1 ug at 0.05 deg/sqrt(h).'
    found = page(replace(contents, calibration=replace(contents.calibration, findings=(told,))))
    assert 'Scatter of 3 ± 1 µg at 0.05 deg/√h.' in found
    shown = found.partition('</style>')[2]
    assert re.findall(r'\bug\b|sqrt\(|m/s\^2', shown) == []
    assert {'µg', 'deg/√h', '(m/s)/√h'} <= set(re.findall('<td[^>]*>([^<]*)</td>', shown))


def test_every_column_of_the_terms_is_explained(contents):
    told = ''.join(terms_section(contents.calibration)).partition('</table>')[2].lower()
    assert [word for word in TERM_HEADINGS[1:] if f'{word}:' not in told] == []


def test_a_curve_above_the_data_sheet_by_the_steps_of_the_output_names_them():
    """White noise as stated, and steps that hide it at short times (IEEE 952: sqrt(3) Q / tau)."""
    imu = load_imu('fog_medium')
    walk, tau = imu.gyro.random_walk, np.array([0.01, 1.0, 100.0])

    def channel(step):
        known = Coefficient(walk, walk / 100, walk)
        steps = Coefficient(step, 0.0, step)
        curve = np.sqrt(walk**2 / tau + 3 * step**2 / tau**2)
        return ChannelNoise(
            tau, curve, curve / 100, known, NOT_ESTIMATED, steps, NOT_ESTIMATED, timed=False
        )

    coarse, fine = channel(walk), channel(walk / 1000)
    assert 'At short times gx are above the data sheet by quantisation' in noise_notes(
        {'gx': coarse, 'gy': fine}, imu
    )
    for noise, known in (({'gy': fine}, imu), ({'gx': coarse}, None)):
        assert 'quantisation' not in noise_notes(noise, known)


def test_budgets_of_units_in_the_hand_have_the_units_of_their_grade(contents):
    table = contents.calibration
    hand = replace(table, provenance={**table.provenance, 'by_hand': True})
    units = [
        set(re.findall('>(ppm|arcmin|deg/h|µg|%|deg|deg/s|mg)<', ''.join(budget_section(c))))
        for c in (table, hand)
    ]
    assert units == [{'ppm', 'arcmin', 'deg/h', 'µg'}, {'%', 'deg', 'deg/s', 'mg'}]


def test_pages_of_units_in_the_hand_have_no_units_of_data_sheets(contents):
    own = contents.calibration
    trend = {
        'state': 'off',
        'found_from': [1e-9] * 6 + [1e-8] * 2,
        'would_move': {'K_g': {'parameter': 'K_gz', 'by': 360.0}},
    }
    g_sensitivity = {'state': 'off', 'found_from': [1e-6] * 9}
    tests = {'trend': trend, 'g_sensitivity': g_sensitivity}
    facts = {**own.provenance, 'tests_of_terms': tests}

    def units(by_hand):
        held = replace(own, provenance={**facts, 'by_hand': by_hand})
        by_channel = provenance(held).partition('By channel')[2].partition('</table>')[0]
        plots = _residuals(replace(contents, calibration=held))
        terms = ''.join(terms_section(held))
        return [set(re.findall('ppm|arcmin|deg/h|µg', text)) for text in (by_channel, plots, terms)]

    assert units(by_hand=False) == [{'deg/h', 'µg'}, {'deg/h', 'µg'}, {'ppm', 'deg/h', 'µg'}]
    assert units(by_hand=True) == [set()] * 3


def test_a_zero_by_the_choice_of_axes_has_no_row(contents):
    calibration = contents.calibration
    k = PARAMETER_NAMES.index('E_axy')
    free = (np.arange(len(calibration.std)) != k).astype(float)
    model = calibration.model.with_values(calibration.parameters, calibration.values * free)
    covariance = calibration.covariance * np.outer(free, free)
    fixed = replace(calibration, model=model, covariance=covariance)
    shown = limits_tables(assess(fixed, None)) + ''.join(budget_section(fixed))
    assert 'E_axy' not in shown and shown.count('E_axz') > 2
    again = repeated([fixed, moved(fixed, 1.0)], ['a', 'b'])
    assert 'E_axy' not in [row.parameter.name for row in again]


def test_units_in_the_hand_have_the_units_of_their_grade():
    """Of one calibration the same numbers, in % and deg in place of ppm and arcmin."""
    unit = Calibration.load(named_file('truths', 'mems_counts'))
    known = replace(unit, covariance=np.diag(np.full(len(unit.std), 1e-8)))
    held = replace(known, provenance={'by_hand': True})
    table, hand = (limits_tables(assess(one, None)) for one in (known, held))
    assert 'ppm' in table and 'arcmin' in table
    assert 'ppm' not in hand and 'arcmin' not in hand
    assert all(unit in hand for unit in ('>%<', '>deg<', '>deg/s<', '>mg<'))
    first = known.values[0]
    assert f'>{first / PPM:.0f}<' in table
    assert f'>{100 * first:.3f}<' in hand


def test_the_summary_names_what_is_marginal_and_outside():
    def summed(*values):
        pairs = zip(PARAMETERS, values, strict=False)
        return summary([Assessed(p, value, 0.1, 1.0) for p, value in pairs])

    assert summed(0.0, 0.9, 1.3, 1.1).startswith(
        '1 of 4 parameters within the specification, 2 marginal (K_gy, E_gxy), 1 outside (K_gz)'
    )
    assert '8 marginal (K_gx, K_gy, K_gz, E_gxy, E_gxz, E_gyx, 2 more), 0 out' in summed(*[1.0] * 8)


def test_a_line_of_a_file_in_a_sentence_is_code_on_a_page():
    shown = bullets(['State it (`clock: 5 ppm`, for instance) with `gravity_std`.'])
    assert '<code>clock: 5 ppm</code>' in shown and '`' not in shown
    assert '<code>--gravity-std</code>' in shown
