"""imu-calib plans: the plans that ship, what each is for, and how long it takes."""

from __future__ import annotations

import argparse

from rich.table import Table as Rows

from ..errors import InputError
from ..plan import Plan, Step, load_plan
from ..share import share_folder
from ..stream import Mode
from ..turntable import TURN, Table, load_table
from ..units import DEG
from .terminal import OUTPUT


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = commands.add_parser('plans', help='list plans, or lay one out', description=__doc__)
    parser.add_argument(
        'plan', nargs='?', metavar='NAME|FILE', help='lay this plan out, step by step'
    )
    parser.add_argument(
        '--table', default='three_axis', metavar='NAME|FILE', help='default: %(default)s'
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Print the list, or the steps of one plan."""
    table = load_table(arguments.table)
    if arguments.plan is None:
        _list_plans(table)
    else:
        _lay_out(load_plan(arguments.plan), table)


def _list_plans(table: Table) -> None:
    rows = Rows(box=None, pad_edge=False, header_style='bold')
    for heading in ('plan', 'positions', 'turns', 'time, min', 'method', 'what it is'):
        rows.add_column(
            heading, justify='right' if heading in {'positions', 'turns', 'time, min'} else 'left'
        )
    for path in sorted((share_folder() / 'config' / 'plans').glob('*.yaml')):
        plan = load_plan(path)
        turns = sum(len(p.rate_test.rates) or 1 for p in plan.positions if p.rate_test)
        rows.add_row(
            plan.name,
            str(len(plan.positions)),
            str(turns),
            _minutes(plan, table),
            plan.method,
            f'{plan.title} ({plan.source})',
        )
    OUTPUT.print(rows)


def _minutes(plan: Plan, table: Table) -> str:
    if plan.by_hand:
        return 'by hand'
    try:
        return f'{duration(plan.steps(table), table) / 60:.1f}'
    except InputError:
        return 'not on this table'


def _lay_out(plan: Plan, table: Table) -> None:
    OUTPUT.print(f'{plan.title} ({plan.source})\n')
    if plan.by_hand:
        for position in plan.positions:
            turned = ', one turn by hand before' if position.rate_test else ''
            OUTPUT.print(f'  {position.id}: hold {position.dwell:g} s{turned}')
        return
    steps = plan.steps(table)
    rows = Rows(box=None, pad_edge=False, header_style='bold')
    for heading in ('step', 'position', 'does'):
        rows.add_column(heading)
    for name in table.names:
        rows.add_column(f'{name}, deg', justify='right')
    for heading in ('rate, deg/s', 'turns', 'dwell, s'):
        rows.add_column(heading, justify='right')
    for step in steps:
        turning = step.mode is Mode.RATE
        rate = next((r for r in step.rates if r), 0.0)
        rows.add_row(
            str(step.index),
            step.position,
            'turn' if turning else 'stand',
            *(f'{a / DEG:.1f}' for a in step.angles),
            f'{rate / DEG:+.1f}' if turning else '',
            str(step.turns) if turning else '',
            f'{step.dwell:g}' if step.dwell else '',
        )
    OUTPUT.print(rows)
    OUTPUT.print(f'\n{duration(steps, table) / 60:.1f} min on table {table.name}, without settling')


def duration(steps: tuple[Step, ...], table: Table) -> float:
    """Return the time that a plan takes, s: dwells, turns and moves at the joints' limits."""
    total = 0.0
    angles = steps[0].angles
    for step in steps:
        moves = [
            _move_time(abs(a - b), j.max_rate, j.max_acceleration)
            for a, b, j in zip(step.angles, angles, table.joints, strict=True)
        ]
        total += max(moves) + step.dwell
        angles = step.angles.copy()
        if step.mode is Mode.RATE:
            joint = next(k for k, r in enumerate(step.rates) if r)
            rate = abs(float(step.rates[joint]))
            travel = TURN * (step.turns + 1)
            total += _move_time(travel, rate, table.joints[joint].max_acceleration)
            angles[joint] += travel if step.rates[joint] > 0 else -travel
    return total


def _move_time(travel: float, rate: float, acceleration: float) -> float:
    if travel < rate**2 / acceleration:
        return float(2 * (travel / acceleration) ** 0.5)
    return float(travel / rate + rate / acceleration)
