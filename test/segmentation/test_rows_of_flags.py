"""What holds in rows of flags is what numpy says of them."""

from __future__ import annotations

import numpy as np
import pytest

from imu_calib.segmentation.counters import all_in_row, any_in_row


@pytest.mark.parametrize('columns', [1, 3, 6])
@pytest.mark.parametrize('rows', [0, 1, 200])
def test_column_by_column_rows_are_what_they_are(rows: int, columns: int) -> None:
    flags = np.random.default_rng(0).random((rows, columns)) < 0.5
    assert any_in_row(flags).tolist() == flags.any(axis=1).tolist()
    assert all_in_row(flags).tolist() == flags.all(axis=1).tolist()
