"""imu-calib compare: the same unit is the same, whatever its file says it in."""

from dataclasses import replace

import numpy as np
import pytest
from extent import again

from imu_calib.api.compare import compare
from imu_calib.calibration.agreement import agreement
from imu_calib.calibration.calibration import Calibration
from imu_calib.cli import terminal
from imu_calib.cli.main import main
from imu_calib.common.budget import Budget, ErrorSource, Share
from imu_calib.common.errors import InputError
from imu_calib.common.stream import Units
from imu_calib.common.units import DEG_H, MICRO_G, STANDARD_GRAVITY
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.sensors import SensorModel, Skewed, Triad, parameters_of
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.reports.side_by_side import comparison_table, in_scale_of, side_by_side
from imu_calib.reports.tables import parameter_table
from imu_calib.session.imu import load_imu


def unit(*, with_g: bool = True, skewed: bool = True) -> Calibration:
    rng = np.random.default_rng(8)
    model = SensorModel(
        Triad(rng.normal(0, 1e-3, (3, 3)), rng.normal(0, 1e-5, 3)),
        Triad(rng.normal(0, 1e-3, (3, 3)), rng.normal(0, 1e-3, 3)),
        rng.normal(0, 1e-6, (3, 3)) if with_g else np.zeros((3, 3)),
        Skewed(rng.normal(0.58, 1e-3, (1, 3)), rng.normal(0, 1e-5, 1)) if skewed else None,
    )
    square = np.diag(np.full(len(model.parameters), 1e-12))
    return Calibration(load_imu('fog_skewed'), model, square, parameters=model.parameters)


def rows(first: Calibration, second: Calibration) -> dict[str, tuple[str, ...]]:
    table = comparison_table(side_by_side([first, second]), ['a', 'b'])
    columns = [list(c.cells) for c in table.columns]
    return {str(r[0]): tuple(map(str, r[1:8])) for r in zip(*columns, strict=True)}


def test_g_sensitivities_and_skewed_gyros_are_compared_too():
    first, second = unit(), unit()
    moved = second.model.g_sensitivity + np.diag([0, 3e-6, 0])
    second = replace(second, model=replace(second.model, g_sensitivity=moved))
    found = rows(first, second)
    assert len(found) == 24 + 9 + 4
    value, expanded, other, _, difference, error, shown = found['G_gyy']
    assert float(expanded) == pytest.approx(2e-6 * STANDARD_GRAVITY / DEG_H, abs=0.05)
    assert float(difference) == pytest.approx(
        -3e-6 * STANDARD_GRAVITY / DEG_H, abs=0.05
    )  # as shown
    assert float(value) - float(other) == pytest.approx(float(difference), abs=0.1)
    # E_n: 3e-6 over two expanded uncertainties of 2e-6.
    assert float(error) == pytest.approx(-3 / (2 * np.sqrt(2)), abs=0.03)
    assert shown == '(deg/h)/g'
    assert all(float(row[4]) == 0 for name, row in found.items() if name != 'G_gyy')


def test_names_units_and_order_are_those_of_a_calibration():
    first = unit()
    shown = parameter_table(first)
    names, units = (list(shown.columns[k].cells) for k in (0, 3))
    found = rows(first, first)
    assert list(found) == names
    assert [row[6] for row in found.values()] == units
    # Digits, too, up to those that the smaller difference needs.
    values = list(map(float, shown.columns[1].cells))
    assert [float(row[0]) for row in found.values()] == pytest.approx(values, abs=1e-3)


def test_what_only_one_of_them_has_is_named():
    large, small = unit(), unit(with_g=False, skewed=False)
    only, nothing = side_by_side([large, small]).only
    assert list(only) == [p.name for p in parameters_of([G_SENSITIVITY], skewed=1)[24:]]
    assert nothing == ()
    assert len(rows(large, small)) == len(rows(small, large)) == 24


def test_another_nominal_scale_factor_is_no_difference_of_the_unit():
    first = unit()
    imu = first.imu
    other = replace(
        imu,
        gyro=replace(imu.gyro, scale_factor=imu.gyro.scale_factor / 1.002),
        accel=replace(imu.accel, scale_factor=imu.accel.scale_factor * 1.01),
        skewed=replace(imu.skewed, scale_factor=imu.skewed.scale_factor * 3),
    )
    second = in_scale_of(first, replace(first, imu=other))
    assert second.model.gyro.error_matrix[0, 0] != pytest.approx(
        first.model.gyro.error_matrix[0, 0], abs=1e-3
    )
    pulses, rate = np.array([[30.0, -20.0, 70.0]]), 100.0
    compensated = [
        c.model.compensate(
            pulses * c.imu.gyro.scale_factor * rate, pulses * c.imu.accel.scale_factor * rate
        )
        for c in (first, second)
    ]
    for mine, theirs in zip(*compensated, strict=True):
        assert mine == pytest.approx(theirs, rel=1e-12)
    assert all(abs(float(row[4])) < 1e-9 for row in rows(first, second).values())


def test_rows_of_a_kind_have_the_same_decimals():
    # Deviations of different size, and a difference below all of them.
    first = unit()
    parameters = list(first.parameters)
    scale = np.geomspace(1.0, 1e-2, len(parameters))
    spread = first.covariance * np.outer(scale, scale)
    first = replace(first, covariance=spread)
    step = np.where([p.name == 'D_ax' for p in parameters], 5e-8, 2e-6)
    moved = first.model.with_values(first.parameters, first.values + step)
    found = rows(first, replace(first, model=moved))
    assert float(found['D_ax'][4]) == pytest.approx(-5e-8 / MICRO_G, rel=0.2)
    for kind in ('K_g', 'K_a', 'E_g', 'E_a', 'D_a', 'G_g'):
        cells = [row[:5] for name, row in found.items() if name.startswith(kind)]
        after = {len(cell.partition('.')[2]) for row in cells for cell in row}
        assert len(cells) >= 3 and len(after) == 1, kind


def test_two_units_are_said_to_be_two():
    """A unit without a serial number, the truth of a simulation for one, may be any."""
    first, second = (replace(unit(), serial_number=n) for n in ('A1004', 'A1005'))
    (finding,) = compare(first, second, unit()).findings
    assert 'different units, by their serial numbers A1004 and A1005' in finding
    assert compare(first, first, unit()).findings == ()


def test_other_angles_between_axes_may_be_those_of_another_unit():
    own = unit()
    values = own.values.copy()
    values[[p.name for p in own.parameters].index('E_ayz')] += 16e-6
    other = replace(own, model=own.model.with_values(own.parameters, values))
    (said,) = compare(own, other, names=('a', 'b')).findings
    # Of 16e-6 rad, where the angle, of two misalignments, has a deviation of 1.4e-6 in each.
    words = 'b and a may be of two units: accelerometers yz differs by 0.00092 deg, 8 standard'
    assert said.startswith(words)
    assert compare(own, own).findings == ()
    numbered = [replace(one, serial_number='A1') for one in (own, other)]
    assert compare(*numbered).findings == ()


def test_before_units_agree_they_are_said_to_be_two(tmp_path, capsys):
    files = [str(tmp_path / f'{number}.yaml') for number in ('A1004', 'A1005')]
    for file, number in zip(files, ('A1004', 'A1005'), strict=True):
        replace(unit(), serial_number=number).save(file)
    assert main(['compare', *files]) == 0
    shown = capsys.readouterr().out
    assert 0 < shown.index('different units') < shown.index('they agree')


def on_table(name: str, std: float) -> Calibration:
    """A calibration with a share of the errors of a table."""
    plain = replace(unit(), budget=Budget(()), provenance={'table': name})
    size = len(plain.parameters)
    return plain.with_share(ErrorSource.TABLE, Share.known(std**2 * np.eye(size)))


def test_errors_of_one_table_are_said_to_count_as_independent():
    first, exact = on_table('east', 1e-5), on_table('east', 0.0)
    (finding,) = compare(first, first).findings
    assert finding.startswith('The errors of table east are counted as independent, though 2 of')
    # Alike, it would cancel, and their own 1 ppm would be left.
    assert 'K_gx would have a standard deviation of 1.4 in place of 14 ppm' in finding
    for other in (on_table('west', 1e-5), exact, unit()):
        assert compare(first, other).findings == ()


def test_counts_and_rates_are_compared_under_a_condition():
    first = replace(unit(), imu=replace(unit().imu, units=Units.COUNTS))
    nominal = replace(first.imu.gyro, scale_factor=1.0)
    second = replace(first, imu=replace(first.imu, units=Units.SI, gyro=nominal))
    compared = compare(first, second)
    assert not compared.difference.any()
    assert 'compare only if the rates were made of counts with the scale' in compared.findings[0]


def test_pulses_and_si_are_not_compared(tmp_path):
    first = unit()
    second = replace(first, imu=replace(first.imu, units=Units.SI))
    with pytest.raises(InputError, match='of pulses and of si cannot be compared'):
        rows(first, second)
    first.save(tmp_path / 'a.yaml')
    second.save(tmp_path / 'b.yaml')
    assert main(['compare', str(tmp_path / 'a.yaml'), str(tmp_path / 'b.yaml')]) == 2


def test_the_command_names_what_is_not_in_both(tmp_path, capsys):
    unit().save(tmp_path / 'large.yaml')
    unit(skewed=False).save(tmp_path / 'small.yaml')
    assert main(['compare', str(tmp_path / 'large.yaml'), str(tmp_path / 'small.yaml')]) == 0
    output = capsys.readouterr().out
    assert 'Only in large: R_gsx, R_gsy, R_gsz, D_gs.' in output
    assert 'G_gzz' in output


SI = load_imu('si')


def drawn(rng: np.random.Generator, truth: np.ndarray, spread: np.ndarray) -> Calibration:
    """A calibration whose errors have the covariance that it states."""
    values = truth + np.linalg.cholesky(spread) @ rng.standard_normal(len(truth))
    return Calibration(SI, SensorModel.from_vector(values), spread)


def covariance(rng: np.random.Generator, scale: float) -> np.ndarray:
    """Of 24 parameters that hang together, some known ten times better than others."""
    mixed = rng.standard_normal((24, 24)) * np.geomspace(1, 10, 24)[:, None]
    return np.asarray(scale**2 * (mixed @ mixed.T / 24 + np.diag(np.geomspace(0.1, 10, 24))))


@pytest.mark.parametrize('count', [again(2), 4])
def test_chance_marks_a_parameter_in_one_of_a_hundred_comparisons_at_most(count):
    rng = np.random.default_rng(5)
    truth = rng.normal(0, 1e-4, 24)
    spreads = [covariance(rng, 1e-6 * (k + 1)) for k in range(count)]
    runs = 2000 if count == 2 else 500
    found = [
        agreement([drawn(rng, truth, spread) for spread in spreads], PARAMETERS)[0]
        for _ in range(runs)
    ]
    marked = sum(bool(one.names) for one in found)
    apart = sum(not one.consistent for one in found)
    # 1 % of the runs, and three deviations of a binomial law; Bonferroni's bound is an upper one.
    most = 0.01 * runs + 3 * np.sqrt(0.01 * runs)
    assert marked <= most
    assert 0.01 * runs - 3 * np.sqrt(0.01 * runs) <= apart <= most
    totals = np.array([one.total for one in found])
    freedom = 24 * (count - 1)
    assert found[0].total_freedom == freedom
    assert totals.mean() == pytest.approx(freedom, abs=4 * np.sqrt(2 * freedom / runs))
    each = np.array([one.chi_square for one in found]).mean(axis=0)
    assert each == pytest.approx(np.full(24, count - 1), abs=5 * np.sqrt(2 * (count - 1) / runs))


def test_what_has_moved_is_named_and_the_rest_is_not():
    rng = np.random.default_rng(6)
    truth, spread = np.zeros(24), covariance(rng, 1e-6)
    units = [drawn(rng, truth, spread) for _ in range(3)]
    place = [p.name for p in PARAMETERS].index('D_gy')
    moved = np.zeros(24)
    moved[place] = 12 * np.sqrt(spread[place, place])
    units.append(drawn(rng, truth + moved, spread))
    compared = compare(*units)
    assert compared.agreement.names == ('D_gy',)
    assert not compared.agreement.consistent
    assert compare(*units[:3]).agreement.names == ()


def test_chi_square_is_that_about_the_weighted_mean_or_about_a_truth():
    stds, values = np.array([1e-6, 2e-6, 4e-6]), np.array([1e-6, 4e-6, -3e-6])
    units = [
        Calibration(load_imu('si'), SensorModel.from_vector(np.full(24, v)), np.eye(24) * s**2)
        for v, s in zip(values, stds, strict=True)
    ]
    mean = np.sum(values / stds**2) / np.sum(1 / stds**2)
    by_hand = np.sum((values - mean) ** 2 / stds**2)
    for order in ([0, 1, 2], [2, 0, 1]):
        found = compare(*(units[k] for k in order)).agreement
        assert found.chi_square == pytest.approx(np.full(24, by_hand))
        assert set(found.freedom) == {2}
    exact = replace(units[0], covariance=np.zeros((24, 24)))
    found = compare(exact, units[1], units[2]).agreement
    about_it = np.sum((values[1:] - values[0]) ** 2 / stds[1:] ** 2)
    assert found.chi_square == pytest.approx(np.full(24, about_it))
    assert set(found.freedom) == {2}


def test_the_gravity_of_one_place_makes_no_difference_between_its_calibrations():
    doubt, here = 160e-6, {'gravity': 9.797, 'gravity_std': 160e-6 * 9.797, 'latitude_deg': 34.65}
    own = np.eye(24) * (2e-6) ** 2
    both = own.copy()
    scale = [p.name for p in PARAMETERS].index('K_ax')
    # A gravity that is wrong by e makes 1 + K wrong by e, of all three alike.
    for k in range(3):
        for j in range(3):
            both[scale + k, scale + j] += doubt**2
    values = np.zeros(24)
    first = Calibration(load_imu('si'), SensorModel.from_vector(values), both, provenance=here)
    values = values.copy()
    values[scale] = 20e-6
    second = replace(first, model=SensorModel.from_vector(values))
    # 20 ppm are seven deviations of two sessions, and an eleventh of one of gravity.
    assert compare(first, second).agreement.names == ('K_ax',)
    # It is in each U, and cancels in E_n: half of the difference over its deviation.
    found = compare(first, second)
    assert found.e_n == pytest.approx(found.normalised / 2)
    assert -4 < found.e_n[scale] < -3
    elsewhere = replace(second, provenance={**here, 'latitude_deg': 50.0})
    assert compare(first, elsewhere).agreement.names == ()


def test_no_head_and_no_unit_is_cut_in_a_narrow_terminal(tmp_path, capsys, monkeypatch):
    files = [tmp_path / f'a_long_name_of_a_unit_{k}.yaml' for k in range(3)]
    for file in files:
        unit().save(file)
    monkeypatch.setattr(terminal.OUTPUT, 'width', 40)
    assert main(['compare', *map(str, files)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if '\u2026' in line] == []
    head = next(line for line in lines if line.startswith('parameter'))
    row = next(line for line in lines if line.startswith('K_gx'))
    assert row.rstrip().endswith('ppm')
    assert head.index('unit') == row.index('ppm')
    assert lines[0] == '(1) a_long_name_of_a_unit_0, fog_skewed'
