"""A table whose axes, zeros and encoders are not quite what its file says, told so or not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from evidence import evidence_of
from sessions import (
    SITE,
    at_one_rate,
    calibrate,
    fed,
    gathered,
    paper_imu,
    quick_plan,
    session,
    stand,
    truth,
)

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.calibrator import Calibrator
from imu_calib.calibration.results import Result, assumption_findings
from imu_calib.cli.main import main
from imu_calib.cli.terminal import print_findings, show_calibration
from imu_calib.common.budget import ErrorSource
from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.common.files import share_folder
from imu_calib.common.finding import by_effect
from imu_calib.common.stream import Floats
from imu_calib.common.units import ARCMIN, ARCSEC
from imu_calib.estimation import joint
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.forecast import information, state_at
from imu_calib.estimation.information import Information
from imu_calib.estimation.joint import _scatter_findings
from imu_calib.estimation.positioning_errors import PositioningErrors
from imu_calib.estimation.predict import expected
from imu_calib.estimation.setup import Setup
from imu_calib.model.alignment import free_of_frame
from imu_calib.model.parameters import PARAMETERS, ParameterKind
from imu_calib.segmentation.clock import fit_clock
from imu_calib.session.imu import load_imu
from imu_calib.session.table import ASSUMED, Table, load_table, read_table
from imu_calib.session.table_errors import LEVELLED, TableErrors
from imu_calib.simulation.true_table import TableSizes, TrueTable

TABLE = load_table('three_axis')
SIZES = {
    'zeros': 30 * ARCSEC,
    'orthogonality': 10 * ARCSEC,
    'wobble': 3 * ARCSEC,
    'encoder': 3 * ARCSEC,
}


def about(vector: Floats) -> Floats:
    """The rotation by a vector's length about it, by the series of the exponential."""
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    total, power = np.eye(3), np.eye(3)
    for k in range(1, 40):
        power = power @ cross / k
        total = total + power
    return total


ANGLES = np.array([[0.7, -1.1, 2.3], [-2.9, 0.4, 1.2], [0.0, np.pi / 2, -np.pi / 2]])
Z, X, Y = np.eye(3)[2], np.eye(3)[0], np.eye(3)[1]
AXES, SMALL = (Z, X, Z), 1e-6


def attitude(angles: Floats, change) -> Floats:
    """A table with one error: `change(joint, angle)` gives axis, further angle, and lean before."""
    result = np.eye(3)
    for k, angle in enumerate(angles):
        axis, more, lean = change(k, angle)
        result = result @ about(lean) @ about(axis * (angle + more))
    return result @ TABLE.mount


def lean_of(change) -> Floats:
    """How the body turns about its own axes by one error, (n, 3) per unit of it."""
    found = []
    for angles in ANGLES:
        right = attitude(angles, lambda k, a: (AXES[k], 0.0, np.zeros(3)))
        turned = right.T @ attitude(angles, change)
        found.append([turned[2, 1], turned[0, 2], turned[1, 0]])
    return np.array(found) / SMALL


def spans(columns: Floats, wanted: Floats) -> bool:
    """Whether errors, all angles together, are combinations of columns (n, 3, e)."""
    columns = columns.reshape(-1, columns.shape[2])
    wanted = wanted.ravel()
    residuals = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return bool(np.abs(residuals).max() < 1e-5)


def of_joint(which: int, more=None, lean=None):
    """A change of one joint alone."""

    def change(k: int, a: float):
        if k != which:
            return AXES[k], 0.0, np.zeros(3)
        return (
            AXES[k],
            0.0 if more is None else SMALL * more(a),
            np.zeros(3) if lean is None else SMALL * lean(a),
        )

    return change


@pytest.mark.parametrize('joint_number', [1, 2])
def test_a_zero_and_an_encoder_turn_the_body_as_the_table_would(joint_number) -> None:
    zeros = replace(TABLE, errors=TableErrors(zeros=1.0)).attitude_errors(ANGLES)
    assert spans(zeros, lean_of(of_joint(joint_number, more=lambda a: 1.0)))
    encoder = replace(TABLE, errors=TableErrors(encoder=1.0)).attitude_errors(ANGLES)
    assert encoder.shape[2] == 12
    assert spans(encoder[:, :, 4 * joint_number :], lean_of(of_joint(joint_number, more=np.cos)))
    twice = lean_of(of_joint(joint_number, more=lambda a: np.sin(2 * a)))
    (column,) = [
        c for c in np.moveaxis(encoder, 2, 0) if np.allclose(c * np.sqrt(2), twice, atol=1e-5)
    ]
    assert column.shape == (3, 3)


@pytest.mark.parametrize('joint_number', [1, 2])
@pytest.mark.parametrize('direction', [0, 1])
def test_an_axis_that_leans_turns_the_body_as_the_table_would(joint_number, direction) -> None:
    across = (Y, Z) if joint_number == 1 else (X, Y)
    columns = replace(TABLE, errors=TableErrors(orthogonality=1.0)).attitude_errors(ANGLES)
    assert columns.shape[2] == 4
    mine = columns[:, :, 2 * (joint_number - 1) : 2 * joint_number]
    # The frame that it turns leans with it.
    assert spans(mine, lean_of(of_joint(joint_number, lean=lambda a: across[direction])))
    wobble = replace(TABLE, errors=TableErrors(wobble=1.0)).attitude_errors(ANGLES)
    once = of_joint(joint_number, lean=lambda a: across[direction] * np.cos(a))
    assert spans(wobble[:, :, 8 * joint_number : 8 * (joint_number + 1)], lean_of(once))


PLAN = quick_plan('twelve_position', 20.0)
BRIEF = at_one_rate(PLAN)


def true_table(sizes: Mapping[str, float], seed: int) -> TrueTable:
    """A table that is off by as much, drawn once per seed."""
    pairs = {k: (v, v) if k in {'wobble', 'encoder'} else v for k, v in sizes.items()}
    return TrueTable.drawn(TABLE, TableSizes(**pairs), seed)


@cache
def recorded(seed: int) -> Evidence:
    """A session on a table with all of it; its description says how large."""
    options = replace(stand(), true=true_table(SIZES, seed))
    stated_table = replace(TABLE, errors=TableErrors(**SIZES))
    blocks = session(BRIEF, options, seed=seed)
    return gathered(fed(blocks, Setup(paper_imu(), BRIEF, stated_table, SITE, None)))


SILENT = """
name: ours
joints:
  - {name: outer, axis: z, max_rate: 400 deg/s, max_acceleration: 200 deg/s^2}
  - {name: middle, axis: x, max_rate: 200 deg/s, max_acceleration: 100 deg/s^2}
  - {name: inner, axis: z, max_rate: 400 deg/s, max_acceleration: 200 deg/s^2}
"""
"""The shipped table without a word of how good it is."""


def described(more: str = '') -> Table:
    return read_table(Section.parse(SILENT + more, 'ours.yaml'))


@pytest.fixture(scope='module')
def unstated() -> Result:
    """A session on a laboratory's table, as good as is assumed, whose file says nothing of it."""
    sizes = {f.name: ASSUMED[f.name] for f in fields(TableErrors)}
    options = stand(
        true=true_table(sizes, 3),
        positioning_error=np.sqrt(3) * ASSUMED['positioning'],
        tilt=(ASSUMED['level'], -ASSUMED['level']),
    )
    return calibrate(session(BRIEF, options, seed=3), BRIEF, table=described())


@pytest.mark.parametrize('seed', [1, 2])
def test_a_table_that_says_what_it_may_be_off_is_answered_honestly(seed) -> None:
    solution = joint.solve(recorded(seed))
    off = (solution.model.vector() - truth().model.vector()) / solution.std
    assert np.abs(off).max() < 4.5
    assert solution.findings == ()


def test_a_table_that_is_taken_as_exact_is_not() -> None:
    solution = joint.solve(replace(recorded(2), table=None))
    off = (solution.model.vector() - truth().model.vector()) / solution.std
    assert np.abs(off).max() > 8


def test_the_budget_has_a_line_for_it() -> None:
    solution = joint.solve(recorded(1))
    exact = joint.solve(replace(evidence_of(), table=TABLE))
    share = solution.shares[ErrorSource.TABLE].covariance
    # Misalignments are against axes that nobody knows better; biases of gyros hardly feel them.
    assert np.sqrt(share[3, 3]) > 0.5 * solution.std[3]
    assert np.sqrt(share[9, 9]) < 0.2 * solution.std[9]
    assert ErrorSource.TABLE not in exact.shares


def test_what_a_file_leaves_out_is_assumed_and_not_exact(unstated: Result) -> None:
    calibration = unstated.calibration
    off = (calibration.values - truth().model.vector()) / calibration.std
    assert np.abs(off).max() < 4.5
    misaligned = [k for k, p in enumerate(PARAMETERS) if p.kind is ParameterKind.MISALIGNMENT]
    # The doubt of the last zero is whole in some of them, and far above the noise.
    whole = ASSUMED['zeros']
    assert calibration.std[misaligned].max() == pytest.approx(whole, rel=0.1)
    assert {line.source for line in calibration.budget.lines} > {
        ErrorSource.TABLE,
        ErrorSource.POSITIONING_STATED,
    }


def test_what_is_assumed_is_said_once_with_figures_and_keys(unstated: Result) -> None:
    calibration = unstated.calibration
    (sentence,) = [f for f in calibration.findings if 'assumed' in f]
    assert sentence.startswith('Table ours ')
    for key, size in ASSUMED.items():
        assert f'{key} {size / ARCSEC:g} arcsec' in sentence
    assert Calibration.from_yaml(calibration.to_yaml(), 'c').findings == calibration.findings


def test_the_screen_says_it_once_and_shows_the_angles(unstated: Result, capsys) -> None:
    show_calibration(unstated.calibration, verbose=True)
    print_findings(unstated.calibration.findings, verbose=True)
    shown = capsys.readouterr().out
    assert ' '.join(shown.split()).count(described().assumption) == 1
    (row,) = [line.split() for line in shown.splitlines() if 'gyros to accelerometers Z' in line]
    (angles,) = [a for a in unstated.calibration.free_of_frame if a.group.triads == 'ga']
    assert float(row[4]) == pytest.approx(angles.values[2] / ARCMIN, abs=0.001)


def test_arrivals_worse_than_assumed_are_not_held_against_a_statement() -> None:
    silent = described('zeros: 0 arcsec\n')
    for table, words in (
        (silent, '2 arcsec are assumed of the table'),
        (replace(silent, assumed=()), "the table's description states 2 arcsec"),
    ):
        evidence = replace(evidence_of(), table=table, positioning=table.positioning)
        found = estimate(evidence)
        off = replace(
            found.scatter,
            positioning=PositioningErrors(joints=10 * ARCSEC),
            probability=1.0,
            positioning_probability=1.0,
        )
        (sentence,) = [
            f for f in _scatter_findings(replace(found, scatter=off)) if 'positioning errors' in f
        ]
        assert words in sentence


def test_a_method_that_counts_no_errors_of_a_table_assumes_none(unstated: Result) -> None:
    setup = Setup(paper_imu(), PLAN, described('clock: 0 ppm\n'), SITE)
    counted = unstated.solution
    assert assumption_findings(setup, counted) == [described().assumption]
    # The skewed gyros' method tells no sources: what is not counted is not said to be.
    assert assumption_findings(setup, replace(counted, shares=None)) == []


@pytest.mark.parametrize(
    ('imu', 'more', 'said'),
    [
        ('fog_medium', '', True),
        ('increments', '', True),
        # Rates do not make K_a depend on the table's clock.
        ('si', '', False),
        ('fog_medium', 'clock: 0 ppm\n', False),
        ('fog_medium', 'simulated: true\n', False),
    ],
)
def test_a_clock_that_is_not_stated_is_a_note_where_samples_are_increments(
    unstated: Result, imu: str, more: str, said: bool
) -> None:
    setup = Setup(load_imu(imu), PLAN, described(more), SITE)
    notes = [n for n in assumption_findings(setup, unstated.solution) if 'clock of table' in n]
    assert ['no K_a has an uncertainty of it' in note for note in notes] == [True] * said
    # Before every note that changes less, as a gravity without a standard deviation.
    assert by_effect(['another', *notes], None)[: len(notes)] == tuple(notes)


def test_a_session_on_such_a_table_is_reviewed_from_its_first_block_on() -> None:
    # What a review finds at first: nothing at all, then turns, then a rest as well.
    calibrator = Calibrator(Setup(paper_imu(), PLAN, described(), SITE))
    calls = set()
    for count, (_, block) in enumerate(islice(session(PLAN, seed=1), 500)):
        if count % 20 == 0:
            review = calibrator.snapshot().review()
            assert review.result is None and review.refusal
            calls.add((bool(review.session.segments), bool(review.session.turns)))
        if len(calls) == 3:
            break
        calibrator.add_block(block)
    assert calls == {(False, False), (False, True), (True, True)}


def test_nothing_is_assumed_of_a_table_that_states_all_nor_without_one() -> None:
    for file in (share_folder() / 'config' / 'tables').glob('*.yaml'):
        table = load_table(file.stem)
        assert (table.assumed, table.assumption, table.positioning) == ((), '', 0.0)
        assert table.errors.exact
        assert table.level == LEVELLED == 20 * ARCSEC
    alone = calibrate(session(BRIEF, seed=1), BRIEF, imu_only=True).calibration
    assert not any('assumed' in finding for finding in alone.findings)
    assert ErrorSource.TABLE not in {line.source for line in alone.budget.lines}
    hand = Evidence((), (), PLAN, SITE, fit_clock([]), None, np.ones(6))
    assert (hand.levelling, hand.positioning) == (LEVELLED, 0.0)


def test_a_file_may_state_some_and_leave_the_others() -> None:
    stated = 'zeros: 1 arcsec\nlevel: 5 arcsec\npositioning: 0 arcsec\nsimulated: true\n'
    table = described(stated)
    assert table.assumed == ('orthogonality', 'wobble', 'encoder')
    assert (table.errors.zeros, table.level, table.positioning) == (ARCSEC, 5 * ARCSEC, 0.0)
    assert table.errors.wobble == ASSUMED['wobble']
    assert 'zeros' not in table.assumption and 'orthogonality 30 arcsec' in table.assumption
    # One axis alone has no other to be at right angles to, and its zero is the azimuth.
    lines = SILENT.splitlines()
    one = read_table(Section.parse('\n'.join(lines[:4]), 'one.yaml'))
    assert one.assumed == ('positioning', 'level', 'wobble', 'encoder')
    with pytest.raises(InputError, match='level: found 0 deg, expected more than 0 to 1 deg'):
        described('level: 0 arcsec\n')


def test_a_prediction_says_what_it_assumes(tmp_path: Path, capsys) -> None:
    (tmp_path / 'ours.yaml').write_text(SILENT, encoding='utf-8')
    asked = ['plans', 'twelve_position', '--imu', 'fog_medium', '--table']
    assert main([*asked, str(tmp_path / 'ours.yaml')]) == 0
    assert ' '.join(capsys.readouterr().out.split()).count(described().assumption) == 1
    assert main([*asked, 'three_axis']) == 0
    assert 'assumed' not in capsys.readouterr().out


@pytest.mark.parametrize('level', [5 * ARCSEC, 60 * ARCSEC])
def test_the_level_that_a_table_states_is_the_prior_of_its_tilts(level: float) -> None:
    # Six positions do not see one of the tilts: it is in how channel z answers to X (test_budget).
    # Accelerometers in turns would: those that no table times do not count.
    evidence = replace(evidence_of('six_position'), azimuth=0.0, table=replace(TABLE, level=level))
    evidence = replace(evidence, turns=tuple(replace(t, seconds=None) for t in evidence.turns))
    share = joint.solve(evidence).shares[ErrorSource.TILT].covariance
    place = next(k for k, p in enumerate(PARAMETERS) if p.name == 'E_azx')
    assert np.sqrt(share[place, place]) == pytest.approx(level, rel=0.01)


@pytest.mark.parametrize('seed', [1, 2])
def test_angles_between_input_axes_are_told_by_sensors_and_moves_on_any_table(seed: int) -> None:
    evidence = recorded(seed)
    solution = joint.solve(evidence)
    found = free_of_frame(solution.model, solution.covariance, PARAMETERS)
    right = free_of_frame(truth().model, np.zeros((24, 24)), PARAMETERS)
    for angles, true in zip(found, right, strict=True):
        assert np.abs((angles.values - true.values) / angles.std).max() < 4.5
    std = np.concatenate([angles.std for angles in found])
    misaligned = [k for k, p in enumerate(PARAMETERS) if p.kind is ParameterKind.MISALIGNMENT]
    assert solution.std[misaligned].max() > 0.9 * SIZES['zeros'] > 5 * std.max()
    # A hundred times the doubt of axes and zeros: they stay what sensors and moves tell of them.
    vague = replace(TableErrors(**SIZES), zeros=3000 * ARCSEC, orthogonality=1000 * ARCSEC)
    equations = Equations(replace(evidence, table=replace(TABLE, errors=vague)))
    state = state_at(equations, solution.model)
    unknown = Information.from_jacobian(equations.whitened(state)[0]).covariance[:24, :24]
    assert np.sqrt(np.diag(unknown))[misaligned].max() > 90 * SIZES['zeros']
    widened = np.concatenate([a.std for a in free_of_frame(solution.model, unknown, PARAMETERS)])
    assert np.all(widened < 1.2 * std)


DOCUMENT = Path(__file__).parents[2] / 'docs' / 'tables.md'
BOTH = TableErrors(zeros=30 * ARCSEC, orthogonality=30 * ARCSEC)


def predicted(imu: str, table: Table, *, moves: bool) -> list[float]:
    """Largest deviations of misalignments, angles within triads and between them, microradians."""
    positions = tuple(replace(p, dwell=40.0 if p.dwell else 0.0) for p in PLAN.positions)
    setup = Setup(load_imu(imu), replace(PLAN, positions=positions), table, SITE)
    evidence = expected(setup, truth().model)
    evidence = evidence if moves else replace(evidence, moves=())
    square = information(evidence, truth().model).covariance[:24, :24]
    misaligned = [k for k, p in enumerate(PARAMETERS) if p.kind is ParameterKind.MISALIGNMENT]
    gyros, accels, both = free_of_frame(truth().model, square, PARAMETERS)
    within = max(gyros.std.max(), accels.std.max())
    return [v * 1e6 for v in (np.sqrt(np.diag(square))[misaligned].max(), within, both.std.max())]


@pytest.mark.parametrize(
    ('row', 'table', 'moves'),
    [
        ('exact', TABLE, True),
        ('`zeros: 30', replace(TABLE, errors=replace(BOTH, orthogonality=0.0)), True),
        ('and `orthogonality', replace(TABLE, errors=BOTH), True),
        ('the same without', replace(TABLE, errors=BOTH), False),
        ('nothing stated', described(), True),
    ],
)
def test_the_figures_of_the_page_are_those_of_the_prediction(
    row: str, table: Table, moves: bool
) -> None:
    line = next(x for x in DOCUMENT.read_text().splitlines() if x.startswith(f'| {row}'))
    shown = [float(cell) for cell in line.strip('|').split('|')[1:]]
    found = [
        v for imu in ('fog_navigation', 'fog_medium') for v in predicted(imu, table, moves=moves)
    ]
    # Two digits are shown.
    assert shown == pytest.approx(found, rel=0.05)


def test_sizes_are_read_and_kept_within_reason() -> None:
    joint_of = '{name: a, axis: z, max_rate: 9 deg/s, max_acceleration: 9 deg/s^2}'
    text = f'name: t\njoints: [{joint_of}]\n'
    lines = ''.join(f'{f.name}: {k + 1} arcsec\n' for k, f in enumerate(fields(TableErrors)))
    errors = read_table(Section.parse(text + lines, 'table.yaml')).errors
    assert errors == TableErrors(*(ARCSEC * k for k in (1, 2, 3, 4)))
    assert TABLE.errors.exact
    with pytest.raises(InputError, match='wobble: found 2 deg, expected 0 to 1 deg'):
        read_table(Section.parse(text + 'wobble: 2 deg\n', 'table.yaml'))
