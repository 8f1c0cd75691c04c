import math

import pytest

from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import named_file
from imu_calib.common.stream import Units
from imu_calib.common.units import Dimension, parse, typeset
from imu_calib.session.imu import load_imu, read_imu
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table


@pytest.mark.parametrize(
    ('text', 'dimension', 'value'),
    [
        ('7.8 arcsec/pulse', Dimension.ANGLE_PER_PULSE, 7.8 / 206264.806247),
        ('0.01 (m/s)/pulse', Dimension.VELOCITY_PER_PULSE, 0.01),
        ('0.05 deg/sqrt(h)', Dimension.ANGLE_RANDOM_WALK, 3 / 206264.806247),
        ('0.012 (m/s)/sqrt(h)', Dimension.VELOCITY_RANDOM_WALK, 0.0002),
        ('20 ug', Dimension.ACCELERATION, 1.96133e-4),
        ('15.041067 deg/h', Dimension.RATE, 7.292115e-5),
        ('2000 dps', Dimension.RATE, 34.9065850),
        ('8.75 mdps/count', Dimension.RATE_PER_COUNT, 1.527163095e-4),
        ('17.5 mdps/LSB', Dimension.RATE_PER_COUNT, 3.05432619e-4),
        ('17.5 mdeg/s/count', Dimension.RATE_PER_COUNT, 3.05432619e-4),
        ('0.0175 deg/s/LSB', Dimension.RATE_PER_COUNT, 3.05432619e-4),
        ('65.5 LSB/dps', Dimension.RATE_PER_COUNT, 2.66462480e-4),
        ('65.5 LSB/(\u00b0/s)', Dimension.RATE_PER_COUNT, 2.66462480e-4),
        ('16384 LSB/g', Dimension.ACCELERATION_PER_COUNT, 5.98550415e-4),
        ('0.061 mg/LSB', Dimension.ACCELERATION_PER_COUNT, 5.98205650e-4),
        ('9.8 m/s2', Dimension.ACCELERATION, 9.8),
        ('9.8 m/s\u00b2', Dimension.ACCELERATION, 9.8),
        ('5 mdps/sqrt(Hz)', Dimension.ANGLE_RANDOM_WALK, 8.726646e-5),
        ('-90 deg', Dimension.ANGLE, -math.pi / 2),
        ('2 min', Dimension.TIME, 120.0),
    ],
)
def test_quantities_become_si(text, dimension, value):
    assert parse(text, dimension, 'key') == pytest.approx(value, rel=1e-7)


@pytest.mark.parametrize('text', ['7.8', 7.8, '7.8 deg/h', 'fast', None, '1e999 arcsec/pulse'])
def test_what_is_no_quantity_of_the_kind_is_refused_with_key_and_units(text):
    with pytest.raises(InputError, match=r'gyro\.scale: found .*expected'):
        parse(text, Dimension.ANGLE_PER_PULSE, 'gyro.scale')


def test_no_counts_per_unit_are_refused():
    with pytest.raises(InputError, match=r"found '0 LSB/g', expected a finite number"):
        parse('0 LSB/g', Dimension.ACCELERATION_PER_COUNT, 'gyro.scale')


def test_pages_set_units_and_leave_names_alone():
    written = 'D_ax is 3 +- 1 ug, 2 ug/g^2; 0.1 deg/sqrt(h) at 20 degC, 9.8 m/s^2: 4 ug.'
    assert typeset(written) == ('D_ax is 3 ± 1 µg, 2 µg/g²; 0.1 deg/√h at 20 °C, 9.8 m/s²: 4 µg.')
    names = 'ug.yaml, my-ug, /data/ug/rec, debug, 2^10'
    assert typeset(names) == names


def test_a_key_that_stands_twice_is_refused():
    with pytest.raises(InputError, match='found the key range more than once'):
        Section.parse('gyro: {range: 1 deg/s, range: 2 deg/s}', 'my file')


def test_a_misspelt_key_is_named():
    text = 'id: a\nunits: si\nsample_frequency: 100 Hz\n'
    with pytest.raises(InputError, match=r"my\.yaml: unknown key 'sample_frequency'; known are"):
        read_imu(Section.parse(text, 'my.yaml'))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('units: si', r"the key 'id' is missing\.$"),
        ('id: a\nunit: si', "'units' is missing; is 'unit' a misspelling of it"),
        ('id: a\nunits: si\nsample_rat: 1 Hz', r"'sample_rat'; known .*\. Is 'sample_rate' meant"),
        ('id: a\nunits: si\ncolour: red', r"unknown key 'colour'; known are [^?]*\.$"),
        ('[1, 2', 'not YAML'),
        ('- 1', 'found a list, expected keys'),
    ],
)
def test_a_wrong_imu_file_is_refused_in_words(text, message):
    with pytest.raises(InputError, match=message):
        read_imu(Section.parse(text, 'my.yaml'))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (
            b'time,gx,gy\n0,1,2\n',
            "line 1 is 'time,gx,gy', expected 'key: value'. Give in its place the file of",
        ),
        (b'<!DOCTYPE html>\n<p a="b: c">', 'line 1 is of a web page.* Download the file itself'),
        (
            b'PK\x03\x04\x00',
            'found binary data, expected YAML text. Give in its place the file of an IMU',
        ),
        (
            b'\xff\xfei\x00',
            'found binary data, expected YAML text. Give in its place the file of an IMU',
        ),
        (
            b'id: a\nunits si\nb: c',
            "line 2 is 'units si', expected 'key: value'. Mend that line, or",
        ),
        (b'id: a\ngyro:\n\trange: 1', r"line 3 is '.trange: 1', expected blanks to indent a line"),
        (b'id: a\nb: [1,\n', r"line 2 is 'b: \[1,', expected a bracket that is closed"),
        (b'id: a: b', "line 1 is 'id: a: b', expected one 'key: value' in a line, with quotes"),
        (b'id: a\n b: c\n', "line 2 is ' b: c', expected "),
        (b'id: a\nb:\n  c: 1\n d: 2', "line 4 is ' d: 2', expected the indent of the lines above"),
        (b'id: "a\n', "line 1 is 'id: \"a', expected a quote that is closed"),
        (b'id: a\nid: b', 'found the key id more than once in line 2. Mend that line'),
    ],
)
def test_a_file_that_is_no_yaml_is_refused_with_its_line_and_what_to_do(text, message, tmp_path):
    (tmp_path / 'my.yaml').write_bytes(text)
    with pytest.raises(InputError, match=message) as refused:
        load_imu(tmp_path / 'my.yaml')
    assert 'unicode string' not in str(refused.value)


def test_every_shipped_file_reads():
    config = named_file('imus', 'si').parent.parent
    for path in (config / 'imus').glob('*.yaml'):
        assert load_imu(path).id == path.stem
    for path in (config / 'plans').glob('*.yaml'):
        assert load_plan(path).name == path.stem
    for path in (config / 'tables').glob('*.yaml'):
        assert load_table(path).name == path.stem


def test_the_medium_unit_is_that_of_the_paper():
    spec = load_imu('fog_medium')
    assert spec.units is Units.PULSES
    assert spec.gyro.scale_factor == pytest.approx(7.8 / 206264.806247)
    assert spec.accel.scale_factor == 0.01


def test_an_unknown_name_lists_the_shipped_ones(tmp_path):
    with pytest.raises(
        InputError, match=r"No plan is called 'twelve'; there are: .*twelve_position"
    ):
        load_plan('twelve')
    with pytest.raises(InputError, match='no such file'):
        load_plan(tmp_path / 'mine.yaml')
    with pytest.raises(InputError, match=r'~nobody-of-this-name/mine\.yaml: there is no such home'):
        load_plan('~nobody-of-this-name/mine.yaml')
