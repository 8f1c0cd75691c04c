"""Convert HTML to PDF, by WeasyPrint if installed, else by Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from ..common.errors import InputError

_BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'chrome')
_OLDEST = 131
"""First version of Chromium that prints the margin boxes of @page."""
_PATIENCE = 300.0
"""s: a page takes a second or two; a machine may be very busy."""


def pdf(html: str) -> bytes:
    """Print a page.

    Raises:
        InputError: No printing software is installed, or it failed; the text states the remedy.
    """
    by_weasyprint = _weasyprint()
    if by_weasyprint is not None:
        return by_weasyprint(html)
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise InputError(
            'A PDF needs WeasyPrint or Chromium, and neither is installed. Run '
            f"{sys.executable} -m pip install 'imu_calib[pdf]', or write the .html and print it "
            'from a browser.'
        )
    return _by_chromium(html, browser)


def _weasyprint() -> Callable[[str], bytes] | None:
    """Return a function that prints by WeasyPrint; None if it, or a system library, is missing."""
    if find_spec('weasyprint') is None:
        return None
    try:
        from weasyprint import HTML
    except OSError:
        return None
    return lambda html: bytes(HTML(string=html).write_pdf())


def _by_chromium(html: str, browser: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        page, target = folder / 'page.html', folder / 'page.pdf'
        page.write_text(html, encoding='utf-8')
        _run([browser, '--version'], oldest=True)
        _run(
            [
                browser,
                '--headless',
                # As root Chromium has no sandbox; the page has no script and loads nothing.
                *(['--no-sandbox'] if os.geteuid() == 0 else []),
                '--disable-gpu',
                '--no-first-run',
                '--disable-background-networking',
                f'--user-data-dir={folder / "profile"}',
                '--no-pdf-header-footer',
                f'--print-to-pdf={target}',
                page.as_uri(),
            ]
        )
        try:
            return target.read_bytes()
        except OSError as error:
            raise InputError(f'{browser} printed no PDF ({error.strerror}).') from None


def _run(command: list[str], *, oldest: bool = False) -> None:
    """Run a browser."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise InputError(f'{command[0]} printed no PDF ({error}).') from None
    found = re.search(r'(\d+)\.\d+', done.stdout)
    if oldest and found and int(found[1]) < _OLDEST:
        raise InputError(
            f'{command[0]} is version {found[1]}, which does not number pages; expected '
            f'{_OLDEST} or newer, or WeasyPrint (pip install weasyprint).'
        )
