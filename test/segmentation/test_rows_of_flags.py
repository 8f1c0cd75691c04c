"""What holds in rows of flags is what numpy says of them."""

from __future__ import annotations

import numpy as np
import pytest

from imu_calib.segmentation.counters import all_in_row, any_in_row, by_columns


@pytest.mark.parametrize('columns', [1, 3, 6])
@pytest.mark.parametrize('rows', [0, 1, 200])
def test_column_by_column_rows_are_what_they_are(rows: int, columns: int) -> None:
    flags = np.random.default_rng(0).random((rows, columns)) < 0.5
    assert any_in_row(flags).tolist() == flags.any(axis=1).tolist()
    assert all_in_row(flags).tolist() == flags.all(axis=1).tolist()


@pytest.mark.parametrize('rows', [1, 63, 64, 200])
def test_columns_reduced_abreast_are_what_they_are(rows: int) -> None:
    values = np.random.default_rng(0).normal(size=(rows, 6))
    flags = values > 1.0
    assert by_columns(np.maximum, values).tolist() == values.max(axis=0).tolist()
    assert by_columns(np.maximum, values[:, :3]).tolist() == values[:, :3].max(axis=0).tolist()
    assert by_columns(np.logical_or, flags).tolist() == flags.any(axis=0).tolist()
    assert by_columns(np.logical_and, flags).tolist() == flags.all(axis=0).tolist()
