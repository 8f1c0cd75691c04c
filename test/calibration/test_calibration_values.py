"""A calibration file with one value changed: refused by its key, or sound in everything after."""

import copy
import random
import warnings
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from typing import Any

import numpy as np
import pytest
from extent import again
from loopback import CHECKOUT
from sessions import truth

import imu_calib
from imu_calib.calibration.calibration import Calibration
from imu_calib.common.budget import Budget, BudgetLine, ErrorSource
from imu_calib.common.config import dump, load
from imu_calib.common.errors import InputError
from imu_calib.reports.page import Contents, page

FIELDS = CHECKOUT / 'config' / 'certificates' / 'example.yaml'
GONE = object()
VALUES = [
    *(0, 1, -1, 0.5, True, None, GONE, '', 'text', '1e-5', '1e400', date(2026, 1, 1)),
    *(float('nan'), float('inf'), -float('inf'), 1e-300, 1e90, -1e90, 1e300, 10**400),
    *([], {}, [1.0], ['a'], [[1.0]], [None], {'a': 1}, {'state': 3}, [float('nan')] * 6),
]
CHANGES = 100
"""Of each of the two files: a value of every key in turn, in some seconds."""
Path_ = tuple[Any, ...]


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """A short session on a table, and one in the hand; the calibration file of each beside it."""
    folder = tmp_path_factory.mktemp('sessions')
    plan = (CHECKOUT / 'config' / 'plans' / 'twelve_position.yaml').read_text()
    (folder / 'brief.yaml').write_text(plan.replace('120 s', '20 s'))
    of_plan: dict[str, dict[str, Any]] = {
        'table': {'plan': folder / 'brief.yaml'},
        'hand': {'plan': 'free_positions', 'imu': 'mems_counts', 'truth': 'mems_counts'},
    }
    for name, stated in of_plan.items():
        imu_calib.simulate(output=folder / name, seed=3, latitude=34.65, **stated)
    terms = {'table': {'terms': 'g_sensitivity,trend', 'method': 'joint'}, 'hand': {}}
    for name in of_plan:
        imu_calib.calibrate(folder / name, **terms[name]).calibration.save(folder / f'{name}.yaml')
    return {name: folder / name for name in of_plan}


def paths(node: Any, above: Path_ = ()) -> Iterator[Path_]:
    """Yield the path of every value of a document."""
    children = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in children:
        yield (*above, key)
        if isinstance(value, (dict, list)):
            yield from paths(value, (*above, key))


def with_another(document: Any, path: Path_, value: Any) -> Any:
    changed = copy.deepcopy(document)
    place = changed
    for part in path[:-1]:
        place = place[part]
    if value is GONE:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return changed


def cases(document: Any, seed: int, count: int) -> Iterator[tuple[Path_, Any]]:
    """Yield places and values at random; every key as often, however many numbers it has."""
    by_keys: dict[Path_, list[Path_]] = {}
    for path in paths(document):
        by_keys.setdefault(tuple(p for p in path if isinstance(p, str)), []).append(path)
    rng = random.Random(seed)
    groups = list(by_keys.values())
    for _ in range(count):
        yield rng.choice(rng.choice(groups)), rng.choice(VALUES)


def loaded(text: str, path: Path_) -> Calibration | None:
    """Return the calibration; None where it is refused with the key in the sentence."""
    try:
        return Calibration.from_yaml(text, 'my.yaml')
    except InputError as error:
        assert any(str(part) in str(error) for part in path if isinstance(part, str)), error
        assert str(error).startswith('my.yaml'), error
        return None


@pytest.mark.parametrize(
    ('name', 'seed'), [('table', 1), ('hand', 1), again('table', 2), again('hand', 2)]
)
def test_one_changed_value_is_refused_by_its_key_or_does_no_harm(recordings, name, seed, tmp_path):
    document = load(recordings[name].with_suffix('.yaml').read_text())
    accepted = 0
    for path, value in cases(document, seed, CHANGES):
        text = dump(with_another(document, path, value))
        with warnings.catch_warnings():
            warnings.simplefilter('error')
            calibration = loaded(text, path)
            if calibration is None:
                continue
            accepted += 1
            written = calibration.to_yaml()
            assert Calibration.from_yaml(written, 'again.yaml').to_yaml() == written, path
            page(Contents(calibration, 'my.yaml'))
            if calibration.budget is None:
                continue
            try:
                imu_calib.certificate(calibration, FIELDS, tmp_path / 'c.html', draft=True)
            except InputError as error:
                # Another day or serial number than that of the fields.
                assert str(error).startswith(str(FIELDS)), (path, error)
    assert CHANGES / 10 < accepted < CHANGES


def test_a_budget_of_exact_parameters_has_no_picture_and_no_certificate(tmp_path):
    line = BudgetLine(ErrorSource.NOISE, np.zeros(24), np.full(24, np.inf))
    exact = replace(truth(), budget=Budget((line,)))
    assert 'Uncertainty budget' not in imu_calib.report(exact, tmp_path / 'r.html').read_text()
    with pytest.raises(InputError, match='no uncertainty budget'):
        imu_calib.certificate(exact, FIELDS, tmp_path / 'c.html', draft=True)


def test_what_is_loaded_can_be_verified(recordings):
    document = load(recordings['hand'].with_suffix('.yaml').read_text())
    origin = {'provenance': document['provenance']}
    judged = 0
    for path, value in cases(origin, 5, 60):
        calibration = loaded(dump(with_another(document, path, value)), path)
        if calibration is not None and judged < 6:
            judged += 1
            imu_calib.verify(recordings['hand'], calibration, latitude=34.65)
    assert judged == 6
