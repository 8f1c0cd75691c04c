"""Holds and turns chosen by a person: `info` writes what was found, `calibrate` obeys the edit."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hand_sessions import spread_holds
from mems_by_hand import SPEC, unit
from sessions import SITE

import imu_calib
from imu_calib.cli.main import main
from imu_calib.estimation.hand import in_frame_of_accelerometers
from imu_calib.reports.provenance import gravity_won

Rows = list[dict[str, str]]
HAND = {'imu': 'mems_counts', 'latitude': 48.1}


@pytest.fixture(scope='module')
def hand(tmp_path_factory):
    bag = tmp_path_factory.mktemp('hand') / 'bag'
    imu_calib.simulate('free_positions', bag, imu='mems_counts', latitude=48.1, seed=2)
    return bag


@pytest.fixture(scope='module')
def table(tmp_path_factory):
    bag = tmp_path_factory.mktemp('table') / 'bag'
    imu_calib.simulate('twelve_position', bag, latitude=48.1, seed=3)
    return bag


def written(bag: Path, folder: Path) -> tuple[Path, Rows]:
    file = folder / 'found.csv'
    assert main(['info', str(bag), '--segments', str(file)]) == 0
    # What a person edits is not written over.
    assert main(['info', str(bag), '--segments', str(file)]) == 2
    with file.open(newline='') as lines:
        return file, list(csv.DictReader(lines))


def edited(file: Path, rows: Rows) -> Path:
    with file.open('w', newline='') as lines:
        writer = csv.DictWriter(lines, ['kind', 'start', 'end', 'attitude'])
        writer.writeheader()
        writer.writerows(rows)
    return file


def holds_of(result: imu_calib.Result) -> np.ndarray:
    """Start and end of the holds that were used, s after the first sample."""
    zero = result.session.start
    return np.array([(s.start - zero, s.end - zero) for s in result.session.segments]) * 1e-9


def test_a_file_as_it_was_written_gives_the_result_of_the_search(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    found, again = imu_calib.calibrate(hand), imu_calib.calibrate(hand, segments=file)
    assert {row['kind'] for row in rows} == {'hold'}
    # A hand holds it up to some degrees.
    assert rows[0]['attitude'].startswith('X +8')
    # Times are written to a millisecond, and each hold settles anew: far below the noise.
    moved = np.abs(again.calibration.values - found.calibration.values)
    assert (moved <= 0.5 * found.calibration.std + 1e-12).all()
    assert again.calibration.provenance['segments_file'] == 'found.csv'
    assert 'found.csv' in ' '.join(again.calibration.findings)


@pytest.fixture(scope='module')
def log(tmp_path_factory):
    """A text file of counts with late stamps, and its columns."""
    file = tmp_path_factory.mktemp('log') / 'log.csv'
    blocks = list(spread_holds(20).blocks(SPEC, unit(0), SITE))
    stamps = np.concatenate([block.stamp for block in blocks]) // 1000
    late = np.random.default_rng(0).integers(0, 2000, len(stamps))
    rows = np.vstack([np.hstack([block.gyro, block.accel]) for block in blocks])
    np.savetxt(file, np.column_stack([stamps - stamps[0] + late, rows]), fmt='%d', delimiter=',')
    return file, {'stamp': '1:us', 'gyro': '2,3,4:count', 'accel': '5,6,7:count'}


def test_a_report_on_columns_needs_no_imu(log, tmp_path):
    file, columns = log
    options = [f'--{name}={value}' for name, value in columns.items()]
    saved, imu = str(tmp_path / 'calibration.yaml'), tmp_path / 'imu.yaml'
    imu.write_text(
        'id: mine\nunits: counts\ngyro: {scale_factor: 0.06103515625 dps/LSB}\n'
        'accelerometer: {scale_factor: 2048 LSB/g}\n'
    )
    imu_calib.calibrate(file, **columns, **{**HAND, 'imu': imu}).calibration.save(saved)
    page = tmp_path / 'page.html'
    assert main(['report', saved, str(file), *options, '-o', str(page)]) == 0
    assert 'data:image' in page.read_text() or '<svg' in page.read_text()


def test_as_many_holds_as_unknowns_say_nothing_of_what_is_left(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    # Six faces, and a slant in each plane of two axes.
    nine = edited(file, [*rows[:6], rows[6], rows[10], rows[14]])
    found = imu_calib.calibrate(hand, segments=nine).calibration
    assert 'gravity_off_after' not in found.provenance
    assert gravity_won(found.provenance).endswith('% off raw')


def test_holds_of_one_second_with_late_stamps_are_used_as_they_were_written(log, tmp_path):
    file, (log, columns) = tmp_path / 'found.csv', log
    columns = {**columns, **HAND}
    options = [f'--{name}={value}' for name, value in columns.items()]
    assert main(['info', str(log), *options, '--segments', str(file)]) == 0
    found, again = (imu_calib.calibrate(log, **columns, **s) for s in ({}, {'segments': file}))
    np.testing.assert_allclose(holds_of(again), holds_of(found), rtol=0, atol=1e-6)
    with file.open(newline='') as lines:
        rows = [{**row, 'end': f'{float(row["start"]) + 1:.3f}'} for row in csv.DictReader(lines)]
    # A hundred samples lie 0.99 s apart.
    used = holds_of(imu_calib.calibrate(log, segments=edited(file, rows), **columns))
    np.testing.assert_allclose(used[:, 0], holds_of(found)[:, 0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(used[:, 1] - used[:, 0], 0.99, rtol=0, atol=2e-3)


def test_holds_in_the_hand_are_removed_moved_and_added(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    removed, moved, parted = rows[4], rows[7], rows[9]
    kept = [row for row in rows if row is not removed and row is not parted]
    start, end = float(parted['start']), float(parted['end'])
    middle = (start + end) / 2
    kept[kept.index(moved)] = {**moved, 'start': f'{float(moved["start"]) + 0.7:.3f}'}
    kept += [
        {**parted, 'end': f'{middle - 0.1:.3f}'},
        {**parted, 'start': f'{middle + 0.1:.3f}'},
    ]
    result = imu_calib.calibrate(hand, segments=edited(file, kept))
    used = holds_of(result)
    assert len(used) == len(rows)
    # No hold is longer than its line, and the removed one is not used.
    listed = np.array(sorted((float(r['start']), float(r['end'])) for r in kept))
    assert (used[:, 0] >= listed[:, 0] - 2e-3).all()
    assert (used[:, 1] <= listed[:, 1] + 2e-3).all()
    # The turn across the removed hold is carried on: one less in all, one more at the parted one.
    assert len(result.session.moves) + len(result.session.lost_moves) == len(rows) - 1
    truth = in_frame_of_accelerometers(
        imu_calib.Calibration.load(hand / 'truth.yaml').model
    ).values(result.calibration.parameters)
    off = np.abs(result.calibration.values - truth)
    # 21 normal errors: five standard deviations.
    assert (off <= 5 * result.calibration.std + 1e-12).all()


def test_holds_of_a_frame_are_chosen_too(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    edited(file, rows[:-3])
    (columns,) = (c for c in imu_calib.read(hand).values() if c.type == 'sensor_msgs/msg/Imu')
    by_frame = imu_calib.calibrate(columns.to_dataframe(), segments=file, **HAND)
    by_path = imu_calib.calibrate(hand, segments=file)
    np.testing.assert_array_equal(by_frame.calibration.values, by_path.calibration.values)


def test_verify_takes_holds_that_were_chosen_too(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    calibration = imu_calib.calibrate(hand)
    found, chosen = (
        imu_calib.verify(hand, calibration, latitude=48.1, **listed)
        for listed in ({}, {'segments': edited(file, rows[5:])})
    )
    # Each hold has a row of its gravity.
    holds = [len({one.at for one in of.compared if one.at >= 0}) for of in (found, chosen)]
    assert holds == [len(rows), len(rows) - 5]


def test_dwells_and_turns_of_a_table_are_chosen(table, tmp_path):
    file, rows = written(table, tmp_path)
    holds = [row for row in rows if row['kind'] == 'hold']
    turns = [row for row in rows if row['kind'] == 'turn']
    found = imu_calib.calibrate(table)
    assert len(turns) == len(found.session.turns)
    # One turn is left out, one dwell is removed, and one is parted about an event in its middle.
    start, end = float(holds[5]['start']), float(holds[5]['end'])
    parts = [
        {**holds[5], 'end': f'{start + 0.4 * (end - start):.3f}'},
        {**holds[5], 'start': f'{start + 0.5 * (end - start):.3f}'},
    ]
    kept = [*turns[1:], *holds[:5], *parts, *holds[6:-1]]
    result = imu_calib.calibrate(table, segments=edited(file, kept))
    assert len(result.session.turns) == len(turns) - 1
    assert result.session.turns[0].start == found.session.turns[1].start
    assert len(result.session.segments) == len(holds)
    assert 'the file of segments does not list it' in ' '.join(
        rejected.reason for rejected in result.session.rejected
    )
    off = np.abs(result.calibration.values - found.calibration.values)
    assert (off < 5 * result.calibration.std).all()


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('start,end\n1,3\n', 'line 1: kind: found the columns start, end, expected kind, start'),
        ('kind,start,end\nrest,1,3\n', "line 2: kind: found 'rest', expected hold or turn"),
        ('kind,start,end\nhold,1,3\nhold,x,9\n', "line 3: start: found 'x', expected s after"),
        ('kind,start,end\n\nhold,5,5.5\n', 'line 3: end: found 5.5, expected 6 or more'),
        ('kind,start,end\nhold,1,4\nhold,3,6\n', 'line 3: start: found 3, expected 4 or more: the'),
        ('kind,start,end\nhold,1,1e5\n', 'line 2: end: found 100000, expected at most 147.980'),
        ('kind,start,end\nhold,1,3\nturn,3,5\n', 'line 3: kind: found turn, expected hold: with'),
        ('kind,start,end\nhold,' + '1' * 200_000, 'found no lines of columns'),
        ('kind,start,end,attitude\nhold,1,3,"up\nhold,4,6,down\n', 'found no lines of columns'),
        ('kind,start,end\nhold,1,5,3,0\n', 'line 2: found 5 cells, expected 3: write decimals'),
        ('kind,start,end\n', 'found no segment, expected a hold in each line'),
    ],
)
def test_a_wrong_file_is_refused_with_its_line_and_key(hand, tmp_path, text, message):
    file = tmp_path / 'edited.csv'
    file.write_text(text)
    with pytest.raises(imu_calib.InputError) as refused:
        imu_calib.calibrate(hand, segments=file)
    assert str(refused.value).startswith(str(file))
    assert message in str(refused.value)


def test_a_hold_in_which_the_table_moved_is_refused(table, tmp_path):
    file, rows = written(table, tmp_path)
    at = next(k for k, row in enumerate(rows) if row['kind'] == 'hold')
    rows[at] = {**rows[at], 'end': f'{float(rows[at]["end"]) + 1.5:.3f}'}
    with pytest.raises(imu_calib.InputError) as refused:
        imu_calib.calibrate(table, segments=edited(file, rows))
    assert f'line {at + 2}: start, end: found' in str(refused.value)
    assert 'expected a time in which the table stood still: ' in str(refused.value)


def test_holds_that_are_too_few_are_refused_by_what_they_lack(hand, tmp_path):
    file, rows = written(hand, tmp_path)
    with pytest.raises(imu_calib.NotObservable, match='hold'):
        imu_calib.calibrate(hand, segments=edited(file, rows[:3]))
