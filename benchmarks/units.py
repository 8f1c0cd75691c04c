"""Several units on one table: shared unknowns estimated once, compared with separate solutions.

Sessions of eight units are simulated by plain arrays that share no code with the package
(test/support/units_world.py): twelve attitudes, turns about three axes, a tilted base, and
positioning errors of the joints. Each unit is solved separately, then the first 2, 4 and 8
together. For shared unknowns and for parameters the root-mean-square error and
the mean stated deviation are compared with those of the separate solutions, and the processor time
of both. The consistency of errors and deviations requires more draws: further sessions of four
units.

    python benchmarks/units.py [--seeds 10] [--further 40] [--write]

`--write` writes docs/units_study.md. Exit code 1: the tilts' deviations are above 1.1 / sqrt(N) of
those of one unit, errors and deviations are inconsistent (chi-square, one in 10^4; parameters: by
Student's t over sessions), or a valid unit was excluded.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2, ttest_1samp

CHECKOUT = Path(__file__).parent.parent
sys.path.insert(0, str(CHECKOUT / 'test' / 'support'))

import units_world as world  # noqa: E402
from units_sessions import PULSE, TURNED, WALK, solved, tilt, truth  # noqa: E402

from imu_calib.calibration.calibrator import estimate_together  # noqa: E402
from imu_calib.calibration.results import Result  # noqa: E402
from imu_calib.common.budget import Budget  # noqa: E402
from imu_calib.estimation.session_model import Nuisance  # noqa: E402

PAGE = CHECKOUT / 'docs' / 'units_study.md'
SIZES = (1, 2, 4, 8)
FURTHER = (1, 2, 4)
GRADES = {
    'navigation grade': (WALK, PULSE),
    'medium grade': (
        (np.deg2rad(0.05) / 60, 0.012 / 60),
        (np.deg2rad(7.8 / 3600), 0.01),
    ),
}
TILTS = (Nuisance.TILT_X, Nuisance.TILT_Y)
GROUPS = ('K_g', 'E_g', 'D_g', 'K_a', 'E_a', 'D_a')
SLICES = [slice(a, b) for a, b in pairwise([0, 3, 9, 12, 15, 21, 24])]
MARGIN = 1.1
CHANCE = 1e-4


@dataclass
class Figures:
    """Errors and deviations of sessions with a given number of units on the table.

    Those of parameters are by session, (units, 24) each: errors of units in one session are
    correlated by their common errors, only sessions are independent.
    """

    tilt_errors: list[float] = field(default_factory=list)
    tilt_std: list[float] = field(default_factory=list)
    azimuth_std: list[float] = field(default_factory=list)
    stop_std: list[float] = field(default_factory=list)
    errors: list[Any] = field(default_factory=list)
    std: list[Any] = field(default_factory=list)
    freedom: list[Any] = field(default_factory=list)
    seconds: float = 0.0
    left_out: int = 0


def session(seed: int, grade: str, figures: dict[int, Figures]) -> None:
    """Simulate a session, and solve it with each number of units in `figures`."""
    table, rng = world.turned(seed), np.random.default_rng([seed, 11])
    units, alone, of_all = [], [], max(figures)
    for k in range(of_all):
        unit = world.drawn(rng, *GRADES[grade], TURNED if k % 2 else np.eye(3))
        counts = world.sampled(table, unit, rng)
        begun = time.process_time()
        alone.append(solved(table, unit, counts))
        figures[1].seconds += (time.process_time() - begun) / of_all
        units.append(unit)
    _of_units(figures[1], alone, units)
    for result in alone:
        found = result.solution.search.estimate
        for which, true in zip(TILTS, tilt(table), strict=True):
            value, std = found.nuisance(which)
            figures[1].tilt_errors.append((value - true) / std)
            figures[1].tilt_std.append(std)
        figures[1].azimuth_std.append(found.nuisance(Nuisance.AZIMUTH)[1])
    for size in list(figures)[1:]:
        here, begun = figures[size], time.process_time()
        shared = estimate_together(alone[:size], [str(k) for k in range(size)])
        here.seconds += time.process_time() - begun
        here.left_out += len(shared.left_out)
        _of_units(here, shared.results, units[:size])
        if shared.table is not None:
            seen = shared.table
            here.tilt_errors += ((seen.values[1:3] - tilt(table)) / seen.std[1:3]).tolist()
            here.tilt_std += seen.std[1:3].tolist()
            here.azimuth_std.append(float(seen.std[0]))
            here.stop_std.append(float(np.sqrt((seen.std[3:] ** 2).mean())))


def _of_units(
    figures: Figures, results: Sequence[Result | None], units: Sequence[world.Sensors]
) -> None:
    found = [result.calibration for result in results if result is not None]
    true = np.array([truth(unit) for unit in units])
    figures.errors.append(np.array([one.values for one in found]) - true)
    figures.std.append(np.array([one.std for one in found]))
    shares = [result.solution.shares for result in results if result is not None]
    figures.freedom.append(
        np.array([Budget.from_shares(one).freedom[: true.shape[1]] for one in shares])
    )


def rms(values: Any) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def groups(values: Any) -> list[float]:
    """Return the root mean squares of K, E and D of gyros, then of accelerometers."""
    return [rms(values[..., mine]) for mine in SLICES]


def with_errors(normal: Any) -> list[tuple[float, float]]:
    """Return the root mean squares of each group with their standard errors.

    Args:
        normal: (sessions, units, 24) errors in stated deviations. The standard error is that of the
            mean square over sessions, which are independent.
    """
    found = []
    for mine in SLICES:
        squares = np.square(normal[..., mine]).mean(axis=(1, 2))
        root = float(np.sqrt(squares.mean()))
        found.append((root, float(squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * root))))
    return found


def of_parameters(figures: dict[int, Figures], size: int) -> tuple[Any, Any, Any, Any]:
    """Return errors and deviations with `size` units, then of the same units solved separately."""
    here, one = figures[size], figures[1]
    alone = (np.array(values)[:, :size] for values in (one.errors, one.std))
    return (np.array(here.errors), np.array(here.std), *alone)


def table_of(figures: dict[int, Figures]) -> list[str]:
    """Return the figures of a grade as a table in Markdown."""
    rows = [
        '| units | tilt, std | its sqrt(N) over one unit | tilt, rms of error / std '
        '| azimuth, std | stops, std | join, CPU |',
        '|---|---|---|---|---|---|---|',
    ]
    one = figures[1]
    for size in SIZES:
        here = figures[size]
        ratio = rms(here.tilt_std) / rms(one.tilt_std) * np.sqrt(size)
        stops = f'{rms(here.stop_std) / world.ARCSEC:.2f} arcsec' if here.stop_std else ''
        seconds = '' if size == 1 else f'{here.seconds / len(here.azimuth_std):.2f} s'
        rows.append(
            f'| {size} | {rms(here.tilt_std) / world.ARCSEC:.4f} arcsec | {ratio:.3f} | '
            f'{rms(here.tilt_errors):.2f} | {np.rad2deg(rms(here.azimuth_std)):.3f} deg | '
            f'{stops} | {seconds} |'
        )
    rows += ['', f'| units | | {" | ".join(GROUPS)} |', f'|---|---|{"---|" * len(GROUPS)}']
    for size in SIZES[1:]:
        errors, std, errors_alone, std_alone = of_parameters(figures, size)
        achieved = np.divide(groups(errors), groups(errors_alone))
        stated = np.divide(groups(std), groups(std_alone))
        for name, values in (
            ('std over that by itself', stated),
            ('rms error over that by itself', achieved),
        ):
            rows.append(f'| {size} | {name} | {" | ".join(f"{v:.3f}" for v in values)} |')
    return rows


def honesty_of(figures: dict[int, Figures]) -> list[str]:
    """Return the consistency of errors and deviations as a table in Markdown."""
    rows = [
        f'| units | rms of error / std | {" | ".join(GROUPS)} |',
        f'|---|---|{"---|" * len(GROUPS)}',
    ]
    for size in list(figures)[1:]:
        errors, std, errors_alone, std_alone = of_parameters(figures, size)
        for name, normal in (
            ('together', errors / std),
            ('the same by themselves', errors_alone / std_alone),
        ):
            words = (f'{root:.3f} +- {error:.3f}' for root, error in with_errors(normal))
            rows.append(f'| {size} | {name} | {" | ".join(words)} |')
    return rows


def failures(grade: str, figures: dict[int, Figures]) -> list[str]:
    """Return sentences on figures outside their bounds."""
    found = []
    for size in SIZES[1:]:
        here = figures[size]
        ratio = rms(here.tilt_std) / rms(figures[1].tilt_std) * np.sqrt(size)
        if ratio > MARGIN:
            found.append(f'{grade}, {size} units: tilts {ratio:.2f} / sqrt(N) of one unit')
        square = float(np.square(here.tilt_errors).sum())
        if chi2.sf(square, len(here.tilt_errors)) < CHANCE:
            found.append(f'{grade}, {size} units: tilts err by more than they state')
        if here.left_out:
            found.append(f'{grade}, {size} units: {here.left_out} sound units were left out')
    return found


def dishonest(grade: str, figures: dict[int, Figures]) -> list[str]:
    """Return parameters whose errors exceed the stated deviations, by the scatter over sessions."""
    found = []
    for size, here in figures.items():
        freedom = np.array(here.freedom)
        # The variance of Student's t.
        expected = 1 / (1 - 2 / freedom)
        more = np.square(np.array(here.errors) / np.array(here.std)) - expected
        for name, mine in zip(GROUPS, SLICES, strict=True):
            by_session = more[..., mine].mean(axis=(1, 2))
            if ttest_1samp(by_session, 0.0, alternative='greater').pvalue < CHANCE:
                found.append(f'{grade}, {size} units: {name} errs by more than it states')
    return found


HEAD = """# Several units on one table, in figures

`python benchmarks/units.py --write` writes this page: {seeds} simulated sessions of eight units
of each grade, every second one turned by 90 deg on the fixture, by a simulation that shares no
code with the package. The table is tilted by 5 arcsec (one standard deviation about either
axis), and its joints have positioning errors of 3 arcsec, as its description states. Each unit is
solved by itself; then the first two, four and eight together
([several_units.md](several_units.md),
[mathematics](mathematics.md#27-several-units-on-one-table)).
"""

FURTHER_HEAD = """
Errors over stated standard deviations, of {further} further sessions of four units, as the
root mean square with the standard error by the scatter from session to session:
"""

FOOT = """
Beside each ratio of errors to standard deviations is that of the same units by themselves. Both use
the same noise, so a chance deviation from one appears in both. The two grades use the same random
numbers, and are not independent. Each channel's noise is estimated from the blocks of its dwells,
some forty degrees of freedom, and by Student's t the ratio is expected to be 1.02 to 1.03 if that
noise limits ([mathematics](mathematics.md#16-uncertainty-budget)).
The encoder of this table has no error while it turns. The standard deviation of its rate, estimated
from its angles, makes the ratio for scale factors of gyros of medium grade smaller.

Only the sensors determine the tilts: with N units their standard deviations fall by the root of N.
Those of positioning errors fall until a change of frame remains: an error common to all stops of a
joint, which no unit can separate from its own alignment. The units' own parameters improve if the
table limits them: scale factors of the gyros, and the effect of positioning errors on
misalignments. Parameters limited by sensor noise or by the frame do not improve. `join, CPU` is the
time of the joint solution in addition to the separate solutions, which took {alone:.1f} s of
processor time each.
"""


def main() -> int:
    """Run, print, and write the page on request."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--further', type=int, default=40)
    parser.add_argument('--write', action='store_true')
    arguments = parser.parse_args()
    text, wrong, seconds = [HEAD.format(seeds=arguments.seeds)], [], 0.0
    for grade in GRADES:
        figures = {size: Figures() for size in SIZES}
        for seed in range(arguments.seeds):
            session(seed, grade, figures)
        text += ['', f'## Units of {grade}', '', *table_of(figures)]
        wrong += failures(grade, figures)
        further = {size: Figures() for size in FURTHER}
        for seed in range(arguments.seeds, arguments.seeds + arguments.further):
            session(seed, grade, further)
        text += [FURTHER_HEAD.format(further=arguments.further), *honesty_of(further)]
        wrong += dishonest(grade, further)
        seconds += figures[1].seconds / arguments.seeds / len(GRADES)
    text.append(FOOT.format(alone=seconds))
    page = '\n'.join(text).replace('\n\n\n', '\n\n')
    print(page)
    if arguments.write:
        PAGE.write_text(page, encoding='utf-8')
    for sentence in wrong:
        print(sentence, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
