"""Draw the pictures of docs/report.md: a simulated session, its report, and what a browser shows.

Usage: python docs/report.py    (needs chromium, playwright and matplotlib)
"""

import io
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import sync_playwright

from imu_calib.api.simulate import serialised
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli.main import main as imu_calib
from imu_calib.common.files import named_file
from imu_calib.common.stream import Block, ImuBlock
from imu_calib.common.units import DEG
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.session.imu import load_imu
from imu_calib.session.metadata import describe
from imu_calib.session.plan import load_plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.stand import simulate

Image = NDArray[np.float32]
HERE = Path(__file__).parent
SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
LOOSE = (110.0, 111.0)
"""When the cable was loose, s from the start: in the middle of a turn."""


def session() -> Iterator[tuple[str, Block]]:
    """Twelve positions of the paper's unit; for one second the IMU is not heard."""
    truth = Calibration.load(named_file('truths', 'cao2022_table1'))
    stand = StandOptions(azimuth=40 * DEG, positioning_error=0.0, bias_instability=False)
    plan, table, imu = (
        load_plan('twelve_position'),
        load_table('three_axis'),
        load_imu('fog_medium'),
    )
    for topic, block in simulate(plan, table, imu, truth.model, SITE, stand, seed=3):
        if isinstance(block, ImuBlock):
            seconds = (block.stamp - stand.start_time) * 1e-9
            heard = (seconds < LOOSE[0]) | (seconds > LOOSE[1])
            block = replace(  # noqa: PLW2901
                block, stamp=block.stamp[heard], gyro=block.gyro[heard], accel=block.accel[heard]
            )
        yield topic, block


def record(folder: Path) -> None:
    """Write the session as a recording that says what it is."""
    data = describe('twelve_position', 'fog_medium', 'three_axis', SITE, 'A1001')
    with RecordingWriter(folder, data) as writer:
        for topic, block in session():
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)


def shown(html: str, width: int, *, dark: bool = False, height: int = 0) -> Image:
    """Return what a browser shows of a page; `height` px of it where that is stated."""
    names = ('chromium', 'chromium-browser', 'google-chrome')
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=next(filter(None, map(shutil.which, names))), args=['--no-sandbox']
        )
        page = browser.new_page(
            viewport={'width': width, 'height': height or 200},
            color_scheme='dark' if dark else 'light',
            device_scale_factor=1.5 if height else 1,
        )
        page.set_content(html)
        image = page.screenshot(full_page=not height)
        browser.close()
    return np.asarray(plt.imread(io.BytesIO(image)))


def main() -> None:
    """Simulate, calibrate, report; then the head of the report and its sections as pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder / 'session')
        made, report = str(folder / 'calibration.yaml'), folder / 'report.html'
        imu_calib(['calibrate', str(folder / 'session'), '-o', made])
        imu_calib(['report', made, str(folder / 'session'), '-o', str(report)])
        html = report.read_text(encoding='utf-8')
    plain = '<style>html, body { background: #fff; } body { box-shadow: none; margin: 0; }</style>'
    whole, html = html, html.replace('</head>', f'{plain}</head>')
    start = html.index('<h1>')
    sections = re.findall(r'<section.*?</section>', html, flags=re.DOTALL)
    by_title = {re.findall(r'<h2>(.*?)</h2>', section)[0]: section for section in sections}
    end = html.index(by_title['Terms'])
    course = by_title['Course of the session'] + by_title['Residuals']
    for name, body in {
        'report': html[start:end],
        'report_course': course,
        'report_noise': by_title['Noise'],
    }.items():
        plt.imsave(HERE / f'{name}.png', shown(f'{html[:start]}{body}</body></html>', 900))
    phones = [shown(whole, 390, dark=dark, height=800) for dark in (False, True)]
    plt.imsave(HERE / 'report_phone.png', np.hstack(phones))


if __name__ == '__main__':
    main()
