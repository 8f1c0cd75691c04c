"""What a million recordings a year take, from the figures of benchmarks/fleet.py; writes a page.

    python benchmarks/fleet.py --json fleet.json
    python docs/fleet_scale.py fleet.json

Writes docs/fleet_scale.md.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

RECORDINGS = 1_000_000
MEGABYTES = 100.0
YEAR = 365.25 * 86400.0
BUSY = 0.5
"""Share of the time that workers are to work: recordings come by day, and a worker that works all
of the time has a queue that grows."""
FLUSH = 60.0
"""s between additions of a batch that goes on for long (fleet/running)."""

PAGE = """\
# A million recordings a year

Written by `python docs/fleet_scale.py` from figures of `python benchmarks/fleet.py`: {machine},
batches of {counts} recordings of {short:.1f} MB, and one recording of {long:.0f} MB.

| measured | |
|---|---|
| one recording of {short:.1f} MB by `calibrate` in a loop | {loop:.0f} ms of a processor |
| beside that, in a worker | {worker:+.1f} ms |
| beside that, in client and scheduler | {client:.1f} ms |
| one recording of {long:.0f} MB | {long_cpu:.1f} s of a processor |
| client and scheduler | {early:.0f} MB after {tenth} recordings, {late:.0f} MB after {count} |
| a worker | {of_worker:.0f} MB |
| a row of the catalogue | {row:.1f} kB on disk, {in_memory:.1f} kB in memory |
| a calibration file | {file:.1f} kB |

{ratios}

A million recordings of {size:.0f} MB a year are one every {every:.0f} s on average:

- **Workers**: {cpu:.1f} s of a processor each, the time of {long:.0f} MB in proportion, are
  {cores:.2f} cores of load. Workers at half load: **{workers}**.
- **Network**: {network:.1f} MB/s ({megabits:.0f} Mbit/s) averaged over the year. A working worker
  reads {reads:.0f} MB/s, each byte fetched once: {workers} of them at a time need
  {peak:.0f} MB/s.
- **Space of a worker**: a recording of a URL is kept in its folder for temporary files while it is
  calibrated: {size:.0f} MB. Memory: {of_worker:.0f} MB here, of the 2 GiB that are allowed.
- **Storage**: {terabytes:.0f} TB of recordings. The catalogue beside them is {rows:.1f} GB of rows
  and {files:.0f} GB of calibration files, a million of them.
- **Client and scheduler**: {busy:.3f} of a core. One pair could hand out {most:.0f} recordings/s,
  {times:,.0f} times as many.

The limits, in the order in which they are reached:

1. *Storage of the recordings*: a disk of 20 TB is full after {full:.0f} days.
2. *Memory of queries*: `imu-calib catalogue` and `Catalogue.table` load all rows, {whole:.1f} GB
   after a year. DuckDB, Polars and pandas read only the needed columns of `catalogue/rows`: use
   those, or keep a catalogue for each year or product.
3. *Parts of the catalogue*: a batch that runs forever adds one a minute, {parts:,.0f} a year, and
   each start of a batch reads the keys of all of them. Start it every few days, with the new
   recordings.
4. *Files*: a million calibrations are a million files, which most file systems store, but no file
   manager displays.
5. *Number of workers*: the scheduler has {times:,.0f} times the capacity.
"""


def page(figures: dict[str, Any]) -> str:
    """Return the page."""
    loop, last = figures['loop'], figures['batches'][-1]
    kept, long = figures['catalogue'], figures['long']
    rate = RECORDINGS / YEAR
    beside = last['worker'] - loop['cpu']
    cpu = long['cpu'] * MEGABYTES * 1e6 / long['bytes'] + max(beside, 0.0)
    workers = max(1, math.ceil(rate * cpu / BUSY))
    most = 1 / last['client']
    ratios = ' '.join(
        f'With {one["workers"]} worker{"s" * (one["workers"] > 1)} each does '
        f'{loop["wall"] / one["wall"]:.2f} of what the loop does by the clock, and '
        f'{loop["cpu"] / (one["worker"] + one["client"]):.2f} by the time of processors.'
        for one in figures['batches']
    )
    return PAGE.format(
        machine=figures['machine'],
        counts=' and '.join(str(one['recordings']) for one in figures['batches']),
        short=figures['bytes'] / 1e6,
        long=long['bytes'] / 1e6,
        loop=1e3 * loop['cpu'],
        worker=1e3 * beside,
        client=1e3 * last['client'],
        long_cpu=long['cpu'],
        early=last['early'],
        late=last['late'],
        tenth=last['recordings'] // 10,
        count=last['recordings'],
        of_worker=last['of_worker'],
        row=kept['rows'] / 1e3,
        in_memory=kept['in_memory'] / 1e3,
        file=kept['files'] / 1e3,
        ratios=ratios,
        size=MEGABYTES,
        every=1 / rate,
        cpu=cpu,
        cores=rate * cpu,
        workers=workers,
        network=rate * MEGABYTES,
        megabits=8 * rate * MEGABYTES,
        reads=MEGABYTES / cpu,
        peak=workers * MEGABYTES / cpu,
        terabytes=RECORDINGS * MEGABYTES / 1e6,
        rows=RECORDINGS * kept['rows'] / 1e9,
        files=RECORDINGS * kept['files'] / 1e9,
        busy=rate * last['client'],
        most=most,
        times=most / rate,
        full=20e12 / (rate * MEGABYTES * 1e6) / 86400,
        whole=RECORDINGS * kept['in_memory'] / 1e9,
        parts=YEAR / FLUSH,
    )


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('figures', type=Path, help='what benchmarks/fleet.py wrote with --json')
    chosen = parser.parse_args()
    text = page(json.loads(chosen.figures.read_text(encoding='utf-8')))
    Path(__file__).with_suffix('.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
