"""imu-calib calibrate: calibrate from a recording; write calibration.yaml, print 24 parameters."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..api.calibrate import calibrated
from ..api.compare import conformity
from ..api.streams import output_or_default, output_path, recording_path
from ..calibration.calibration import Calibration
from ..common.units import DEG, DEG_H, MICRO_G, PPM, significant
from ..model.earth import MEASURED, VAGUE
from ..reports.budget import budget_tables
from ..reports.provenance import noise_lines, summary
from ..reports.tables import change_note, change_table, parameter_tables
from ..session.plan import METHOD_NAMES
from . import options
from .calibrate_units import FOLDER, of_several, run_several
from .outcome import EXIT_CODES, Outcome, add_json_option, judged_outcome
from .terminal import OUTPUT, progress_bar, sentence_list

if TYPE_CHECKING:
    from ..calibration.results import Result

_FILE = 'calibration.yaml'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the subcommand."""
    options.add_bag(parser)
    options.add_session_options(parser)
    options.add_imus_option(parser)
    parser.add_argument(
        '--separate',
        action='store_true',
        help='calibrate each of several units by itself: by default the azimuth, the tilts and the '
        'errors of the table that they share are estimated once from all of them',
    )
    parser.add_argument(
        '-o',
        '--output',
        metavar='FILE|DIR',
        help=(
            f'default: {_FILE}; of several units a folder (default: {FOLDER}), in which each '
            'calibration is called by its serial number. A path that is given here is overwritten; '
            'the default is not, where it exists'
        ),
    )
    parser.add_argument(
        '--budget',
        action='store_true',
        help='show the sources of the uncertainty of each parameter',
    )
    parser.add_argument(
        '--specification',
        action='store_true',
        help="check the unit against the specification in the IMU's file: exit code 3 where a "
        'parameter is outside, its uncertainty considered',
    )
    add_json_option(parser)
    parser.epilog = f'{EXIT_CODES} Methods: {", ".join(sorted(METHOD_NAMES))}.'
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> Outcome:
    """Calibrate and print."""
    # Examined before it is read: a remote recording is fetched once for both.
    arguments.bag = recording_path(arguments.bag)
    if of_several(arguments):
        return run_several(arguments)
    path = output_path(output_or_default(arguments.output, _FILE))
    judged = arguments.specification
    result = calibrated(arguments.bag, options.stated(arguments), progress_bar, to_be_judged=judged)
    result.calibration.save(path)
    show(result)
    if arguments.budget:
        OUTPUT.print('\nUncertainty budget', style='bold')
        for part in budget_tables(result.calibration):
            OUTPUT.print(part, markup=False)
    found = conformity(result) if judged else None
    if found is not None:
        OUTPUT.print(f'\n{summary(found.assessed)}')
    OUTPUT.print(f'\nwritten to {path}')
    document = {
        **result.to_dict(),
        'specification': None if found is None else found.to_dict(),
        'file': str(path),
    }
    return judged_outcome(document, found)


def show(result: Result, truth: Calibration | None = None) -> None:
    """Print the 24 parameters and messages for the user."""
    session, solution, setup = result.session, result.solution, result.calibration.provenance
    clock = session.clock
    for part in parameter_tables(result.calibration, truth):
        OUTPUT.print(part)
    changes = change_table(result.calibration)
    if changes is not None:
        OUTPUT.print()
        OUTPUT.print(changes)
        OUTPUT.print(change_note(result.calibration), markup=False)
    without = '' if setup['plan'] else ' without a plan'
    OUTPUT.print(
        f'\n{setup["method"]}{without}: {setup["segments"]} static dwells, '
        f'{setup["turns"]} turns, {session.samples} samples in {session.duration:.0f} s'
    )
    for line in result.terms:
        OUTPUT.print(line, markup=False)
    if result.comparison is not None:
        OUTPUT.print(result.comparison.sentence(), markup=False)
    if solution.bias_drift is not None and solution.bias_drift.any():
        OUTPUT.print(
            f'the standard deviations include bias drift of '
            f'{significant(solution.bias_drift[0] / DEG_H)} deg/h and '
            f'{significant(solution.bias_drift[3] / MICRO_G)} ug '
            'over some 1000 s (by the data sheet and the session)'
        )
    OUTPUT.print(
        f'gravity {setup["gravity"]:.6f} m/s^2 ({_source(setup)}), {_gravity_std(setup)}; '
        f'latitude {_latitude(setup)}'
    )
    if session.temperature is not None:
        seen = session.temperature
        OUTPUT.print(
            f'temperature {seen.mean:.2f} degC, from {seen.lowest:.2f} to {seen.highest:.2f} degC'
        )
    if solution.azimuth_std < 10 * DEG:
        OUTPUT.print(
            f"the table's zero points {solution.azimuth / DEG:.1f} +- "
            f'{solution.azimuth_std / DEG:.1f} deg from north, counter-clockwise'
        )
    if clock.motions:
        OUTPUT.print(
            f'IMU clock against table: {clock.offset * 1e3:+.3f} +- {clock.offset_std * 1e3:.3f} '
            f'ms, {clock.rate * 1e6:+.2f} +- {clock.rate_std * 1e6:.2f} ppm '
            f'({clock.motions} motions)'
        )
    for line in noise_lines(result.calibration):
        OUTPUT.print(line, markup=False)
    sentence_list('Worth knowing', result.calibration.findings)


def _latitude(provenance: Mapping[str, Any]) -> str:
    """Return the latitude, or that it was not stated."""
    if provenance['latitude_std_deg'] > 0.99 * VAGUE / DEG:
        return 'not stated'
    return f'{provenance["latitude_deg"]:.3f} deg'


def _source(provenance: Mapping[str, Any]) -> str:
    """Return the source of gravity; with a measurement a height is not used."""
    source, height = str(provenance['gravity_source']), provenance['height']
    if source != MEASURED or height is None or provenance['height_assumed']:
        return source
    return f'{source}; the height of {height:g} m is not used'


def _gravity_std(provenance: Mapping[str, Any]) -> str:
    """Return the standard deviation of gravity, which limits that of every K_a."""
    doubt = provenance['gravity_std'] / provenance['gravity']
    if not doubt:
        return 'taken as exact'
    return f'known to {doubt / PPM:.3g} ppm, which the standard deviations of K_a include'
