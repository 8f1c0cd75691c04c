"""Write docs/command_line.md: every option of every command, as the parser has it.

Usage: python docs/command_line.py
"""

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

from imu_calib.cli.dispatch import COMMANDS, build_parser
from imu_calib.cli.outcome import EXIT_CODES

PAGE = Path(__file__).with_suffix('.md')

HEAD = f"""# Command line

    imu-calib COMMAND ...
    imu-calib --version

{EXIT_CODES} An error is a sentence on
stderr; with `--json` it is in the document on stdout too ([output](files/output.md)).
A recording is never overwritten, nor is a text file where samples are written (`compensate -o
log.csv`): nobody can make raw data again. Any other file named with `-o` is; one that a command
names itself is not where it exists, but for the page of `fleet`, which is made anew.
`imu-calib COMMAND --help` prints the usual options, `--help-all` all of this text
(`python docs/command_line.py` writes this page).

| command | does |
|---|---|
"""


def page() -> str:
    """Return the page."""
    # Of what is private: argparse has no other way to its own options.
    (commands,) = (
        a.choices for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)
    )
    rows = ''.join(f'| [{name}](#{name}) | {words} |\n' for name, (_, words) in COMMANDS.items())
    return HEAD + rows + ''.join(_section(name, commands[name]) for name in COMMANDS)


def _section(name: str, parser: argparse.ArgumentParser) -> str:
    actions = [a for a in parser._actions if a.dest not in {'help', 'help_all'}]
    text = f'\n## {name}\n\n{_prose(parser.description)}\n'
    places = ''.join(f' {_place(a)}' for a in actions if not a.option_strings)
    text += f'\n    imu-calib {name}{places} [options]\n'
    text += '\n| argument | meaning |\n|---|---|\n'
    text += ''.join(_rows(actions))
    return text + (f'\n{_prose(parser.epilog)}\n' if parser.epilog else '')


def _rows(actions: list[argparse.Action]) -> Iterator[str]:
    for action in actions:
        names = ', '.join(action.option_strings) or _value(action)
        value = f' {_value(action)}' if action.option_strings and action.nargs != 0 else ''
        words = (action.help or '') % {**vars(action), 'prog': 'imu-calib'}
        yield f'| {_code(names + value)} | {_prose(words)} |\n'


def _place(action: argparse.Action) -> str:
    value = _value(action)
    return {'*': f'[{value} ...]', '+': f'{value} ...', '?': f'[{value}]'}.get(
        str(action.nargs), value
    )


def _value(action: argparse.Action) -> str:
    if isinstance(action.metavar, tuple):
        return ' '.join(action.metavar)
    if action.metavar:
        return action.metavar
    if action.choices is not None:
        return '{' + ','.join(map(str, action.choices)) + '}'
    return action.dest.upper() if action.option_strings else action.dest


def _code(text: str) -> str:
    return '`' + text.replace('|', r'\|') + '`'


def _prose(text: str | None) -> str:
    """Return words as Markdown: on one line, without what would be a mark."""
    return re.sub(r'([|*<])', r'\\\1', ' '.join((text or '').split()))


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
