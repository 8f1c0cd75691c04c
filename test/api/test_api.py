"""The suite from Python: the same results, and the same sentences, as the commands."""

import argparse
import enum
import inspect
import json
import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from loopback import completed
from sessions import brief_plan

import imu_calib
from imu_calib.api import simulate as repeating
from imu_calib.api.session import as_applied
from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.verify import Verdict
from imu_calib.cli.dispatch import COMMANDS
from imu_calib.cli.main import main
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.units import DEG_H, MICRO_G, PPM
from imu_calib.model.parameters import PARAMETERS
from imu_calib.model.session_terms import Changes, split_terms
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.recordings.writer import RecordingWriter
from imu_calib.reports.side_by_side import in_scale_of
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan

SITE = ('--latitude', '34.65')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A plan of short dwells, its recording and its result."""
    folder = tmp_path_factory.mktemp('api')
    imu_calib.simulate(brief_plan(folder / 'brief.yaml'), folder / 'bag', seed=3, latitude=34.65)
    return folder


@pytest.fixture(scope='module')
def result(folder):
    return imu_calib.calibrate(folder / 'bag')


def test_it_loads_what_is_asked_for_alone():
    code = 'import imu_calib, json, sys; print(json.dumps(sorted(sys.modules)))'
    done = completed([sys.executable, '-c', code], check=True)
    assert 'numpy' not in json.loads(done.stdout)


def test_every_name_is_there_and_no_other():
    assert imu_calib.__version__[0].isdigit()
    for name in imu_calib.__all__:
        assert getattr(imu_calib, name).__name__ == name
    assert dir(imu_calib) == sorted(imu_calib.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        imu_calib.calibrat  # noqa: B018


def test_the_command_gives_the_same_bits(folder, result):
    file = folder / 'by_command.yaml'
    assert main(['calibrate', str(folder / 'bag'), '-o', str(file)]) == 0
    result.calibration.save(str(folder / 'by_api.yaml'))
    assert file.read_text() == (folder / 'by_api.yaml').read_text()


def test_the_simulated_recording_is_that_of_the_command(folder, tmp_path):
    words = ['simulate', str(folder / 'brief.yaml'), '-o', str(tmp_path / 'bag'), '--seed', '3']
    assert main([*words, *SITE]) == 0
    with open_recording(tmp_path / 'bag') as one, open_recording(folder / 'bag') as other:
        assert one.sha256() == other.sha256()


def test_it_finds_the_truth_that_was_simulated(folder, result):
    truth = Calibration.load(str(folder / 'bag' / 'truth.yaml'))
    errors = (result.calibration.values[:24] - truth.values[:24]) / result.calibration.std[:24]
    assert np.abs(errors).max() < 4.5


def test_values_do_where_names_do(folder, result):
    plan, imu = load_plan(folder / 'brief.yaml'), load_imu('fog_medium')
    again = imu_calib.calibrate(str(folder / 'bag'), plan=plan, imu=imu, latitude=34.65)
    # The recording says the same of itself, but for how well the latitude is known.
    assert again.calibration.values == pytest.approx(result.calibration.values, rel=1e-6)


def test_progress_is_shown_and_terms_are_left_out_where_that_is_asked(folder):
    opened: list[str] = []
    shown: list[float] = []

    class Bar:
        def __init__(self, text):
            opened.append(text)

        def __enter__(self):
            return lambda done, total, *_: shown.append(done / total)

        def __exit__(self, *_: object) -> None: ...

    result = imu_calib.calibrate(folder / 'bag', terms='none', progress=Bar)
    assert not result.calibration.provenance['terms_looked_for']
    with pytest.raises(InputError, match='nonsense'):
        imu_calib.calibrate(folder / 'bag', terms='nonsense')
    assert opened == ['reading']
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('stated', 'error', 'sentence'),
    [
        ({'plan': 'no_such'}, InputError, "No plan is called 'no_such'; there are: .*twelve_pos"),
        ({'imu_topic': '/else'}, InputError, 'topic /else: .* are: /imu/pulses'),
        ({'azimuth': float('nan')}, InputError, '`azimuth`: found nan deg, expected -360 to 360'),
        ({'azimuth': 1000.0}, InputError, '`azimuth`: found 1000 deg, expected -360 to 360'),
        ({'serial': '7', 'latitude': 95.0}, InputError, 'latitude'),
        ({'plan': 'six_position'}, InputError, 'setpoints of the recording are of plan twelve'),
        ({'latitude': -60.0}, NotObservable, 'latitude'),
    ],
)
def test_errors_are_the_sentences_of_the_command(folder, stated, error, sentence):
    with pytest.raises(error, match=sentence):
        imu_calib.calibrate(folder / 'bag', **stated)


def test_read_gives_columns_with_stamps_and_units(folder):
    topics = imu_calib.read(folder / 'bag')
    assert set(topics) >= {'/imu/pulses', '/turntable/joint_states', '/turntable/setpoint'}
    pulses = topics['/imu/pulses']
    assert pulses.units['angular_velocity.x'] == 'pulse'
    assert np.all(np.diff(pulses.stamp) == 10_000_000)
    # Z is down at the last position: 1 g in pulses of 0.01 m/s, of an axis that counts 25 % more.
    last = pulses['linear_acceleration.z'][-100:].mean()
    assert last == pytest.approx(-9.8 * 1.25, rel=0.02)
    joints = imu_calib.read(folder / 'bag', 'turntable/joint_states')
    assert joints.units['position.outer'] == 'rad'
    assert len(joints) == len(joints['position.outer'])
    setpoints = topics['/turntable/setpoint']
    assert set(setpoints['mode']) == {'POSITION', 'RATE'}
    assert set(setpoints['position_id']) == {str(k + 1) for k in range(12)}
    with pytest.raises(InputError, match=r"no column 'gx'; it has: angular_velocity.x"):
        pulses['gx']
    with pytest.raises(InputError, match=r'no topic /imu/nothing .* its topics: /imu/pulses'):
        imu_calib.read(folder / 'bag', '/imu/nothing')


def test_columns_are_data_frames_too(folder):
    import pandas as pd

    frame = imu_calib.read(folder / 'bag', '/imu/pulses').to_dataframe()
    assert isinstance(frame.index, pd.DatetimeIndex)
    assert frame.index[0].value == imu_calib.read(folder / 'bag', '/imu/pulses').stamp[0]
    assert frame.attrs['units']['linear_acceleration.z'] == 'pulse'
    assert list(frame.columns[:3]) == [f'angular_velocity.{a}' for a in 'xyz']


def test_parameters_are_a_data_frame_and_a_picture(result):
    frame = result.calibration.to_dataframe()
    assert frame.loc['D_gx', 'unit'] == 'deg/h'
    at = [p.name for p in result.calibration.parameters].index('D_gx')
    assert frame.loc['D_gx', 'value'] == pytest.approx(result.calibration.values[at] / DEG_H)
    assert frame.loc['K_ay', 'std'] == pytest.approx(result.calibration.std[13] / PPM)
    figure = result.calibration.plot()
    labels = [t.get_text() for axes in figure.axes for t in axes.get_xticklabels()]
    assert sorted(labels) == sorted(frame.index)
    assert {axes.get_ylabel() for axes in figure.axes} == set(frame['unit'])


def test_what_is_not_installed_is_asked_for(folder, result, monkeypatch):
    monkeypatch.setattr('imu_calib.common.files.find_spec', lambda _: None)
    with pytest.raises(InputError, match=r"needs pandas.*pip install '\.\[dataframe\]'"):
        result.calibration.to_dataframe()
    with pytest.raises(InputError, match=r"needs matplotlib.*pip install '\.\[plot\]'"):
        result.calibration.plot()
    with pytest.raises(InputError, match='needs pandas'):
        imu_calib.read(folder / 'bag', '/imu/pulses').to_dataframe()


def test_a_simulation_takes_values_and_its_recording_asks_for_them(folder, result, tmp_path):
    plan, imu = load_plan(folder / 'brief.yaml'), load_imu('fog_medium')
    table = imu_calib.load_table('three_axis')
    bag = imu_calib.simulate(
        plan, tmp_path / 'bag', imu=imu, table=table, seed=3, latitude=34.65
    ).path
    with pytest.raises(InputError, match=r'does not state its table.*give `table`'):
        imu_calib.calibrate(bag)
    # Pulses in the place of SI units.
    with pytest.raises(imu_calib.ImuCalibError):
        imu_calib.calibrate(bag, table=table)
    again = imu_calib.calibrate(bag, plan=plan, imu=imu, table=table)
    assert again.calibration.values.tolist() == result.calibration.values.tolist()
    with pytest.raises(InputError, match='`imu`: found a value of the type ImuSpec, expected a te'):
        imu_calib.stand('six_position', tmp_path / 'stand', imu=imu)


def test_one_calibration_is_a_list_of_one(result, tmp_path):
    result.calibration.save(tmp_path / 'c.yaml')
    others = replace(result.calibration, serial_number='B')
    others.save(tmp_path / 'b.yaml')
    with pytest.raises(InputError, match='serial_number: found B, expected A'):
        imu_calib.report(
            replace(result.calibration, serial_number='A'),
            tmp_path / 'r.html',
            compare=tmp_path / 'b.yaml',
        )
    for one in (tmp_path / 'c.yaml', str(tmp_path / 'c.yaml'), result):
        with pytest.raises(InputError, match='Found 1 calibration, expected two or more'):
            imu_calib.combine(one)
        with pytest.raises(InputError, match='Found 1 calibration, expected two or more'):
            imu_calib.compare(one)
    with pytest.raises(InputError, match='Found 0 calibrations, expected two or more'):
        imu_calib.combine([])


def test_ros_takes_a_result_whose_file_is_written_beside(result, tmp_path):
    imu_calib.export(result, 'ros', tmp_path / 'node.yaml')
    file = tmp_path / 'node_calibration.yaml'
    assert f'calibration: {file}' in (tmp_path / 'node.yaml').read_text()
    assert Calibration.load(file).values.tolist() == result.calibration.values.tolist()


def test_every_result_is_shown_in_one_line(folder, result, tmp_path):
    plan = folder / 'brief.yaml'
    result.calibration.save(tmp_path / 'c.yaml')
    prediction = imu_calib.predict(plan, 'fog_medium')
    shown = [
        result,
        result.calibration,
        prediction,
        imu_calib.reach(plan, 'fog_medium', {'D_gx': '0.5 deg/h'}),
        imu_calib.montecarlo(plan, runs=1, terms='none'),
        imu_calib.read(folder / 'bag', '/imu/pulses'),
        imu_calib.inspect(folder / 'bag'),
        imu_calib.compare(result, tmp_path / 'c.yaml'),
        imu_calib.conformity(result, 'fog_medium'),
        imu_calib.export(result, 'c'),
        imu_calib.compensate(folder / 'bag', result, tmp_path / 'compensated'),
        imu_calib.verify(folder / 'bag', result),
        imu_calib.load_plan(plan),
        imu_calib.load_imu('fog_medium'),
        imu_calib.load_table('three_axis'),
    ]
    for one in shown:
        assert re.fullmatch(rf'<{type(one).__name__}\b.{{9,200}}>', repr(one)), repr(one)
    assert repr(result.calibration) == str(result.calibration)
    assert repr(prediction) == (
        '<Prediction of plan twelve_position with IMU fog_medium: 24 parameters by joint>'
    )


def test_every_class_is_shown_in_one_line(result):
    known, here = result.calibration, Path('there')
    plan = load_plan('six_position')
    warm = {**known.provenance, 'temperature': {'mean': 20.0, 'lowest': 19.0, 'highest': 21.0}}
    failed = imu_calib.UnitResult('A1', '/imu', '', None, InputError('Why.'))
    shown: dict[object, str] = {
        imu_calib.ThermalCalibration((replace(known, provenance=warm),)): (
            'ThermalCalibration of fog_medium (simulated): at 20.0 degC'
        ),
        imu_calib.Optimum(plan, 0.0, 90.0): 'Optimum: 6 positions in 1.5 min',
        imu_calib.Simulated(here, plan, known, 60.0, None): (
            'Simulated: 60 s of plan six_position in there'
        ),
        imu_calib.SimulatedUnits(here, plan, {'A1': known}, 60.0, None): (
            'SimulatedUnits: 60 s of 1 unit in there'
        ),
        imu_calib.StandRun(here, here, known, known, None): f'StandRun: {known} in there',
        imu_calib.Certificate(None, known, None, (), ''): f'Certificate of {known}: 0 results',
        imu_calib.History(None, None, (), {}, None): 'History of 0 units of 0 types',
        imu_calib.Batch(here, 4, 1, 2, 1, 0, 3.0): (
            'Batch: 4 recordings, 1 calibrated, 2 failed, 1 known, in there'
        ),
        failed: 'UnitResult of A1 on /imu: Why.',
        imu_calib.UnitResults((failed,)): 'UnitResults of 1 unit, 1 failed',
        imu_calib.MountedUnit('A1', 'si', '/imu'): 'MountedUnit A1 of type si on /imu',
    }
    for one, line in shown.items():
        assert repr(one) == f'<{line}>'
    # Converted holds a mapping, by which no dictionary can have it as a key.
    assert repr(imu_calib.Converted(here, {'/imu': 2}, ('Why.',))) == (
        '<Converted: 2 messages in there, 1 finding>'
    )
    for name in imu_calib.__all__:
        one = getattr(imu_calib, name)
        if inspect.isclass(one) and not issubclass(one, Exception | enum.Enum):
            # Written for it: that of a dataclass has a line for every array.
            written = getattr(one.__repr__, '__code__', None)
            assert written is not None and 'imu_calib' in written.co_filename, name


def test_results_are_shown_in_a_line(folder, result):
    assert re.fullmatch(
        r'<Result: <Calibration of .*: 24 parameters, \d+ warnings?, \d+ notes?> of '
        r'\d+ static dwells and \d+ turns>',
        str(result),
    )
    assert re.fullmatch(r'<Labelled: \d+ static dwells and \d+ turns>', repr(result.labelled))
    assert repr(result.calibration.labelled) == '<LabelledValues: 24 parameters in SI units>'
    found = imu_calib.verify(folder / 'bag', result)
    assert repr(found).startswith('<Verification: NOT_TESTED; gyros PASS (chi-square ')
    first, second, *_ = str(found).splitlines()
    assert first.startswith('NOT TESTED: the calibration was made from this recording or from')
    assert second.startswith('gyros: pass, chi-square ') and f'{found.verdict}' == 'not tested'
    assert found.to_dict()['verdict'] == 'not tested' and found.to_dict()['own_recording']


@pytest.mark.parametrize(
    ('name', 'value', 'said'),
    [
        ('latitude', '59,9', 'write 59.9.'),
        ('gravity', '9.81', "`gravity`: found '9.81', expected a number."),
        ('height', True, '`height`: found True, expected a number.'),
    ],
)
def test_texts_for_numbers_are_refused_in_words(name, value, said):
    with pytest.raises(InputError, match=said):
        imu_calib.calibrate('x', **{name: value})


def test_verify_judges_values_and_files(folder, result, tmp_path):
    imu_calib.simulate(folder / 'brief.yaml', tmp_path / 'other', seed=4, latitude=34.65)
    verification = imu_calib.verify(tmp_path / 'other', result.calibration)
    assert verification.verdict is Verdict.PASS
    same = imu_calib.verify(folder / 'bag', result.calibration)
    assert same.findings[0].startswith('The calibration was made from this recording')
    assert same.verdict is Verdict.NOT_TESTED and same.own_recording
    assert verification.accepted and not same.accepted
    with pytest.raises(InputError, match='another'):
        imu_calib.verify(tmp_path / 'other', result.calibration, imu='mems_counts')


def test_a_copy_in_another_container_is_the_same_recording(folder, result, tmp_path):
    with (
        open_recording(folder / 'bag') as bag,
        RecordingWriter(tmp_path / 'copy', bag.custom_data, 'zstd') as copy,
    ):
        for topic, messages, times in bag.messages():
            copy.write(topic.name, topic.message_type, messages, times.log)
    assert imu_calib.verify(tmp_path / 'copy', result.calibration).own_recording


def test_compensate_writes_rates_and_forces(folder, result, tmp_path):
    done = imu_calib.compensate(folder / 'bag', result.calibration, tmp_path / 'si')
    assert done.samples_out == done.samples_in
    assert done.target == '/imu/data_raw'
    columns = imu_calib.read(tmp_path / 'si', done.target)
    assert columns.units['linear_acceleration.x'] == 'm/s^2'
    assert columns['linear_acceleration.z'][-100:].mean() == pytest.approx(-9.797, abs=0.01)
    with pytest.raises(InputError, match='exists'):
        imu_calib.compensate(folder / 'bag', result.calibration, tmp_path / 'si')


def test_a_prediction_is_what_the_session_reached(folder, result):
    prediction = imu_calib.predict(folder / 'brief.yaml', 'fog_medium', latitude=34.65)
    names = [p.name for p in result.calibration.parameters]
    reached = dict(zip(names, result.calibration.std, strict=True))
    for name in ('K_gx', 'D_gy', 'E_axy'):
        assert prediction.std[name] == pytest.approx(reached[name], rel=0.5)
    assert prediction.closed_form is not None
    assert {one.term.name for one in prediction.terms} >= {'g_sensitivity', 'gyro_asymmetry'}
    with pytest.raises(InputError, match='terms of the sensors: trend, warm_up and step'):
        imu_calib.predict(folder / 'brief.yaml', 'fog_medium', terms='trend')


def test_a_calibration_of_simulated_data_says_so(result, tmp_path):
    result.calibration.save(tmp_path / 'c.yaml')
    known = Calibration.load(tmp_path / 'c.yaml')
    assert known.provenance['simulated'] is True
    numbered = replace(known, serial_number='A1')
    for one, name in ((known, 'fog_medium'), (numbered, 'A1')):
        page = imu_calib.report(one, tmp_path / 'r.html').read_text()
        assert f'<h1>{name} (simulated)</h1>' in page
        assert '(simulated)' in imu_calib.export(one, 'c').text and '(simulated)' in repr(one)
    measured = {k: v for k, v in known.provenance.items() if k != 'simulated'}
    assert '(simulated)' not in repr(replace(known, provenance=measured))


def test_reports_of_results_and_of_files_are_the_same(folder, result, tmp_path):
    result.calibration.save(tmp_path / 'c.yaml')
    by_value = imu_calib.report(result, tmp_path / 'a.html')
    by_file = imu_calib.report(tmp_path / 'c.yaml', tmp_path / 'b.html', bag=folder / 'bag')
    assert '<svg' in by_value.read_text()
    name = result.calibration.imu.id
    assert by_file.read_text().replace('c.yaml', name) == by_value.read_text()
    with pytest.raises(InputError, match='nowhere does not exist'):
        imu_calib.report(result, tmp_path / 'nowhere' / 'a.html')


def test_limits_of_another_type_judge_nothing(folder, result, tmp_path):
    other = 'found the limits of type fog_navigation, but the calibration is of a fog_medium'
    with pytest.raises(InputError, match=other):
        imu_calib.conformity(result, 'fog_navigation')
    with pytest.raises(InputError, match=other):
        imu_calib.report(result, tmp_path / 'a.html', imu='fog_navigation')


def test_gravity_without_a_standard_deviation_is_said_to_be_exact(folder, tmp_path):
    def notes(bag=folder / 'bag', **stated):
        return ' '.join(imu_calib.calibrate(bag, **stated).calibration.findings)

    words = 'The stated gravity, 9.797 m/s^2, is taken as exact'
    assert words in notes(gravity=9.797)
    assert words not in notes(gravity=9.797, gravity_std=2e-5)
    # The same from the recording.
    imu_calib.simulate('six_position', tmp_path / 'bag', latitude=34.65, gravity=9.797, seed=1)
    assert words in notes(tmp_path / 'bag')
    assert words not in notes(tmp_path / 'bag', gravity_std=2e-5)


def test_a_report_takes_the_site_of_the_calibration_not_of_the_recording(folder, tmp_path):
    elsewhere = imu_calib.calibrate(folder / 'bag', height=420.0)
    elsewhere.calibration.save(tmp_path / 'c.yaml')
    page = imu_calib.report(tmp_path / 'c.yaml', tmp_path / 'b.html', bag=folder / 'bag')
    assert '420' in page.read_text()


def test_each_option_of_a_command_is_a_keyword_of_its_function():
    functions = {
        'compensate': imu_calib.compensate,
        'convert': imu_calib.convert,
        'export': imu_calib.export,
        'montecarlo': imu_calib.montecarlo,
        'simulate': imu_calib.simulate,
    }
    # Several units are a function of their own, and so many recordings a loop.
    others = {'simulate': {'imus', 'units'}}
    assert 'imus' in inspect.signature(imu_calib.simulate_units).parameters
    of_commands = {'help', 'output', 'format', 'calibration', 'imu'}
    for name, function in functions.items():
        parser = argparse.ArgumentParser()
        subject, _ = COMMANDS[name]
        getattr(import_module(f'imu_calib.cli.{subject}'), f'add_{name}_options')(parser)
        given = {action.dest for action in parser._actions if action.option_strings}
        known = set(inspect.signature(function).parameters)
        assert given - of_commands - others.get(name, set()) <= known, name
        assert known - {'progress'} <= {action.dest for action in parser._actions} | {'source'}, (
            name
        )


def test_the_folder_of_a_session_is_no_calibration_but_names_one(result, tmp_path):
    result.calibration.save(tmp_path / 'calibration.yaml')
    said = f'{tmp_path} is a folder: did you mean {tmp_path / "calibration.yaml"}?'
    with pytest.raises(InputError, match=re.escape(said)):
        imu_calib.report(tmp_path, tmp_path / 'report.html')


def test_a_recording_comes_before_a_calibration(folder, result, tmp_path):
    result.calibration.save(tmp_path / 'c.yaml')
    with pytest.raises(InputError, match='bag is a recording, expected a calibration file'):
        imu_calib.verify(tmp_path / 'c.yaml', folder / 'bag')
    with pytest.raises(InputError, match='`bag`: found a value of the type Result, expected'):
        imu_calib.verify(result, folder / 'bag')


def test_keywords_that_functions_share_are_in_their_signatures_and_others_are_refused():
    verify = inspect.signature(imu_calib.verify).parameters
    assert {'plan', 'imu', 'table', 'latitude', 'height_std', 'imu_topic'} < set(verify)
    assert verify['plan'].default is None
    assert verify['imu_only'].default is False
    with pytest.raises(TypeError, match=r"^verify\(\) got an unexpected keyword argument 'method'"):
        imu_calib.verify('bag', 'calibration.yaml', method='joint')


def test_two_calibrations_are_compared_in_any_form(folder, result, tmp_path, capsys):
    truth = folder / 'bag' / 'truth.yaml'
    compared = imu_calib.compare(result, truth)
    assert compared.names == ('first', 'truth')
    assert [p.name for p in compared.parameters] == [p.name for p in PARAMETERS]
    exact = Calibration.load(truth)
    wrong = result.calibration.values[:24] - exact.values[:24]
    assert compared.normalised == pytest.approx(wrong / result.calibration.std[:24])
    # Of an exact value, E_n is the error over its own U: that of the budget.
    u = result.calibration.budget.expanded[:12]
    assert compared.e_n[:12] == pytest.approx(wrong[:12] / u)
    frame = compared.to_dataframe()
    assert list(frame.columns) == [
        *('first', 'truth', 'difference', 'std', 'difference/std', 'chance', 'unit')
    ]
    assert frame.loc['K_gy', 'difference'] == pytest.approx(wrong[1] / PPM)
    (axes,) = compared.plot().axes
    assert [t.get_text() for t in axes.get_xticklabels()] == list(frame.index)
    result.calibration.save(tmp_path / 'mine.yaml')
    assert imu_calib.compare(tmp_path / 'mine.yaml', exact).names == ('mine', 'second')
    assert main(['compare', str(tmp_path / 'mine.yaml'), str(truth)]) == 0
    shown = capsys.readouterr().out
    assert f'{compared.e_n[0]:+.2f}' in shown
    assert 'mine: fog_medium (simulated), recorded 2023-11-17' in shown
    assert len(shown.splitlines()) <= 40 and max(map(len, shown.splitlines())) <= 100
    with pytest.raises(InputError, match=r'nothing\.yaml'):
        imu_calib.compare(result, tmp_path / 'nothing.yaml')


def test_agreement_of_the_same_data_is_said_to_be_none_of_the_unit(result):
    def said(one, other):
        findings = imu_calib.compare(one, other).findings
        return [text for text in findings if 'made from the same data' in text]

    again = replace(result.calibration, serial_number='A1')
    assert said(result, again) == said(again, again) != []
    assert imu_calib.compare(result, again).same_data
    # Two units on one table share a recording.
    assert said(again, replace(again, serial_number='A2')) == []
    other = {**again.provenance, 'sha256': 64 * 'f'}
    assert said(result, replace(again, provenance=other)) == []


def test_a_unit_in_another_scale_is_compared_in_that_of_the_first(result):
    mine = result.calibration
    twice = replace(
        mine.imu, gyro=replace(mine.imu.gyro, scale_factor=2 * mine.imu.gyro.scale_factor)
    )
    other = in_scale_of(mine, replace(mine, imu=twice))
    compared = imu_calib.compare(mine, other)
    assert np.abs(compared.normalised).max() < 1e-6
    assert compared.findings[1:] == ('Shown with the nominal scale factors of first.',)


def test_calibrations_at_several_temperatures_are_combined(result, tmp_path):
    warm, cold = (
        replace(
            result.calibration,
            provenance={
                **result.calibration.provenance,
                'temperature': {'mean': at, 'lowest': at - 1, 'highest': at + 1},
            },
        )
        for at in (40.0, 10.0)
    )
    cold.save(tmp_path / 'cold.yaml')
    combined = imu_calib.combine([warm, tmp_path / 'cold.yaml'], tmp_path / 'both.yaml')
    assert combined.temperatures == pytest.approx([10.0, 40.0])
    assert combined.at(25.0).values == pytest.approx(result.calibration.values)
    words = ['combine', str(tmp_path / 'cold.yaml'), str(tmp_path / 'warm.yaml'), '-o']
    warm.save(tmp_path / 'warm.yaml')
    assert main([*words, str(tmp_path / 'again.yaml')]) == 0
    assert (tmp_path / 'again.yaml').read_text() == (tmp_path / 'both.yaml').read_text()
    with pytest.raises(InputError, match=r'Two calibrations at 40\.00 and 40\.00 degC'):
        imu_calib.combine([warm, warm])
    with pytest.raises(InputError, match='combines calibrations at several temperatures'):
        imu_calib.compare(tmp_path / 'both.yaml', result)
    with pytest.raises(InputError, match='format c cannot carry them, export one'):
        imu_calib.export(combined, 'c')


@pytest.mark.parametrize('kind', ['ros', 'kalibr', 'imucal', 'c'])
def test_an_export_is_that_of_the_command(result, tmp_path, kind):
    file = tmp_path / 'c.yaml'
    mine, its = (tmp_path / folder / 'imu_calib.h' for folder in 'ab')
    for folder in (mine.parent, its.parent):
        folder.mkdir()
    result.calibration.save(file)
    done = imu_calib.export(file, kind, mine, sample_rate=100.0, imu='fog_medium')
    words = ['export', str(file), '--format', kind, '--sample-rate', '100', '--imu', 'fog_medium']
    assert main([*words, '-o', str(its)]) == 0
    assert mine.read_text() == its.read_text() == done.text
    assert done.findings
    if kind == 'ros':
        with pytest.raises(InputError, match='give its path, or `output`, beside which'):
            imu_calib.export(result, kind)
    else:
        again = imu_calib.export(result, kind, sample_rate=100.0, imu=load_imu('fog_medium'))
        assert again.text == done.text


def test_what_cannot_be_exported_is_refused(result, tmp_path):
    file = tmp_path / 'c.yaml'
    result.calibration.save(file)
    with pytest.raises(InputError, match="`format`: found 'json', expected one of ros, kalibr"):
        imu_calib.export(file, 'json')
    with pytest.raises(InputError, match='`sample_rate`: found -1'):
        imu_calib.export(file, 'kalibr', sample_rate=-1.0)
    with pytest.raises(InputError, match='is the calibration itself'):
        imu_calib.export(file, 'c', file)


def test_repeated_sessions_are_those_of_the_command(folder, capsys, monkeypatch):
    repeated = imu_calib.montecarlo(folder / 'brief.yaml', runs=2, seed=5, terms='none')
    assert [run.seed for run in repeated.outcome.runs] == [5, 6]
    # Of 48 normalised errors: four deviations of their root mean square (1 / sqrt(2 * 48)).
    assert np.sqrt((repeated.outcome.normalised**2).mean()) == pytest.approx(1.0, abs=0.41)
    frame = repeated.to_dataframe()
    assert frame.loc['D_gz', 'worst'] == pytest.approx(repeated.outcome.worst[11] / DEG_H)
    (axes,) = repeated.plot().axes
    assert [t.get_text() for t in axes.get_xticklabels()] == list(frame.index)

    def known(study, runs, seed, jobs, *_):
        assert (runs, seed, jobs) == (2, 5, 1)
        assert study.setup.plan.name == repeated.setup.plan.name
        assert not study.setup.search_terms
        return repeated.outcome

    monkeypatch.setattr(repeating, 'repeat', known)
    words = ['montecarlo', str(folder / 'brief.yaml'), '--runs', '2', '--seed', '5', '--jobs', '1']
    assert main([*words, '--terms', 'none']) == 0
    shown = capsys.readouterr().out
    assert f'{frame.loc["D_gz", "normalised"]:.3f}' in shown
    with pytest.raises(InputError, match='expected a whole number from 1 on'):
        imu_calib.montecarlo(folder / 'brief.yaml', runs=0)


def test_dwells_are_found_that_reach_what_is_wanted(folder):
    asked = folder / 'brief.yaml', 'fog_medium', {'D_gx': '0.05 deg/h'}
    reached = imu_calib.reach(*asked, bias_instability=False)
    places = {p.name: k for k, p in enumerate(reached.forecast.parameters)}
    std = reached.forecast.std[places['D_gx']] / DEG_H
    # Dwells are found to a thousandth below what is wanted.
    assert std == pytest.approx(0.05, rel=5e-3)
    again = imu_calib.predict(reached.plan, 'fog_medium')
    assert again.std['D_gx'] / DEG_H == pytest.approx(std)
    assert again.to_dataframe().loc['D_gx', 'std'] == pytest.approx(std)
    table = imu_calib.load_table('three_axis')
    standing = sum(step.dwell for step in reached.plan.steps(table))
    assert again.duration > standing
    # Biases that drift need longer dwells, and the plan is a file.
    more = imu_calib.reach(*asked, output=folder / 'mine.yaml')
    written = load_plan(folder / 'mine.yaml')
    assert sum(p.dwell for p in written.positions) > standing
    known = imu_calib.predict(written, 'fog_medium', bias_instability=True).std['D_gx']
    assert known / DEG_H == pytest.approx(0.05, rel=5e-3)
    assert written.text('mine') == more.plan.text('mine')
    with pytest.raises(InputError, match=r'`reach` D_gx=0\.0: a standard deviation is above zero'):
        imu_calib.reach(folder / 'brief.yaml', 'fog_medium', {'D_gx': 0.0})


def test_noise_and_residuals_are_pictures_that_notebooks_show(result):
    calibration = result.calibration
    gyros, accels = calibration.plot_residuals().axes
    assert len(gyros.get_lines()) == 1 + 3
    assert [t.get_text() for t in accels.get_xticklabels()] == [
        r.position for r in calibration.residuals
    ]
    assert accels.get_lines()[1].get_ydata()[2] == pytest.approx(
        calibration.residuals[2].accel[0] / MICRO_G
    )
    noise = calibration.noise['gx']
    picture = calibration.plot_noise()
    drawn = picture.axes[0].get_lines()[0]
    assert drawn.get_xdata() == pytest.approx(noise.tau)
    assert drawn.get_ydata() == pytest.approx(noise.deviation / DEG_H)
    assert picture._repr_png_().startswith(b'\x89PNG')


def test_a_truth_has_no_residuals_to_draw(result):
    with pytest.raises(InputError, match='carries no residuals: it was not made of a recording'):
        replace(result.calibration, residuals=()).plot_residuals()


def test_no_more_names_are_below_an_axis_than_can_be_read(result):
    rows = result.calibration.residuals
    many = replace(result.calibration, residuals=(rows * 9)[:70])
    axes = many.plot_residuals().axes[0]
    assert axes.get_xticks().tolist() == list(range(0, 70, 4))
    assert [t.get_text() for t in axes.get_xticklabels()][1] == many.residuals[4].position


def test_a_calibration_that_follows_the_temperature_does_so_as_a_value_too(result):
    mine = result.calibration
    asked = split_terms('thermal:D_gx')[1]
    zeros = np.zeros((len(asked), len(asked)))
    cross = np.zeros((len(mine.parameters), len(asked)))
    follows = replace(mine, changes=Changes(asked, zeros[0], zeros, cross))
    loaded, name = as_applied(follows)
    assert isinstance(loaded, imu_calib.ThermalCalibration)
    assert name == f'calibration of {mine.imu.id}'
    assert as_applied(replace(result, calibration=mine))[0] is mine


@pytest.mark.parametrize(
    ('ask', 'words'),
    [
        (
            lambda: imu_calib.compare(None, None),
            '`calibrations`: found None, expected a Result',
        ),
        (lambda: imu_calib.load_imu(None), '`name`: found None, expected a text or a path.'),
        (lambda: imu_calib.calibrate(None), '`bag`: found None, expected a text, a path, a DataF'),
        (lambda: imu_calib.calibrate(''), "found '', expected the path of a recording"),
        (lambda: imu_calib.montecarlo('twelve_position', runs=2.5), '`runs`: found 2.5'),
        (lambda: imu_calib.simulate('six_position', 'there', seed=-1), '`seed`: found -1'),
    ],
)
def test_what_is_none_of_what_is_expected_gets_a_sentence(ask, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words):
        ask()
