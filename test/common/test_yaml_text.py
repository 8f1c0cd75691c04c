"""YAML that PyYAML cannot make values of is refused as text is, with a sentence."""

import pytest
import yaml

from imu_calib.common.config import Section, load
from imu_calib.common.errors import InputError
from imu_calib.recordings.metadata_yaml import custom_data_of, read_metadata
from imu_calib.reports.certificate_fields import read_fields

TENS = 'a: &a [x,x,x,x,x,x,x,x,x,x]\n' + ''.join(
    f'{below}: &{below} [{",".join([f"*{above}"] * 10)}]\n'
    for above, below in zip('abcdefgh', 'bcdefghi', strict=True)
)
BROKEN = {
    'digits': f'a: {"9" * 5000}',
    'hexadecimal digits': f'a: 0x{"f" * 5000}',
    'no digits': 'a: 0x_',
    'a tag': 'a: !!int x',
    'a tag of a date': 'a: !!timestamp 2026-02-30',
    'a tag of no date': 'a: !!timestamp x',
    'a tag of a flag': 'a: !!bool x',
    'an empty tag': "a: !!int ''",
    'depth': 'a: ' + '[' * 5000,
    'depth that libyaml takes': 'a: ' + '[' * 950 + ']' * 950,
    'a circle': 'a: &b [*b]',
    'a circle of mappings': '&b {a: *b}',
    'a thousand million values': TENS,
}


@pytest.mark.parametrize('text', BROKEN.values(), ids=BROKEN)
def test_what_has_no_value_is_refused_and_not_raised(text):
    with pytest.raises(InputError, match=r'my\.yaml: not YAML: (found|line 1)'):
        numbers = Section.parse(text, 'my.yaml')
        numbers.array('a', (1,))


def test_dates_are_texts_whether_or_not_there_is_such_a_day():
    document = load('{day: 2026-02-20, none: 2026-02-30, moment: 2026-01-31T12:00:00Z}')
    assert document == {'day': '2026-02-20', 'none': '2026-02-30', 'moment': '2026-01-31T12:00:00Z'}
    section = Section.parse('issued: 2026-02-30', 'my.yaml')
    with pytest.raises(InputError, match=r'my\.yaml: issued: found .* expected a date'):
        read_fields(section)


def test_aliases_that_end_are_read():
    assert load('a: &a [1, 2]\nb: *a\nc: {<<: &d {e: 1}}\nf: *d') == {
        'a': [1, 2],
        'b': [1, 2],
        'c': {'e': 1},
        'f': {'e': 1},
    }


@pytest.mark.parametrize('text', BROKEN.values(), ids=BROKEN)
def test_a_recording_is_read_without_such_metadata(text, tmp_path):
    (tmp_path / 'metadata.yaml').write_text(text)
    assert read_metadata(tmp_path).problem.startswith('metadata.yaml ')
    assert custom_data_of(text) == {}


def test_a_count_that_is_no_number_is_unknown(tmp_path):
    text = """
rosbag2_bagfile_information:
  relative_file_paths: [a.mcap]
  topics_with_message_count:
  - {topic_metadata: {name: /imu}, message_count: .inf}
"""
    (tmp_path / 'metadata.yaml').write_text(text)
    assert read_metadata(tmp_path).counts == {}


def test_one_document_is_read_and_no_more():
    with pytest.raises(yaml.YAMLError, match='single document'):
        load('--- a\n--- b')
