"""Names that people state are text in every page, certificate and header that is written."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import fleets
import pytest
import yaml
from loopback import CHECKOUT
from sessions import at_one_rate, calibrate, quick_plan, session, stand

from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.common.config import Section
from imu_calib.reports.certificate import certificate_of, certificate_page
from imu_calib.reports.certificate_fields import read_fields
from imu_calib.reports.dcc import DCC, dcc
from imu_calib.reports.page import Contents, page
from imu_calib.session.imu import load_imu

MARKUP = '<b id="injected">x</b>*/ int injected; /*'
KEPT = frozenset({'number', 'issued', 'received', 'valid_until', 'rule', 'country', 'from', 'to'})
"""Keys of a certificate whose texts have a form; the number names pages, too."""
PLAN = at_one_rate(quick_plan('six_position', 20.0))


class Injected(HTMLParser):
    """Elements that a name has made, and the texts of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.made: list[str] = []
        self.texts = ''
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: Iterable[tuple[str, str | None]]) -> None:
        if dict(attrs).get('id') == 'injected':
            self.made.append(tag)

    def handle_data(self, data: str) -> None:
        self.texts += data


def is_text(html: str, times: int) -> None:
    """Names stand in a page as often as stated at least, and have made no element."""
    found = Injected(html)
    assert found.made == []
    assert found.texts.count(MARKUP) >= times


def marked(value: Any, kept: frozenset[str] = frozenset()) -> Any:
    """Return a document with markup for every text, those of some keys excepted."""
    if isinstance(value, dict):
        return {k: v if k in kept else marked(v, kept) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(marked(v, kept) for v in value)
    return MARKUP if isinstance(value, str) else value


@pytest.fixture(scope='module')
def result():
    plan = replace(
        PLAN,
        name=MARKUP,
        positions=tuple(replace(p, id=f'{MARKUP}{p.id}') for p in PLAN.positions),
    )
    return calibrate(session(plan, stand(), 1), plan)


@pytest.fixture(scope='module')
def calibration(result):
    found = result.calibration
    kept = frozenset({'recorded', 'state', 'parameter', 'tests_of_terms', 'method', 'tables'})
    return replace(
        found,
        imu=replace(found.imu, id=MARKUP),
        serial_number=MARKUP,
        # Gravity taken as exact and a simulated table give no certificate.
        provenance={
            **marked(dict(found.provenance), kept),
            'gravity_std': 2e-5,
            'table_simulated': False,
        },
        findings=(MARKUP,),
    )


@pytest.fixture(scope='module')
def certificate(calibration):
    example = CHECKOUT / 'config' / 'certificates' / 'example.yaml'
    document = marked(yaml.safe_load(example.read_text()), KEPT)
    document |= {'location': 'laboratory'}
    document['conformity']['rule'] = 'guard_band'
    stated = read_fields(Section(document, 'my.yaml'))
    return certificate_of(calibration, stated, load_imu('fog_medium').specification, dcc=True)


def test_in_the_report(result, calibration):
    own = replace(result, calibration=calibration)
    others = {}
    for month in (2, 3):
        moved = calibration.values + month * calibration.std
        others[f'{MARKUP}{month}.yaml'] = replace(
            calibration,
            model=calibration.model.with_values(calibration.parameters, moved),
            provenance={
                **calibration.provenance,
                'recorded': f'2026-0{month}-03T08:00:00Z',
                'sha256': f'{MARKUP}{month}',
            },
        )
    is_text(page(Contents(calibration, MARKUP, load_imu('fog_medium'), own, others)), 20)


def test_in_the_certificate(certificate):
    is_text(certificate_page(certificate), 30)


def test_in_the_digital_certificate(certificate):
    root = ET.fromstring(dcc(certificate))
    assert {e.tag.partition('}')[0] for e in root.iter()} <= {
        f'{{{DCC}',
        '{https://ptb.de/si',
    }
    assert ' '.join(root.itertext()).count(MARKUP) >= 30


def test_in_the_c_header(calibration):
    source = ExportSource(calibration, Path('calibration.yaml'), 100.0, '/imu0')
    text = EXPORTS['c'](source).text
    assert 'x</b>' in text
    code = re.sub(r'/\*.*?\*/', '', text, flags=re.DOTALL)
    assert 'injected' not in code


def test_in_the_fleet_page():
    pytest.importorskip('bokeh')
    from imu_calib.fleet import page as fleet_page

    known = fleets.fleet(fleets.invented(20))
    rows = known.recordings
    names = {k: [MARKUP] * len(rows.key) for k in ('recording', 'stand', 'error')}
    shifts = tuple(replace(s, stand=MARKUP) for s in known.history.stands.shifts)
    stands = replace(known.history.stands, shifts=shifts)
    units = tuple(replace(u, serial=f'{MARKUP}{u.serial}') for u in known.history.units)
    history = replace(known.history, stands=stands, units=units)
    serials = [f'{MARKUP}{s}' if s else '' for s in rows.serial]
    recordings = replace(rows, **names, serial=serials)
    evil = replace(known, name=MARKUP, history=history, recordings=recordings)
    is_text(fleet_page.page(evil), 4)
