"""Print the JSON Schema of a file that you write, for your editor (docs/files)."""

from __future__ import annotations

import argparse

from ..common.files import share_folder
from .outcome import write_text


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add options and the function that runs the command."""
    schemas = sorted(p.stem for p in (share_folder() / 'config' / 'schemas').glob('*.json'))
    parser.add_argument('kind', choices=schemas, help='kind of file')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print a schema."""
    file = share_folder() / 'config' / 'schemas' / f'{arguments.kind}.json'
    write_text(file.read_text(encoding='utf-8'))
