"""imu-calib compare: the same unit is the same, whatever its file says it in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imu_calib.calibration import Calibration
from imu_calib.cli.main import main
from imu_calib.errors import InputError
from imu_calib.imu import load_imu
from imu_calib.model import G_SENSITIVITY, SensorModel, Skewed, Triad, parameters_of
from imu_calib.reports.side_by_side import comparison_table, in_scale_of, side_by_side
from imu_calib.stream import Units
from imu_calib.units import DEG_H, STANDARD_GRAVITY


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
    return {str(r[1]): tuple(map(str, r[2:7])) for r in zip(*columns, strict=True)}


def test_g_sensitivities_and_skewed_gyros_are_compared_too() -> None:
    first, second = unit(), unit()
    moved = second.model.g_sensitivity + np.diag([0, 3e-6, 0])
    second = replace(second, model=replace(second.model, g_sensitivity=moved))
    found = rows(first, second)
    assert len(found) == 24 + 9 + 4
    value, other, difference, ratio, shown = found['G_gyy']
    assert float(difference) == pytest.approx(
        -3e-6 * STANDARD_GRAVITY / DEG_H, abs=0.05
    )  # as shown
    assert float(value) - float(other) == pytest.approx(float(difference), abs=0.1)
    # 3e-6 against two deviations of 1e-6.
    assert float(ratio) == pytest.approx(-3 / np.sqrt(2), abs=0.06)
    assert shown == '(deg/h)/g'
    assert all(float(row[2]) == 0 for name, row in found.items() if name != 'G_gyy')


def test_what_only_one_of_them_has_is_named() -> None:
    large, small = unit(), unit(with_g=False, skewed=False)
    only, nothing = side_by_side([large, small]).only
    assert list(only) == [p.name for p in parameters_of([G_SENSITIVITY], skewed=1)[24:]]
    assert nothing == ()
    assert len(rows(large, small)) == len(rows(small, large)) == 24


def test_another_nominal_scale_factor_is_no_difference_of_the_unit() -> None:
    first = unit()
    imu = first.imu
    assert imu.skewed is not None
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
    assert all(abs(float(row[2])) < 1e-9 for row in rows(first, second).values())


def test_pulses_and_si_are_not_compared(tmp_path: Path) -> None:
    first = unit()
    second = replace(first, imu=replace(first.imu, units=Units.SI))
    with pytest.raises(InputError, match='of pulses and of si cannot be compared'):
        rows(first, second)
    first.save(tmp_path / 'a.yaml')
    second.save(tmp_path / 'b.yaml')
    assert main(['compare', str(tmp_path / 'a.yaml'), str(tmp_path / 'b.yaml')]) == 2


def test_the_command_names_what_is_not_in_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unit().save(tmp_path / 'large.yaml')
    unit(skewed=False).save(tmp_path / 'small.yaml')
    assert main(['compare', str(tmp_path / 'large.yaml'), str(tmp_path / 'small.yaml')]) == 0
    told = capsys.readouterr().out
    assert 'Only in large: R_gsx, R_gsy, R_gsz, D_gs.' in told
    assert 'G_gzz' in told
