"""Arguments of a wrong type, given to any function of the package, are refused in a sentence."""

import inspect
import itertools
from collections.abc import Callable
from datetime import datetime
from functools import cache
from typing import Any

import numpy as np
import pytest

import imu_calib
from imu_calib.common.arguments import checked
from imu_calib.common.errors import ImuCalibError, InputError

OTHERS: dict[str, object] = {'minutes': 30.0, 'wanted': {}}
METHODS = ('Calibration.load', 'Calibration.save', 'Calibration.from_yaml')
METHODS += ('ThermalCalibration.save', 'UnitResults.save', 'Catalogue.query', 'Catalogue.selected')


@cache
def functions() -> dict[str, Callable[..., Any]]:
    """Return all exported functions, the methods that read and write, and the catalogue."""
    found = {name: getattr(imu_calib, name) for name in imu_calib.__all__}
    chosen = {name: one for name, one in found.items() if not inspect.isclass(one)}
    for name in METHODS:
        of, method = name.split('.')
        chosen[name] = getattr(found[of], method)
    return {**chosen, 'Catalogue': imu_calib.Catalogue}


def arguments(name: str) -> list[inspect.Parameter]:
    known = inspect.signature(functions()[name]).parameters.values()
    return [one for one in known if one.name not in {'self', 'create'}]


def call(name: str, argument: str, value: object) -> object:
    """Call a function with one argument, and a text that names nothing for those it requires."""
    function = functions()[name]
    known = inspect.signature(function).parameters
    given: dict[str, object] = {
        one.name: OTHERS.get(one.name, 'nothing')
        for one in known.values()
        if one.default is one.empty and one.kind is not one.VAR_POSITIONAL
    }
    if known[argument].kind is inspect.Parameter.VAR_POSITIONAL:
        return function(value, value)
    return function(**{**given, argument: value})


WRONG = [(None, 'None'), (3, '3'), (object(), 'a value of the type object')]


@pytest.mark.parametrize('name', functions())
def test_any_argument_of_a_wrong_type_is_refused_in_a_sentence(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for parameter, (value, found) in itertools.product(arguments(name), WRONG):
        argument, kinds = parameter.name, str(parameter.annotation).split(' | ')
        if value is None and 'None' in kinds:
            continue
        with pytest.raises(ImuCalibError) as caught:
            call(name, argument, value)
        # A number may be right by its type, and then the other arguments are not.
        if value != 3 or not {'int', 'float'} & set(kinds):
            assert str(caught.value).startswith(f'`{argument}`: found {found}, expected ')
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ('ask', 'sentence'),
    [
        (lambda: imu_calib.read('bag', 3), '`topic`: found 3, expected a text or None.'),
        (
            lambda: imu_calib.optimise('fog_medium', minutes='30'),
            "`minutes`: found '30', expected a number.",
        ),
        (
            lambda: imu_calib.stand('six_position', speed='4,5'),
            "`speed`: found '4,5', expected a number or None. The decimal sign is a point: write "
            '4.5.',
        ),
        (
            lambda: imu_calib.reach('six_position', 'fog_medium', 'D_gx=1'),
            "`wanted`: found 'D_gx=1', expected a mapping.",
        ),
        (
            lambda: imu_calib.reach('six_position', 'fog_medium', {'D_gx': None}),
            "`wanted['D_gx']`: found None, expected a text or a number.",
        ),
        (
            lambda: imu_calib.reach('six_position', 'fog_medium', {3: 1.0}),
            '`a key of wanted`: found 3, expected a text.',
        ),
        (
            lambda: imu_calib.combine(['a.yaml', 3]),
            '`calibrations[1]`: found 3, expected a Result, a Calibration, a text or a path.',
        ),
        (
            lambda: imu_calib.simulate('six_position', 'o', start=datetime, seed=True),
            '`seed`: found True, expected a whole number.',
        ),
        (
            lambda: imu_calib.certificate('c.yaml', {}),
            '`fields`: found a value of the type dict, expected a Fields, a text or a path.',
        ),
        (
            lambda: imu_calib.calibrate_units('bag', [imu_calib.load_imu('si')]),
            '`imus[0]`: found a value of the type ImuSpec, expected a MountedUnit.',
        ),
    ],
)
def test_the_sentence_names_the_keyword_what_was_found_and_what_was_expected(ask, sentence):
    with pytest.raises(InputError) as caught:
        ask()
    assert str(caught.value) == sentence


def test_a_stand_that_is_a_command_names_keywords_too(tmp_path):
    with pytest.raises(InputError, match=r'^`speed`: found -1') as caught:
        imu_calib.stand('six_position', tmp_path / 'stand', speed=-1.0)
    assert '--' not in str(caught.value)


def test_nothing_in_place_of_several_is_refused(tmp_path):
    with pytest.raises(InputError, match=r'^`reach`: found no parameter'):
        imu_calib.reach('six_position', 'fog_medium', {})
    with pytest.raises(InputError, match=r'^`imus`: found no unit, expected one or more'):
        imu_calib.simulate_units('six_position', tmp_path / 'bag', [])
    with pytest.raises(InputError, match=r'^/: is a folder, expected the name of a file'):
        imu_calib.export(tmp_path, 'c', '/')


def test_what_numpy_and_python_call_a_number_is_one():
    @checked
    def both(rate: 'float', runs: 'int' = 1):
        return rate * runs

    assert both(np.float32(2), np.int64(3)) == 6
    assert both(2) == 2
    for wrong in (2.0, True, np.float64(2)):
        with pytest.raises(InputError, match='`runs`: found'):
            both(1.0, wrong)


def test_missing_and_unknown_arguments_are_those_of_python():
    with pytest.raises(TypeError, match=r'calibrate.. missing 1 required positional'):
        imu_calib.calibrate()
    with pytest.raises(TypeError, match=r"export.. got an unexpected keyword argument 'nothing'"):
        imu_calib.export('c.yaml', 'c', nothing=1)


@pytest.mark.parametrize('name', ['x' * 300, 'a\0b'])
def test_a_name_that_no_file_can_have_is_refused_in_a_sentence(name):
    for ask in (imu_calib.load_plan, imu_calib.Calibration.load, imu_calib.read):
        with pytest.raises(InputError, match='no file can be found there'):
            ask(name)
