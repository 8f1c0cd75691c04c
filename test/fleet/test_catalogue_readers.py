"""A catalogue in the readers of others, also one that grew over versions of its columns.

docs/interoperability.md says what was seen, with the versions.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from installed import needs_modules

from imu_calib.fleet.catalogue import Catalogue, schema
from imu_calib.fleet.recordings import Job
from imu_calib.fleet.task import TaskResult, failed

needs_modules('pyarrow', 'duckdb', 'pandas')

LACKING = {1: ['lot', 'limits', 'topic', 'simulated'], 2: ['topic', 'simulated']}
"""Columns that a version does not have (docs/fleet.md)."""
GROWN = (1, 1, 2)
"""Versions of the parts, one row each; of row 0 the recording failed."""
ROWS = 4
"""With the one that this version adds."""


def row(k: int) -> TaskResult:
    """A row without a recording behind it."""
    made = failed(Job(f'r{k}'), f'{k:032x}', '', 'It failed.', 2)
    return TaskResult(made['key'], made if k == 0 else {**made, **numbers(k)})


def numbers(k: int) -> dict[str, Any]:
    return {
        'K_gx': k + 0.25,
        'samples': 6000 + k,
        'lot': f'lot {k}',
        'topic': f'/imu_{k}',
        'limits': [k + 0.5, 2.0],
    }


def as_of_version(part: Path, version: int) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(part).drop_columns(LACKING[version])
    pq.write_table(table.replace_schema_metadata({b'imu_calib.catalogue': b'%d' % version}), part)


@pytest.fixture
def grown(tmp_path):
    kept = Catalogue(tmp_path / 'catalogue', create=True)
    for k, version in enumerate(GROWN):
        kept.add([row(k)])
        as_of_version(kept.folder / 'rows' / f'part-{k:06d}.parquet', version)
    return kept.folder


def expected(k: int) -> dict[str, Any]:
    """What is known of a row in a catalogue that grew."""
    version = (*GROWN, 3)[k]
    lacking = {*LACKING.get(version, []), *(numbers(0) if k == 0 else ())}
    return {name: None if name in lacking else value for name, value in numbers(k).items()}


def told(record: dict[str, Any]) -> dict[str, Any]:
    """What a reader gives of a row: each has its own for what is missing."""
    found = {name: record.get(name) for name in numbers(0)}
    found['limits'] = None if np.ndim(found['limits']) == 0 else [*found['limits']]
    # Not a number and pandas' NA do not equal themselves.
    return {n: v if n == 'limits' or (v == v) is True else None for n, v in found.items()}


def by_pandas(rows: Path) -> list[dict[str, Any]]:
    import pandas as pd

    return pd.read_parquet(rows).to_dict('records')


def by_duckdb(rows: Path) -> list[dict[str, Any]]:
    import duckdb

    return duckdb.sql(f"from '{rows}/*.parquet'").to_arrow_table().to_pylist()


def by_polars(rows: Path) -> list[dict[str, Any]]:
    polars = pytest.importorskip('polars')
    return polars.read_parquet(rows).to_dicts()


def by_dask(rows: Path) -> list[dict[str, Any]]:
    dataframe = pytest.importorskip('dask.dataframe')
    return dataframe.read_parquet(rows).compute().to_dict('records')


def of_a_union(rows: Path) -> list[dict[str, Any]]:
    import duckdb

    union = f"from read_parquet('{rows}/*.parquet', union_by_name=true)"
    return duckdb.sql(union).to_arrow_table().to_pylist()


# Of Dask 2026.8, whose code pandas 3.1 warns of.
@pytest.mark.filterwarnings('ignore:The inplace keyword')
@pytest.mark.parametrize('reader', [by_pandas, by_duckdb, by_polars, by_dask, of_a_union])
def test_readers_find_all_columns_once_this_version_has_added_a_row(grown, reader):
    assert Catalogue(grown).add([row(3)]) == 1
    read = sorted(reader(grown / 'rows'), key=lambda one: one['key'])
    assert {*read[0]} == {*schema().names}
    assert [told(one) for one in read] == [expected(k) for k in range(ROWS)]


def test_before_that_the_catalogue_and_a_union_by_name_find_them(grown):
    for read in (Catalogue(grown).table().to_pylist(), of_a_union(grown / 'rows')):
        assert [told(one) for one in read] == [expected(k) for k in range(len(GROWN))]


def test_parts_of_the_present_version_stay_as_they_are(grown):
    Catalogue(grown).add([row(3)])
    before = {p: p.stat().st_ino for p in (grown / 'rows').iterdir()}
    Catalogue(grown).add([row(4)])
    assert before.items() <= {p: p.stat().st_ino for p in (grown / 'rows').iterdir()}.items()
