"""Draw the picture of docs/fleet.md: the page on a catalogue that is made up, and one of its units.

Usage: python docs/fleet_page.py    (needs chromium, playwright, pyarrow, bokeh and matplotlib)
"""

import io
import shutil
import sys
import tempfile
from datetime import datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from playwright.sync_api import sync_playwright

import imu_calib

sys.path.insert(0, str(Path(__file__).parents[1] / 'test' / 'support'))
import fleets

HERE = Path(__file__).parent

UNIT = '#unit=mems_counts/A1007'
HEIGHT = 1500


def main() -> None:
    """Write the page of a laboratory's units; its head and a unit beside each other."""
    names = ('chromium', 'chromium-browser', 'google-chrome')
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        catalogue = fleets.write(Path(name) / 'laboratory', fleets.invented(300))
        on = datetime.fromisoformat(str(fleets.TODAY))
        path = imu_calib.fleet_report(catalogue, Path(name) / 'fleet.html', on=on)
        browser = driver.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, names))), args=['--no-sandbox']
        )
        images = []
        for place in ('', UNIT):
            page = browser.new_page(viewport={'width': 1000, 'height': HEIGHT})
            page.goto(path.as_uri() + place)
            page.wait_for_selector('html[data-ready=drawn]', timeout=120_000)
            images.append(np.asarray(plt.imread(io.BytesIO(page.screenshot(timeout=120_000)))))
        browser.close()
    plt.imsave(HERE / 'fleet_page.png', np.hstack(images))


if __name__ == '__main__':
    main()
