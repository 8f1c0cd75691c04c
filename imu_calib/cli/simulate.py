"""imu-calib simulate: write a recording that a real stand, or a hand, could have written."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..bags import RecordingWriter
from ..cdr import Kind, Messages, encode_imu, encode_joints, encode_setpoints, encode_temperatures
from ..earth import LUOYANG
from ..errors import InputError
from ..imu import load_imu
from ..methods import check_plan
from ..plan import Plan, load_plan
from ..session import describe
from ..simulation import SimulatedStand, StandOptions, load_imperfections
from ..simulation.hand import as_planned
from ..simulation.stand import IMU_TOPIC
from ..stream import Block, ImuBlock, JointBlock, SetpointBlock, SkewBlock, Stamps
from ..turntable import Table, load_table
from ..units import DEG
from . import options
from .terminal import OUTPUT, progress_bar

_TABLE = 'three_axis'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    parser.add_argument('plan', metavar='PLAN', help='name of a plan, or a file')
    parser.add_argument('-o', '--output', required=True, metavar='DIR', help='folder to create')
    parser.add_argument(
        '--imu', default='fog_medium', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.add_argument(
        '--table',
        metavar='NAME|FILE',
        help=f'default: {_TABLE}; none where the plan is run by hand',
    )
    parser.add_argument(
        '--truth',
        default='cao2022_table1',
        metavar='NAME|FILE',
        help="the unit's true parameters, as a calibration file (default: %(default)s)",
    )
    parser.add_argument(
        '--azimuth',
        type=float,
        metavar='DEG',
        help="true heading of the table's zero against north, about up (default: 0)",
    )
    parser.add_argument(
        '--bias-instability', action='store_true', help="let the biases wander by the IMU's figure"
    )
    options.add_imperfections_option(parser)
    parser.add_argument('--seed', type=int, default=0, help='same seed, same bits (default: 0)')
    parser.add_argument(
        '--compression', choices=('', 'lz4', 'zstd'), default='', help='of the recording'
    )
    options.add_serial_option(parser)
    options.add_site_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Simulate and write."""
    site = options.site_at(arguments, LUOYANG)
    imu = load_imu(arguments.imu)
    truth = options.load_truth(arguments.truth, imu)
    plan = load_plan(arguments.plan)
    check_plan(plan.method, plan, site)
    named = None if plan.by_hand else arguments.table or _TABLE
    blocks: Iterator[tuple[str, Block]]
    table = None if named is None else load_table(named)
    imperfect = _options(table, arguments)
    if table is None:
        _refuse_table(plan, arguments)
        held = as_planned(plan, np.random.default_rng([arguments.seed, 1]))
        read = held.blocks(imu, truth.model, site, imperfect, arguments.seed)
        duration, blocks = held.duration, ((IMU_TOPIC, block) for block in read)
    else:
        stand = SimulatedStand(plan, table, imu, truth.model, site, imperfect, arguments.seed)
        duration, blocks = stand.duration, stand.blocks()
    data = describe(arguments.plan, arguments.imu, named, site, arguments.serial or '')
    target = Path(arguments.output)
    with (
        RecordingWriter(target, data, arguments.compression) as writer,
        progress_bar('simulating') as show,
    ):
        start = None
        for topic, block in blocks:
            kind, messages, stamp = serialised(block)
            writer.write(f'/{topic}', kind.type_name, messages, stamp)
            start = int(stamp[0]) if start is None else start
            show(int(stamp[-1]) - start, round(duration * 1e9))
    truth.save(target / 'truth.yaml')
    written = f'the true parameters to {target / "truth.yaml"}'
    if table is not None and imperfect.true is not None:
        imperfect.true.save(target / options.TRUE_TABLE, table)
        written += f', the true table to {target / options.TRUE_TABLE}'
    OUTPUT.print(f'{duration:.0f} s of plan {plan.name} written to {target}, {written}')


def _options(table: Table | None, arguments: argparse.Namespace) -> StandOptions:
    """Return the options of the simulated stand, or of the unit that is held by hand."""
    stated = StandOptions(
        azimuth=(arguments.azimuth or 0.0) * DEG,
        # A uniform error of this half width has the standard deviation that the table states.
        positioning_error=0.0 if table is None else math.sqrt(3) * table.positioning,
        bias_instability=arguments.bias_instability,
    )
    if arguments.imperfections is None:
        return stated
    return load_imperfections(arguments.imperfections, stated, table, arguments.seed)


def _refuse_table(plan: Plan, arguments: argparse.Namespace) -> None:
    """Refuse options of a table for a plan that is run without one.

    Raises:
        InputError: Names the option.

    """
    for name in ('table', 'azimuth'):
        found = getattr(arguments, name)
        if found is not None:
            raise InputError(
                f'--{name}: found {found}, expected none: plan {plan.name} is run by hand, '
                'without a table.'
            )


def serialised(block: Block) -> tuple[Kind, Messages, Stamps]:
    """Serialise a block: what it is, its messages, and when each was recorded."""
    if isinstance(block, ImuBlock):
        return Kind.IMU, encode_imu(block), block.stamp
    if isinstance(block, SkewBlock):
        return Kind.SKEW, encode_imu(block.as_imu()), block.stamp
    if isinstance(block, JointBlock):
        return Kind.JOINTS, encode_joints(block), block.stamp
    if isinstance(block, SetpointBlock):
        stamps = np.array([s.stamp for s in block.setpoints], dtype=np.int64)
        return Kind.SETPOINTS, encode_setpoints(block), stamps
    return Kind.TEMPERATURES, encode_temperatures(block), block.stamp
