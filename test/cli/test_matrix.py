"""Every shipped plan with every shipped IMU and truth that fits it, through the commands.

What fits is told by the files: channels, units, scale factors, and which table can run a plan, so
that a new file joins by itself. Sessions are the plans' own but for time: dwells last `DWELL`, or
`ALONE` where the Earth alone turns the unit; rate tests keep their turns, one in each sense, at
`RATES`; units sample at no more than `HIGHEST` Hz. None of this is what a plan or a unit is about:
deviations follow the noise, and errors are held against them.

Every combination is simulated, calibrated, verified, compensated and exported. Its calibration is
verified by the recording of the next plan with the same unit: each recording serves twice. The
combinations of `covering` take each plan once, each IMU and truth with some plan; they alone run by
default (`extent`). The commands that read a recording once more for a person, `info` and `report`
with the recording, run for one of each kind of stream and one of each method; `info` of what was
compensated for one of each kind of stream.
"""

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from extent import ALL

from imu_calib.api.compare import conformity
from imu_calib.api.session import HELD_UNIT as HELD
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.exports import EXPORTS
from imu_calib.cli.main import main
from imu_calib.common.files import share_folder
from imu_calib.common.stream import Floats, Units
from imu_calib.estimation import hand as free_positions
from imu_calib.estimation.evidence import SMALLEST_VARIANCE
from imu_calib.estimation.methods import JOINT
from imu_calib.model.earth import EARTH_RATE
from imu_calib.model.sensors import terms_of
from imu_calib.recordings.cdr_codec import Kind
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.session.imu import ImuSpec, load_imu, read_imu
from imu_calib.session.plan import Plan, load_plan

CONFIG = share_folder() / 'config'
DWELL, ALONE = 8.0, 200.0
RATES = '[90 deg/s, -90 deg/s]'
HIGHEST = 50.0
GRAVITY = 9.797
PLACE = ['--latitude', '34.65', '--gravity', repr(GRAVITY)]
DEFAULT_TRUTH = 'cao2022_table1'
TOO_FAR = 4.5
TOLD = 0.1
"""Of a response: where the Earth turns the unit, calibrate refuses what is known no better."""


def names(kind: str) -> list[str]:
    return sorted(path.stem for path in (CONFIG / kind).glob('*.yaml'))


@dataclass(frozen=True)
class Case:
    """A plan, a unit and its truth, by the names of their files."""

    plan: str
    imu: str
    truth: str

    def __str__(self) -> str:
        return f'{self.plan}-{self.imu}-{self.truth}'


plan_of, imu_of = cache(load_plan), cache(load_imu)


@cache
def truth_of(name: str) -> Calibration:
    return Calibration.load(CONFIG / 'truths' / f'{name}.yaml')


def short_plan(name: str) -> str:
    text = (CONFIG / 'plans' / f'{name}.yaml').read_text()
    if plan_of(name).by_hand:
        return text
    dwell = DWELL if turned(plan_of(name)) else ALONE
    text = re.sub(r'(?m)^dwell: *[\d.]+ s', f'dwell: {dwell:g} s', text)
    return re.sub(r'(?m)^  rates: \[.*\]', f'  rates: {RATES}', text)


def slow_imu(name: str) -> str:
    text = (CONFIG / 'imus' / f'{name}.yaml').read_text()
    if imu_of(name).sample_rate is None:
        return f'{text}\nsample_rate: {HIGHEST:g} Hz\n'
    return re.sub(r'(?m)^sample_rate: .*$', f'sample_rate: {HIGHEST:g} Hz', text)


def same_numbers(truth: Calibration, imu: ImuSpec) -> bool:
    """Whether a truth is of a unit whose stream means the same numbers."""
    pairs = ((truth.imu.gyro, imu.gyro), (truth.imu.accel, imu.accel))
    return truth.imu.units is imu.units and all(
        np.isclose(a.scale_factor, b.scale_factor, rtol=1e-9) for a, b in pairs
    )


def linear_truths() -> list[str]:
    """Those that plans solve without being asked for terms; test_terms.py has the others."""
    return [t for t in names('truths') if not terms_of(truth_of(t).model.parameters)]


def truths_of(imu_name: str) -> list[str]:
    """The truths of a unit's own numbers; a unit without any is one of the paper's parameters."""
    imu = imu_of(imu_name)
    own = [t for t in linear_truths() if same_numbers(truth_of(t), imu)]
    own = own or [DEFAULT_TRUTH]
    return [t for t in own if (imu.skewed is None) == (truth_of(t).model.skewed is None)]


def every() -> Iterator[Case]:
    for plan in names('plans'):
        for imu in names('imus'):
            # Its turns are for a fourth gyro.
            fits = plan_of(plan).method != 'skewed' or imu_of(imu).skewed is not None
            for truth in truths_of(imu) if fits else ():
                yield Case(plan, imu, truth)


def turned(plan: Plan) -> bool:
    """Whether more than the Earth turns the unit: whole turns, or moves that its method sees."""
    return plan.method in JOINT or any(p.rate_test is not None for p in plan.positions)


def table(case: Case) -> list[str]:
    return [] if plan_of(case.plan).by_hand else ['--table', 'three_axis']


def north(case: Case) -> list[str]:
    """Where nothing but the Earth turns a unit, its north must be known."""
    plan = plan_of(case.plan)
    return [] if turned(plan) or plan.by_hand else ['--azimuth', '0']


def covering(cases: list[Case]) -> list[Case]:
    """Each plan with the unit that has had the fewest plans so far; then a plan for each other."""
    times: Counter[str] = Counter()
    chosen: list[Case] = []
    # Plans that few units can run choose first.
    number = Counter(c.plan for c in cases)
    for plan in sorted(number, key=lambda p: (number[p], p)):
        # In the hand the unit that the command `stand` gives into it.
        held = plan_of(plan).by_hand
        mine = [c for c in cases if c.plan == plan and (not held or c.imu == HELD)]
        chosen.append(min(mine, key=lambda c: times[c.imu]))
        times[chosen[-1].imu] += 1
    on_table = [c for c in cases if not plan_of(c.plan).by_hand]
    for imu in sorted({c.imu for c in cases} - set(times)):
        mine = [c for c in on_table if c.imu == imu]
        chosen.append(min(mine, key=lambda c: len(plan_of(c.plan).positions)))
    return chosen


CASES = list(every())
WHOLE = covering(CASES)
RUN = CASES if ALL else WHOLE
OF_EACH_STREAM = {
    (imu_of(c.imu).units, imu_of(c.imu).skewed is None, plan_of(c.plan).by_hand): c
    for c in sorted(WHOLE, key=lambda c: -len(plan_of(c.plan).positions))
}.values()
"""One of each kind of stream, by its shortest plan: once compensated all are in SI units."""
READ_AGAIN = {
    *OF_EACH_STREAM,
    *{
        (plan_of(c.plan).method, plan_of(c.plan).by_hand, turned(plan_of(c.plan))): c
        for c in sorted(WHOLE, key=lambda c: -len(plan_of(c.plan).positions))
    }.values(),
}
"""One of each kind of stream and one of each method, by its shortest plan."""


def too_noisy(case: Case) -> bool:
    """Whether a mean over a dwell leaves a tenth of the Earth's rate in doubt, or more."""
    if turned(plan_of(case.plan)) or plan_of(case.plan).by_hand:
        return False
    return imu_of(case.imu).gyro.random_walk / np.sqrt(ALONE) > TOLD * EARTH_RATE


def without_g(truth: Calibration) -> Calibration:
    return replace(truth, model=replace(truth.model, g_sensitivity=np.zeros((3, 3))))


def plan_tells_g(case: Case) -> bool:
    """Whether gravity and what turns a unit are two things.

    Where the Earth alone turns it, both lie still: a g-sensitivity of 0.1 (deg/h)/g is 0.7 % of a
    scale factor then, in few positions by no method to be told from one.
    """
    return turned(plan_of(case.plan)) or plan_of(case.plan).by_hand


def following(case: Case) -> Case:
    """Return the next plan with the same unit: in the hand, the other plan of the hand.

    A table's attitudes are those of the unit's case, those of free positions are in the frame of
    the accelerometers: recordings in the hand are held against lengths alone, whatever the frame.
    """
    hand = plan_of(case.plan).by_hand
    alike = [
        c
        for c in CASES
        if (c.imu, c.truth) == (case.imu, case.truth) and plan_of(c.plan).by_hand == hand
    ]
    return alike[(alike.index(case) + 1) % len(alike)]


@pytest.fixture(scope='module')
def workshop(tmp_path_factory):
    folder = tmp_path_factory.mktemp('matrix')
    for plan in names('plans'):
        (folder / f'{plan}.plan.yaml').write_text(short_plan(plan))
    for imu in names('imus'):
        (folder / f'{imu}.imu.yaml').write_text(slow_imu(imu))
    for truth in names('truths'):
        without_g(truth_of(truth)).save(folder / f'{truth}.truth.yaml')
    return folder


@pytest.fixture
def shell(workshop, capsys, monkeypatch):
    monkeypatch.chdir(workshop)
    return Shell(capsys)


class Shell:
    """Commands as a person types them."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: str, code: int | None = 0) -> str:
        """Run a command to the exit code that is expected; return what it printed.

        None: that of a verification, by what it tests.
        """
        found = main(list(words))
        printed = self._capsys.readouterr()
        text = ' '.join((printed.out + printed.err).split())
        if code is None:
            code = 4 if 'does not test' in text else 0
        assert found == code, f'imu-calib {" ".join(words)}: {found}: {text[-2000:]}'
        return text

    def simulated(self, case: Case, again: int = 0) -> str:
        """A session, made once; no two have the same noise."""
        seed = 1 + CASES.index(case) + again * len(CASES)
        bag = f'{case}-{seed}'
        if not Path(bag).exists():
            true = case.truth if plan_tells_g(case) else f'./{case.truth}.truth.yaml'
            words = ['--imu', f'./{case.imu}.imu.yaml', '--truth', true, *PLACE]
            words += [*table(case), '--seed', str(seed)]
            self('simulate', f'./{case.plan}.plan.yaml', '-o', bag, *words)
        return bag


@pytest.mark.parametrize('case', RUN, ids=str)
def test_a_shipped_plan_with_a_shipped_unit_goes_all_the_way(case, shell):
    bag = shell.simulated(case)
    file = f'{case}.calibration.yaml'
    if case in READ_AGAIN:
        output = shell('info', bag, *north(case))
        assert _supported(case, output)
    if too_noisy(case):
        output = shell('calibrate', bag, '-o', file, *north(case), code=1)
        assert 'The Earth rate is too small for the noise of these gyros' in output
        assert not Path(file).exists()
        return
    assert 'taken as exact' in shell('calibrate', bag, '-o', file, '--verbose', *north(case))
    found = Calibration.load(Path(file))
    _near_the_truth(case, found)
    _reported(case, found, bag, file, shell)
    _verified(case, file, shell)
    _compensated(case, found, bag, file, shell)
    _exported(case, found, file, shell)
    # The recording of the next one is read again; this one is not.
    shutil.rmtree(bag)


def _supported(case: Case, told: str) -> bool:
    """Whether info says that the session does, at a table or in the hand."""
    return f'plan {case.plan}: complete' in told or 'determine all' in told


def _near_the_truth(case: Case, found: Calibration) -> None:
    model = truth_of(case.truth).model
    if found.provenance.get('frame') == 'accelerometers':
        model = free_positions.in_frame_of_accelerometers(model)
    error = found.values - model.values(found.parameters)
    known = np.isfinite(found.std) & (found.std > 0)
    assert known.sum() >= 12
    far = {
        p.name: (e, s)
        for p, e, s in zip(found.parameters, error, found.std, strict=True)
        if s > 0 and abs(e) > TOO_FAR * s
    }
    assert not far


def _reported(case: Case, found: Calibration, bag: str, file: str, shell: Shell) -> None:
    report = f'{case}.html'
    imu, whole = imu_of(case.imu), case in READ_AGAIN
    # A true unit of a paper may be outside the limits that the file of an IMU gives as an example.
    judged = whole and imu.specification is not None
    code = 3 if judged and conformity(found, imu).outside else 0
    shell('report', file, *([bag, *north(case)] if whole else []), '-o', report, code=code)
    text = Path(report).read_text(encoding='utf-8')
    assert all(p.name in text for p, k in zip(found.parameters, found.std, strict=True) if k > 0)


def _verified(case: Case, file: str, shell: Shell) -> None:
    """Another session accepts the calibration, and one of another unit does not come to it."""
    next_one = following(case)
    other = shell.simulated(next_one)
    output = shell('verify', other, '--calibration', file, *north(next_one), code=None)
    if 'MARGINAL' in output:
        # One session in a hundred is a doubt by chance, calibration and recording together: two
        # of two are not.
        bag, again = shell.simulated(case, 1), f'{case}.again.yaml'
        shell('calibrate', bag, '-o', again, *north(case))
        other = shell.simulated(next_one, 2)
        output = shell('verify', other, '--calibration', again, *north(next_one), code=None)
    assert 'PASS: ' in output
    stranger = next(imu for imu in names('imus') if imu_of(imu).id != imu_of(case.imu).id)
    words = ['--imu', stranger, *north(next_one)]
    assert imu_of(stranger).id in shell('verify', other, '--calibration', file, *words, code=2)


def _compensated(case: Case, found: Calibration, bag: str, file: str, shell: Shell) -> None:
    out = f'{case}-compensated'
    shell('compensate', bag, '--calibration', file, '-o', out)
    rest = _last_rest(out)
    imu = imu_of(case.imu)
    with open_recording(Path(out)) as recording:
        text = recording.custom_data['imu_calib.imu:/imu/data_raw']
        assert 'imu_calib.imu' not in recording.custom_data
    described = read_imu(_section(text))
    assert (described.id, described.units) == (imu.id, Units.SI)
    if found.has_accelerometers:
        # The noise of the mean of so many seconds, its pulse, and the calibration's own doubt.
        seconds = 0.5
        noise = imu.accel.random_walk / np.sqrt(seconds)
        step = imu.accel.scale_factor / seconds if imu.units is Units.PULSES else 0.0
        step += imu.accel.scale_factor if imu.units is Units.COUNTS else 0.0
        doubt = float(found.std[12:15].max()) * GRAVITY + float(found.std[21:24].max())
        drift = 3 * imu.accel.bias_instability
        length = float(np.linalg.norm(rest[3:]))
        assert abs(length - GRAVITY) < 5 * np.hypot(noise, doubt) + step * np.sqrt(3) + drift + 1e-6
    if case in OF_EACH_STREAM:
        output = shell('info', out, *north(case))
        assert f'compensated by {file}' in output
        assert _supported(case, output)
    shutil.rmtree(out)


def _section(text: str):
    from imu_calib.common.config import Section

    return Section.parse(text, 'recording')


def _last_rest(bag: str) -> Floats:
    """The mean of the last half second, when the unit stands: (6,) rad/s and m/s^2."""
    rows = []
    with open_recording(Path(bag)) as recording:
        for _, block in recording.read({'/imu/data_raw': Kind.IMU}):
            rows.append(np.column_stack([block.stamp, block.gyro, block.accel]))
    values = np.vstack(rows)
    last = values[:, 0] > values[-1, 0] - 0.5e9
    return np.asarray(values[last, 1:].mean(axis=0))


def _exported(case: Case, found: Calibration, file: str, shell: Shell) -> None:
    imu = imu_of(case.imu)
    seen = np.array(found.provenance['random_walk'])
    # Of a stream without noise it is what numbers are rounded to.
    silent = any(
        sheet.bias_instability == 0
        or (sheet.random_walk == 0 and not (walk > SMALLEST_VARIANCE**0.5).any())
        for sheet, walk in ((imu.gyro, seen[:3]), (imu.accel, seen[3:]))
    )
    for kind in EXPORTS:
        target = f'{case}.{kind}'
        words = ['export', file, '--format', kind, '-o', target, '--sample-rate', '100']
        words += ['--imu', f'./{case.imu}.imu.yaml'] if kind == 'kalibr' else []
        if kind == 'kalibr' and silent:
            assert 'that imu.yaml needs: give' in shell(*words, code=2)
            assert not Path(target).exists()
            continue
        shell(*words)
        _readable(kind, Path(target).read_text())


def _readable(kind: str, text: str) -> None:
    if kind == 'imucal':
        assert json.loads(text)
    elif kind == 'c':
        assert '#ifndef' in text
        assert len(re.findall(r'-?\d+\.\d+', text)) >= 12
    else:
        assert yaml.safe_load(text)


def test_every_file_that_ships_is_in_some_combination():
    assert {c.plan for c in CASES} == {c.plan for c in WHOLE} == set(names('plans'))
    assert {c.imu for c in CASES} == {c.imu for c in WHOLE} == set(names('imus'))
    assert {c.truth for c in CASES} == {c.truth for c in WHOLE} == set(linear_truths())
