"""Values that no user means, from files and on the command line: one sentence, no traceback."""

import sys

import pytest
from extent import again
from loopback import CHECKOUT, completed

import imu_calib
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError
from imu_calib.fleet.catalogue import Catalogue

LONG = 200_000
"""Characters; the csv module takes fields of 131 072."""
SI = {'stamp': 't:s', 'gyro': 'a,b,c:rad/s', 'accel': 'd,e,f:m/s^2'}


def rows(count: int = 200) -> list[str]:
    still = [
        't,a,b,c,d,e,f,g',
        *(f'{k / 100},0.001,0.002,0.003,0.1,0.2,9.8,0' for k in range(count)),
    ]
    still[5] = still[5].replace('0.002', '0.0021')
    return still


def test_a_long_field_of_a_text_file_costs_its_row(tmp_path):
    table = rows()
    table[100] = f'"{"x" * LONG}"' + table[100]
    (tmp_path / 'a.csv').write_text('\n'.join(table))
    converted = imu_calib.convert(tmp_path / 'a.csv', tmp_path / 'bag', **SI)
    assert sum(converted.counts.values()) == len(table) - 2
    (tmp_path / 'b.csv').write_text('\n'.join(f'"{"x" * LONG}"' for _ in range(3)))
    with pytest.raises(InputError, match=r'b\.csv: no row of numbers found'):
        imu_calib.convert(tmp_path / 'b.csv', tmp_path / 'other', **SI)


def test_a_long_field_of_a_manifest_is_named(tmp_path):
    pytest.importorskip('distributed')
    (tmp_path / 'm.csv').write_text(f'recording,serial\nbag,"{"x" * LONG}"')
    with pytest.raises(InputError, match=r'm\.csv: not a table of recordings \(field larger'):
        imu_calib.batch(tmp_path / 'm.csv', tmp_path / 'c')


@pytest.mark.parametrize(
    'url', ['zip://a.zip', 'github://owner/name', 'reference://a', 'dir://a', 'jupyter://a']
)
def test_a_protocol_that_fails_is_no_traceback(url):
    pytest.importorskip('fsspec')
    with pytest.raises(InputError, match=f'{url}: cannot be opened'):
        imu_calib.calibrate(url)


@pytest.mark.parametrize('size', ['-1GiB', '1e400GiB', '0', '1MiB', 'much'])
def test_a_size_of_memory_that_no_worker_can_have_is_refused(size, tmp_path):
    pytest.importorskip('distributed')
    (tmp_path / 'm.csv').write_text('recording\nbag')
    with pytest.raises(InputError, match=r'`memory`: found .* expected a size of 256 MiB or more'):
        imu_calib.batch(tmp_path / 'm.csv', tmp_path / 'c', memory=size)


@pytest.mark.parametrize('word', ['--latitude=--', '--plan=--', '-p--'])
def test_two_dashes_are_no_value(word, capsys):
    assert main(['calibrate', 'bag', word]) == 2
    option = word.removesuffix('--').rstrip('=')
    assert (
        f"imu-calib calibrate: {option}: found '--', expected a value." in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ('words', 'place'),
    [
        ('calibrate|', ''),
        ('calibrate|bag|--table|', '--table: '),
        ('calibrate|bag|--terms=', '--terms: '),
        ('compensate|bag|--calibration|c.yaml|-o|', '-o: '),
    ],
)
def test_an_empty_word_is_neither_the_present_folder_nor_a_default(words, place, capsys):
    assert main(words.split('|')) == 2
    assert f": {place}found '', expected a value" in capsys.readouterr().err


def test_an_unknown_option_is_said_of_its_command(capsys):
    assert main(['calibrate', 'bag', '--lattitude', '3']) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert said == (
        'imu-calib calibrate: unrecognized arguments: --lattitude 3; imu-calib calibrate --help '
        'lists all.'
    )


def test_several_files_of_a_session_are_to_be_joined(tmp_path, capsys):
    files = [tmp_path / f'{k}.csv' for k in range(3)]
    for file in files:
        file.write_text('')
    assert main(['calibrate', *map(str, files)]) == 2
    said = ' '.join(capsys.readouterr().err.split())
    assert 'found 3 files, expected one recording. Join the text files of a session' in said


def test_a_catalogue_is_not_written_into_a_recording(tmp_path):
    pytest.importorskip('pyarrow')
    (tmp_path / 'metadata.yaml').write_text('')
    with pytest.raises(InputError, match='is a recording, expected a folder for the catalogue'):
        Catalogue(tmp_path, create=True)
    assert [path.name for path in tmp_path.iterdir()] == ['metadata.yaml']


@pytest.mark.parametrize('size', ['1e300', again('1e160'), '1.7e308'])
def test_a_huge_sample_is_left_out_without_a_word_of_numpy(size, tmp_path):
    table = rows(6000)
    table[3000] = table[3000].replace('0.001', size)
    table[4000] = table[4000].replace('0.1,', f'-{size},')
    (tmp_path / 'a.csv').write_text('\n'.join(table))
    command = [sys.executable, '-m', 'imu_calib.cli.main', 'convert', 'a.csv', '-o', 'bag']
    words = [part for key, value in SI.items() for part in (f'--{key}', value)]
    made = completed([*command, *words], cwd=tmp_path)
    assert made.returncode == 0
    assert 'Warning' not in made.stderr
    calibration = CHECKOUT / 'config' / 'truths' / 'mems_counts.yaml'
    si = calibration.read_text().replace('units: counts', 'units: si').replace('mems_counts', 'si')
    (tmp_path / 'c.yaml').write_text(si)
    for words in (
        ['calibrate', 'bag', '--plan', 'six_position_by_hand', '--imu', 'si', '--latitude', '48'],
        ['compensate', 'bag', '--calibration', 'c.yaml', '-o', 'out'],
        ['info', 'bag'],
    ):
        ended = completed([*command[:3], *words], cwd=tmp_path)
        assert 'Warning' not in ended.stderr
        assert 'Traceback' not in ended.stderr
