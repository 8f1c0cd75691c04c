"""Take the pictures of docs/web.md: the page of a simulated stand, on a desk and on a phone.

Usage: python docs/stand_page.py    (needs chromium and playwright, and the extras dds and web)
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Error, sync_playwright

HERE = Path(__file__).parent
SPEED = 8
"""Times real time: the session takes some five minutes."""
PATIENCE = 900_000
"""ms that the session may take to its later part, on a machine that is busy."""
DONE = 70
"""Per cent of the plan from which most parameters are known."""
STOP = 300
"""s that the nodes may take to end."""
ADDRESS = re.compile(r'page: (http://\S+)')
_DRAWN = "document.querySelector('.table-picture canvas') !== null"
_LATE = f"parseFloat(document.querySelector('.banner .foot').innerText.split(/\\s/).pop()) > {DONE}"


def picture(browser: Browser, url: str, name: str, **window: Any) -> None:
    """Look at the page in a window and take what it shows, once most parameters are known."""
    page = browser.new_context(**window).new_page()
    while True:
        try:
            page.goto(url, timeout=PATIENCE)
            break
        except Error:
            # The address is printed before the page is served.
            time.sleep(0.5)
    page.wait_for_function(_LATE, timeout=PATIENCE)
    page.wait_for_function(_DRAWN, timeout=PATIENCE)
    page.screenshot(path=HERE / name, timeout=PATIENCE)
    page.close()


def main() -> None:
    """Run a session, look at it twice, end it."""
    names = ('chromium', 'chromium-browser', 'google-chrome')
    words = ['twelve_position', '--web', '0', '--control', '--speed', str(SPEED)]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        stand = subprocess.Popen(
            [sys.executable, '-m', 'imu_calib.cli.main', 'stand', *words, '-o', f'{folder}/stand'],
            env={'ROS_DOMAIN_ID': '91', **os.environ, 'PYTHONUNBUFFERED': '1'},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert stand.stdout is not None
            url = next(found[1] for found in map(ADDRESS.match, stand.stdout) if found)
            browser = driver.chromium.launch(
                executable_path=next(filter(None, map(shutil.which, names))),
                # WebGL without a graphics card.
                args=['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'],
            )
            desk, phone = {'width': 1280, 'height': 1250}, {'width': 390, 'height': 844}
            picture(browser, url, 'stand_page.png', viewport=desk)
            picture(browser, url, 'stand_page_phone.png', viewport=phone, color_scheme='dark')
            browser.close()
        finally:
            stand.terminate()
            stand.wait(STOP)


if __name__ == '__main__':
    main()
