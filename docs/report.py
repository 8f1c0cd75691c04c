"""Draw the pictures of docs/report.md: a simulated session, its report, and what a browser shows.

Usage: python docs/report.py    (needs chromium and matplotlib)
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from imu_calib.api.simulating import serialised
from imu_calib.bags import RecordingWriter
from imu_calib.calibration import Calibration
from imu_calib.cli.main import main as imu_calib
from imu_calib.earth import Site, normal_gravity
from imu_calib.imu import load_imu
from imu_calib.metadata import describe
from imu_calib.plan import load_plan
from imu_calib.share import named_file
from imu_calib.simulation import StandOptions, simulate
from imu_calib.stream import Block, ImuBlock
from imu_calib.turntable import load_table
from imu_calib.units import DEG

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
    data = describe('twelve_position', 'fog_medium', 'three_axis', SITE)
    with RecordingWriter(folder, data) as writer:
        for topic, block in session():
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)


def picture(html: str, target: Path) -> None:
    """Write what a browser shows of a page, without the empty rest below it."""
    browser = shutil.which('chromium') or shutil.which('chromium-browser') or 'google-chrome'
    with tempfile.TemporaryDirectory() as folder:
        page, shot = Path(folder) / 'page.html', Path(folder) / 'shot.png'
        page.write_text(html, encoding='utf-8')
        subprocess.run(
            [
                browser,
                '--headless',
                '--no-sandbox',
                '--disable-gpu',
                '--disable-background-networking',
                '--host-resolver-rules=MAP * ~NOTFOUND',
                f'--user-data-dir={folder}/profile',
                '--hide-scrollbars',
                '--window-size=900,2000',
                f'--screenshot={shot}',
                page.as_uri(),
            ],
            check=True,
            capture_output=True,
        )
        image = plt.imread(shot)
    used = np.flatnonzero(np.any(image != image[-1, :1], axis=(1, 2)))
    plt.imsave(target, image[: used[-1] + 20])


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
    html = html.replace('</head>', f'{plain}</head>')
    start = html.index('<h1>')
    sections = re.findall(r'<section.*?</section>', html, flags=re.DOTALL)
    end = html.index(sections[2])
    picture(f'{html[:end]}</body></html>', HERE / 'report.png')
    picture(f'{html[:start]}{"".join(sections[2:4])}</body></html>', HERE / 'report_course.png')
    picture(f'{html[:start]}{sections[4]}</body></html>', HERE / 'report_noise.png')


if __name__ == '__main__':
    main()
