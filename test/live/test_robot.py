"""From a live stand to a robot: the compensator takes the calibration over while it runs."""

from dataclasses import replace

import numpy as np
from live import EMBEDDED, NODES, Stand, State, short_plan
from sessions import SITE

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.units import MICRO_G
from imu_calib.live import middleware as ros
from imu_calib.live.nodes import qos
from imu_calib.recordings.cdr import Messages
from imu_calib.recordings.cdr_codec import decode_imu, decode_joints
from imu_calib.session.imu import load_imu
from imu_calib.session.table import load_table

DWELL = 10.0
SETTLED = 1.5
OVERRIDE = 'qos_overrides./imu/data_raw.publisher'


class Ears:
    """All of the compensated stream and of the table's encoders, from now on."""

    def __init__(self, node):
        self.rates, self.joints = [], []
        m = ros.messages
        ros.open_stream(node, m.Imu, 'imu/data_raw', self.rates.extend, qos.stream())
        ros.open_stream(
            node, m.JointState, 'turntable/joint_states', self.joints.extend, qos.stream()
        )

    def dwells(self, begin):
        """Yield each dwell after a time, s: rates and forces in it, and the attitude."""
        (rates,) = decode_imu(Messages.join(self.rates))
        (joints,) = decode_joints(Messages.join(self.joints))
        still = (joints.velocity == 0).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
        table = load_table('three_axis')
        for first, end in edges.reshape(-1, 2):
            if joints.stamp[first] <= begin * 1e9:
                # The table stands where the last session left it, until this one starts.
                continue
            start, stop = joints.stamp[first] + round(SETTLED * 1e9), joints.stamp[end - 1]
            if stop - start < 0.8 * DWELL * 1e9:
                continue
            inside = (rates.stamp > start) & (rates.stamp <= stop)
            columns = [joints.names.index(name) for name in table.names]
            attitude = table.attitude(joints.position[first:end, columns].mean(axis=0))
            yield rates.gyro[inside], rates.accel[inside], attitude


def true_unit(folder):
    """A navigation-grade unit that its 24 parameters describe."""
    shipped = Calibration.load(named_file('truths', 'fog_navigation_33'))
    model = replace(shipped.model, g_sensitivity=np.zeros((3, 3)))
    truth = Calibration(shipped.imu, model, np.zeros((24, 24)))
    path = folder / 'truth.yaml'
    truth.save(path)
    return path


def doubt(calibration, rate):
    """Variance of a compensated rate by the calibration's own covariance."""
    effect = np.zeros((3, 24))
    for k, parameter in enumerate(calibration.parameters[:12]):
        effect[parameter.row, k] = 1.0 if parameter.column is None else rate[parameter.column]
    return np.diag(effect @ calibration.covariance @ effect.T)


def test_a_stand_ends_in_a_stream_that_shows_gravity_and_the_earths_rate(tmp_path):
    options = ['--imu', 'fog_navigation', '--truth', str(true_unit(tmp_path))]
    plan = short_plan(tmp_path, dwell=DWELL)
    with Stand(tmp_path, *options, plan=plan, nodes=(), embedded=EMBEDDED) as stand:
        stand.parameters['compensator_node'] = {
            'use_sim_time': True,
            f'{OVERRIDE}.reliability': 'reliable',
            f'{OVERRIDE}.history': 'keep_all',
        }
        for name in ('compensator_node', *NODES):
            stand.start(name)
        assert stand.wait(lambda: stand.has_status('compensator_node', 'No calibration'))
        final = stand.ended(seconds=240)
        assert final.status == final.VALID, final.status_text
        assert stand.wait(lambda: stand.has_status('compensator_node', '/calibration is applied'))
        assert stand.reaches(State.DONE, seconds=60)
        ears = Ears(stand.node)
        stand.states.clear()
        # The calibrator has finished its session: a new one is asked for.
        assert stand.call('calibrator_node/reset')[0]
        begin = stand.joints.header.stamp.sec
        assert stand.wait(lambda: stand.call('turntable_node/start')[0])
        assert stand.wait(lambda: stand.state.steps > 0)
        assert stand.reaches(State.DWELLING, step=stand.state.steps - 1, seconds=240)
        # The end of the plan would wait for the calibrator, whose session is over.
        last = stand.joints.header.stamp.sec
        assert stand.wait(lambda: stand.joints.header.stamp.sec > last + DWELL + 2)
        calibration = Calibration.load(stand.folder / 'calibration.yaml')
    spec = load_imu('fog_navigation')
    seen = list(ears.dwells(begin))
    assert len(seen) == 12
    assert {tuple(np.rint(attitude[2]).astype(int)) for *_, attitude in seen} == {
        tuple(sign * row) for row in np.eye(3, dtype=int) for sign in (1, -1)
    }
    earth = np.array([0.0, SITE.north_rate, SITE.up_rate])
    for rate, force, attitude in seen:
        seconds = len(rate) / spec.sample_rate
        # The simulated table arrives exactly where its encoders say. A dwell of 10 s leaves
        # 1.6 micro-g of random walk (5.1 / sqrt(T)) and 2.1 of pulses (20.8 / T), both times.
        error = force.mean(axis=0) - attitude.T @ [0.0, 0.0, SITE.gravity]
        assert np.linalg.norm(error) < 20 * MICRO_G
        # Random walk and pulses over the dwell, and the calibration's own deviation.
        walk = spec.gyro.random_walk**2 / seconds
        pulses = (spec.gyro.scale_factor / seconds) ** 2 / 6
        own = doubt(calibration, attitude.T @ earth)
        sigma = np.sqrt(walk + pulses + own)
        assert (np.abs(rate.mean(axis=0) - attitude.T @ earth) < 4.5 * sigma).all()
