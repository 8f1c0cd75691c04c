"""Messages of a running stand as its pages and terminals take them."""

from datetime import datetime
from types import SimpleNamespace

import pytest

from imu_calib.common.config import Section
from imu_calib.common.units import DEG
from imu_calib.estimation.setup import Setup
from imu_calib.live.rules import Phase
from imu_calib.model.earth import Site
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.session.units_file import read_units

FOG = load_imu('fog_medium')
SETUP = Setup(FOG, load_plan('twelve_position'), load_table('three_axis'), Site.at(0.6))
NOON = datetime(2026, 3, 1, 12, 0)


def stamp(seconds):
    return SimpleNamespace(sec=int(seconds), nanosec=round((seconds % 1) * 1e9))


def header(seconds):
    return SimpleNamespace(stamp=stamp(seconds))


def state(seconds, phase=Phase.DWELLING, **changed):
    given = {
        'header': header(seconds),
        'plan': 'twelve_position',
        'step': 3,
        'steps': 28,
        'position_id': '2',
        'phase': int(phase),
        'reason': '',
        'joint_names': ['outer', 'middle', 'inner'],
        'positions': [0.0, 90 * DEG, 0.0],
        'rates': [0.0, 0.0, 0.0],
        'turns_done': 0.0,
        'seconds_left': 600.0,
    }
    return SimpleNamespace(**{**given, **changed})


def progress(seconds, std, **changed):
    names = [parameter.name for parameter in SETUP.parameters]
    given = {
        'header': header(seconds),
        'plan': 'twelve_position',
        'step': 4,
        'steps': 28,
        'state': 1,
        'text': 'It goes on.',
        'parameter_names': names,
        'standard_deviations': [std] * len(names),
        'seconds_left': 600.0,
        'repeat_steps': [],
        'next_attitudes': [],
    }
    kinds = {'WAITING': 0, 'COLLECTING': 1, 'DETERMINED': 2, 'FINISHED': 3, 'FAILED': 4}
    return SimpleNamespace(**{**given, **kinds, **changed})


def calibration(status, text='All is well.', **values):
    names = [parameter.name for parameter in SETUP.parameters]
    kinds = {'VALID': 0, 'PROVISIONAL': 1, 'REFUSED': 2, 'INCOMPLETE': 3}
    numbers = {name.lower(): values.get(name, 0.0) for name in names}
    return SimpleNamespace(
        status=kinds[status],
        status_text=text,
        parameter_names=names,
        standard_deviations=[1e-6] * len(names),
        term_parameters=[],
        term_values=[],
        **kinds,
        **numbers,
    )


def diagnostics(source, level, text, **figures):
    values = [SimpleNamespace(key=key, value=value) for key, value in figures.items()]
    status = SimpleNamespace(name=source, level=bytes([level]), message=text, values=values)
    return SimpleNamespace(status=[status])


UNITS = """
units:
  - {serial_number: A1, imu: fog_medium, place: left}
  - {serial_number: <B>, imu: mems_counts}
  - {serial_number: C3, imu: fog_medium}
"""


@pytest.fixture(scope='module')
def mounted():
    return read_units(Section.parse(UNITS, 'units.yaml'))
