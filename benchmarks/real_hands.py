"""Published sessions in the hand: imu_calib compared with their authors' tools.

Each recording is calibrated from some of its holds and scored on the others: the root mean square
of |a| - g over them, and of the angle between gravity propagated by the gyros from hold to hold and
gravity by the accelerometers there. The authors' tools are reimplemented from their descriptions
(`Tool`), and get the holds that imu_calib finds. Each is also compared with imu_tk's with the best
gyro bias, the mean of all holds.

    python benchmarks/real_hands.py DIRECTORY [--only NAME ...] [--dealings 12] [--threes]

Holds are dealt in threes of neighbours to two halves (or three at a time are excluded, `--threes`):
in turn, and then by seeds. DIRECTORY has the files that docs/real_recordings.md names; missing ones
are skipped.

Sources: Tedaldi, Pretto and Menegatti 2014, ICRA; Mikov, Reginya and Moschevikin 2020, ICINS.
"""

from __future__ import annotations

import argparse
import enum
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from imu_calib.calibration.hand import HandCalibrator
from imu_calib.common.errors import NotObservable
from imu_calib.common.parallel import run_all
from imu_calib.common.stream import Floats, ImuBlock, Stamps, Units
from imu_calib.common.units import DEG, STANDARD_GRAVITY
from imu_calib.estimation.setup import Setup
from imu_calib.model.earth import Site
from imu_calib.model.sensors import SensorModel
from imu_calib.segmentation.segments import Segment
from imu_calib.session.imu import ImuSpec, TriadSpec
from imu_calib.session.plan import load_plan

Corrected = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Conversion of outputs of gyros and accelerometers (n, 3) in SI to inputs."""

_EPOCH = 1_600_000_000_000_000_000
"""ns: start of recordings whose stamps do not state it."""


class Recording(NamedTuple):
    """A published recording: stamps (n,) ns, values (n, 6) as delivered, description, site."""

    stamp: Stamps
    values: Floats
    imu: ImuSpec
    site: Site

    def some(self, rows: NDArray[np.bool_]) -> Recording:
        """Return it with some of its samples."""
        return self._replace(stamp=self.stamp[rows], values=self.values[rows])

    def outputs(self, start: int, end: int) -> Floats:
        """Return the outputs between two instants, ns, (n, 6) SI by nominal scale factors."""
        inside = slice(*np.searchsorted(self.stamp, [start, end + 1]).tolist())
        scale = np.repeat([self.imu.gyro.scale_factor, self.imu.accel.scale_factor], 3)
        return self.values[inside] * scale

    def calibrator(self) -> HandCalibrator:
        """Return a calibrator with all of its data."""
        found = HandCalibrator(Setup(self.imu, load_plan('free_positions'), None, self.site))
        gyro, accel = self.values[:, :3], self.values[:, 3:]
        found.add_block(ImuBlock(self.stamp, gyro, accel, 'imu'))
        return found


def _stamped(seconds: Floats) -> Stamps:
    return np.asarray(_EPOCH + np.rint((seconds - seconds[0]) * 1e9).astype(np.int64))


def _evenly(count: int, rate: float) -> Stamps:
    return _stamped(np.arange(count) / rate)


def _imu(name: str, units: Units, gyro: float, accel: float, limit: float = np.inf) -> ImuSpec:
    """Return an IMU: rad/s and m/s^2 per count, and the end of the gyros' range, rad/s."""
    return ImuSpec(name, units, None, TriadSpec(gyro, range=limit), TriadSpec(accel))


def _site(latitude: float) -> Site:
    return Site.at(latitude * DEG)


def _xsens(folder: Path) -> Recording:
    accel, gyro = (np.loadtxt(folder / f'xsens_{kind}.mat') for kind in ('acc', 'gyro'))
    values = np.hstack([gyro[:, 1:], accel[:, 1:]]) - 32768
    # imu_tk starts from 1 / 6258 rad/s; counts at rest have the length 3719.
    imu = _imu('xsens_mti', Units.COUNTS, 1 / 6258, STANDARD_GRAVITY / 3719)
    return Recording(_stamped(accel[:, 0]), values, imu, Site.at(45.41 * DEG, gravity=9.80655))


def _mpu_9150(unit: int, folder: Path) -> Recording:
    values = np.loadtxt(folder / f'imu{unit}.log')
    imu = _imu('mpu_9150', Units.SI, 1.0, 1.0)
    return Recording(_evenly(len(values), 100), values[:, [3, 4, 5, 0, 1, 2]], imu, _site(59.9))


def _matlab(name: str, key: str, gyro: float, accel: float, folder: Path) -> Recording:
    data = np.asarray(scipy.io.loadmat(folder / f'{name}.mat')[key])
    imu = _imu(name, Units.COUNTS, gyro, accel)
    values = data[:, [4, 5, 6, 1, 2, 3]]
    return Recording(_stamped(data[:, 0]), values, imu, _site(31.2))


def _good(which: int, folder: Path) -> Recording:
    data = np.loadtxt(folder / f'imu_good{which}.txt')
    # Seconds since 1970 in 64-bit numbers have microsecond resolution.
    imu = _imu('ahrs', Units.SI, 1.0, 1.0)
    kept = np.append(True, np.diff(data[:, 0]) > 0)
    values = data[:, [4, 5, 6, 1, 2, 3]]
    return Recording(_stamped(data[:, 0][kept]), values[kept], imu, _site(37.5))


def _mpu_6050(name: str, folder: Path) -> Recording:
    values = np.loadtxt(folder / f'{name}.csv', delimiter=',', skiprows=5)
    imu = _imu('mpu_6050', Units.COUNTS, DEG / 131, STANDARD_GRAVITY / 16384, 250 * DEG)
    # Their parameters assume standard gravity.
    site = Site.at(-32.9 * DEG, gravity=STANDARD_GRAVITY)
    return Recording(_evenly(len(values), 100), values[:, [3, 4, 5, 0, 1, 2]], imu, site)


DEALT: dict[str, Callable[[Path], Recording]] = {
    'xsens': _xsens,
    **{f'mpu9150_{k}': partial(_mpu_9150, k) for k in range(5)},
    'gesture': partial(_matlab, 'caldata', 'cal_data', DEG / 16.4, STANDARD_GRAVITY / 3276.8),
    'position': partial(_matlab, 'Data', 'data', DEG / 16.4, STANDARD_GRAVITY / 2048),
}
"""Long enough for several dealings."""

ACROSS: dict[str, tuple[Callable[[Path], Recording], Callable[[Path], Recording]]] = {
    **{
        f'good {a}, good {b}': (partial(_good, a), partial(_good, b))
        for a in (1, 2, 3)
        for b in (1, 2, 3)
        if a != b
    },
    'MPU-6050, its turns of 90 deg': (
        partial(_mpu_6050, 'example_data_calibration'),
        partial(_mpu_6050, 'imu_90_x_rot'),
    ),
}
"""Too short for that: calibrated on the first, scored on the second."""


class Bias(enum.Enum):
    """The gyro bias that a tool uses."""

    START = enum.auto()
    """The mean at the first hold."""
    MEAN = enum.auto()
    """The mean over all holds."""
    FREE = enum.auto()
    """Estimated, for the best propagation of gravity."""


class Tool(NamedTuple):
    """A tool of two steps: the accelerometers by lengths, then the gyros by propagated gravity.

    It gets the holds that imu_calib finds, in place of its own detection by variance.

    Attributes:
        bias: Gyro bias.
        by_samples: Whether lengths are weighted by samples; else all holds have equal weight.
    """

    bias: Bias
    by_samples: bool = False

    def calibrate(self, session: Session, chosen: Sequence[int], *, gyros: bool = True) -> Triads:
        """Calibrate from some of the holds, and the gyros from the turns between neighbours."""
        holds = [session.holds[k] for k in sorted(chosen)]
        at_rest = session.at_rest(chosen)
        outputs = at_rest
        if self.by_samples:
            outputs = np.vstack([session.recording.outputs(h.start, h.end) for h in holds])
        accel = _lengths(outputs[:, 3:], session.recording.site.gravity)
        turns = session.turns(chosen) if gyros else []
        if not turns:
            return Triads(np.eye(3), np.zeros(3), *accel)
        seen = (at_rest[:, 3:] - accel[1]) @ accel[0].T
        ups = seen / np.linalg.norm(seen, axis=1)[:, None]
        bias = at_rest[0, :3] if self.bias is Bias.START else at_rest[:, :3].mean(axis=0)
        return Triads(*_led(turns, ups, bias, seeks_bias=self.bias is Bias.FREE), *accel)


IMU_TK = Tool(Bias.START)
"""By Tedaldi, Pretto and Menegatti 2014, eqs. (9) to (15)."""
MIKOV = Tool(Bias.FREE, by_samples=True)
"""By Mikov, Reginya and Moschevikin 2020, eqs. (10) and (16)."""
AVERAGED = Tool(Bias.MEAN)
"""imu_tk's with the bias of shenshikexmu: the best one."""


def _led(
    turns: Sequence[tuple[int, int, Floats, Floats, Floats]],
    ups: Floats,
    bias: Floats,
    *,
    seeks_bias: bool,
) -> tuple[Floats, Floats]:
    """Fit nine gains of the gyros, and optionally their bias, to up vectors around turns.

    Source: Tedaldi, Pretto and Menegatti 2014, eqs. (14) and (15), and (17) to (19) for the
    Runge-Kutta steps.
    """
    first, second = (ups[[turn[k] for turn in turns]] for k in (0, 1))
    rates, steps = _padded([turn[2] for turn in turns], [turn[4] for turn in turns])

    def parts(values: Floats) -> tuple[Floats, Floats]:
        gain = np.diag(values[:3])
        gain[~np.eye(3, dtype=bool)] = values[3:9]
        return gain, values[9:] if seeks_bias else bias

    def missed(values: Floats) -> Floats:
        gain, zero = parts(values)
        carried = _turned(_carried((rates - zero) @ gain.T, steps), first)
        return np.asarray((carried - second).ravel())

    start = np.concatenate([[1.0, 1, 1, 0, 0, 0, 0, 0, 0], bias if seeks_bias else []])
    return parts(scipy.optimize.least_squares(missed, start, method='lm', xtol=1e-7, ftol=1e-7).x)


class Triads(NamedTuple):
    """Gains (3, 3) and biases (3,) of both triads: inputs are gain (outputs - bias)."""

    gyro: Floats
    gyro_bias: Floats
    accel: Floats
    accel_bias: Floats

    def __call__(self, gyro: Floats, accel: Floats) -> tuple[Floats, Floats]:
        """Return the inputs for outputs (n, 3)."""
        return (gyro - self.gyro_bias) @ self.gyro.T, (accel - self.accel_bias) @ self.accel.T


def _lengths(outputs: Floats, gravity: float) -> tuple[Floats, Floats]:
    """Fit nine parameters of the accelerometers to |a|^2 = g^2 at rest; return gain and bias."""

    def parts(values: Floats) -> tuple[Floats, Floats]:
        misaligned = np.eye(3)
        misaligned[np.triu_indices(3, 1)] = values[3:6]
        return misaligned @ np.diag(values[:3]), values[6:] * gravity

    def wrong(values: Floats) -> Floats:
        gain, bias = parts(values)
        return np.asarray((((outputs - bias) @ gain.T) ** 2).sum(axis=1) / gravity**2 - 1)

    start = np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 0])
    return parts(scipy.optimize.least_squares(wrong, start, xtol=1e-12, ftol=1e-12).x)


def _padded(rates: list[Floats], steps: list[Floats]) -> tuple[Floats, Floats]:
    """Return sequences of equal length, (k, n, 3) and (k, n - 1): added steps have no duration."""
    longest = 1 + (1 << (max(len(s) for s in steps) - 1).bit_length())
    all_rates = np.zeros((len(rates), longest, 3))
    all_steps = np.zeros((len(rates), longest - 1))
    for k, (rate, step) in enumerate(zip(rates, steps, strict=True)):
        all_rates[k, : len(rate)], all_steps[k, : len(step)] = rate, step
    return all_rates, all_steps


def _carried(rates: Floats, steps: Floats) -> Floats:
    """Integrate rates (k, n, 3) over steps (k, n - 1), n - 1 a power of two: quaternions (k, 4).

    A Runge-Kutta step of q' = q (0, w) / 2 is linear in q: a multiplication by a quaternion.
    """
    half = np.zeros((*rates.shape[:2], 4))
    half[..., 1:] = rates / 2
    before, after = half[:, :-1], half[:, 1:]
    between, h = (before + after) / 2, steps[..., None]
    one = np.array([1.0, 0, 0, 0])
    k1 = before
    k2 = _product(one + h / 2 * k1, between)
    k3 = _product(one + h / 2 * k2, between)
    k4 = _product(one + h * k3, after)
    found = one + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    while found.shape[1] > 1:
        found = _product(found[:, ::2], found[:, 1::2])
    return np.asarray(found[:, 0] / np.linalg.norm(found[:, 0], axis=1)[:, None])


def _product(a: Floats, b: Floats) -> Floats:
    u, v = a[..., 1:], b[..., 1:]
    scalar = a[..., :1] * b[..., :1] - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, a[..., :1] * v + b[..., :1] * u + np.cross(u, v)], axis=-1)


def _turned(quaternions: Floats, vectors: Floats) -> Floats:
    """Return world vectors (k, 3) in axes rotated by quaternions."""
    u, w = -quaternions[:, 1:], quaternions[:, :1]
    once = np.cross(u, vectors) + w * vectors
    return np.asarray(vectors + 2 * np.cross(u, once))


@dataclass(frozen=True, eq=False)
class Session:
    """A recording with the holds that imu_calib finds in it."""

    recording: Recording
    holds: tuple[Segment, ...]

    @classmethod
    def of(cls, recording: Recording) -> Session:
        """Find the holds."""
        return cls(recording, recording.calibrator().segmented().segments)

    def blocks(self) -> Floats:
        """Return the hold of each sample, (n,): turns are divided in their middle."""
        cuts = [
            (a.end + b.start) // 2 for a, b in zip(self.holds[:-1], self.holds[1:], strict=True)
        ]
        return np.searchsorted(np.array(cuts), self.recording.stamp, side='right')

    def only(self, chosen: Sequence[int]) -> Recording:
        """Return the samples of some of the holds, and of the turns between neighbours."""
        return self.recording.some(np.isin(self.blocks(), chosen))

    def turns(self, chosen: Sequence[int]) -> list[tuple[int, int, Floats, Floats, Floats]]:
        """Return the turns between neighbours among some holds.

        Returns:
            Indices among the chosen, (n, 3) outputs of both triads between them, and the durations
            of the n - 1 steps, s.
        """
        found, place = [], {hold: k for k, hold in enumerate(sorted(chosen))}
        stamp = self.recording.stamp
        for hold, k in place.items():
            if hold + 1 not in place:
                continue
            start, end = self.holds[hold].end, self.holds[hold + 1].start
            outputs = self.recording.outputs(start, end)
            inside = slice(*np.searchsorted(stamp, [start, end + 1]).tolist())
            steps = np.diff(stamp[inside]) * 1e-9
            found.append((k, place[hold + 1], outputs[:, :3], outputs[:, 3:], steps))
        return found

    def at_rest(self, chosen: Sequence[int]) -> Floats:
        """Return the means of the outputs at some holds, (k, 6) SI."""
        holds = [self.holds[k] for k in sorted(chosen)]
        return np.array([self.recording.outputs(h.start, h.end).mean(axis=0) for h in holds])

    def score(self, corrected: Corrected, chosen: Sequence[int]) -> Score:
        """Score sensors on some holds and the turns between them."""
        means = self.at_rest(chosen)
        forces = corrected(means[:, :3], means[:, 3:])[1]
        size = np.linalg.norm(forces, axis=1)
        turns = self.turns(chosen)
        lengths, angles = np.full((2, len(self.holds)), np.nan)
        lengths[sorted(chosen)] = size - self.recording.site.gravity
        if turns:
            first, second = ([turn[k] for turn in turns] for k in (0, 1))
            ups = forces / size[:, None]
            rates = [corrected(gyro, accel)[0] for _, _, gyro, accel, _ in turns]
            carried = _turned(_carried(*_padded(rates, [t[4] for t in turns])), ups[first])
            sines = np.linalg.norm(np.cross(carried, ups[second]), axis=1)
            after = np.array(sorted(chosen))[first]
            angles[after] = np.arctan2(sines, (carried * ups[second]).sum(axis=1))
        return Score(lengths, angles)


class Score(NamedTuple):
    """Residuals on holds not used for calibration: m/s^2, and rad for each following turn.

    NaN if a hold, or the next one, was not scored.
    """

    lengths: Floats
    angles: Floats

    def rms(self) -> tuple[float, float]:
        """Return the root mean squares; NaN without any."""
        parts = (p[np.isfinite(p)] for p in self)
        lengths, angles = (float(np.sqrt(np.mean(p**2))) if len(p) else np.nan for p in parts)
        return lengths, angles


def calibrated(recording: Recording) -> SensorModel | None:
    """Calibrate by imu_calib; None if it refuses."""
    try:
        return recording.calibrator().finish().calibration.model
    except NotObservable:
        return None


def dealt(holds: int, seed: int, *, threes: bool) -> list[list[int]]:
    """Deal holds to parts, each of which is excluded in turn.

    Seed 0 deals threes of neighbours in turn. Others deal, by halves, threes of neighbours that
    begin at the first, second or third hold, at random; by threes, any holds.
    """
    rng = np.random.default_rng(seed)
    every = np.arange(holds)
    if threes:
        order = every if not seed else rng.permutation(holds)
        return [order[k : k + 3].tolist() for k in range(0, holds, 3)]
    of_three = (every + (int(rng.integers(3)) if seed else 0)) // 3
    groups = np.arange(of_three.max() + 1)
    half = groups % 2 if not seed else rng.permutation(groups % 2)
    return [every[half[of_three] == k].tolist() for k in (0, 1)]


def one(read: Callable[[Path], Recording], folder: Path, threes: bool, seed: int) -> Dealing | None:
    """Score a dealing; None if imu_calib refuses a part."""
    session = Session.of(read(folder))
    every = range(len(session.holds))
    found: list[list[Score]] = []
    for out in dealt(len(every), seed, threes=threes):
        kept = [k for k in every if k not in out]
        model = calibrated(session.only(kept))
        if model is None:
            return None
        ours = session.score(model.compensate, out)
        tools = [
            tool.calibrate(session, kept, gyros=bool(np.isfinite(ours.angles).any()))
            for tool in (_tool_of(session), AVERAGED)
        ]
        found.append([ours, *(session.score(tool, out) for tool in tools)])
    return Dealing(*map(_joined, zip(*found, strict=True)))


def _joined(scores: Sequence[Score]) -> Score:
    """Combine the scores of parts, each of which has its own holds."""
    result = Score(*np.array(scores[0]))
    for score in scores[1:]:
        for whole, part in zip(result, score, strict=True):
            np.copyto(whole, part, where=np.isfinite(part))
    return result


def _tool_of(session: Session) -> Tool:
    """Return the tool of the authors of a session."""
    return {'mpu_9150': MIKOV, 'caldata': AVERAGED, 'Data': AVERAGED}.get(
        session.recording.imu.id, IMU_TK
    )


class Dealing(NamedTuple):
    """Scores of imu_calib, of the authors' tool, and of that with the best bias."""

    ours: Score
    theirs: Score
    best: Score


def across(
    pair: tuple[Callable[[Path], Recording], Callable[[Path], Recording]], folder: Path
) -> Dealing:
    """Score a recording with the calibration from another of the same unit."""
    of, on = (Session.of(read(folder)) for read in pair)
    every = range(len(on.holds))
    model = calibrated(of.recording)
    assert model is not None, 'a whole recording is refused'
    published = folder / 'params_acc.csv'
    best = AVERAGED.calibrate(of, range(len(of.holds)))
    if of.recording.imu.id == 'mpu_6050' and published.exists():
        theirs = _published(folder, of.recording)
    else:
        theirs = _tool_of(of).calibrate(of, range(len(of.holds)))
    scores = [on.score(each, every) for each in (model.compensate, theirs, best)]
    return Dealing(*scores)


def _published(folder: Path, recording: Recording) -> Triads:
    """Read the published parameters of the MPU-6050, for outputs in SI."""
    a, g = (np.loadtxt(folder / f'params_{kind}.csv') for kind in ('acc', 'gyro'))
    accel = np.array([[1, -a[0], a[1]], [0, 1, -a[2]], [0, 0, 1]]) @ np.diag(a[3:6])
    gyro = np.array([[1, -g[0], g[1]], [g[2], 1, -g[3]], [-g[4], g[5], 1]]) @ np.diag(g[6:9])
    by_gyro, by_accel = recording.imu.gyro.scale_factor, recording.imu.accel.scale_factor
    return Triads(gyro / by_gyro, g[9:] * by_gyro, accel / by_accel, -a[6:] * by_accel)


def _row(name: str, first: str, found: Sequence[Dealing]) -> str:
    """Write medians over the dealings, in how many imu_calib is better, and the margin per hold.

    The margin: the mean of squares minus those of either tool, each averaged over the dealings, in
    standard deviations of that mean over the holds. Negative values are better for imu_calib.
    """
    cells = []
    for which, unit in ((0, 1e-3), (1, DEG)):
        if not found:
            cells.append(' | | ')
            continue
        rms = np.array([[score.rms()[which] for score in d] for d in found]) / unit
        squares = np.array([[score[which] ** 2 for score in d] for d in found])
        seen = np.isfinite(squares).all(axis=1)
        if not np.isfinite(rms).all():
            cells.append(' | | ')
            continue
        each = np.where(seen[:, None], squares, 0).sum(axis=0)[:, seen.any(axis=0)]
        each /= seen.sum(axis=0)[seen.any(axis=0)]
        less = each[0] - each[1:]
        sigma = less.mean(axis=1) / (less.std(axis=1, ddof=1) / np.sqrt(less.shape[1]))
        ahead = (rms[:, :1] < rms[:, 1:]).sum(axis=0)
        cells.append(
            f'{", ".join(f"{median:.3g}" for median in np.median(rms, axis=0))} | '
            f'{ahead[0]}, {ahead[1]} | {sigma[0]:+.1f}, {sigma[1]:+.1f}'
        )
    return f'| {name} | {first} | {" | ".join(cells)} |'


def _plain(found: Dealing) -> str:
    """Write a dealing: lengths of all three, mm/s^2, and angles, deg."""
    lengths, angles = zip(*(score.rms() for score in found), strict=True)
    parts = (np.array(lengths) / 1e-3, np.array(angles) / DEG)
    return ' '.join(f'{number:.5g}' for part in parts for number in part)


def main() -> int:
    """Score the available recordings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('directory', type=Path)
    parser.add_argument('--only', nargs='+', default=[*DEALT, 'across'], metavar='NAME')
    parser.add_argument('--dealings', type=int, default=0, help='by seeds, after that in turn')
    parser.add_argument('--threes', action='store_true', help='leave three out at a time')
    parser.add_argument('--each', action='store_true', help='print every dealing besides')
    parser.add_argument('--jobs', type=int)
    asked = parser.parse_args()
    print(
        '| recording | dealings | abs(a) - g, mm/s^2 | ahead | sigma '
        '| gravity carried, deg | ahead | sigma |'
    )
    print('|---|---|---|---|---|---|---|---|')
    seeds = range(1, asked.dealings + 1) if asked.dealings else (0,)
    for name, read in DEALT.items():
        if name not in asked.only or not _there(read, asked.directory):
            continue
        work = partial(one, read, asked.directory, asked.threes)
        found = run_all(work, seeds, jobs=asked.jobs)
        kept = [d for d in found if d is not None]
        if asked.each:
            for seed, dealing in zip(seeds, found, strict=True):
                print(f'{name} {seed}:', 'refused' if dealing is None else _plain(dealing))
        refused = '' if len(kept) == len(found) else f' ({len(found) - len(kept)} refused)'
        print(_row(name, f'{len(kept)}{refused}', kept), flush=True)
    for name, pair in ACROSS.items():
        if 'across' in asked.only and all(_there(read, asked.directory) for read in pair):
            found_one = across(pair, asked.directory)
            print(_row(name, '1', [found_one]), flush=True)
    return 0


def _there(read: Callable[[Path], Recording], folder: Path) -> bool:
    """Return whether the files of a recording exist."""
    try:
        read(folder)
    except OSError:
        return False
    return True


if __name__ == '__main__':
    # Workers find the function by the name of this module.
    import real_hands

    sys.exit(real_hands.main())
