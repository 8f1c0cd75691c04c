"""`imu-calib stand`: the units on the table, one or several, from options to results."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from ..api.session import load_truth, usual_unit
from ..calibration.calibration import Calibration
from ..common.config import load
from ..common.errors import InputError
from ..common.files import named_file, read_text, user_path, write_whole
from ..common.finding import is_warning, warning, without_label
from ..common.units import significant
from ..live.devices.format import load_format
from ..live.devices.simulated import SCHEME
from ..live.devices.source import check_port
from ..model.parameters import engineering
from ..reports.assessment import assess, worst
from ..reports.plain_table import plain_table
from ..session.imu import load_imu
from ..session.plan import load_plan
from ..session.table import load_table
from ..session.units_file import PULSES, TRUTHS, MountedUnit, load_units, remaining
from .options import refuse_with_imus
from .terminal import OUTPUT, print_findings, print_whole

CALIBRATIONS = 'calibrations'  #: Folder of the results, SERIAL.yaml each.
_FILES = {'imu': 'imus', 'device': 'devices', 'truth': 'truths'}
"""Keys of a unit that name a file, with its kind."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add --without, which goes with --imus."""
    parser.add_argument(
        '--without',
        metavar='SERIAL,SERIAL',
        default='',
        help='with --imus: units of the file to exclude; also of a resumed session',
    )


def units_of(arguments: argparse.Namespace) -> tuple[MountedUnit, ...]:
    """Return the present units of --imus, or the only one, without a serial number."""
    if arguments.imus:
        return remaining(load_units(arguments.imus), arguments.without)
    port, device, baud = arguments.port or '', arguments.device, arguments.baud or 0
    return (MountedUnit('', arguments.imu, '', port=port, device=device, baud=baud),)


def node_of(unit: MountedUnit) -> str:
    """Return the name of a unit's node, with its namespace if there are several."""
    return f'{unit.name}/imu_node' if unit.serial_number else 'imu_node'


def is_real(arguments: argparse.Namespace) -> bool:
    """Return whether the hardware is real: an IMU has a port."""
    return any(unit.port for unit in units_of(arguments))


def is_embedded(arguments: argparse.Namespace) -> bool:
    """Return whether the nodes run in this process: nothing beside them needs ROS 2's wire.

    A real table that this command does not drive itself is led by setpoints on the wire.
    """
    if arguments.processes or arguments.network:
        return False
    by_hand = load_plan(arguments.plan).by_hand
    return not is_real(arguments) or by_hand or bool(arguments.table_port)


def check(arguments: argparse.Namespace) -> None:
    """Refuse options that do not apply to several units, or units that do not match each other."""
    if not arguments.imus:
        if arguments.without:
            raise InputError('--without is for several units; give --imus, too.')
        return
    refuse_with_imus(arguments, 'imu', 'serial', 'port', 'baud')
    if load_plan(arguments.plan).by_hand:
        raise InputError(f'--imus: plan {arguments.plan} is for one unit in the hand.')
    units = units_of(arguments)
    ported = [unit for unit in units if unit.port]
    if ported and len(ported) < len(units):
        simulated = next(unit.serial_number for unit in units if not unit.port)
        raise InputError(
            f'{arguments.imus}: unit {simulated} has no port, and {ported[0].serial_number} has: '
            'expected a port for each unit, or none of a simulated stand.'
        )
    for unit in ported:
        if not device_of(unit, arguments):
            raise InputError(
                f'{arguments.imus}: unit {unit.serial_number} has no device: expected the format '
                'of its frames (key device), or --device for all.'
            )
        load_format(device_of(unit, arguments))
        check_port(unit.port)


def device_of(unit: MountedUnit, arguments: argparse.Namespace) -> str:
    """Return the format of a unit's frames: its own, or the common one."""
    return unit.device or arguments.device or ''


def truths(arguments: argparse.Namespace) -> dict[str, Calibration]:
    """Return true parameters of simulated units, by serial number: empty of the only one."""
    return {unit.serial_number: _truth_of(unit, arguments) for unit in units_of(arguments)}


def _truth_of(unit: MountedUnit, arguments: argparse.Namespace) -> Calibration:
    """Return a unit's true parameters; its own with a serial number unless stated."""
    truth, imu = unit.truth or arguments.truth, load_imu(unit.imu)
    if unit.serial_number:
        return load_truth(truth, imu, unit.serial_number)
    return load_truth(truth, imu, arguments.serial or '', usual_truth(arguments))


def usual_truth(arguments: argparse.Namespace) -> str:
    """Return the name of the true parameters of a simulated unit without a serial number."""
    return usual_unit(load_plan(arguments.plan))[1]


def node_parameters(
    arguments: argparse.Namespace, clock: Mapping[str, Any], port: int
) -> dict[str, dict[str, Any]]:
    """Return the parameters of each unit's imu_node by its name with namespace."""
    nodes: dict[str, dict[str, Any]] = {}
    for place, unit in enumerate(units_of(arguments)):
        skewed = load_imu(unit.imu).skewed is not None
        simulated = 'simulated_skewed' if skewed else 'simulated'
        nodes[node_of(unit)] = {
            **clock,
            'imu': unit.imu,
            'device': device_of(unit, arguments) if unit.port else simulated,
            'sample_rate': arguments.sample_rate,
            'port': unit.port
            or (f'socket://127.0.0.1:{port + place}' if port else f'{SCHEME}{place}'),
            'baud': unit.baud,
            **({'frame_id': f'{unit.name}_imu_link'} if unit.serial_number else {}),
        }
    return nodes


def remappings(arguments: argparse.Namespace) -> dict[str, dict[str, str]]:
    """Return the topic remappings of each unit's imu_node, if not default."""
    return {
        node_of(unit): {PULSES: unit.named_topic}
        for unit in units_of(arguments)
        if unit.named_topic
    }


def save_settings(arguments: argparse.Namespace, settings: Path) -> None:
    """Copy the units' file and all files that it names into the settings of a session.

    The true parameters of simulated units are written, too: the nodes take them from there.
    """
    file = user_path(arguments.imus)
    units = {unit.name: unit for unit in load_units(file)}
    kept = load(read_text(file))
    folder = settings / 'units'
    folder.mkdir()
    for entry, (name, unit) in zip(kept['units'], units.items(), strict=True):
        for key, kind in _FILES.items():
            given = getattr(unit, key)
            if given:
                copy = folder / f'{name}_{key}.yaml'
                write_whole(copy, read_text(named_file(kind, given)))
                entry[key] = os.path.relpath(copy, settings)
        if not (unit.port or unit.truth or arguments.truth):
            copy = folder / f'{name}_truth.yaml'
            _truth_of(unit, arguments).save(copy)
            entry['truth'] = os.path.relpath(copy, settings)
    write_whole(settings / 'imus.yaml', yaml.safe_dump(kept, sort_keys=False))


def print_results(
    arguments: argparse.Namespace, folder: Path, true: Mapping[str, Calibration], text: str = ''
) -> list[str]:
    """Print a line for each unit; return the serial numbers of those without a result.

    These come first, with the reasons in `text`.
    """
    headings = ('unit', 'type', 'samples', 'least known', 'specification')
    rows = plain_table(headings, 'llrll', no_wrap=True)
    if true:
        rows.add_column('largest error/std', justify='right', no_wrap=True)
        (folder / TRUTHS).mkdir(exist_ok=True)
    missing: list[str] = []
    findings: dict[str, list[str]] = {}
    for unit in units_of(arguments):
        serial = unit.serial_number
        if serial in true:
            replace(true[serial], serial_number=serial).save(folder / TRUTHS / f'{serial}.yaml')
        file = folder / CALIBRATIONS / f'{serial}.yaml'
        if not file.is_file():
            missing.append(serial)
            continue
        found = Calibration.load(file)
        for finding in found.findings:
            findings.setdefault(finding, []).append(serial)
        verdict = worst(assess(found, load_imu(unit.imu).specification))
        cells = [serial, found.imu.id, str(found.provenance['samples']), _least(found)]
        cells.append('' if verdict is None else verdict.value)
        if serial in true:
            cells.append(f'{_largest_error(arguments, found, true[serial]):.2f}')
        rows.add_row(*cells)
    if missing:
        words = f'No calibration of {", ".join(missing)}. {text}'.strip()
        OUTPUT.print(words, style='red', markup=False)
    kept = [unit.serial_number for unit in units_of(arguments)]
    for unit in load_units(arguments.imus):
        if unit.serial_number not in kept:
            OUTPUT.print(f'{unit.serial_number}: excluded by --without', markup=False)
    print_whole(rows)
    # Missing data of the site or the table is reported for every unit alike.
    sentences = [_of_units(finding, of) for finding, of in findings.items()]
    print_findings(sentences, verbose=arguments.verbose)
    return missing


def _of_units(finding: str, units: Sequence[str]) -> str:
    """Return a finding with the units that it is on; a warning remains one."""
    text = f'{", ".join(units)}: {without_label(finding)}'
    return warning(text) if is_warning(finding) else text


def _least(found: Calibration) -> str:
    """Return the gyro bias with the largest standard deviation: the aim of a session on a table."""
    pairs = [(std, p) for p, std in zip(found.parameters, found.std, strict=True)]
    biases = [(std, p) for std, p in pairs if p.name.startswith('D_g') and std > 0]
    if not biases:
        return ''
    std, parameter = max(biases, key=lambda pair: pair[0])
    shown = engineering(parameter)
    return f'{parameter.name} \u00b1{significant(std / shown.scale, 3)} {shown.unit}'


def _largest_error(arguments: argparse.Namespace, found: Calibration, true: Calibration) -> float:
    if arguments.imperfections:
        # Loaded here: most of the command needs no forecast of a session.
        from ..api.stand import truth_in_session

        table = load_table(arguments.table)
        true, _ = truth_in_session(true, found, arguments.imperfections, table)
    error = found.values - true.model.values(found.parameters)
    known = found.std > 0
    return float(max(abs(error[known] / found.std[known]), default=0.0))


def complete(arguments: argparse.Namespace) -> None:
    """Set the type of a single unit, if none is stated."""
    if not arguments.imus and not arguments.imu:
        arguments.imu = usual_unit(load_plan(arguments.plan))[0]
