"""The page of a stand at a high rate: whether viewers cause lost samples, and the cost.

    python benchmarks/web_page.py [RATE_HZ [VIEWERS [PLAN [SPEED]]]]

Runs a session twice as `benchmarks/stand.py` does, without a page and with viewers of it, each a
window of a headless Chromium without 3D, and compares. Samples are counted from the device's
counter to the calibrator's journal. Viewers end with the session; their browser's load is not
counted for a node.
"""

from __future__ import annotations

import shutil
import sys
import threading
import time

import stand

from imu_calib.cli import web_page as web_page_module
from imu_calib.cli.processes import free_port


class WithoutStaying(stand.Watched):
    """Processes whose page ends with the session."""

    def end_all_but(self, kept: object) -> None:  # noqa: ARG002
        """End all processes."""
        super().end_all_but(())


def look_on(port: int, viewers: int, over: threading.Event, seen: list[int]) -> None:
    """Open windows on the page until the session is over; record the number of changes."""
    from playwright.sync_api import Error, sync_playwright

    path = shutil.which('chromium') or shutil.which('google-chrome')
    # A machine without a graphics card would spend its processor on the picture of the table.
    options = ['--disable-3d-apis', '--no-sandbox']
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=options)
        pages = [browser.new_context().new_page() for _ in range(viewers)]
        for page in pages:
            while not over.is_set():
                try:
                    page.goto(f'http://127.0.0.1:{port}/', wait_until='domcontentloaded')
                    break
                except Error:
                    time.sleep(0.2)
        before = [''] * viewers
        while not over.is_set():
            for k, page in enumerate(pages):
                try:
                    text = page.inner_text('.banner', timeout=5000)
                except Error:
                    continue
                seen[k] += text != before[k]
                before[k] = text
            time.sleep(0.2)
        browser.close()


def main(rate: float, viewers: int, plan: str, speed: float) -> int:
    """Run both sessions; return the exit code."""
    print('without a page')
    alone = stand.run(rate, plan, speed)
    without = dict(stand.Watched.used)
    stand.Watched.used.clear()
    port, over, seen = free_port(), threading.Event(), [0] * viewers
    thread = threading.Thread(target=look_on, args=(port, viewers, over, seen))
    thread.start()
    print(f'\nwith {viewers} viewers')
    try:
        looked_at = stand.run(rate, plan, speed, '--web', str(port), processes_kind=WithoutStaying)
    finally:
        over.set()
        thread.join()
    print(f'the windows changed {", ".join(map(str, seen))} times')
    for name, used in stand.Watched.used.items():
        before = f'{without[name]:.1f} s' if name in without else '-'
        print(f'{name:16} {before:>8} of processor time without the page, {used:.1f} s with it')
    if web_page_module.NODE not in stand.Watched.used:
        print('No page was looked at: the session with it did not run.')
        return 1
    return alone or looked_at or int(not all(seen))


if __name__ == '__main__':
    given = sys.argv[1:]
    sys.exit(
        main(
            float(given[0]) if given else 4000.0,
            int(given[1]) if len(given) > 1 else 3,
            given[2] if len(given) > 2 else 'twelve_position',
            float(given[3]) if len(given) > 3 else 0.0,
        )
    )
