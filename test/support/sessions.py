"""Simulated sessions for the tests: the hardware-level simulation straight into the calibrator."""

import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from loopback import until

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result
from imu_calib.common.files import named_file
from imu_calib.common.processes import single_threaded
from imu_calib.common.stream import Block, JointBlock, SetpointBlock
from imu_calib.common.units import DEG
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site, normal_gravity
from imu_calib.recordings.cdr_codec import part
from imu_calib.segmentation.labelling import label
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import Plan, Position, RateTest, load_plan
from imu_calib.session.table import Table, load_table
from imu_calib.simulation.options import StandOptions
from imu_calib.simulation.repetition import Study, economical
from imu_calib.simulation.stand import simulate

LATITUDE = 34.65 * DEG
SITE = Site.at(LATITUDE, gravity=normal_gravity(LATITUDE), latitude_std=0.0)

Named = tuple[str, Block]
Change = Callable[[Iterable[Named]], Iterable[Named]]


@cache
def truth() -> Calibration:
    """The twelve-position column of Cao 2022's Table 1."""
    return Calibration.load(named_file('truths', 'cao2022_table1'))


def paper_imu() -> ImuSpec:
    """The unit of Cao 2022 without bias instability."""
    spec = load_imu('fog_medium')
    return replace(
        spec,
        gyro=replace(spec.gyro, bias_instability=0.0),
        accel=replace(spec.accel, bias_instability=0.0),
    )


def quick_plan(name: str, dwell: float) -> Plan:
    """A shipped plan with shorter dwells."""
    plan = load_plan(name)
    return replace(plan, positions=tuple(replace(p, dwell=dwell) for p in plan.positions))


def brief_plan(path: Path, dwell: float = 3.0) -> Path:
    """Write the twelve positions with short dwells and the fastest pair of rates to a file."""
    text = named_file('plans', 'twelve_position').read_text('utf-8')
    text = text.replace('[10 deg/s, -10 deg/s, 30 deg/s, -30 deg/s, ', '[')
    path.write_text(text.replace('dwell: 120 s', f'dwell: {dwell} s'), 'utf-8')
    return path


def at_one_rate(plan: Plan) -> Plan:
    """The plan with the last pair of its rates alone: the fastest, a third of the time or less."""

    def shorter(position: Position) -> Position:
        test = position.rate_test
        return position if test is None else replace(position, rate_test=last_pair(test))

    def last_pair(test: RateTest) -> RateTest:
        return replace(test, rates=test.rates[-2:])

    return replace(plan, positions=tuple(shorter(p) for p in plan.positions))


def in_parallel(function: Callable[[int], Any], seeds: Iterable[int]) -> list[Any]:
    """Run a module's function for every seed, on all cores; where other tests have these, on one.

    What other tests left running must not be forked: a copy of a thread's lock never opens.
    """
    if 'PYTEST_XDIST_WORKER' in os.environ:
        return [function(seed) for seed in seeds]
    with single_threaded(), ProcessPoolExecutor(os.cpu_count(), get_context('spawn')) as pool:
        return list(pool.map(function, seeds))


class Alone:
    """The live session of a unit that is alone on its table, as the node runs it."""

    def __init__(self, setup: Setup, folder: Path, said: dict[str, str], topics: Any) -> None:
        # Imported here: most tests need no live session.
        from imu_calib.live.nodes.session_parameters import StatedUnit
        from imu_calib.live.nodes.sessions import Sessions
        from imu_calib.recordings.writer import Journal

        journal = Journal(folder, said, {topic: kind for kind, topic in topics.items()})
        self.sessions = Sessions([StatedUnit(setup, '', '')], [topics], journal, {})

    def __getattr__(self, name: str) -> Any:
        return getattr(self.sessions.all[0], name)

    @property
    def may_review(self) -> bool:
        return self.sessions.may_review

    def poll(self) -> bool:
        return bool(self.sessions.poll())

    def close(self) -> None:
        self.sessions.close()


def ended(session: Any) -> Any:
    """Let a live session end, and return it closed."""
    session.end()
    assert until(lambda: session.is_over, step=lambda: session.poll() or time.sleep(0.01))
    session.close()
    return session


def beside_exactness(findings: Iterable[str]) -> list[str]:
    """What is said beside what rests on a table that is stated exact, as the shipped ones are."""
    return [f for f in findings if 'better than any real one' not in f]


def stand(**options: Any) -> StandOptions:
    """A stand whose table arrives exactly: what is left is the IMU's own."""
    return StandOptions(**{'positioning_error': 0.0, 'bias_instability': False, **options})


def session(
    plan: Plan | str = 'twelve_position',
    options: StandOptions | None = None,
    seed: int = 0,
    *,
    table: Table | None = None,
    site: Site = SITE,
    spec: ImuSpec | None = None,
) -> Iterator[Named]:
    """Run a stand."""
    plan = load_plan(plan) if isinstance(plan, str) else plan
    return simulate(
        plan,
        table or load_table('three_axis'),
        spec or paper_imu(),
        truth().model,
        site,
        options or stand(),
        seed,
    )


def calibrate(
    blocks: Iterable[Named],
    plan: Plan | str = 'twelve_position',
    *,
    table: Table | None = None,
    site: Site = SITE,
    spec: ImuSpec | None = None,
    imu_only: bool = False,
    method: str | None = None,
) -> Result:
    """Feed blocks to a calibrator and solve."""
    plan = load_plan(plan) if isinstance(plan, str) else plan
    table = None if imu_only else table or load_table('three_axis')
    setup = Setup(spec or paper_imu(), plan, table, site, method)
    if imu_only:
        blocks = (b for b in blocks if not isinstance(b[1], (JointBlock, SetpointBlock)))
    return fed(blocks, setup).finish()


def fed(blocks: Iterable[Named], setup: Setup) -> Calibrator:
    """Feed blocks to a calibrator."""
    calibrator = Calibrator(setup)
    for _, block in blocks:
        calibrator.add_block(block)
    return calibrator


def gathered(calibrator: Calibrator) -> Evidence:
    """What the segmentation has made of what was fed."""
    setup, found = calibrator._setup, calibrator._segmenter.finish()
    return calibrator._evidence(label(found, setup.plan, setup.table), found)


def recut(blocks: list[Named], seed: int) -> list[Named]:
    """Cut every topic anew at random, and interleave the topics at random."""
    rng = np.random.default_rng(seed)
    topics = {name: [b for n, b in blocks if n == name] for name, _ in blocks}
    queues = {n: [p for b in bs for p in cut(b, rng)] for n, bs in topics.items()}
    turns = rng.permutation([n for n, q in queues.items() for _ in q])
    sources = {n: iter(q) for n, q in queues.items()}
    return [(n, next(sources[n])) for n in turns]


def cut(block: Block, rng: np.random.Generator) -> list[Block]:
    edges = [0, *sorted(rng.integers(0, len(block) + 1, rng.integers(0, 3))), len(block)]
    return [part(block, a, b) for a, b in pairwise(edges) if b > a]


def simulated(
    plan: Plan,
    options: StandOptions | None = None,
    seed: int = 0,
    *,
    table: Table | None = None,
    spec: ImuSpec | None = None,
) -> Evidence:
    """What the segmentation makes of a session on the simulated stand."""
    table, spec = table or load_table('three_axis'), spec or paper_imu()
    options = economical(options or stand())
    blocks = session(plan, options, seed, table=table, spec=spec)
    return gathered(fed(blocks, Setup(spec, plan, table, SITE)))


def brisk(dwell: float) -> Plan:
    """Twelve positions with short dwells and turns at one rate."""
    plan = quick_plan('twelve_position', dwell)
    test = RateTest((60 * DEG, -60 * DEG), 1)
    positions = [replace(p, rate_test=test if p.rate_test else None) for p in plan.positions]
    return replace(plan, positions=tuple(positions))


def study(plan: str | None = None) -> Study:
    chosen = brisk(5.0) if plan is None else load_plan(plan)
    setup = Setup(paper_imu(), chosen, load_table('three_axis'), SITE, chosen.method)
    return Study(setup, truth().model, economical(stand()))
