"""Tables whose files state that they are exact, and that are wrong by one second of arc."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from extent import again
from sessions import SITE, fed, quick_plan, session, stand, truth

from imu_calib.calibration.results import Result
from imu_calib.cli.main import main
from imu_calib.common.config import Section
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCSEC
from imu_calib.estimation import joint
from imu_calib.estimation.exact_table import with_least_errors
from imu_calib.estimation.setup import Setup
from imu_calib.estimation.solution import Solution
from imu_calib.model.parameters import PARAMETERS
from imu_calib.session.imu import load_imu
from imu_calib.session.table import Table, load_table, read_table
from imu_calib.session.table_errors import FINEST, TableErrors
from imu_calib.simulation.true_table import TableSizes, TrueTable

TABLE = load_table('three_axis')
PLAN = quick_plan('twelve_position', 20.0)
NAVIGATION = load_imu('fog_navigation')
ONE = 1 * ARCSEC
WRONG = {
    'zeros': {'true': TableSizes(zeros=ONE)},
    'orthogonality': {'true': TableSizes(orthogonality=ONE)},
    'wobble': {'true': TableSizes(wobble=(ONE, ONE))},
    'encoder': {'true': TableSizes(encoder=(ONE, ONE))},
    'positioning': {'stop_error': ONE},
    'all': {
        'true': TableSizes(
            zeros=ONE, orthogonality=ONE, wobble=(ONE, ONE), encoder=(ONE, ONE)
        ),
        'stop_error': ONE,
    },
}  # fmt: skip
KEYS = ('positioning', 'zeros', 'orthogonality', 'wobble', 'encoder')
OTHERS = re.compile('positioning errors|attitude errors|The session shows|Outlier|drift by|scatter')
"""What findings would blame."""


def solved(wrong: str, seed: int) -> Solution:
    return finished(wrong, seed).solution


@cache
def finished(wrong: str, seed: int) -> Result:
    """A navigation-grade unit on a table that is wrong by as much, and is stated exact."""
    options = dict(WRONG.get(wrong, {}))
    if 'true' in options:
        options['true'] = TrueTable.drawn(TABLE, options['true'], seed)
    blocks = session(PLAN, stand(**options), seed=seed, spec=NAVIGATION)
    setup = Setup(NAVIGATION, PLAN, TABLE, SITE, search_terms=True)
    return fed(blocks, setup).finish()


def off(solution: Solution) -> Floats:
    return np.abs(solution.model.vector() - truth().model.vector()) / solution.std[:24]


ONCE = [('all', 0), ('zeros', 2)]
CASES = [
    (wrong, seed) if (wrong, seed) in ONCE else again(wrong, seed)
    for wrong in WRONG
    for seed in range(8)
]


@pytest.mark.parametrize(('wrong', 'seed'), CASES)
def test_an_arcsecond_on_a_table_that_is_stated_exact_is_never_silently_wrong(
    wrong: str, seed: int
) -> None:
    solution = solved(wrong, seed)
    (finding,) = [f for f in solution.findings if 'table three_axis' in f]
    assert not [f for f in solution.findings if OTHERS.search(f)]
    if 'The session contradicts' in finding:
        # Which error it is, the session does not tell: as much is assumed of each.
        assert off(solution).max() < 4.5
        return
    for k in np.flatnonzero(off(solution) > 4.5):
        # What no sensor shows turns all misalignments alike, and is said.
        assert PARAMETERS[k].name.startswith('E')
        assert f'E_{PARAMETERS[k].triad}' in finding


def test_what_a_session_shows_of_them_is_counted_as_of_the_best_tables() -> None:
    solution = solved('all', 0)
    (finding,) = [f for f in solution.findings if 'table three_axis' in f]
    assert finding.startswith('Warning: The session contradicts table three_axis, which states')
    assert solution.search is not None
    table = solution.search.estimate.equations.evidence.table
    assert table is not None
    assert table.raised == KEYS and table.described is TABLE and table.understated_errors == ()
    assert table.errors == TableErrors(*[FINEST] * 4) and table.positioning == FINEST
    stated = finished('all', 0).calibration.provenance
    assert stated['table_errors'] == {**dict.fromkeys(KEYS, FINEST), 'level': TABLE.level}
    assert stated['table_errors_assumed'] == list(KEYS)


def test_an_exact_table_widens_nothing_and_says_what_that_rests_on() -> None:
    solution = solved('', 0)
    assert off(solution).max() < 4.5
    assert solution.search is not None
    estimate = solution.search.estimate
    evidence = estimate.equations.evidence
    assert evidence.table is TABLE
    (finding,) = solution.findings
    there = joint.solve(with_least_errors(evidence))
    # It is known before that what the deviations would be, without fitting once more.
    for name, minute in re.findall(r'([\d.]+) arcmin of (E_\w+)', finding):
        k = next(k for k, p in enumerate(PARAMETERS) if p.name == minute)
        assert there.std[k] == pytest.approx(float(name) * 60 * ARCSEC, rel=0.1)
        assert there.std[k] > 5 * solution.std[k]


def test_a_real_table_is_not_stated_better_than_any_is_known() -> None:
    joints = '\n'.join(
        f'  - {{name: {name}, axis: {axis}, max_rate: 9 deg/s, max_acceleration: 9 deg/s^2}}'
        for name, axis in (('outer', 'z'), ('inner', 'x'))
    )
    stated = '\n'.join(f'{key}: 0 arcsec' for key in KEYS[:-1])
    text = f'name: ours\njoints:\n{joints}\n{stated}\nencoder: 1 arcsec\nlevel: 0.5 arcsec\n'
    table = read_table(Section.parse(text, 'ours.yaml'))
    assert (table.raised, table.assumed, table.understated_errors) == (KEYS[:-1], (), ())
    assert table.positioning == FINEST
    assert table.errors == TableErrors(FINEST, FINEST, FINEST, pytest.approx(ONE))
    assert table.level == pytest.approx(0.5 * ARCSEC)
    assert table.assumption == (
        'Table ours states less than 1 arcsec of positioning, zeros, orthogonality, wobble, which '
        'no known table reaches: 1 arcsec is used.'
    )
    simulated = read_table(Section.parse(f'{text}simulated: true\n', 'ours.yaml'))
    assert (simulated.raised, simulated.assumption) == ((), '')
    assert simulated.understated_errors == KEYS[:-1]
    alone: Table = replace(simulated, joints=simulated.joints[:1])
    assert alone.understated_errors == ('positioning', 'wobble')


def test_a_prediction_says_what_it_rests_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['plans', 'twelve_position', '--imu', 'fog_navigation']) == 0
    shown = ' '.join(capsys.readouterr().out.split())
    assert 'Table three_axis is described as better than any real one' in shown
    assert main(['plans', 'six_position_by_hand', '--imu', 'mems_counts']) == 0
    assert 'than any real one' not in capsys.readouterr().out
