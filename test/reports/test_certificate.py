"""The certificate: what ISO/IEC 17025 asks for, printed with page numbers, and as a DCC."""

import base64
import re
import shutil
import sys
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml
from browser import CHROMIUM, look_at, needs_chromium, opened, overlaps, width
from browser import browser as browser  # noqa: PLC0414
from loopback import CHECKOUT
from sessions import at_one_rate, calibrate, quick_plan, session, stand

import imu_calib
from imu_calib.api.documents import certificate
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.common.budget import Budget, ErrorSource, Share
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.units import ARCSEC
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.terms import TERMS
from imu_calib.reports import certificate as printing
from imu_calib.reports.budget import budget_parts
from imu_calib.reports.certificate import Certificate, certificate_of, certificate_page
from imu_calib.reports.certificate_fields import Conformity, Rule, decide, read_fields
from imu_calib.reports.dcc import DCC, SI, dcc, digital
from imu_calib.reports.provenance import verdict_line
from imu_calib.session.imu import load_imu

EXAMPLE = CHECKOUT / 'config' / 'certificates' / 'example.yaml'
SCHEMA = CHECKOUT / 'test' / 'data' / 'dcc' / 'dcc.xsd'
PLAN = at_one_rate(quick_plan('twelve_position', 20.0))


@pytest.fixture(scope='module')
def calibration():
    found = calibrate(session(PLAN, stand(), 1), PLAN).calibration
    setup = {**found.provenance, 'gravity_std': 2e-5, 'gravity_source': 'measured'}
    # As if its table were a real one.
    assert setup.pop('table_simulated')
    return replace(found, serial_number='A1234', provenance=setup)


def fields(**changes: Any) -> Any:
    document = {**yaml.safe_load(EXAMPLE.read_text()), **changes}
    return read_fields(Section(document, 'my.yaml'))


def made(calibration: Calibration, **changes: Any) -> Certificate:
    specification = load_imu('fog_medium').specification
    return certificate_of(calibration, fields(**changes), specification, dcc=True)


@pytest.fixture(scope='module')
def example(calibration):
    return made(calibration)


@pytest.fixture(scope='module')
def text(example):
    return certificate_page(example)


def words(element: ET.Element) -> str:
    joined = ' '.join(t.strip() for t in element.itertext() if t.strip())
    return re.sub(r'\s+', ' ', joined)


def rows(text: str) -> dict[str, list[str]]:
    page = ET.fromstring(text.removeprefix('<!DOCTYPE html>\n'))
    lines = [[words(cell) for cell in row] for row in page.iter('tr')]
    return {line[0]: line[1:] for line in reversed(lines)}


def test_every_field_stands_on_the_certificate(text):
    def stated(value):
        if isinstance(value, dict):
            return [t for v in value.values() for t in stated(v)]
        if isinstance(value, list):
            return [t for v in value for t in stated(v)]
        return [f'{value:g}' if isinstance(value, float) else str(value)]

    document = yaml.safe_load(EXAMPLE.read_text())
    document['location'], document['conformity']['rule'] = (
        "laboratory's premises",
        'Guard band w = U',
    )
    page = words(ET.fromstring(text.removeprefix('<!DOCTYPE html>\n')))
    assert [t for t in stated(document) if t not in page] == []


def test_results_are_those_of_the_calibration_with_uncertainty_and_coverage(text, calibration):
    shown, budget = rows(text), calibration.budget
    assert budget is not None
    for k, parameter in enumerate(calibration.parameters):
        _, value, std, freedom, factor, expanded, *_ = shown[parameter.name]
        scale = parameter.unit.scale
        places = len(expanded.partition('.')[2])
        half = 0.51 * 10.0**-places
        assert float(value.replace('−', '-')) == pytest.approx(
            calibration.values[k] / scale, abs=half
        )
        assert float(std) == pytest.approx(calibration.std[k] / scale, rel=0.05)
        # GUM 6.2.1: U = k u, and 7.2.6: two digits of it.
        product = float(factor) * calibration.std[k] / scale
        assert float(expanded) == pytest.approx(product, abs=half + 0.004 * product)
        assert len(expanded.replace('.', '').lstrip('0')) in (2, 3)
        if freedom.isdigit():
            # Student's t at 97.5 %: Abramowitz and Stegun, 26.7.5, by the Gaussian's 1.959964.
            x, n = 1.959964, float(freedom)
            t = x + (x**3 + x) / (4 * n) + (5 * x**5 + 16 * x**3 + 3 * x) / (96 * n**2)
            # Two digits behind the point, and freedom rounded to whole numbers.
            assert float(factor) == pytest.approx(t, abs=0.01)


@pytest.mark.parametrize(
    ('value', 'rule', 'stated'),
    [
        (0.89, Rule.SIMPLE, Conformity.PASS),
        (-1.0, Rule.SIMPLE, Conformity.PASS),
        (-1.01, Rule.SIMPLE, Conformity.FAIL),
        (0.89, Rule.GUARDED, Conformity.PASS),
        (0.91, Rule.GUARDED, Conformity.FAIL),
        (-0.89, Rule.GUARDED_BOTH, Conformity.PASS),
        (0.91, Rule.GUARDED_BOTH, Conformity.CONDITIONAL_PASS),
        (-1.01, Rule.GUARDED_BOTH, Conformity.CONDITIONAL_FAIL),
        (1.11, Rule.GUARDED_BOTH, Conformity.FAIL),
    ],
)
def test_conformity_by_the_stated_rule(value, rule, stated):
    # Limit 1, U 0.1 (ILAC-G8:09/2019, 4.2).
    assert decide(value, 0.1, 1.0, rule) is stated


@pytest.mark.parametrize('rule', Rule)
def test_a_limit_below_the_uncertainty_decides_nothing_but_a_clear_fail(calibration, example, rule):
    # Limit 6 arcmin, U 18: any value up to 24 is as likely within the limit as its neighbours.
    stated = [decide(value, 18.0, 6.0, rule) for value in (0.0, 5.0, -7.0, 23.9)]
    assert set(stated) == {Conformity.NOT_ASSESSED}
    assert decide(-24.1, 18.0, 6.0, rule) is Conformity.FAIL
    passed, *_ = (r for r in example.results if r.conformity is Conformity.PASS)
    unknown = replace(passed, conformity=Conformity.NOT_ASSESSED)
    found = replace(example, results=(passed, unknown))
    assert found.conformity is Conformity.NOT_ASSESSED
    page, root = certificate_page(found), validated(dcc(found))
    assert 'Statement: not assessed. 1 of 2 parameters: pass; 1 of 2 ' in page
    assert 'Not assessed: U exceeds the limit' in page and 'Not assessed: U exc' in words(root)
    assert [e.text for e in root.iter(f'{{{DCC}}}conformity')] == ['pass']


def test_a_guarded_pass_is_wrong_as_seldom_as_the_rule_says():
    rng, limit, std = np.random.default_rng(5), 1.0, 0.1
    measured = limit - 1.96 * std
    true = measured + std * rng.standard_normal((24, 100_000))
    assert decide(measured - 1e-9, 1.96 * std, limit, Rule.GUARDED) is Conformity.PASS
    # 2.5 %, known from so many to 0.05 %.
    assert np.mean(true[0] > limit) == pytest.approx(0.025, abs=0.002)
    # An item of 24 parameters, independent and all at their limits: more often, within the sum.
    stated = re.search('For each parameter .* 2.5 %; .*24 .*, (.*) %', Rule.GUARDED.words(24))
    assert stated is not None
    assert 0.4 < np.mean(np.any(true > limit, axis=0)) <= float(stated[1]) / 100 <= 0.6


def test_without_a_rule_nothing_is_stated_of_conformity(calibration):
    found = made(calibration, conformity=None)
    assert found.conformity is None
    page = certificate_page(found)
    assert 'No statement of conformity was requested' in page and '>fail<' not in page
    assert 'conformity>' not in dcc(found)


def test_what_is_missing_is_named_with_its_clause_and_not_invented(calibration, tmp_path, capsys):
    path, source, target = tmp_path / 'f.yaml', tmp_path / 'c.yaml', tmp_path / 'c.html'
    path.write_text('laboratory: {name: "A <lab> & sons"}\nequipment: [{name: Table}]\n')
    calibration.save(source)
    command = ['certificate', str(source), '--fields', str(path), '-o', str(target)]
    assert main(command) == 2
    errors = capsys.readouterr().err.replace('\n', ' ')
    assert not target.exists()
    for wanted in ('number (7.8.2.1 d)', 'customer: name (7.8.2.1 e)', 'signatures (7.8.2.1 o)'):
        assert wanted in errors
    for wanted in ('equipment[0]: traceability', 'environment: temperature', 'received', '--draft'):
        assert wanted in errors
    # The calibration knows the unit and the day.
    assert 'serial_number (' not in errors.replace('equipment[0]: serial_number (', '')
    assert 'calibrated (' not in errors
    assert main([*command, '--draft']) == 0
    page = target.read_text(encoding='utf-8')
    assert 'This is a draft, not a certificate' in page and 'DRAFT' in page
    assert rows(page)['customer'] == ['MISSING'] and rows(page)['received'] == ['MISSING']
    assert rows(page)['calibrated'] == ['2023-11-14'] and rows(page)['serial number'] == ['A1234']
    assert 'A &lt;lab&gt; &amp; sons' in page and '<lab>' not in page
    assert 'Draft. Missing: number (7.8.2.1 d); ' in capsys.readouterr().out
    assert main([*command[:-1], str(tmp_path / 'd.xml'), '--draft']) == 2
    assert 'A draft may have gaps, and a DCC may not' in capsys.readouterr().err


def test_the_commands_of_the_page_work_with_the_example_to_copy(calibration, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr('imu_calib.api.documents.pdf', str.encode)
    calibration.save(tmp_path / 'calibration.yaml')
    shutil.copy(EXAMPLE, tmp_path / 'my_certificate.yaml')
    shutil.copy(named_file('imus', 'fog_medium'), tmp_path / 'my_imu.yaml')
    page = (CHECKOUT / 'docs' / 'certificate.md').read_text(encoding='utf-8')
    commands = re.findall('^    imu-calib (certificate .*)', page, re.MULTILINE)
    assert [main(command.split()) for command in commands] == [0, 0, 0]


def removed(document: Any, path: tuple[Any, ...]) -> Any:
    """A copy without what is at a path."""
    key, *rest = path
    if not rest:
        return {k: v for k, v in document.items() if k != key}
    if isinstance(document, list):
        return [removed(v, tuple(rest)) if i == key else v for i, v in enumerate(document)]
    return {**document, key: removed(document[key], tuple(rest))}


ASKED = [
    ('number',),
    *(('laboratory', k) for k in ('name', 'street', 'city', 'country', 'email')),
    *(('customer', k) for k in ('name', 'city', 'country', 'email')),
    *(('item', k) for k in ('description', 'manufacturer', 'model', 'condition', 'adjustment')),
    ('received',),
    ('issued',),
    ('procedure', 'name'),
    ('procedure', 'reference'),
    ('environment', 'temperature'),
    *(('equipment', 1, k) for k in ('name', 'serial_number', 'certificate', 'traceability')),
    ('conformity', 'requirement'),
    ('signatures', 0, 'role'),
    ('signatures',),
]


@pytest.mark.parametrize('path', ASKED, ids=lambda p: '-'.join(map(str, p)))
def test_each_thing_that_is_asked_for_is_missed(calibration, path):
    document = removed(yaml.safe_load(EXAMPLE.read_text()), path)
    name = ''.join(f'[{p}]' if isinstance(p, int) else f': {p}' for p in path)[2:]
    sentence = r'my\.yaml: 1 of the entries that a certificate needs is missing: .*'
    with pytest.raises(InputError, match=sentence + re.escape(name)):
        certificate_of(
            calibration,
            read_fields(Section(document, 'my.yaml')),
            load_imu('fog_medium').specification,
            dcc=True,
        )


def test_a_calibration_without_a_serial_number_gives_a_draft_alone(calibration):
    unnamed = replace(calibration, serial_number='')
    with pytest.raises(InputError, match='calibrate again with `serial`'):
        made(unnamed)
    draft = certificate_of(unnamed, fields(), draft=True)
    assert 'calibrate again with `serial`' in draft.missing[-1]


def test_simulated_data_give_a_draft_alone(calibration):
    simulated = replace(calibration, provenance={**calibration.provenance, 'simulated': True})
    with pytest.raises(InputError, match='measured data: those of this calibration were simulated'):
        made(simulated)
    draft = certificate_of(simulated, fields(), draft=True)
    assert 'were simulated' in certificate_page(draft)


def test_a_simulated_table_and_an_impossible_gravity_give_a_draft_alone(calibration):
    for wrong, sentence in (
        ({'table_simulated': True}, 'a real table: three_axis is a simulated one.*by `table`'),
        ({'gravity': calibration.provenance['gravity'] * 1.006}, 'a possible gravity: .*7.6.1'),
    ):
        found = replace(calibration, provenance={**calibration.provenance, **wrong})
        with pytest.raises(InputError, match=f'1 of .* is missing: {sentence}'):
            made(found)
        draft = certificate_page(certificate_of(found, fields(), draft=True))
        assert ('table three_axis (simulated)' in draft) is ('table_simulated' in wrong)


def test_a_procedure_that_was_not_completed_is_stated_as_such(calibration):
    missing = {'missing_positions': ['9', '10']}
    sound = replace(calibration, findings=('A note.',))
    found = replace(sound, provenance={**sound.provenance, **missing})
    for one, ends in ((sound, ''), (found, '; not completed, without position 9, 10')):
        shown = rows(certificate_page(made(one)))['plan and estimator'][0]
        assert shown == f'twelve_position, {one.provenance["method"]}{ends}'
        assert f'{shown}. Recording' in words(validated(dcc(made(one))))
        but = ', but positions of the plan are missing' if ends else ''
        assert verdict_line(one).startswith(f'Verdict: no warnings{but}.')


def test_a_file_that_was_edited_is_not_certified(calibration, tmp_path):
    path, target = tmp_path / 'c.yaml', tmp_path / 'c.html'
    calibration.save(path)
    certificate(path, fields(), target, imu='fog_medium')
    path.write_text(path.read_text().replace('latitude_deg: ', 'latitude_deg:  '))
    with pytest.raises(InputError, match=r'c\.yaml was edited after it was saved'):
        certificate(path, fields(), target, imu='fog_medium')


def test_a_certificate_is_not_issued_before_its_day(calibration, tmp_path):
    later = fields(issued='2123-11-16')
    with pytest.raises(InputError, match='issued: found 2123-11-16, which is after today'):
        certificate(calibration, later, tmp_path / 'c.html', imu='fog_medium')
    certificate(calibration, later, tmp_path / 'd.html', imu='fog_medium', draft=True)


def test_a_certificate_that_nobody_named_is_not_overwritten(
    calibration, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    calibration.save(tmp_path / 'c.yaml')
    command = ['certificate', 'c.yaml', '--fields', str(EXAMPLE), '--imu', 'fog_medium']
    assert [main(command), main(command)] == [0, 2]
    assert 'certificate.html exists already' in capsys.readouterr().err
    assert main([*command, '-o', 'certificate.html']) == 0


def referring(valid_until: str) -> list[dict[str, Any]]:
    """The references of the example, the first of them valid until a date."""
    first, *others = yaml.safe_load(EXAMPLE.read_text())['equipment']
    return [{**first, 'valid_until': valid_until}, *others]


def test_a_reference_that_was_not_valid_any_more_gives_no_certificate(calibration):
    # Recorded on 2023-11-14 (ISO/IEC 17025:2017, 6.5.1).
    sentence = r'equipment\[0\]: valid_until: found 2023-11-13, before the end of the calibration'
    with pytest.raises(InputError, match=sentence):
        made(calibration, equipment=referring('2023-11-13'))
    with pytest.raises(InputError, match=sentence):
        certificate_of(calibration, fields(equipment=referring('2023-11-13')), draft=True)
    assert made(calibration, equipment=referring('2023-11-14')).missing == ()


HINTS = [
    (
        'Assumed: zeros 1 arcsec; state its own under these keys. Table east states less.',
        'Assumed: zeros 1 arcsec. Table east states less.',
    ),
    ('It is one. State what the table has.', 'It is one.'),
    ('Known to 1.5 ppm. State `height`, or `gravity` as measured.', 'Known to 1.5 ppm.'),
    ('Assumed: zeros 30 arcsec; state its own under these keys.', 'Assumed: zeros 30 arcsec.'),
    ('Hold the unit still for 2.5 s.', None),
    (
        'It turns in it. Take it off its isolators, or fasten it, and record again.',
        'It turns in it.',
    ),
    ('It moved: this is estimated. Fasten it, and record again.', 'It moved: this is estimated.'),
    ('a.mcap: its messages do not lie in the order of their log times and are sorted.', None),
    ('Turn 5 was left out. Check the cable. It moved.', 'Turn 5 was left out. It moved.'),
]


@pytest.mark.parametrize(('finding', 'remark'), HINTS)
def test_remarks_hold_findings_without_what_they_advise_the_operator(calibration, finding, remark):
    found = made(replace(calibration, findings=(finding,)), remarks=['State as received.'])
    assert found.remarks == ('State as received.', *([] if remark is None else [remark]))
    told = '\n'.join([certificate_page(found), contents(ET.fromstring(dcc(found)))])
    assert told.count('State as received.') == 2
    assert remark is None or told.count(remark) == 2


def test_contributions_of_the_sources_add_up_to_each_uncertainty(calibration):
    errors = {'positioning': 2 * ARCSEC, 'zeros': 30 * ARCSEC}
    of_table = {'table_errors': errors, 'table_errors_assumed': ['zeros']}
    provenance = {**calibration.provenance, **of_table}
    budget = calibration.budget.with_share(ErrorSource.TABLE, Share.known(calibration.covariance))
    found = made(replace(calibration, provenance=provenance, budget=budget))
    page = ET.fromstring(certificate_page(found).removeprefix('<!DOCTYPE html>\n'))
    lines = [[words(cell) for cell in row] for row in page.iter('tr')]
    for result in found.results:
        _, first, *more = (line[1:] for line in lines if line[0] == result.parameter.name)
        std, _, *cells = [*first, *(cell for line in more for cell in line)]
        numbers = [0.0 if cell == '-' else float(cell) for cell in cells]
        # Two digits of the sum, three of its parts.
        assert np.linalg.norm(numbers) == pytest.approx(float(std), rel=0.06)
    (pulse,) = (line for line in lines if line[0] == 'pulse')
    assert pulse[1] == 'B, rectangular, \u221a12' and '7.8 arcsec' in pulse[-1]
    (table,) = (line for line in lines if line[0] == 'table' and len(line) > 2)
    assert table[-1].endswith('zeros 30 arcsec (assumed)')


def test_gravity_has_its_uncertainty_and_source(calibration):
    known = {'gravity': 9.81, 'gravity_std': 0.0015, 'gravity_source': 'normal gravity (WGS 84)'}
    table = yaml.safe_load(EXAMPLE.read_text())['equipment'][:1]
    provenance = {**calibration.provenance, **known}
    found = made(replace(calibration, provenance=provenance), equipment=table)
    shown = rows(certificate_page(found))['gravity, (u) in its last digits'][0]
    assert shown == '9.8100(15) m/s\u00b2 (normal gravity (WGS 84))'
    root = validated(dcc(found))
    (condition,) = [
        c
        for c in root.iter(f'{{{DCC}}}influenceCondition')
        if contents(c.find('dcc:name', SPACES)) == 'gravity'
    ]
    assert 'normal gravity (WGS 84)' in words(condition)
    value, uncertainty, factor = (
        float(next(condition.iter(f'{{{SI}}}{n}')).text or '')
        for n in ('value', 'uncertainty', 'coverageFactor')
    )
    assert (value, uncertainty / factor) == pytest.approx((9.81, 0.0015))


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'calibrated': {'from': '2024-03-01'}, 'issued': '2024-03-02'}, 'expected 2023-11-14'),
        ({'item': {'serial_number': 'B7'}}, 'item: serial_number: found B7, expected A1234'),
        ({'issued': '2023-11-01'}, 'issued: found 2023-11-01, before calibrated: to'),
        ({'calibrated': None, 'issued': '2023-11-12'}, 'issued: found 2023-11-12, before 2023-11-'),
        ({'calibrated': None, 'received': '2023-11-16'}, 'received: found 2023-11-16, after 2023-'),
        ({'number': 'N7', 'replaces': 'N7'}, 'replaces: found N7, the number of this certificate'),
        ({'conformity': {'requirement': 'Issue 2'}}, 'conformity: rule: missing'),
        ({'numbr': 1}, "unknown key 'numbr'"),
    ],
)
def test_fields_of_another_session_are_refused(calibration, change, message):
    with pytest.raises(InputError, match=message):
        made(calibration, **change)


def test_all_contradictions_are_named_at_once(calibration):
    changes = {'item': {'serial_number': 'B7'}, 'calibrated': None, 'received': '2023-11-16'}
    lines = r'(?s)\n  - item: serial_number: .*\n  - received: .*\n  - equipment\[0\]: '
    with pytest.raises(InputError, match=lines):
        made(calibration, **changes, equipment=referring('2023-11-13'))
    # What is missing, and references that ended before the session, are not a second round.
    changes |= {'calibrated': {'from': '2023-11-16'}, 'laboratory': {'name': 'L'}}
    told = rf'{lines}valid_until: .*\n\d+ of the entries .* are missing:\n  - laboratory'
    with pytest.raises(InputError, match=told):
        made(calibration, **changes, equipment=referring('2023-11-13'))


def test_a_gravimeter_is_no_reference_of_a_session_that_used_normal_gravity(calibration):
    normal = {**calibration.provenance, 'gravity_source': 'normal gravity (WGS 84)'}
    with pytest.raises(InputError, match=r'equipment\[1\]: found Local.* used normal gravity'):
        made(replace(calibration, provenance=normal))


@pytest.mark.parametrize(
    ('source', 'which', 'said'),
    [
        (ErrorSource.GRAVITY, 'gravity, which was measured', 'gravity by Example Survey'),
        (
            ErrorSource.TABLE_CLOCK,
            'the stated clock of the table',
            'its clock by a receiver of GPS',
        ),
    ],
)
def test_stated_references_that_contribute_are_among_the_equipment(
    calibration, source, which, said
):
    table = yaml.safe_load(EXAMPLE.read_text())['equipment'][0]
    small = Share.known(1e-4 * np.diag(np.diag(calibration.covariance)))
    used = replace(calibration, budget=calibration.budget.with_share(source, small))
    with pytest.raises(InputError, match=f'1 of .* is missing: .* reference of {which}.*7.8.4.1 c'):
        made(used, equipment=[table])
    named = {**table, 'traceability': f'{table["traceability"]}; {said}'}
    assert made(used, equipment=[named]).missing == ()


def test_the_angles_of_a_table_that_contribute_have_a_reference(calibration):
    gravity = yaml.safe_load(EXAMPLE.read_text())['equipment'][1]
    errors = Share.known(1e-4 * np.diag(np.diag(calibration.covariance)))
    budget = calibration.budget.with_share(ErrorSource.TABLE, errors)
    used = replace(calibration, budget=budget)
    with pytest.raises(InputError, match='reference of the angles of the table'):
        made(used, equipment=[gravity])
    polygon = {**gravity, 'name': 'Polygon', 'traceability': 'Angles, to the radian'}
    assert made(used, equipment=[gravity, polygon]).missing == ()


def test_inputs_that_nobody_stated_are_named(calibration):
    sizes = {'positioning': 10 * ARCSEC, 'level': 20 * ARCSEC, 'zeros': 3 * ARCSEC}
    known = {
        'table_errors': sizes,
        'table_errors_assumed': ['positioning', 'level'],
        'table_clock_std': 0.0,
        'height_assumed': False,
        'latitude_std_deg': 0.001,
    }
    found = made(replace(calibration, provenance={**calibration.provenance, **known}))
    expected = "positioning 10 arcsec, level 20 arcsec, the table's clock exact"
    assert rows(certificate_page(found))['assumed'] == [expected]
    assert f'Assumed: {expected}.' in words(validated(dcc(found)))
    stated = {**known, 'table_errors_assumed': [], 'table_clock_std': 1e-6}
    found = made(replace(calibration, provenance={**calibration.provenance, **stated}))
    assert rows(certificate_page(found))['assumed'] == ['nothing']


def test_sources_have_their_sizes_from_the_file_and_say_assumed_of_what_was(tmp_path):
    imu = load_imu('fog_medium')
    calibrate(session(PLAN, stand(), 1, spec=imu), PLAN, spec=imu).calibration.save(
        tmp_path / 'c.yaml'
    )
    read = Calibration.load(tmp_path / 'c.yaml')
    share = Share.known(read.covariance)
    for source in (ErrorSource.POSITIONING_STATED, ErrorSource.TABLE):
        read = replace(read, budget=read.budget.with_share(source, share))
    sizes = {'table_errors': {'positioning': 2 * ARCSEC, 'zeros': 3 * ARCSEC}}
    assumed = {'table_errors_assumed': ['zeros'], **sizes}
    read = replace(read, provenance={**read.provenance, **assumed})
    told = words(ET.fromstring(f'<p>{"".join(budget_parts(read, read.budget))}</p>'))
    for said in (
        'as the IMU description states it: gyros 0.1 deg/h, accelerometers 20 \u00b5g',
        'positioning errors, as stated: positioning 2 arcsec',
        'encoders of the table, assumed where marked: zeros 3 arcsec (assumed)',
    ):
        assert said in told


def test_a_certificate_has_the_words_of_the_gum_and_says_what_g_is(text):
    page = words(ET.fromstring(text.removeprefix('<!DOCTYPE html>\n')))
    assert not re.search(r'\b(std|dof|inf)\b', page)
    assert (
        page.count('g is the standard acceleration 9.80665 m/s\u00b2, \u00b5g is 10\u207b\u2076 g')
        == 1
    )
    assert 'standard uncertainty' in page and 'degrees of freedom' in page


def test_gravity_taken_as_exact_gives_no_certificate(calibration):
    exact = replace(calibration, provenance={**calibration.provenance, 'gravity_std': 0.0})
    with pytest.raises(InputError, match='a standard uncertainty of gravity'):
        made(exact)


def test_a_calibration_without_a_budget_has_no_certificate(calibration, tmp_path):
    with pytest.raises(InputError, match='no uncertainty budget'):
        made(replace(calibration, budget=None))
    parts = [
        replace(
            calibration,
            provenance={
                **calibration.provenance,
                'temperature': {'mean': c, 'lowest': c, 'highest': c},
            },
        )
        for c in (10.0, 40.0)
    ]
    combined = imu_calib.combine(parts, tmp_path / 'both.yaml')
    with pytest.raises(InputError, match='combines calibrations at several temperatures'):
        certificate(combined, EXAMPLE, tmp_path / 'c.html')
    with pytest.raises(InputError, match=r'ends in \.html, \.pdf, \.xml'):
        certificate(calibration, EXAMPLE, tmp_path / 'c.doc')


def pages_of(data: bytes) -> list[str]:
    """The texts of a PDF's pages."""
    pdfium = pytest.importorskip('pypdfium2')
    document = pdfium.PdfDocument(data)
    try:
        sizes = [tuple(round(v) for v in page.get_size()) for page in document]
        assert set(sizes) == {(595, 842)}
        return [page.get_textpage().get_text_range() for page in document]
    finally:
        document.close()


PRINTERS = [
    pytest.param(
        'weasyprint',
        marks=pytest.mark.skipif(not find_spec('weasyprint'), reason='WeasyPrint is not installed'),
    ),
    pytest.param(
        'chromium', marks=pytest.mark.skipif(CHROMIUM is None, reason='chromium is not installed')
    ),
]


@pytest.mark.parametrize('by', PRINTERS)
def test_every_printed_page_has_the_number_and_how_many_there_are(text, by, monkeypatch):
    if by == 'chromium':
        monkeypatch.setattr(printing, 'find_spec', lambda name: None)
    pages = pages_of(printing.pdf(text))
    assert 3 <= len(pages) <= 6
    for k, page in enumerate(pages):
        assert f'page {k + 1} of {len(pages)}' in page
        assert 'Calibration certificate 2026-0147' in page
        assert 'Example Inertial Calibration Laboratory' in page


@pytest.mark.parametrize('by', PRINTERS)
def test_budgets_of_all_sources_stay_on_their_paper(calibration, by, monkeypatch):
    if by == 'chromium':
        monkeypatch.setattr(printing, 'find_spec', lambda name: None)
    large = Share.known(np.diag(np.diag(calibration.covariance)))
    budget = calibration.budget
    for source in ErrorSource:
        budget = budget.with_share(source, large)
    table, gravity = yaml.safe_load(EXAMPLE.read_text())['equipment']
    timed = [table, gravity, {**table, 'name': 'Clock of the table'}]
    page = certificate_page(made(replace(calibration, budget=budget), equipment=timed))
    pdfium = pytest.importorskip('pypdfium2')
    document = pdfium.PdfDocument(printing.pdf(page))
    try:
        texts = [sheet.get_textpage() for sheet in document]
        assert all(s.heading in ''.join(t.get_text_range() for t in texts) for s in ErrorSource)
        boxes = [t.get_rect(k) for t in texts for k in range(t.count_rects())]
        # A4 less its right margin, mm in pt; the number of the page stands in the lower margin.
        right = [right for _, bottom, right, _ in boxes if bottom > 18 * 72 / 25.4]
        assert max(right) <= (210 - 16) * 72 / 25.4
        [t.close() for t in texts]
    finally:
        document.close()


def test_without_a_printer_it_says_what_to_do(monkeypatch):
    monkeypatch.setattr(printing, 'find_spec', lambda name: None)
    monkeypatch.setattr(printing.shutil, 'which', lambda name: None)
    with pytest.raises(InputError, match=r'needs WeasyPrint or Chromium.*\.\[pdf\]'):
        printing.pdf('<p>a</p>')


def test_no_text_ends_the_style_that_prints_it(calibration):
    nasty = '7"; } </style><b>\\'
    page = certificate_page(made(calibration, number=nasty))
    head, _, rest = page.partition('</style>')
    assert '<b>' not in head and '<b>\\' not in rest
    assert ET.fromstring(page.removeprefix('<!DOCTYPE html>\n')).tag == 'html'


@needs_chromium
def test_no_text_of_a_certificate_stands_on_another(browser, text, tmp_path):
    path = tmp_path / 'certificate.html'
    path.write_text(text, encoding='utf-8')
    with opened(browser, path) as shown:
        for size in (390, 820, 1400):
            look_at(shown, size)
            assert overlaps(shown) == []
            assert width(shown) <= size
            # No table is to be pushed aside to be read.
            assert shown.evaluate(
                """[...document.querySelectorAll('.wide')]
                   .every(one => one.scrollWidth <= one.clientWidth + 1)"""
            )


def validated(text: str) -> ET.Element:
    """Return a DCC, which PTB's schema finds valid."""
    etree = pytest.importorskip('lxml.etree')
    schema = etree.XMLSchema(etree.parse(str(SCHEMA), etree.XMLParser(no_network=True)))
    schema.assertValid(etree.fromstring(text.encode()))
    return ET.fromstring(text)


SPACES = {'dcc': DCC, 'si': SI}


def contents(element: ET.Element | None) -> str:
    assert element is not None
    return words(element)


def test_a_dcc_is_valid_and_says_the_same(example, calibration):
    root = validated(dcc(example))
    core = root.find('dcc:administrativeData/dcc:coreData', SPACES)
    assert core is not None
    stated = {child.tag.partition('}')[2]: words(child) for child in core}
    assert stated['uniqueIdentifier'] == '2026-0147' and stated['receiptDate'] == '2023-11-10'
    assert stated['beginPerformanceDate'] == stated['endPerformanceDate'] == '2023-11-14'
    reals = {r.findtext('si:label', '', SPACES): r for r in root.iter(f'{{{SI}}}real')}
    for k, parameter in enumerate(calibration.parameters):
        real, scale = reals[parameter.name], si_scale(digital(parameter).unit)
        assert real.findtext('si:unit', '', SPACES) == digital(parameter).unit
        value = float(real.findtext('si:value', '', SPACES)) * scale
        assert value == pytest.approx(calibration.values[k], rel=1e-9)
        expanded, factor = (
            float(real.findtext(f'si:expandedUnc/si:{n}', '', SPACES))
            for n in ('uncertainty', 'coverageFactor')
        )
        assert expanded * scale / factor == pytest.approx(calibration.std[k], rel=1e-5)
    (probability,) = {
        e.text for n, r in reals.items() if n for e in r.iter(f'{{{SI}}}coverageProbability')
    }
    assert probability == '0.95'


def test_a_dcc_carries_budget_conformity_and_the_calibration_itself(example, calibration):
    root = validated(dcc(example))
    (data,) = [e.text for e in root.iter(f'{{{DCC}}}dataBase64')]
    assert data is not None
    again = Calibration.from_yaml(base64.b64decode(data).decode(), 'dcc')
    np.testing.assert_array_equal(again.covariance, calibration.covariance)
    said = [e.text for e in root.iter(f'{{{DCC}}}conformity')]
    of_unit, of_parameters = said[0], said[1:]
    assert of_parameters == [r.conformity.value for r in example.results if r.conformity]
    assert of_unit == 'fail' and 'fail' in of_parameters
    (budget,) = [
        r
        for r in root.iter(f'{{{DCC}}}result')
        if contents(r.find('dcc:name', SPACES)) == 'Uncertainty budget'
    ]
    lists = budget.findall('dcc:data/dcc:list/dcc:list', SPACES)
    assert len(lists) == len(example.results)
    for one, result in zip(lists, example.results, strict=True):
        shares = [float(e.text or '') for e in one.iter(f'{{{SI}}}value')]
        k = calibration.parameters.index(result.parameter)
        scale = si_scale(digital(result.parameter).unit)
        # GUM 5.1.2: the squares of the contributions add up.
        assert np.sqrt(np.sum(np.square(shares))) * scale == pytest.approx(
            calibration.std[k], rel=1e-6
        )


def test_a_dcc_keeps_the_rules_of_ptb_beside_the_schema(calibration, example):
    root = validated(dcc(example))
    # A letter first, as PTB's Schematron wants it.
    releases = [e.text or '' for e in root.iter(f'{{{DCC}}}release')]
    assert len(releases) == 2 and all(re.fullmatch(r'v\d+\.\d+\.\d+', r) for r in releases)
    measured = [
        q for q in root.iter(f'{{{DCC}}}quantity') if q.get('refType') == 'basic_measuredValue'
    ]
    # They want one text in each language; the certificate has one.
    texts = [[c.get('lang') for c in e.findall('dcc:content', SPACES)] for e in root.iter()]
    assert {tuple(languages) for languages in texts if languages} == {('en',)}
    labels = [q.findtext('si:real/si:label', '', SPACES) for q in measured]
    assert labels == [r.parameter.name for r in example.results]


def test_degrees_of_freedom_are_stated_where_the_coverage_factor_depends_on_them(example):
    few, many = (replace(example.results[0], freedom=f) for f in (7.5, 2e8))
    told = ET.fromstring(dcc(replace(example, results=(few, many))))
    data = [
        m for m in told.iter(f'{{{DCC}}}metaData') if m.get('refType') == 'basic_degreesOfFreedom'
    ]
    assert [float(next(m.iter(f'{{{SI}}}value')).text or '') for m in data] == [7.5]
    shapes = [e.text for e in told.iter(f'{{{SI}}}distribution')]
    assert shapes.count('student-t') == 1


def stated(certificate: Certificate) -> dict[str, float]:
    """The expanded uncertainties by parameter, in units of D-SI."""
    return {r.parameter.name: r.expanded / digital(r.parameter).scale for r in certificate.results}


def test_dcc2json_reads_a_dcc_and_writes_it_again(example):
    toolkit = pytest.importorskip('dcc_json_toolkit')
    # PTB's schema, as it lies here: the tool would ask the network for it.
    schema = toolkit.DccSchema('3.1.2', no_cache=True, schema_url=str(SCHEMA))
    text = dcc(example)
    assert schema.validate_dcc(text) == []
    again = validated(schema.to_xml_string(schema.to_dict(text)))
    given = {
        r.findtext('si:label', '', SPACES): float(
            r.findtext('si:expandedUnc/si:uncertainty', '', SPACES)
        )
        for r in again.iter(f'{{{SI}}}real')
        if r.find('si:label', SPACES) is not None
    }
    assert given == pytest.approx(stated(example))


def test_pydcc_reads_a_dcc(example, tmp_path, monkeypatch):
    pytest.importorskip('signxml')
    # It loads no library of signatures with OpenSSL 3.0.10 and newer, and asks PTB for schemas.
    monkeypatch.setitem(sys.modules, 'certvalidator', MagicMock())
    module = pytest.importorskip('dcc.dcc')
    monkeypatch.setattr(module, 'DCCXMLValidator', MagicMock())
    path = tmp_path / 'c.xml'
    path.write_text(dcc(example), encoding='utf-8')
    read = module.DCC(str(path))
    assert read.is_loaded()
    assert (read.uid(), read.version(), read.mandatory_language()) == ('2026-0147', '3.1.2', 'en')
    assert f'{read.calibration_date():%Y-%m-%d}' == '2023-11-14'
    reals = [found['real'] for _, found in read.get_calibration_results('name', 'en')]
    given = {
        one['label']: float(one['expandedUnc']['uncertainty']) for one in reals if 'label' in one
    }
    assert given == pytest.approx(stated(example))


def si_scale(unit: str) -> float:
    """The SI value of a unit, by PTB's own reader of D-SI."""
    dsi = pytest.importorskip('dsi_unit')
    with warnings.catch_warnings():
        # It says of every text that \\per is deprecated.
        warnings.simplefilter('ignore')
        tree = dsi.DsiUnit(unit)
        assert tree.valid, unit
        return float(dsi.DsiUnit(BASES[unit]).get_scale_factor(tree))


BASES = {
    r'\one': r'\one',
    r'\ppm': r'\one',
    r'\arcminute': r'\radian',
    r'\degree\hour\tothe{-1}': r'\radian\second\tothe{-1}',
    r'\micro\metre\second\tothe{-2}': r'\metre\second\tothe{-2}',
    r'\degree\hour\tothe{-1}\metre\tothe{-1}\second\tothe{2}': r'\radian\metre\tothe{-1}\second',
    r'\degree\hour\tothe{-1}\metre\tothe{-2}\second\tothe{4}': (
        r'\radian\metre\tothe{-2}\second\tothe{3}'
    ),
    r'\metre\tothe{-1}\second\tothe{2}': r'\metre\tothe{-1}\second\tothe{2}',
    r'\metre\tothe{-2}\second\tothe{4}': r'\metre\tothe{-2}\second\tothe{4}',
    r'\milli\metre': r'\metre',
    r'\milli\second': r'\second',
}
"""Units of SI without factors, for each that is written."""


def test_units_are_those_of_d_si():
    dsi = pytest.importorskip('dsi_unit')
    for parameter in [*PARAMETERS, *(p for term in TERMS for p in term.parameters)]:
        unit = digital(parameter)
        # dsiUnits takes prefixes and hours behind \per twice, and calls units valid that its own
        # pattern refuses (findings).
        assert '\\per' not in unit.unit.replace('\\percent', '')
        assert re.match(dsi.dsi_re.DSI_UNIT_REGEX, unit.unit), parameter.name
        assert si_scale(unit.unit) == pytest.approx(unit.scale, rel=1e-12), parameter.name


def test_the_schema_finds_what_is_wrong(example):
    etree = pytest.importorskip('lxml.etree')
    text = dcc(example).replace('<dcc:receiptDate>2023-11-10', '<dcc:receiptDate>10.11.2023')
    with pytest.raises(etree.DocumentInvalid):
        validated(text)


def test_limits_of_another_type_are_refused(calibration, tmp_path):
    target = tmp_path / 'c.html'
    with pytest.raises(InputError, match=r'limits of type mems_counts, but .* of a fog_medium'):
        certificate(calibration, EXAMPLE, target, imu='mems_counts')
    assert not target.exists()


def test_a_draft_does_not_take_the_name_of_the_final_certificate(
    calibration, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    calibration.save('c.yaml')
    command = ['certificate', 'c.yaml', '--fields', str(EXAMPLE), '--imu', 'fog_medium']
    assert main(command) == 0
    final = Path('certificate.html').read_bytes()
    assert main([*command, '--draft']) == 0
    assert Path('certificate.html').read_bytes() == final
    assert b'DRAFT, not a certificate' in Path('certificate_draft.html').read_bytes()


def test_the_file_with_the_covariance_is_named_with_its_hash(calibration, tmp_path):
    source = tmp_path / 'unit_7.yaml'
    calibration.save(source)
    digest = sha256(source.read_bytes()).hexdigest()
    for given, name in ((source, 'unit_7.yaml'), (calibration, 'as saved')):
        certificate(given, EXAMPLE, tmp_path / 'c.html', imu='fog_medium')
        page = (tmp_path / 'c.html').read_text(encoding='utf-8')
        assert f'the file of the calibration ({name}, SHA-256 {digest})' in page


def test_the_files_of_imu_and_table_are_named_with_their_hashes(calibration):
    hashes = {'imu_sha256': '1a2b', 'table_sha256': '3c4d'}
    found = replace(calibration, provenance={**calibration.provenance, **hashes})
    page, xml = certificate_page(made(found)), words(validated(dcc(made(found))))
    for name, said in (
        ('table', 'three_axis (SHA-256 of its file 3c4d)'),
        ('IMU description', f'{calibration.imu.id} (SHA-256 of its file 1a2b)'),
    ):
        assert rows(page)[name] == [said]
        assert said in xml


def test_the_command_and_the_function_write_the_same(calibration, tmp_path):
    source, names = tmp_path / 'c.yaml', ('one.html', 'one.xml')
    calibration.save(source)
    targets = [str(tmp_path / n) for n in names]
    command = ['certificate', str(source), '--fields', str(EXAMPLE), '--imu', 'fog_medium']
    assert main([*command, '-o', *targets]) == 0
    again = [tmp_path / f'again{Path(n).suffix}' for n in names]
    found = imu_calib.certificate(source, EXAMPLE, again, imu='fog_medium')
    assert isinstance(found, Certificate) and isinstance(found.budget, Budget)
    for target, other in zip(targets, again, strict=True):
        assert Path(target).read_bytes() == other.read_bytes()
