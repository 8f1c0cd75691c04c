"""Write docs/unit_or_stand.md and its picture: how small a shift of a stand is found and named.

Usage: python docs/unit_or_stand.py
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import beta, norm

from imu_calib.common.units import ARCMIN, PPM
from imu_calib.fleet.results import USUAL, StandShift
from imu_calib.fleet.stands import PATTERNS, judge_stands

PICTURE = Path(__file__).with_suffix('.png')
STANDS = ('A', 'B', 'C')
SESSIONS = 4
UNITS = (10, 30, 100)
RATIOS = (0.25, 0.5, 1.0, 2.0)
RUNS, QUIET, CLOSER = 60, 200, 150
"""Laboratories: of a cell of the first table, of its last row, of a cell of the second."""
SCATTER = {'K': 5 * PPM, 'E': 0.01 * ARCMIN}
"""Between sessions of a unit: of a scale factor, of a misalignment."""
CASES = ('K_a', 'E_gxy', 'E about Z')
MORE = (4, 5, 6, 8)
"""Sessions of each unit, in the second table."""
WAYS = ('home', 'lot', 'turn')
"""How units come to stands: three of four sessions on one of their own; by lot; A, B, C in turn."""
HOME = 0.75
DRAWS, DESIGNS = 2000, 100
"""Of the bound: draws of what is seen, for each of so many laboratories."""
ENOUGH = 0.9


@dataclass(frozen=True)
class Cell:
    """Laboratories of a kind: how many, what stand B shifts by how many scatters, and how."""

    runs: int
    units: int
    what: str
    ratio: float
    sessions: int = SESSIONS
    way: str = 'lot'
    seed: int = 0


def stands_of(rng: np.random.Generator, cell: Cell) -> NDArray[np.int64]:
    """Return the stand of each session, unit by unit."""
    shape = cell.units, cell.sessions
    drawn = rng.integers(len(STANDS), size=shape)
    own = np.arange(cell.units)[:, None] % len(STANDS)
    if cell.way == 'turn':
        drawn = (own + np.arange(cell.sessions)) % len(STANDS)
    elif cell.way == 'home':
        away = (own + rng.integers(1, len(STANDS), size=shape)) % len(STANDS)
        drawn = np.where(rng.uniform(size=shape) < HOME, own, away)
    return np.asarray(drawn.ravel())


def pattern(what: str) -> NDArray[np.float64]:
    """Return what a shift of one scatter adds to the 24 parameters, in scatters."""
    return next(one.shifts for one in PATTERNS if one.name == what)


def run(rng: np.random.Generator, cell: Cell) -> tuple[StandShift, ...]:
    """Return the shifts that are named in a laboratory whose stand B shifts every unit."""
    count = cell.units * cell.sessions
    unit = np.repeat(np.arange(cell.units), cell.sessions)
    stand = stands_of(rng, cell)
    values = 20 * rng.standard_normal((cell.units, 24))[unit] + rng.standard_normal((count, 24))
    values[stand == 1] += cell.ratio * pattern(cell.what)
    months = rng.uniform(0, 48, (count, 1))
    names = [STANDS[k] for k in stand]
    found = judge_stands(unit, names, months, values, np.ones_like(values), USUAL)
    return found.shifts


def counted(cell: Cell) -> dict[str, int]:
    """Return in how many laboratories what was named, and how often intervals held."""
    rng = np.random.default_rng([38, cell.seed])
    count = dict.fromkeys(('any', 'right', 'wrong', 'named', 'held'), 0)
    for _ in range(cell.runs):
        shifts = run(rng, cell)
        hit = [s for s in shifts if (s.stand, s.what, s.identified) == ('B', cell.what, True)]
        count['any'] += bool(shifts)
        count['right'] += bool(hit)
        count['wrong'] += any(s.stand != 'B' and s.identified for s in shifts)
        count['named'] += len(hit)
        count['held'] += sum(s.low <= cell.ratio <= s.high for s in hit)
    return count


def bound(cell: Cell) -> float:
    """Return the share in which B is named, alone, by whoever knows the scatter and all trends.

    With the same chance of a false alarm over the same number of tests, and the same odds for
    naming one stand alone. Of a known covariance the score of each stand is sufficient.
    """
    rng = np.random.default_rng([21, cell.seed])
    count = len(STANDS)
    least = norm.isf(USUAL.false_alarm / (len(PATTERNS) * count) / 2)
    size = cell.ratio * float(np.linalg.norm(pattern(cell.what)))
    shares = []
    for _ in range(DESIGNS):
        placed = np.eye(count)[stands_of(rng, cell)].reshape(cell.units, cell.sessions, count)
        less = (placed - placed.mean(axis=1, keepdims=True)).reshape(-1, count)
        matrix = less.T @ less
        values, vectors = np.linalg.eigh(matrix)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        score = size * matrix[1] + rng.standard_normal((DRAWS, count)) @ root.T
        square = score**2 / np.diag(matrix)
        others = np.delete(square, 1, axis=1).max(axis=1)
        alone = square[:, 1] + 2 * np.log(USUAL.false_alarm) > others
        shares.append(np.mean(alone & (square[:, 1] > least**2)))
    return float(np.mean(shares))


def enough(what: str, ratio: float, way: str, units: int = 30) -> int:
    """Return the fewest sessions of each unit with which the bound is `ENOUGH`."""
    least, most = 2, 4096
    while least < most:
        middle = (least + most) // 2
        if bound(Cell(0, units, what, ratio, middle, way)) >= ENOUGH:
            most = middle
        else:
            least = middle + 1
    return least


def share(hits: int, runs: int) -> str:
    """Return a share with its interval of 95 % (Clopper & Pearson 1934)."""
    low = beta.ppf(0.025, hits, runs - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, runs - hits) if hits < runs else 1.0
    return f'{100 * hits / runs:.0f} % ({100 * low:.0f} to {100 * high:.0f})'


def size_of(what: str, ratio: float) -> str:
    """Return a shift with its unit."""
    unit, scale = ('ppm', PPM) if what.startswith('K') else ('arcmin', ARCMIN)
    return f'{ratio * SCATTER[what[0]] / scale:g} {unit}'


def main() -> None:
    """Run the study, draw and write the page."""
    cells = [
        Cell(RUNS, units, what, ratio) for what in CASES for ratio in RATIOS for units in UNITS
    ]
    quiet = [Cell(QUIET, units, 'K_a', 0.0) for units in UNITS]
    closer = [Cell(CLOSER, 30, 'E_gxy', 1.0, sessions, way) for way in WAYS for sessions in MORE]
    every = [*cells, *quiet, *closer]
    every = [Cell(**{**vars(cell), 'seed': k}) for k, cell in enumerate(every)]
    # Numpy's own threads would only get into each other's way.
    with ProcessPoolExecutor() as pool:
        found = list(pool.map(counted, every))
    first, none = found[: len(cells)], found[len(cells) : len(cells) + len(quiet)]
    power = {
        (c.what, c.units, c.ratio): one['right'] / RUNS for c, one in zip(cells, first, strict=True)
    }
    rows = []
    for k in range(0, len(cells), len(UNITS)):
        cell = cells[k]
        shares = ' | '.join(share(one['right'], RUNS) for one in first[k : k + len(UNITS)])
        size = size_of(cell.what, cell.ratio)
        rows.append(f'| {cell.what} | {size} | {cell.ratio:g} | {shares} |')
    alarms = ' | '.join(share(one['any'], QUIET) for one in none)
    second = []
    for k, cell in enumerate(closer):
        one = found[len(cells) + len(quiet) + k]
        best = f'{100 * bound(cell):.0f} %'
        words = f'| {cell.way} | {cell.sessions} | {share(one["right"], CLOSER)} | {best} |'
        second.append(words)
    needed = [
        f'| {what} | {size_of(what, ratio)} | {ratio:g} | {enough(what, ratio, "lot")} | '
        f'{enough(what, ratio, "turn")} |'
        for what in CASES
        for ratio in RATIOS
    ]
    draw(power)
    total = len(cells) * RUNS
    wrong, held, named = (sum(one[name] for one in first) for name in ('wrong', 'held', 'named'))
    every_quiet = share(sum(one['any'] for one in none), QUIET * len(none))
    text = f"""# Unit or stand: detectable shifts

Written by `docs/unit_or_stand.py`. A laboratory has three stands; stand B adds the same to every
unit. Each unit has {SESSIONS} sessions in four years, each on a stand drawn by lot, and scatters
between sessions by 5 ppm of a scale factor and 0.01 arcmin of a misalignment, one standard
deviation, turn-on repeatability and the session's own errors together. The method:
[history.md](history.md#unit-or-stand). Shares are those of {RUNS} laboratories in which B
alone was named, with its true shift; in brackets the interval of 95 % for the share.

| shifted | by | of the scatter | {' | '.join(f'{n} units' for n in UNITS)} |
|---|---|---|{'---|' * len(UNITS)}
{chr(10).join(rows)}
| nothing | 0 | 0 | {alarms} |

![Share of laboratories in which the stand is named, against the shift](unit_or_stand.png)

- The last row is of {QUIET} laboratories each without a shifted stand: how often any stand was
  named, or two were reported to differ; of all together {every_quiet}. The stated
  limit is {100 * USUAL.false_alarm:g} %.
- A wrong stand was named in {wrong} of {total} laboratories.
- The stated interval of a shift contained the truth in {held} of {named}. It is simultaneous,
  for all tested parameters and stands, and so wider than for one.
- `K_a` is a shift of all three accelerometers alike, as of gravity; it is tested as one
  pattern, and three channels determine it better by the square root of three. `E about Z` is a
  fixture that is turned about Z: it shifts four misalignments, two of each triad, and is tested as
  one pattern, twice as well. A single misalignment has one channel: it is the hardest to find, and
  no error of a stand is known that shifts one alone.

## Limits

One misalignment, shifted by one scatter, and thirty units. No test exceeds the bound that
has the same false alarms over the same {len(PATTERNS) * len(STANDS)} tests and names one stand by
the same odds (99 to 1), even with known scatter and trends. The results of the method
are from {CLOSER} laboratories.

| how units come to stands | sessions of each | named alone | bound |
|---|---|---|---|
{chr(10).join(second)}

`home`: three of four sessions are on a stand of the unit's own; `lot`: drawn by lot; `turn`: A, B,
C, A and so on. Only a unit that was on a stand and elsewhere shows the stand's shift: from
*n* sessions by lot over *s* stands a unit has the information *(n - 1) p (1 - p)* over the
scatter's square, *p = 1/s*. The power depends on the shift over the scatter times the square root
of units times sessions less one. Without a change of stand there is no information in any number of
sessions.

Two effects reduce the power below the bound: the scatter is estimated, and outlying sessions get
less weight. Both are small, and where the power is low the bound itself is low: naming a stand
needs {norm.isf(USUAL.false_alarm / (len(PATTERNS) * len(STANDS)) / 2):.1f} standard deviations,
since {len(PATTERNS) * len(STANDS)} shifts are tested at a false alarm of
{100 * USUAL.false_alarm:g} %.

## What a laboratory must do

Fewest sessions of each of thirty units with which the bound is {100 * ENOUGH:.0f} % and more:

| shifted | by | of the scatter | by lot | in turn |
|---|---|---|---|---|
{chr(10).join(needed)}

Rotate units among the stands instead of keeping each on one. If repeatability is twice as bad, four
times as many sessions less one are needed; more units help as more sessions do.
"""
    Path(__file__).with_suffix('.md').write_text(text, encoding='utf-8')


def draw(power: dict[tuple[str, int, float], float]) -> None:
    """Draw the shares against the shift."""
    figure = Figure(figsize=(10.4, 3.4), layout='constrained')
    for axes, what in zip(figure.subplots(1, len(CASES), sharey=True), CASES, strict=True):
        for units, marker in zip(UNITS, 'os^', strict=True):
            shares = [100 * power[what, units, ratio] for ratio in RATIOS]
            axes.semilogx(RATIOS, shares, marker=marker, label=f'{units} units')
        axes.set_xticks(RATIOS, [f'{ratio:g}' for ratio in RATIOS])
        axes.minorticks_off()
        axes.set_xlabel('shift / scatter between sessions')
        axes.set_title(what)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel('stand named, %')
    figure.axes[0].legend()
    figure.savefig(PICTURE, dpi=120)


if __name__ == '__main__':
    main()
