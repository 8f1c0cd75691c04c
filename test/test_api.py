"""The suite from Python: the same results, and the same sentences, as the commands."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from loopback import CHECKOUT

import imu_calib
from imu_calib import Calibration, InputError, NotObservable, Verdict
from imu_calib.bags import open_recording
from imu_calib.cli.main import main
from imu_calib.imu import load_imu
from imu_calib.plan import load_plan
from imu_calib.units import DEG_H, PPM

SITE = ('--latitude', '34.65')


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan of short dwells, its recording and its result."""
    folder = tmp_path_factory.mktemp('api')
    text = Path(CHECKOUT, 'config/plans/twelve_position.yaml').read_text(encoding='utf-8')
    lines = ['dwell: 3.0 s\n' if row.startswith('dwell:') else row for row in text.splitlines(True)]
    (folder / 'brief.yaml').write_text(''.join(lines), encoding='utf-8')
    imu_calib.simulate(folder / 'brief.yaml', folder / 'bag', seed=3, latitude=34.65)
    return folder


@pytest.fixture(scope='module')
def result(folder: Path) -> imu_calib.Result:
    return imu_calib.calibrate(folder / 'bag')


def test_it_loads_what_is_asked_for_alone() -> None:
    code = 'import imu_calib, json, sys; print(json.dumps(sorted(sys.modules)))'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert 'numpy' not in json.loads(done.stdout)


def test_every_name_is_there_and_no_other() -> None:
    for name in imu_calib.__all__:
        assert getattr(imu_calib, name).__name__ == name
    assert set(imu_calib.__all__) <= set(dir(imu_calib))
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        imu_calib.calibrat  # noqa: B018


def test_the_command_gives_the_same_bits(folder: Path, result: imu_calib.Result) -> None:
    file = folder / 'by_command.yaml'
    assert main(['calibrate', str(folder / 'bag'), '-o', str(file)]) == 0
    result.calibration.save(str(folder / 'by_api.yaml'))
    assert file.read_text() == (folder / 'by_api.yaml').read_text()


def test_the_simulated_recording_is_that_of_the_command(folder: Path, tmp_path: Path) -> None:
    words = ['simulate', str(folder / 'brief.yaml'), '-o', str(tmp_path / 'bag'), '--seed', '3']
    assert main([*words, *SITE]) == 0
    with open_recording(tmp_path / 'bag') as one, open_recording(folder / 'bag') as other:
        assert one.sha256() == other.sha256()


def test_it_finds_the_truth_that_was_simulated(folder: Path, result: imu_calib.Result) -> None:
    truth = Calibration.load(str(folder / 'bag' / 'truth.yaml'))
    errors = (result.calibration.values[:24] - truth.values[:24]) / result.calibration.std[:24]
    assert np.abs(errors).max() < 4.5


def test_values_do_where_names_do(folder: Path, result: imu_calib.Result) -> None:
    plan, imu = load_plan(folder / 'brief.yaml'), load_imu('fog_medium')
    again = imu_calib.calibrate(str(folder / 'bag'), plan=plan, imu=imu, latitude=34.65)
    # The recording says the same of itself, but for how well the latitude is known.
    assert again.calibration.values == pytest.approx(result.calibration.values, rel=1e-6)


def test_terms_are_left_out_where_they_are_not_wanted(folder: Path) -> None:
    result = imu_calib.calibrate(folder / 'bag', terms='none')
    assert not result.calibration.provenance['terms_looked_for']
    with pytest.raises(InputError, match='nonsense'):
        imu_calib.calibrate(folder / 'bag', terms='nonsense')


def test_progress_is_shown_to_who_asks(folder: Path) -> None:
    opened: list[str] = []
    shown: list[float] = []

    class Bar:
        def __init__(self, text: str) -> None:
            opened.append(text)

        def __enter__(self) -> object:
            return lambda done, total, *_: shown.append(done / total)

        def __exit__(self, *_: object) -> None: ...

    imu_calib.calibrate(folder / 'bag', progress=Bar)
    assert opened == ['reading']
    assert shown == sorted(shown)
    assert shown[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('stated', 'error', 'sentence'),
    [
        ({'plan': 'no_such'}, InputError, "No plan is called 'no_such'; there are: .*twelve_pos"),
        ({'imu_topic': '/else'}, InputError, r'--imu-topic /else: .* it has: /imu/pulses'),
        ({'azimuth': float('nan')}, InputError, '--azimuth: found nan, expected degrees'),
        ({'serial': '7', 'latitude': 95.0}, InputError, 'latitude'),
        ({'plan': 'six_position'}, InputError, 'setpoints of the recording are of plan twelve'),
        ({'latitude': -60.0}, NotObservable, 'latitude'),
    ],
)
def test_errors_are_the_sentences_of_the_command(
    folder: Path, stated: dict[str, object], error: type[Exception], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        imu_calib.calibrate(folder / 'bag', **stated)  # type: ignore[arg-type]


def test_read_gives_columns_with_stamps_and_units(folder: Path) -> None:
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


def test_columns_are_data_frames_too(folder: Path) -> None:
    frame = imu_calib.read(folder / 'bag', '/imu/pulses').to_dataframe()
    assert isinstance(frame.index, pd.DatetimeIndex)
    assert frame.index[0].value == imu_calib.read(folder / 'bag', '/imu/pulses').stamp[0]
    assert frame.attrs['units']['linear_acceleration.z'] == 'pulse'
    assert list(frame.columns[:3]) == [f'angular_velocity.{a}' for a in 'xyz']


def test_parameters_are_a_data_frame_and_a_picture(result: imu_calib.Result) -> None:
    frame = result.calibration.to_dataframe()
    assert frame.loc['D_gx', 'unit'] == 'deg/h'
    at = [p.name for p in result.calibration.parameters].index('D_gx')
    assert frame.loc['D_gx', 'value'] == pytest.approx(result.calibration.values[at] / DEG_H)
    assert frame.loc['K_ay', 'std'] == pytest.approx(result.calibration.std[13] / PPM)
    figure = result.calibration.plot()
    labels = [t.get_text() for axes in figure.axes for t in axes.get_xticklabels()]
    assert sorted(labels) == sorted(frame.index)
    assert {axes.get_ylabel() for axes in figure.axes} == set(frame['unit'])


def test_what_is_not_installed_is_asked_for(
    folder: Path, result: imu_calib.Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr('imu_calib.extras.find_spec', lambda _: None)
    with pytest.raises(InputError, match=r"needs pandas.*pip install 'imu_calib\[dataframe\]'"):
        result.calibration.to_dataframe()
    with pytest.raises(InputError, match=r"needs matplotlib.*pip install 'imu_calib\[plot\]'"):
        result.calibration.plot()
    with pytest.raises(InputError, match='needs pandas'):
        imu_calib.read(folder / 'bag', '/imu/pulses').to_dataframe()


def test_verify_judges_values_and_files(
    folder: Path, result: imu_calib.Result, tmp_path: Path
) -> None:
    imu_calib.simulate(folder / 'brief.yaml', tmp_path / 'other', seed=4, latitude=34.65)
    verification = imu_calib.verify(result.calibration, tmp_path / 'other')
    assert verification.verdict is Verdict.PASS
    same = imu_calib.verify(result.calibration, folder / 'bag')
    assert same.findings[0].startswith('This recording made the calibration')
    with pytest.raises(InputError, match='another'):
        imu_calib.verify(result.calibration, tmp_path / 'other', imu='mems_counts')


def test_compensate_writes_rates_and_forces(
    folder: Path, result: imu_calib.Result, tmp_path: Path
) -> None:
    done = imu_calib.compensate(folder / 'bag', result.calibration, tmp_path / 'si')
    assert done.given == done.taken
    assert done.target == '/imu/data_raw'
    columns = imu_calib.read(tmp_path / 'si', done.target)
    assert columns.units['linear_acceleration.x'] == 'm/s^2'
    assert columns['linear_acceleration.z'][-100:].mean() == pytest.approx(-9.797, abs=0.01)
    with pytest.raises(InputError, match='exists'):
        imu_calib.compensate(folder / 'bag', result.calibration, tmp_path / 'si')


def test_a_prediction_is_what_the_session_reached(folder: Path, result: imu_calib.Result) -> None:
    prediction = imu_calib.predict(folder / 'brief.yaml', 'fog_medium', latitude=34.65)
    names = [p.name for p in result.calibration.parameters]
    reached = dict(zip(names, result.calibration.std, strict=True))
    for name in ('K_gx', 'D_gy', 'E_axy'):
        assert prediction.std[name] == pytest.approx(reached[name], rel=0.5)
    assert prediction.closed_form is not None
    assert {one.term.name for one in prediction.terms} >= {'g_sensitivity', 'gyro_asymmetry'}
    with pytest.raises(InputError, match='terms of the sensors alone'):
        imu_calib.predict(folder / 'brief.yaml', 'fog_medium', terms='trend')


def test_reports_of_results_and_of_files_are_the_same(
    folder: Path, result: imu_calib.Result, tmp_path: Path
) -> None:
    result.calibration.save(tmp_path / 'c.yaml')
    by_value = imu_calib.report(result, tmp_path / 'a.html')
    by_file = imu_calib.report(tmp_path / 'c.yaml', tmp_path / 'b.html', bag=folder / 'bag')
    assert '<svg' in by_value.read_text()
    name = result.calibration.imu.id
    assert by_file.read_text().replace('c.yaml', name) == by_value.read_text()
    with pytest.raises(InputError, match='cannot be written'):
        imu_calib.report(result, tmp_path / 'nowhere' / 'a.html')
