"""The page on a catalogue: its size, and the time for a browser to open it.

    python benchmarks/fleet_page.py [--units 5000] [--sessions 6] [--runs 3]

The page is written from the simulated histories of `test/support/fleets.py`. Printed are its size,
the processor time to write it, and from headless Chromium, for the fastest run: wall time from
navigation to the page's load event, to the table of units, and to the last drawing; and processor
time of the thread that does it. Exit code 1: the table appears after more than 3 s.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / 'test' / 'support'))

import fleets

from imu_calib.fleet.page import page

MOST = 3.0
"""s until the table appears."""

_LOAD = "() => performance.getEntriesByType('navigation')[0].loadEventEnd / 1000"
_MARK = 'name => performance.getEntriesByName(name)[0].startTime / 1000'


def opened(path: Path) -> dict[str, float]:
    """Return the times to open a page in a new browser, s."""
    from playwright.sync_api import sync_playwright

    names = ('chromium', 'chromium-browser', 'google-chrome')
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, names))), args=['--no-sandbox']
        )
        window: Any = browser.new_page()
        session = window.context.new_cdp_session(window)
        session.send('Performance.enable')
        window.goto(path.as_uri())
        window.wait_for_selector('html[data-ready=drawn]', timeout=120_000)
        metrics = session.send('Performance.getMetrics')['metrics']
        found = {
            'load event': window.evaluate(_LOAD),
            'table of units': window.evaluate(_MARK, 'table'),
            'last drawing': window.evaluate(_MARK, 'drawn'),
            'processor': next(m['value'] for m in metrics if m['name'] == 'ThreadTime'),
        }
        browser.close()
    return found


def main(units: int, sessions: int, runs: int) -> int:
    """Write the page and open it; return the exit code."""
    fleet = fleets.fleet(fleets.invented(units, sessions))
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'fleet.html'
        begun = time.process_time()
        path.write_text(page(fleet), encoding='utf-8')
        print(f'{units} units, {len(fleet.recordings.key)} recordings')
        print(f'{path.stat().st_size / 1e6:8.1f} MB')
        print(f'{time.process_time() - begun:8.1f} s of processor to write it')
        found = min((opened(path) for _ in range(runs)), key=lambda one: one['table of units'])
    for words, seconds in found.items():
        print(f'{seconds:8.2f} s {words}')
    return int(found['table of units'] > MOST)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    for option, default in (('--units', 5000), ('--sessions', 6), ('--runs', 3)):
        parser.add_argument(option, type=int, default=default)
    given = parser.parse_args()
    sys.exit(main(given.units, given.sessions, given.runs))
