"""Execute the notebooks of this folder and keep what they print and draw.

    python docs/notebooks/run.py [NAME ...]

Needs nbclient, ipykernel, pandas and matplotlib (`pip install '.[test]'`).
"""

from __future__ import annotations

import argparse
import base64
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).resolve().parent
_CELL_SECONDS = 600
_COLOURS = 32
"""Of a picture: lines and letters need no more, and take a third of the space."""


def names() -> list[str]:
    """Return the notebooks that there are."""
    return sorted(path.stem for path in FOLDER.glob('*.ipynb'))


def read(name: str) -> NotebookNode:
    """Return a notebook as it is committed."""
    return nbformat.read(FOLDER / f'{name}.ipynb', as_version=4)


@contextmanager
def kernel() -> Iterator[KernelManager]:
    """A kernel for one notebook after the other: to start one takes longer than most cells."""
    with TemporaryDirectory() as folder:
        # Settings of the person's own do not count.
        environment = {**os.environ, 'IPYTHONDIR': folder, 'OMP_NUM_THREADS': '1'}
        manager = KernelManager(kernel_name='python3')
        manager.start_kernel(env=environment, cwd=folder)
        try:
            yield manager
        finally:
            manager.shutdown_kernel(now=True)


def executed(name: str, manager: KernelManager) -> NotebookNode:
    """Run a notebook in an empty folder, without a name that another one left; return it.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell raises.
    """
    notebook = read(name)
    with TemporaryDirectory() as work:
        begin = nbformat.v4.new_code_cell(f'import os\nos.chdir({work!r})\n%reset -f')
        notebook.cells.insert(0, begin)
        client = NotebookClient(
            notebook,
            km=manager,
            timeout=_CELL_SECONDS,
            startup_timeout=_CELL_SECONDS,
            # Time stamps do not count: what changes in a file is what its outputs say.
            record_timing=False,
            # What a busy machine prints in two goes is one text.
            coalesce_streams=True,
        )
        try:
            client.execute()
        finally:
            client.kc.stop_channels()
        notebook.cells.remove(begin)
    return cleared(notebook)


def cleared(notebook: NotebookNode) -> NotebookNode:
    """Return a notebook without what differs from run to run and from machine to machine."""
    notebook.metadata = nbformat.from_dict(
        {
            'kernelspec': {'display_name': 'Python 3', 'language': 'python', 'name': 'python3'},
            'language_info': {'name': 'python'},
        }
    )
    count = 0
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        if cell.cell_type == 'code':
            count += 1
            cell.execution_count = count
            for output in cell.outputs:
                if 'execution_count' in output:
                    output.execution_count = count
                if 'image/png' in output.get('data', {}):
                    output.data['image/png'] = _small(output.data['image/png'])
                    # What is drawn says nothing in words but its size.
                    output.data['text/plain'] = '<picture>'
    return notebook


def _small(picture: str) -> str:
    """Return a PNG, base64, in few colours."""
    image = Image.open(BytesIO(base64.b64decode(picture))).convert('RGB').quantize(_COLOURS)
    buffer = BytesIO()
    image.save(buffer, format='png', optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def main() -> None:
    """Execute and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('names', nargs='*', metavar='NAME', default=names())
    wanted = parser.parse_args().names
    with kernel() as manager:
        for name in wanted:
            nbformat.write(executed(name, manager), FOLDER / f'{name}.ipynb')
            print(f'{name}: executed')


if __name__ == '__main__':
    main()
