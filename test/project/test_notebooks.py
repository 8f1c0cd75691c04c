"""The notebooks of docs/notebooks: they run, and print what is committed."""

import importlib.util
import re
from contextlib import ExitStack
from decimal import Decimal
from pathlib import Path
from types import ModuleType
from typing import Any

import processes
import pytest
from installed import needs_modules
from loopback import CHECKOUT

needs_modules('nbclient')

FOLDER = Path(CHECKOUT, 'docs', 'notebooks')
NAMES = sorted(path.stem for path in FOLDER.glob('*.ipynb'))
NUMBER = re.compile(r'[-+]?\b\d+(?:\.\d+)?(?:e[-+]?\d+)?')
SHOWN = 2
"""Units of the last digit shown: other machines and libraries round otherwise, and no more."""


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location('run_notebooks', FOLDER / 'run.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RUN = script()


def differences(found: str, committed: str) -> list[str]:
    """Return where two texts differ by more than the last digit of a number."""
    words = [' '.join(NUMBER.sub('#', text).split()) for text in (found, committed)]
    if words[0] != words[1]:
        return [f'{words[0]!r} instead of {words[1]!r}']
    pairs = zip(NUMBER.findall(found), NUMBER.findall(committed), strict=True)
    return [
        f'{mine} instead of {theirs}'
        for mine, theirs in pairs
        if abs(Decimal(mine) - Decimal(theirs)) > SHOWN * _last_digit(theirs)
    ]


def _last_digit(number: str) -> Decimal:
    return Decimal(1).scaleb(Decimal(number).as_tuple().exponent)


def output_texts(cell: Any) -> list[str]:
    """Return what the outputs of a cell are, and say: pictures say nothing but that they are."""
    texts = []
    for output in cell.get('outputs', []):
        if output.output_type == 'stream':
            texts.append(f'{output.name}: {output.text}')
        else:
            data = output.get('data', {})
            texts.append(f'{sorted(data)}: {data.get("text/plain", "")}')
    return texts


@pytest.fixture(scope='module')
def kernel():
    with ExitStack() as started:
        with processes.kept():
            manager = started.enter_context(RUN.kernel())
        yield manager


@pytest.mark.parametrize('name', NAMES)
def test_a_notebook_runs_and_prints_what_is_committed(name, kernel):
    committed = RUN.read(name).cells
    for cell, before in zip(RUN.executed(name, kernel).cells, committed, strict=True):
        now, then = output_texts(cell), output_texts(before)
        assert not [text for text in now if text.startswith('stderr')], cell.source
        assert len(now) == len(then), f'{cell.source}\n{now}'
        for mine, theirs in zip(now, then, strict=True):
            assert not differences(mine, theirs), (
                f'{cell.source}\nRun docs/notebooks/run.py {name}, and look at what changed.'
            )


def test_only_the_last_digit_may_differ():
    table = 'K_gx  1.234  0.10 ppm\nroot mean square: 1.6e+02'
    assert not differences('K_gx 1.236  0.11  ppm\nroot mean square: 1.4e+02', table)
    assert differences(table.replace('1.234', '1.237'), table) == ['1.237 instead of 1.234']
    assert differences(table.replace('1.6e+02', '1.6e+03'), table)
    assert differences(table.replace('1.234', '-1.234'), table)
    assert differences(table.replace('ppm', 'deg/h'), table)
    assert differences(table.replace('1.234', 'NaN'), table)
    assert differences(f'{table} 3', table)


@pytest.mark.parametrize('name', NAMES)
def test_a_notebook_is_committed_as_it_was_run(name):
    notebook = RUN.read(name)
    assert notebook.nbformat == 4
    assert set(notebook.metadata) == {'kernelspec', 'language_info'}
    cells = [cell for cell in notebook.cells if cell.cell_type == 'code']
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert all(not cell.metadata for cell in notebook.cells)
    pictures = [out for cell in cells for out in cell.outputs if 'image/png' in out.get('data', {})]
    assert pictures
    text = (FOLDER / f'{name}.ipynb').read_text(encoding='utf-8')
    assert not re.search(r'/tmp/|/root/|/home/', text)
    assert len(text) < 150_000


@pytest.mark.parametrize('name', [*(f'{name}.ipynb' for name in NAMES), 'index.md'])
def test_links_of_notebooks_lead_somewhere(name):
    path = FOLDER / name
    cells = RUN.read(path.stem).cells if path.suffix == '.ipynb' else []
    text = '\n'.join(c.source for c in cells if c.cell_type == 'markdown') or path.read_text()
    links = re.findall(r'\]\(([^)]+)\)', text)
    assert links
    for link in links:
        assert (FOLDER / link.partition('#')[0]).is_file(), link


def test_each_notebook_is_in_the_index():
    index = (FOLDER / 'index.md').read_text(encoding='utf-8')
    assert NAMES
    assert all(f'({name}.ipynb)' in index for name in NAMES)
