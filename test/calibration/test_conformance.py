"""Every parameter of the model, in every place that must know it: all agree, or refuse in words.

The formulas are written out once more here, in plain loops: nothing of the package predicts for it.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from c_program import compensated_in_c
from evidence import CLOCK, SECOND, WALK, statistics
from sessions import SITE, truth

from imu_calib.calibration.calibration import Calibration
from imu_calib.calibration.compensate import Compensation, Mark, concatenated
from imu_calib.calibration.exports import EXPORTS, ExportSource
from imu_calib.calibration.provenance import check_plausible
from imu_calib.calibration.thermal import (
    ThermalCalibration,
    by_temperature,
    combine,
    load_calibration,
)
from imu_calib.calibration.verify import Verdict, verify
from imu_calib.common.errors import InputError, NotObservable
from imu_calib.common.rotations import rotation
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG
from imu_calib.estimation import joint
from imu_calib.estimation.equations import Equations
from imu_calib.estimation.estimate import estimate
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.free_dwells import Sensors
from imu_calib.estimation.solve import check_observable
from imu_calib.estimation.system import Observed
from imu_calib.model.parameters import PARAMETERS, Parameter, ParameterKind
from imu_calib.model.sensors import PRODUCTS, SensorModel, gravity_slope, parameters_of
from imu_calib.model.session_terms import Changes, Course, change
from imu_calib.model.terms import TERMS, Term
from imu_calib.reports.assessment import assess, limits_tables
from imu_calib.reports.side_by_side import comparison_table, in_scale_of, side_by_side
from imu_calib.reports.tables import parameter_table
from imu_calib.segmentation.segments import Segment, Turn
from imu_calib.session.imu import load_imu
from imu_calib.session.plan import load_plan
from imu_calib.simulation.imu import SimulatedImu
from imu_calib.simulation.options import ImuOptions

REFERENCE = math.pi / 3
"""60 deg/s, at which the coefficients of gyros' terms are stated."""

SHOWN = {
    'K_g': ('ppm', 1e-6),
    'K_a': ('ppm', 1e-6),
    'E_g': ('arcmin', math.pi / 180 / 60),
    'E_a': ('arcmin', math.pi / 180 / 60),
    'D_g': ('deg/h', math.pi / 180 / 3600),
    'D_a': ('ug', 9.80665e-6),
    'G_g': ('(deg/h)/g', math.pi / 180 / 3600 / 9.80665),
    'A_g': ('ppm', 1e-6),
    'N_g': ('ppm', 1e-6),
    'C_g': ('ppm', 1e-6),
    'Q_g': ('ppm', 1e-6),
    'K2_a': ('ug/g^2', 1e-6 / 9.80665),
    'A_a': ('ppm', 1e-6),
    'K3_a': ('ug/g^3', 1e-6 / 9.80665**2),
    'X_a': ('ug/g^2', 1e-6 / 9.80665),
    'P_a': ('mm', 1e-3),
    'T_a': ('ms', 1e-3),
    'G2_g': ('(deg/h)/g^2', math.pi / 180 / 3600 / 9.80665**2),
}
"""Unit of people and its SI value, by the beginning of a name: 1 ug/g^2 is 1e-6 g per g^2."""

SETS = [*[(term,) for term in TERMS], TERMS]
NAMES = [*(term.name for term in TERMS), 'all']
of_sets = pytest.mark.parametrize('terms', SETS, ids=NAMES)

AT_REST = tuple(term for term in TERMS if not term.moving)
of_resting = pytest.mark.parametrize(
    'terms',
    [*[(term,) for term in AT_REST], AT_REST],
    ids=[*(term.name for term in AT_REST), 'all'],
)
"""Of rests and turns: what only motion shows is asked in test_motion_terms.py."""


def plain(values: Mapping[str, float], w: Floats, f: Floats) -> list[float]:
    """Six outputs by the formulas of each term, one after the other."""
    v = defaultdict(float, values)
    out = []
    for i, x in enumerate('xyz'):
        n = (1 + v[f'K_g{x}']) * w[i] + v[f'D_g{x}']
        for j, y in enumerate('xyz'):
            n += v[f'E_g{x}{y}'] * w[j] if j != i else 0.0
            n += v[f'G_g{x}{y}'] * f[j]
        n += v[f'A_g{x}'] * abs(w[i])
        n += v[f'N_g{x}'] * w[i] * abs(w[i]) / REFERENCE
        n += v[f'C_g{x}'] * w[i] ** 3 / REFERENCE**2
        n += v[f'Q_g{x}'] * w[i] ** 2 / REFERENCE
        n += v[f'G2_g{x}'] * f[i] ** 2
        out.append(float(n))
    for i, x in enumerate('xyz'):
        n = (1 + v[f'K_a{x}']) * f[i] + v[f'D_a{x}']
        for j, y in enumerate('xyz'):
            n += v[f'E_a{x}{y}'] * f[j] if j != i else 0.0
        n += v[f'K2_a{x}'] * f[i] ** 2
        n += v[f'A_a{x}'] * abs(f[i])
        n += v[f'K3_a{x}'] * f[i] ** 3
        n += v[f'X_a{x}xy'] * f[0] * f[1] + v[f'X_a{x}xz'] * f[0] * f[2]
        n += v[f'X_a{x}yz'] * f[1] * f[2]
        out.append(float(n))
    return out


def outputs(values: Mapping[str, float], rate: Floats, force: Floats) -> tuple[Floats, Floats]:
    """Outputs of many samples, (n, 3) each."""
    both = np.array([plain(values, w, f) for w, f in zip(rate, force, strict=True)])
    return both[:, :3], both[:, 3:]


@cache
def unit(terms: tuple[Term, ...]) -> SensorModel:
    """Large errors of all 24 kinds, and of the terms a fiftieth of what any IMU may have."""
    rng = np.random.default_rng(11)
    parameters = parameters_of(terms)
    sizes = [1e-3 if p in PARAMETERS else 0.02 * (p.unit.limit or 0.0) for p in parameters]
    signs = rng.choice([-1.0, 1.0], len(parameters))
    values = np.array(sizes) * signs * rng.uniform(0.5, 1.0, len(parameters))
    return SensorModel().with_values(parameters, values)


def named(model: SensorModel) -> dict[str, float]:
    values = model.values(model.parameters)
    return dict(zip([p.name for p in model.parameters], values.tolist(), strict=True))


def samples(count: int = 40, seed: int = 0) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 2.0, (count, 3)), rng.normal(0, 9.8, (count, 3))


def known(model: SensorModel, spread: Floats | None = None, **provenance: object) -> Calibration:
    """A calibration of a unit in SI."""
    n = len(model.parameters)
    covariance = np.zeros((n, n)) if spread is None else spread
    imu = load_imu('si')
    # A range says how steep terms can become.
    gyro = replace(imu.gyro, range=500 * DEG)
    imu = replace(imu, gyro=gyro, accel=replace(imu.accel, range=100.0))
    return Calibration(imu, model, covariance, provenance=provenance, parameters=model.parameters)


def spread_of(model: SensorModel) -> Floats:
    """Some full covariance: deviations of a tenth of the values."""
    rng = np.random.default_rng(3)
    n = len(model.parameters)
    root = rng.normal(size=(n, n)) / np.sqrt(n) * np.abs(model.values(model.parameters)) / 10
    return np.asarray(root.T @ root)


# ---------------------------------------------------------------- the model


def test_every_parameter_has_a_name_a_unit_a_product_and_a_row_for_each_export():
    parameters = parameters_of(TERMS, skewed=4)
    assert len({p.name for p in parameters}) == len(parameters) == 24 + 49 + 16
    assert set(PRODUCTS) == set(parameters)
    for kind in ParameterKind:
        assert set(kind.value.exports) == set(EXPORTS)
        assert kind.value.words
        assert kind.value.key
    for parameter in parameters:
        assert parameter.unit.si
        assert parameter.unit.dimension.value[
            parameter.unit.si if parameter.unit.si != '1' else 'ppm'
        ]
    assert {t.kind for t in TERMS} == {p.kind for p in parameters_of(TERMS)} - {
        p.kind for p in PARAMETERS
    }
    for term in TERMS:
        assert term.needs
        assert term.kind.value.key == term.name


@of_sets
def test_the_prediction_is_the_formula(terms):
    model, (rate, force) = unit(terms), samples()
    for found, expected in zip(
        model.predict(rate, force), outputs(named(model), rate, force), strict=True
    ):
        assert found == pytest.approx(expected, rel=1e-13, abs=1e-13)


@of_sets
def test_derivatives_and_slopes_are_those_of_the_formula(terms):
    model, (rate, force) = unit(terms), samples(5)
    parameters, values = model.parameters, named(model)
    by_parameters = model.derivatives(rate, force, parameters)
    slopes = model.slopes(rate, force)
    for k, (w, f) in enumerate(zip(rate, force, strict=True)):
        for n, parameter in enumerate(parameters):
            # Outputs are linear in the parameters: any step does.
            moved = {**values, parameter.name: values[parameter.name] + 1.0}
            slope = np.array(plain(moved, w, f)) - plain(values, w, f)
            assert by_parameters[k, :, n] == pytest.approx(slope, rel=1e-9, abs=1e-9)
        for n, step in enumerate(1e-6 * np.eye(6)):
            up = plain(values, w + step[:3], f + step[3:])
            down = plain(values, w - step[:3], f - step[3:])
            slope = (np.array(up) - down) / 2e-6
            # Third derivatives are below one: 1e-12, and rounding of 1e-14 over 1e-6.
            assert slopes[k, :, n] == pytest.approx(slope, abs=1e-7)


@of_sets
def test_compensation_undoes_the_formula(terms):
    model, (rate, force) = unit(terms), samples()
    found = model.compensate(*outputs(named(model), rate, force))
    assert found[0] == pytest.approx(rate, abs=1e-12)
    assert found[1] == pytest.approx(force, abs=1e-11)
    one = model.compensate(*(v[0] for v in outputs(named(model), rate, force)))
    assert one[0].tolist() == found[0][0].tolist()


def test_what_cannot_be_inverted_is_refused():
    # Beyond w = -w_ref / (2 Q) a quadratic turns back: no rate reads so little.
    model = SensorModel().with_values(parameters_of(TERMS)[42:45], np.array([-0.04, 0, 0]))
    assert list(model.terms) == ['gyro_quadratic']
    with pytest.raises(NotObservable, match='gyro_quadratic'):
        model.compensate(np.array([30.0, 0, 0]), np.zeros(3))


# ---------------------------------------------------------------- compensation


@of_sets
def test_samples_are_compensated_live_and_in_bulk(terms):
    model, (rate, force) = unit(terms), samples(700)
    gyro, accel = outputs(named(model), rate, force)
    applied = Compensation(known(model))
    whole = applied.apply(gyro, accel, np.full(len(rate), 0.01))
    assert whole.rate == pytest.approx(rate, abs=1e-11)
    assert whole.force == pytest.approx(force, abs=1e-11)
    assert not whole.marks.any()
    pairs = zip(gyro[:60], accel[:60], strict=True)
    alone = concatenated([applied.apply(g[None], a[None], np.array([0.01])) for g, a in pairs])
    for part in ('rate', 'force', 'rate_covariance', 'force_covariance'):
        assert getattr(alone, part).tobytes() == getattr(whole, part)[:60].tobytes()


@of_sets
def test_the_covariance_of_a_sample_is_that_of_the_parameters(terms):
    model, (rate, force) = unit(terms), samples(4)
    gyro, accel = outputs(named(model), rate, force)
    spread = spread_of(model)
    found = Compensation(known(model, spread)).apply(gyro, accel, np.full(4, 0.01))
    parameters, values = model.parameters, model.values(model.parameters)
    columns = []
    for step in np.diag(1e-6 * np.abs(values)):
        up, down = (model.with_values(parameters, values + s) for s in (step, -step))
        moved = np.hstack(up.compensate(gyro, accel)) - np.hstack(down.compensate(gyro, accel))
        columns.append(moved / (2 * step.sum()))
    jacobian = np.array(columns).transpose(1, 2, 0)
    expected = jacobian @ spread @ jacobian.transpose(0, 2, 1)
    for first, part in ((0, found.rate_covariance), (3, found.force_covariance)):
        block = expected[:, first : first + 3, first : first + 3].reshape(4, 9)
        # Second order in deviations of the parameters of a thousandth and less.
        assert part == pytest.approx(block, abs=2e-3 * np.abs(block).max())


def test_a_sample_that_no_input_explains_is_no_number():
    model = SensorModel().with_values(parameters_of(TERMS)[42:45], np.array([-0.04, 0, 0]))
    gyro = np.array([[1.0, 0, 0], [8.0, 0, 0], [1.0, 0, 0]])
    found = Compensation(known(model)).apply(gyro, np.zeros((3, 3)), np.full(3, 0.01))
    assert found.marks.tolist() == [0, int(Mark.NO_NUMBER), 0]
    assert np.isnan(found.rate[1]).all()
    assert found.rate_covariance[1, 0] == -1.0


# ---------------------------------------------------------------- files, messages, temperature


@of_sets
def test_a_file_keeps_every_parameter(terms):
    model = unit(terms)
    calibration = known(model, spread_of(model))
    text = calibration.to_yaml()
    again = Calibration.from_yaml(text, 'file')
    assert again.parameters == calibration.parameters
    assert again.values.tolist() == calibration.values.tolist()
    assert again.covariance.tolist() == calibration.covariance.tolist()
    for term in terms:
        assert f'  {term.name}:' in text
        channel = '[i]' if len(term.parameters) > 1 else ''
        assert f'add {term.name}{channel}' in text


def test_a_truth_by_hand_states_any_term_and_no_wrong_one():
    text = truth().to_yaml()
    head = text.split('covariance:')[0]
    stated = head.replace('accelerometer:\n', 'accelerometer:\n  accel_quadratic: [1.0e-6, 0, 0]\n')
    found = Calibration.from_yaml(stated, 'mine.yaml')
    assert named(found.model)['K2_ax'] == 1e-6
    for wrong, message in (
        (stated.replace('[1.0e-6, 0, 0]', '[1.0e-6, 0]'), 'found 2 numbers, expected 3'),
        (stated.replace('accel_quadratic', 'accel_quadratics'), "unknown key 'accel_quadratics'"),
        (stated.replace('accel_quadratic', 'gyro_cubic'), "unknown key 'gyro_cubic'"),
        (stated.replace('1.0e-6', '1.0'), 'accelerometer quadratic term: found 1 '),
    ):
        with pytest.raises(InputError, match=message):
            Calibration.from_yaml(wrong, 'mine.yaml')


def provenance() -> dict[str, object]:
    return {
        'plan': 'p',
        'method': 'joint',
        'gravity': 9.8,
        'latitude_deg': 34.0,
        'segments': 1,
        'turns': 1,
        'samples': 1,
        'residual_rms': [0.0] * 6,
        'condition_number': 1.0,
        'random_walk': [0.0] * 6,
        'highest_rate': None,
        'temperature': None,
    }


def conversion() -> tuple[Callable[[Calibration], Any], Callable[[Any], Calibration]]:
    """Return what makes a message of a calibration, and what reads it."""
    from imu_calib.live.middleware import Time
    from imu_calib.live.nodes.convert import calibration_message, calibration_of

    stamp = Time(nanoseconds=1).to_msg()
    return lambda calibration: calibration_message(
        calibration, 0, 'imu_link', stamp
    ), calibration_of


@of_sets
def test_a_message_keeps_every_parameter(terms):
    message_of, calibration_of = conversion()
    model = unit(terms)
    calibration = known(model, spread_of(model), **provenance())
    message = message_of(calibration)
    again = calibration_of(message)
    assert again.parameters == calibration.parameters
    assert again.values.tolist() == calibration.values.tolist()
    assert again.covariance.tolist() == calibration.covariance.tolist()
    if message.term_parameters:
        message.term_units = ['furlong', *message.term_units[1:]]
        with pytest.raises(InputError, match='furlong'):
            calibration_of(message)
        message.term_parameters = ['Z_gx', *message.term_parameters[1:]]
        with pytest.raises(InputError, match="does not know its parameter 'Z_gx'"):
            calibration_of(message)


@pytest.mark.parametrize('course', Course)
def test_a_message_keeps_what_follows_time_or_temperature(course):
    message_of, calibration_of = conversion()
    model = unit(())
    changes = (change(course, 'K_gx'), change(course, 'D_az'))
    cross = np.arange(48.0).reshape(24, 2) * 1e-9
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]]) * 1e-10
    calibration = replace(
        known(model, spread_of(model), **provenance()),
        changes=Changes(changes, np.array([2e-5, -3e-4]), covariance, cross, 120.0, 1.7e9),
    )
    message = message_of(calibration)
    found = calibration_of(message).changes
    assert found.changes == changes
    assert found.values.tolist() == [2e-5, -3e-4]
    assert found.covariance.tolist() == covariance.tolist()
    assert found.cross.tolist() == cross.tolist()
    assert (found.time_constant, found.instant) == (120.0, 1.7e9)
    for field, value, words in (
        ('change_units', ['furlong', *message.change_units[1:]], 'furlong'),
        ('change_cross_covariance', message.change_cross_covariance[:-1], r'2, 2, 4, 47\] numbers'),
        ('change_terms', ['tide', 'tide'], "found 'tide', expected trend, warm_up, step, thermal"),
        ('change_of', ['Z_gx', 'D_az'], 'Z_gx'),
    ):
        kept = getattr(message, field)
        setattr(message, field, value)
        with pytest.raises(InputError, match=words):
            calibration_of(message)
        setattr(message, field, kept)


def test_a_calibration_by_message_follows_the_temperature_as_its_file_does():
    message_of, calibration_of = conversion()
    model = unit(())
    kelvin = Changes(
        (change(Course.THERMAL, 'K_gx'),), np.array([2e-5]), np.eye(1), np.zeros((24, 1))
    )
    temperature = {'mean': 25.0, 'lowest': 15.0, 'highest': 35.0}
    calibration = replace(
        known(model, spread_of(model), **{**provenance(), 'temperature': temperature}),
        changes=kelvin,
    )
    message = message_of(calibration)
    ready = by_temperature(calibration_of(message), 'topic')
    assert isinstance(ready, ThermalCalibration)
    at, index = ready.at(30.0), calibration.parameters.index(PARAMETERS[0])
    assert at.values[index] == pytest.approx(calibration.values[index] + 5 * 2e-5, rel=1e-12)
    message.reference_temperature = float('nan')
    with pytest.raises(InputError, match='topic: provenance: temperature: found None'):
        by_temperature(calibration_of(message), 'topic')


@of_sets
def test_temperature_interpolates_every_parameter(terms, tmp_path):
    model = unit(terms)
    parts = []
    for celsius, factor in ((0.0, 1.0), (20.0, 3.0)):
        values = factor * model.values(model.parameters)
        temperature = {'mean': celsius, 'lowest': celsius, 'highest': celsius}
        parts.append(known(model.with_values(model.parameters, values), temperature=temperature))
    combine(parts, ['a', 'b']).save(tmp_path / 'both.yaml')
    both = load_calibration(tmp_path / 'both.yaml')
    assert not isinstance(both, Calibration)
    assert both.at(10.0).values == pytest.approx(2 * model.values(model.parameters), rel=1e-12)
    lacking = known(unit(()), temperature={'mean': 40.0, 'lowest': 40.0, 'highest': 40.0})
    with pytest.raises(InputError, match=terms[0].parameters[0].name):
        combine([*parts, lacking], ['a', 'b', 'c'])


# ---------------------------------------------------------------- people


@of_sets
def test_every_parameter_is_shown_by_its_name_in_its_unit(terms):
    model = unit(terms)
    calibration = known(model, spread_of(model))
    values, deviations = named(model), calibration.std
    rows = [list(c.cells) for c in parameter_table(calibration).columns]
    shown = {str(r[0]): tuple(map(str, r[1:])) for r in zip(*rows, strict=True)}
    assert list(shown) == [p.name for p in model.parameters]
    page = limits_tables(assess(calibration, None))
    for (name, (value, std, unit_shown)), deviation in zip(shown.items(), deviations, strict=True):
        words, scale = SHOWN[name[: name.index('_') + 2]]
        assert unit_shown == words
        # Two digits of the deviation are shown.
        assert float(value) * scale == pytest.approx(values[name], abs=0.06 * deviation)
        assert float(std) * scale == pytest.approx(deviation, rel=0.06)
        assert f'>{name}<' in page


@of_sets
def test_in_another_scale_the_unit_reads_the_same_numbers(terms):
    model, (rate, force) = unit(terms), samples(5)
    calibration = known(model, spread_of(model))
    imu = calibration.imu
    other = replace(
        calibration,
        imu=replace(
            imu,
            gyro=replace(imu.gyro, scale_factor=2.0),
            accel=replace(imu.accel, scale_factor=4.0),
        ),
    )
    seen = in_scale_of(calibration, other)
    gyro, accel = outputs(named(model), rate, force)
    found = seen.model.predict(rate, force)
    assert found[0] == pytest.approx(2 * gyro, rel=1e-12)
    assert found[1] == pytest.approx(4 * accel, rel=1e-12)
    table = comparison_table(side_by_side([calibration, seen]), ['a', 'b'])
    assert list(table.columns[0].cells)[24:] == [p.name for p in model.parameters[24:]]
    # Lengths and times do not double with the outputs.
    for parameter in model.parameters:
        if parameter.unit.si in {'m', 's'}:
            assert seen.model.values((parameter,)) == model.values((parameter,))


@of_sets
def test_limits_are_by_kind(terms):
    for parameter in parameters_of(terms)[24:]:
        limit = parameter.unit.limit
        assert limit is not None
        for share, refused in ((0.99, False), (1.01, True)):
            model = unit(terms).with_values((parameter,), np.array([share * limit]))
            if not refused:
                check_plausible(known(model), 'file')
                continue
            with pytest.raises(InputError, match=rf'\({parameter.name}\)'):
                check_plausible(known(model), 'file')


@of_sets
def test_a_wrong_gravity_changes_parameters_by_their_share_of_force(terms):
    # Outputs stay what they are where forces are larger by a ten-millionth: what changes instead?
    model, more = unit(terms), 1e-7
    rate, force = samples(60)
    gyro, accel = outputs(named(model), rate, force)
    slope = gravity_slope(model, model.parameters)
    moved = model.with_values(model.parameters, model.values(model.parameters) + more * slope)
    found = outputs(named(moved), rate, force * (1 + more))
    # Second order in it is 1e-14 of some ten.
    assert found[0] == pytest.approx(gyro, abs=1e-12)
    assert found[1] == pytest.approx(accel, abs=1e-12)


# ---------------------------------------------------------------- exports


@of_sets
def test_exports_carry_every_parameter_or_refuse_it(terms):
    calibration = known(unit(terms), random_walk=[1e-5] * 6)
    sheet = load_imu('fog_medium')
    for name, export in EXPORTS.items():
        source = ExportSource(calibration, Path('/c.yaml'), 100.0, sheet=sheet)
        # The formulas of Kalibr and imucal (test_exports.py) have a place for G and no other.
        products = [t for t in terms if t.name != 'g_sensitivity' and not t.moving]
        refused = products if name in {'kalibr', 'imucal'} else []
        if not refused:
            exported = export(source)
            assert exported.text
            # At rest files are right without what only motion shows, and the node takes it off.
            for term in (t for t in terms if t.moving and name != 'ros'):
                assert f'The {term.kind.value.words} is left out.' in exported.findings
            continue
        with pytest.raises(InputError) as error:
            export(source)
        for term in refused:
            assert term.kind.value.words in str(error.value)
            assert term.parameters[0].name in str(error.value)


@of_sets
def test_the_c_header_takes_every_term_off(terms, tmp_path):
    model, (rate, force) = unit(terms), samples(8)
    text = EXPORTS['c'](ExportSource(known(model), Path('/c.yaml'))).text
    found = compensated_in_c(tmp_path, text, np.hstack(outputs(named(model), rate, force)))
    assert found[:, 0::2] == pytest.approx(rate, abs=1e-11)
    assert found[:, 1::2] == pytest.approx(force, abs=1e-11)


def test_a_header_whose_rounds_would_not_end_is_refused():
    model = SensorModel().with_values(parameters_of(TERMS)[39:42], np.array([0.04, 0, 0]))
    with pytest.raises(NotObservable, match='gyro_cubic outgrow'):
        EXPORTS['c'](ExportSource(known(model), Path('/c.yaml')))


# ---------------------------------------------------------------- sessions


def attitudes() -> list[Floats]:
    """Body axes along those of the table, and each of them slanted by 45 degrees."""
    found = []
    for order in permutations(range(3)):
        for signs in ((1, 1), (-1, -1)):
            axes = np.eye(3)[:, list(order)] * np.array([*signs, 1])
            axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
            found.append(axes)
    turned = [rotation(np.eye(3)[k % 3], 45 * DEG) for k in range(len(found))]
    return [*found, *(a @ t for a, t in zip(found, turned, strict=True))]


RATES = np.array([10.0, -10.0, 25.0, -25.0, 60.0, -60.0, 90.0, -90.0]) * DEG


@cache
def session_of(
    terms: tuple[Term, ...],
) -> tuple[list[tuple[Floats, list[float]]], list[tuple[Floats, Floats, float]]]:
    """Rests by attitude and turns by rate, as the formulas say, means over a whole turn."""
    values = named(unit(terms))
    rests = [
        (a, plain(values, a.T @ SITE.earth_rate, a.T @ SITE.specific_force)) for a in attitudes()
    ]
    turns = []
    for axis in range(3):
        upright = next(a for a in attitudes() if a[2, axis] > 0.999)
        for rate in RATES.tolist():
            sums = np.zeros(6)
            for step in range(120):
                body = (rotation(np.array([0.0, 0, 1]), step * 3 * DEG) @ upright).T
                spin = body @ SITE.earth_rate + body[:, 2] * rate
                sums += plain(values, spin, body @ SITE.specific_force)
            turns.append((sums / 120, upright[2], rate))
    return rests, turns


def evidence_of(terms: tuple[Term, ...]) -> Evidence:
    rests, spins = session_of(terms)
    segments, turns, now = [], [], 0
    for output, up, rate in spins:
        seconds = 2 * math.pi / abs(rate)
        found = statistics(output, seconds)
        angle = math.copysign(2 * math.pi, rate)
        turns.append(Turn(now, now + 1, found, angle, seconds, up, 't'))
        now += 100 * SECOND
    for k, (attitude, output) in enumerate(rests):
        found = statistics(np.array(output), 60.0)
        segments.append(Segment(now, now + 1, found, attitude, str(k)))
        now += 200 * SECOND
    plan = load_plan('twelve_position')
    return Evidence(tuple(segments), tuple(turns), plan, SITE, CLOCK, 0.0, WALK)


def observed(terms: tuple[Term, ...]) -> Observed:
    return Observed(evidence_of(terms), load_imu('si'))


@pytest.mark.parametrize('triads', ['g', 'a', 'ga'])
def test_the_joint_estimate_finds_every_parameter(triads):
    terms = tuple(term for term in AT_REST if term.triad in triads)
    parameters = parameters_of(terms)
    found = estimate(evidence_of(terms), parameters)
    wanted = unit(terms).values(parameters)
    got = found.state[: len(parameters)]
    std = np.sqrt(np.diag(found.covariance))[: len(parameters)]
    # Without noise what is left is how far means over 120 and 8 headings differ for what has a
    # kink, |w|: some 3 % of the level Earth rate times a thousandth, 2e-9 rad/s, of which
    # next to nothing gets into one parameter; noise as stated would leave 2e-7 and more.
    assert np.abs((got - wanted) / std).max() < 0.05


@of_resting
def test_verify_accepts_with_every_term_and_names_the_one_that_is_missing(terms):
    model = unit(terms)
    observation = observed(terms)
    # Deviations far below the session's own, and none that is zero.
    spread = np.diag((1e-7 * np.abs(model.values(model.parameters))) ** 2)
    accepted = verify(known(model, spread), observation)
    assert accepted.verdict is Verdict.PASS
    for judged in accepted.triads:
        # Nothing but rounding, and the headings of a mean, is left of it.
        assert judged.chi_square < 0.1 * judged.freedom
    if len(terms) > 1:
        return
    lacking = unit(()).with_values(PARAMETERS, model.values(PARAMETERS))
    rejected = verify(known(lacking, spread[:24, :24]), observation)
    (judged,) = [t for t in rejected.triads if t.gyros == (terms[0].triad == 'g')]
    assert judged.verdict is Verdict.FAIL
    assert f'{terms[0].name} is in the model' in judged.diagnosis.symptom


@of_sets
def test_verify_predicts_by_the_formula(terms):
    model, (rate, force) = unit(terms), samples(5)
    gyro, accel = outputs(named(model), rate, force)
    for gyros, read, inputs in ((True, gyro, rate), (False, accel, force)):
        sensors = Sensors.from_parameters(model.parameters, gyros=gyros)
        values = model.values(sensors.parameters)
        predicted = sensors.model(values).predict(rate, force)[0 if gyros else 1]
        assert predicted == pytest.approx(read, rel=1e-12)
        found, by_outputs, by_parameters = sensors.compensated(values, np.array(read), force)
        assert found == pytest.approx(inputs, abs=1e-11)
        # Of a step of 1e-7 the second order is 1e-14 times coefficients, and rounding 1e-16 / 1e-7.
        for k in range(3):
            step = np.eye(3)[k] * 1e-7
            moved = sensors.compensated(values, np.array(read) + step, force)[0]
            assert by_outputs[..., k] == pytest.approx((moved - found) / 1e-7, rel=1e-4, abs=1e-6)
        for k in range(len(values)):
            other = values + np.eye(len(values))[k] * 1e-7
            moved = sensors.compensated(other, np.array(read), force)[0]
            slope = (moved - found) / 1e-7
            assert by_parameters[..., k] == pytest.approx(slope, rel=1e-4, abs=1e-6)


@pytest.mark.parametrize(
    ('names', 'told'),
    [
        # At 0 and 1 g a cubic is a scale factor, and |f| is f^2.
        ({'accel_cubic'}, 'accel_cubic .*K3_ax.* apart from K_ax.* 45 degrees off the vertical'),
        ({'accel_quadratic', 'accel_asymmetry'}, 'accel_quadratic .*apart from A_ax'),
        ({'accel_cross'}, 'accel_cross .*X_axxy.*not observable'),
    ],
)
def test_what_a_plan_cannot_tell_is_refused_by_name(names, told):
    evidence = evidence_of(())
    aligned = replace(evidence, segments=evidence.segments[:12])
    terms = [term for term in TERMS if term.name in names]
    check_observable(Equations(evidence, parameters_of(terms)))
    with pytest.raises(NotObservable, match=told):
        check_observable(Equations(aligned, parameters_of(terms)))


def test_one_rate_does_not_tell_a_scale_factor_that_depends_on_it():
    evidence = evidence_of(())
    slow = tuple(t for t in evidence.turns if abs(abs(t.rate()) - 10 * DEG) < 1e-9)
    terms = [term for term in TERMS if term.name == 'gyro_rate_dependence']
    with pytest.raises(NotObservable, match=r'gyro_rate_dependence.*turns about each axis at two'):
        joint.solve(replace(evidence, turns=slow), tuple(terms))


@of_sets
def test_the_simulated_unit_reads_the_formula(terms):
    options = ImuOptions(noise=False, bias_instability=False, quantise=False, turn_on_gyro=0.0)
    imu = SimulatedImu(load_imu('si'), unit(terms), SITE, options, np.random.default_rng(1))
    rate, force = samples(3)
    found = imu._respond(rate, force, np.arange(4.0))
    for mine, expected in zip(found, outputs(named(unit(terms)), rate, force), strict=True):
        assert mine == pytest.approx(expected, rel=1e-12)


def test_a_parameter_of_no_known_kind_is_an_error_and_no_zero():
    stranger = Parameter(ParameterKind.G_SENSITIVITY, 'a', 0, 0)
    for wrong in (
        lambda: SensorModel().values((stranger,)),
        lambda: SensorModel().with_values((stranger,), np.ones(1)),
        lambda: SensorModel().derivatives(np.zeros(3), np.zeros(3), (stranger,)),
        lambda: stranger.unit,
    ):
        with pytest.raises(KeyError):
            wrong()
