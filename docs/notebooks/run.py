"""Execute the notebooks of this folder and keep what they print and draw.

    python docs/notebooks/run.py [NAME ...]

Needs nbclient, ipykernel, pandas and matplotlib (`pip install '.[test]'`).
"""

from __future__ import annotations

import argparse
import base64
import os
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
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


def executed(name: str) -> NotebookNode:
    """Run a notebook in a kernel of its own and an empty folder; return it with new outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell raises.
    """
    notebook = read(name)
    with TemporaryDirectory() as folder:
        # Settings of the person's own do not count, nor do time stamps: what changes in a file is
        # what its outputs say.
        environment = {**os.environ, 'IPYTHONDIR': f'{folder}/ipython', 'OMP_NUM_THREADS': '1'}
        work = Path(folder, 'work')
        work.mkdir()
        NotebookClient(
            notebook,
            timeout=_CELL_SECONDS,
            startup_timeout=_CELL_SECONDS,
            kernel_name='python3',
            record_timing=False,
            # What a busy machine prints in two goes is one text.
            coalesce_streams=True,
            resources={'metadata': {'path': str(work)}},
        ).execute(env=environment)
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
    for name in parser.parse_args().names:
        nbformat.write(executed(name), FOLDER / f'{name}.ipynb')
        print(f'{name}: executed')


if __name__ == '__main__':
    main()
