"""Repeated sessions: seeds decide, and the table says what they came to."""

import sys
from dataclasses import replace
from importlib.metadata import requires

import numpy as np
import pytest
from sessions import study

import imu_calib
from imu_calib.api import simulate as repeating
from imu_calib.cli.main import main
from imu_calib.common.files import named_file
from imu_calib.common.units import ARCSEC
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.session.table import load_table
from imu_calib.session.table_errors import TableErrors
from imu_calib.simulation.repetition import Run, RunStatistics, repeat


def test_the_outcome_depends_on_seeds_and_not_on_processes():
    shown: list[tuple[int, int]] = []
    alone = repeat(study(), 4, seed=7, jobs=1, show=lambda *at: shown.append(at))
    together = repeat(study(), 4, seed=7, jobs=2)
    np.testing.assert_array_equal(alone.errors, together.errors)
    assert [run.seed for run in together.runs] == [7, 8, 9, 10]
    assert shown == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len(np.unique(alone.errors[:, 0])) == 4


def test_what_is_refused_is_counted_and_left_out():
    outcome = repeat(study('six_position'), 1, jobs=1)
    assert 'north' in outcome.refused[0].refusal
    assert len(outcome.errors) == 0


def test_figures_are_those_of_the_errors():
    rng = np.random.default_rng(1)
    errors = 2.0 + 3.0 * rng.standard_normal((2000, 24))
    runs = tuple(Run(k, PARAMETERS, row, np.full(24, 6.0)) for k, row in enumerate(errors))
    outcome = RunStatistics(runs)
    # Five deviations of the mean and of the spread of 2000 normal numbers.
    assert outcome.bias == pytest.approx(2.0, abs=5 * 3 / np.sqrt(2000))
    assert outcome.spread == pytest.approx(3.0, abs=5 * 3 / np.sqrt(4000))
    assert outcome.mean_stated == pytest.approx(6.0)
    assert outcome.normalised == pytest.approx(errors / 6)


def test_command_line(capsys, tmp_path):
    target = tmp_path / 'study.png'
    arguments = ['montecarlo', 'twelve_position', '--runs', '2', '--jobs', '1', '-o', str(target)]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert 'spread/stated' in shown
    assert '2 runs of plan twelve_position' in shown
    assert target.read_bytes().startswith(b'\x89PNG')
    assert main(['montecarlo', 'six_position', '--method', 'six_position', '--runs', '1']) == 1
    assert main(['montecarlo', 'free_positions', '--table', 'three_axis', '--runs', '1']) == 2
    assert main(['montecarlo', 'twelve_position', '--runs', '0']) == 2
    assert main(['montecarlo', 'twelve_position', '--runs', f'{10**30}']) == 2


@pytest.mark.parametrize(
    ('installed', 'name', 'words'),
    [
        (False, 'study.png', [f"{sys.executable} -m pip install '.[plot]'", '--output']),
        (True, 'study.xyz', ["found the ending '.xyz'", 'png', 'svg']),
    ],
)
def test_a_plot_that_cannot_be_drawn_is_refused_before_the_first_run(
    monkeypatch, capsys, tmp_path, installed, name, words
):
    if not installed:
        monkeypatch.setitem(sys.modules, 'matplotlib', None)
    monkeypatch.setattr(repeating, 'repeat', lambda *_: pytest.fail('it runs'))
    arguments = ['montecarlo', 'twelve_position', '--runs', '1', '-o', str(tmp_path / name)]
    assert main(arguments) == 2
    errors = ' '.join(capsys.readouterr().err.split())
    assert all(word in errors for word in words), errors
    assert not list(tmp_path.iterdir())


def test_what_draws_is_an_extra_of_its_own():
    extras = [r for r in requires('imu_calib') or [] if r.startswith('matplotlib')]
    assert {r.split('extra ==')[1].strip(' "\'') for r in extras} == {'plot', 'test', 'dev'}


def test_a_plan_in_the_hand_is_of_a_unit_that_is_held(tmp_path):
    free, held = 'free_positions', 'mems_counts'
    true = {
        n: imu_calib.Calibration.load(named_file('truths', n)) for n in (held, 'cao2022_table1')
    }
    done = imu_calib.simulate(free, tmp_path / 'bag', seed=1)
    assert done.truth.imu.id == held
    np.testing.assert_array_equal(done.truth.values, true[held].values)
    assert imu_calib.montecarlo(free, runs=1).setup.imu.id == held
    assert imu_calib.predict(free, held).std == imu_calib.predict(free, held, truth=held).std
    on_table = imu_calib.simulate('static_six', tmp_path / 'table').truth
    assert on_table.imu.id == 'fog_medium'
    np.testing.assert_array_equal(on_table.values, true['cao2022_table1'].values)


@pytest.mark.parametrize('plan', ['free_positions', 'six_position_by_hand'])
def test_a_plan_in_the_hand_is_repeated(plan):
    found = imu_calib.montecarlo(plan, 'mems_counts', runs=4, seed=5)
    outcome = found.outcome
    assert not outcome.refused
    known = outcome.mean_stated > 0
    # Of four sessions with 18 to 21 normal errors each: the mean square is 1 within five standard
    # deviations of a chi-square of 72.
    square = float((outcome.normalised[:, known] ** 2).mean())
    assert square == pytest.approx(1.0, abs=5 * np.sqrt(2 / (4 * known.sum())))


def test_the_errors_that_a_table_states_are_drawn_for_each_run():
    """As the standard deviations count them: of an exact table their ratio is far below one."""
    errors = TableErrors(zeros=300 * ARCSEC, orthogonality=300 * ARCSEC, wobble=0.0, encoder=0.0)
    one = study()
    leaning = replace(load_table('three_axis'), errors=errors)
    runs = repeat(replace(one, setup=replace(one.setup, table=leaning, method=None)), 4, jobs=1)
    exact = repeat(replace(one, setup=replace(one.setup, method=None)), 4, jobs=1)
    of_angles = [k for k, p in enumerate(runs.parameters) if p.kind is ParameterKind.MISALIGNMENT]
    assert np.abs(runs.errors[:, of_angles]).max() > 5 * np.abs(exact.errors[:, of_angles]).max()
    # Some tens of standard normal numbers, of few independent errors.
    assert 0.3 < np.sqrt((runs.normalised[:, of_angles] ** 2).mean()) < 2.0
