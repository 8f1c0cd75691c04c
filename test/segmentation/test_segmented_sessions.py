"""Whole sessions at the edge of what tables and units send."""

from dataclasses import replace

import numpy as np
import pytest
from extent import again
from sessions import at_one_rate, calibrate, paper_imu, quick_plan, session, stand, truth

from imu_calib.calibration.results import Result
from imu_calib.common.errors import NotObservable
from imu_calib.common.stream import Floats, ImuBlock, JointBlock, SetpointBlock
from imu_calib.common.units import DEG, DEG_H, PPM
from imu_calib.session.imu import ImuSpec, load_imu
from imu_calib.session.plan import Plan
from imu_calib.session.table import load_table
from imu_calib.simulation.options import Vibration

PLAN = at_one_rate(quick_plan('twelve_position', 20.0))


def mems(noise: float) -> ImuSpec:
    """A unit of ADC codes that does not drift, with a multiple of its data sheet's noise."""
    spec = load_imu('mems_counts')
    gyro, accel = (replace(t, bias_instability=0.0) for t in (spec.gyro, spec.accel))
    return replace(
        spec,
        gyro=replace(gyro, random_walk=noise * gyro.random_walk),
        accel=replace(accel, random_walk=noise * accel.random_walk),
    )


def si() -> ImuSpec:
    """The paper's unit behind a driver that publishes SI: noise, no pulses."""
    spec = paper_imu()
    return replace(
        load_imu('si'),
        gyro=replace(spec.gyro, scale_factor=1.0),
        accel=replace(spec.accel, scale_factor=1.0),
    )


def normalised(result: Result) -> Floats:
    errors = result.calibration.model.vector() - truth().model.vector()
    return np.asarray(errors / result.calibration.std)


@pytest.mark.parametrize(
    ('options', 'spec', 'scale_ppm', 'bias_deg_h'),
    [
        ({'joint_state_rate': 1.0}, None, 60, 0.5),
        ({'joint_state_rate': 7.0, 'wrapped': True}, None, 20, 0.5),
        again({'wrapped': True}, None, 6, 0.5),
        ({'encoder_resolution': 0.01 * DEG}, None, 6, 0.5),
        again({'sample_rate': 4000.0}, None, 6, 0.5),
        ({'sample_rate': 1000.0}, None, 6, 0.5),
        ({'sample_rate': 10.0}, None, 6, 0.5),
        ({'imu_stamp_jitter': 0.002, 'joint_stamp_jitter': 0.002}, None, 20, 0.5),
        ({'lead': 1000.0}, None, 6, 0.5),
        ({'servo_error': 0.002 * DEG}, None, 6, 0.5),
        # Turns of 360 deg end somewhere in a swing of 0.005 rad/s at 3 Hz, 55 arcsec: with 10 ppm
        # K_gz was off by 4.2 deviations in another session.
        ({'vibration': Vibration(0.005, 0.05, 3.0, 3.0)}, None, 20, 0.5),
        again({}, si(), 6, 0.5),
        ({}, mems(1.0), 30, 2.0),
        # Less noise than an ADC's step of 220 deg/h: the mean keeps a part of a step.
        ({}, mems(0.01), 300, 30.0),
    ],
)
def test_what_tables_and_units_send(options, spec, scale_ppm, bias_deg_h):
    result = calibrate(
        session(PLAN, stand(azimuth=0.3, **options), seed=1, spec=spec), PLAN, spec=spec
    )
    assert len(result.labelled.segments) == 12
    assert len(result.labelled.turns) == 6
    assert np.abs(normalised(result)).max() < 4.5
    assert result.calibration.std[:3].max() < scale_ppm * PPM
    assert result.calibration.std[9:12].max() < bias_deg_h * DEG_H


def test_two_codes_of_an_adc_tell_no_noise():
    # The joint estimate trusts every deviation: a mean between two codes may be half a step off.
    coarse = mems(0.01)
    blocks = session(PLAN, stand(azimuth=0.3), seed=1, spec=coarse)
    result = calibrate(blocks, PLAN, spec=coarse, method='joint')
    assert np.abs(normalised(result)).max() < 4.5


def test_si_units_need_no_noise_figures():
    result = calibrate(
        session(PLAN, stand(azimuth=0.3), seed=1, spec=si()), PLAN, spec=load_imu('si')
    )
    assert np.abs(normalised(result)).max() < 4.5
    assert result.calibration.std[9:12].max() < 0.5 * DEG_H


def test_clocks_that_are_not_compared_leave_the_angles_of_moves():
    options = stand(azimuth=0.3, joint_state_rate=1.0, clock_rate_error=100e-6)
    result = calibrate(session(PLAN, options, seed=1), PLAN)
    assert np.abs(normalised(result)[:9]).max() < 4.5
    # Turns know K_g to the 50 ppm of the clocks: nothing rests on them.
    assert result.calibration.std[:3].max() < 10 * PPM
    assert not any('compared to' in finding for finding in result.calibration.findings)


def test_turns_that_leave_their_line_widen_what_rests_on_them():
    # Nobody stated that the range ends just below the fastest turn.
    narrow = replace(paper_imu(), gyro=replace(paper_imu().gyro, range=59.99 * DEG))
    plan = quick_plan('twelve_position', 20.0)
    result = calibrate(session(plan, stand(azimuth=0.3), seed=1, spec=narrow), plan)
    assert any('the angle of gyro x scatters by' in f for f in result.calibration.findings)
    assert result.calibration.std[:3].max() > 20 * PPM
    assert np.abs(normalised(result)).max() < 4.5
    assert result.calibration.std[9:12].max() < 0.5 * DEG_H


def without_7() -> Plan:
    return replace(PLAN, positions=tuple(p for p in PLAN.positions if p.id != '7'))


def test_the_imu_alone_does_not_guess_which_of_two_positions_is_missing():
    kept = [
        b
        for b in session(without_7(), stand(azimuth=0.3), seed=2)
        if not isinstance(b[1], (SetpointBlock, JointBlock))
    ]
    sentence = 'only some of positions 7, 8 were found, and the IMU alone cannot tell which'
    with pytest.raises(NotObservable, match=sentence):
        calibrate(kept, PLAN, imu_only=True, method='twelve_position')
    result = calibrate(kept, PLAN, imu_only=True)
    assert any(sentence in finding for finding in result.calibration.findings)
    assert np.abs(normalised(result)).max() < 4.5


def test_joint_states_tell_which_position_is_missing():
    kept = [
        b
        for b in session(without_7(), stand(azimuth=0.3), seed=2)
        if not isinstance(b[1], SetpointBlock)
    ]
    result = calibrate(kept, PLAN)
    assert 'Missing from the recording: position 7.' in result.calibration.findings
    assert np.abs(normalised(result)).max() < 4.5


def test_a_table_without_joint_states_is_named():
    kept = [b for b in session(PLAN, stand(), seed=2) if not isinstance(b[1], JointBlock)]
    with pytest.raises(NotObservable, match='There are no joint states of table three_axis'):
        calibrate(kept, PLAN, table=load_table('three_axis'))


def test_an_imu_of_another_clock_than_the_tables_is_said_to_be_that():
    blocks = list(session(PLAN, stand(), seed=2))
    hour = 3600 * 10**9
    begin = next(b.stamp[0] for _, b in blocks if isinstance(b, ImuBlock))

    with pytest.raises(
        NotObservable, match='they are of two clocks, and no sample can be given an attitude'
    ):
        calibrate(
            [
                (t, replace(b, stamp=b.stamp - hour) if isinstance(b, ImuBlock) else b)
                for t, b in blocks
            ],
            PLAN,
        )
    # The table's clock leaps, the IMU's does not: what comes after is not used, and that is said.
    leap = begin + 10 * 10**9
    leaping = [
        (t, replace(b, stamp=b.stamp + hour * (b.stamp > leap)) if isinstance(b, JointBlock) else b)
        for t, b in blocks
        if not isinstance(b, SetpointBlock)
    ]
    with pytest.raises(NotObservable, match=r'go on for \d+.\d s after the last IMU sample'):
        calibrate(leaping, PLAN)
