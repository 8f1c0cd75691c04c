"""The commands of a page print what it shows."""

import re

import pytest
from loopback import CHECKOUT

from imu_calib.cli.main import main

DOCS = CHECKOUT / 'docs'
FENCE = re.compile(r'^(```|~~~).*?^\1', re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r'(?:(?<=\n\n)|^)(?: {4}.*\n?)+')


@pytest.mark.parametrize(
    ('page', 'begins', 'ends_with'),
    [
        ('first_calibration', '## Look before you run', {'report': 3}),
        ('at_home', 'A simulated one:', {}),
    ],
)
def test_the_commands_of_a_page_print_what_it_shows(
    page, begins, ends_with, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f'{page}.md').read_text('utf-8').partition(begins)[2].partition('## Is it')[0]
    blocks = ''.join(INDENTED.findall(FENCE.sub('', text))).splitlines()
    lines = [line.strip() for line in blocks if line.strip() not in ('', '...')]
    commands = [line for line in lines if re.match('imu-calib [a-z_]+ ', line)]
    printed = []
    for command in commands:
        words = command.split()[1:]
        assert main(words) == ends_with.get(words[0], 0), command
        printed += ''.join(capsys.readouterr()).splitlines()
    said = {' '.join(line.split()) for line in printed}
    assert [
        line for line in lines if line not in commands and ' '.join(line.split()) not in said
    ] == []
    assert len(commands) > 1 and len(lines) > len(commands)
