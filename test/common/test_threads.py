"""Commands and nodes leave the cores to each other: small matrices gain nothing by threads."""

import os
import sys
from pathlib import Path

import pytest
from loopback import CHECKOUT, completed

from imu_calib.api.calibrate import calibrate_units, calibrated
from imu_calib.api.predict import optimise, predicted, shortest
from imu_calib.api.simulate import montecarlo
from imu_calib.api.verify import verify
from imu_calib.common import processes

_COUNT = """
import os, {module}, numpy
numpy.ones((500, 500)) @ numpy.ones((500, 500))
print(len(os.listdir('/proc/self/task')))
"""


@pytest.mark.skipif(
    not Path('/proc/self/task').is_dir(), reason='threads are counted as Linux does'
)
@pytest.mark.parametrize('module', ['imu_calib.cli.main', 'imu_calib.live.nodes.live_session'])
def test_a_product_of_matrices_takes_one_thread(module):
    environ = {k: v for k, v in os.environ.items() if not k.endswith('_NUM_THREADS')}
    environ['PYTHONPATH'] = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    run = [sys.executable, '-c', _COUNT.format(module=module)]
    counted = completed(run, env=environ, check=True)
    assert int(counted.stdout) == 1


_DEEP = """
import sys
from threadpoolctl import threadpool_info, threadpool_limits
from imu_calib.common.processes import by_one_thread

def threads():
    return sorted({pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'})

import numpy, scipy.linalg
# Asked for here: what BLAS starts with follows the processors that a machine lends the process.
threadpool_limits(int(sys.argv[1]), user_api='blas')
print(threads(), by_one_thread(threads)(), threads())
"""


@pytest.mark.parametrize('allowed', ['2', '1'])
def test_what_is_called_from_python_takes_one_thread_and_gives_the_others_back(allowed):
    pytest.importorskip('threadpoolctl')
    environ = {**os.environ, 'OMP_NUM_THREADS': allowed}
    environ['PYTHONPATH'] = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    run = [sys.executable, '-c', _DEEP, allowed]
    output = completed(run, env=environ, check=True).stdout
    before, within, after = (part.strip('[ ]\n') for part in output.split(']')[:3])
    assert (before, within, after) == (allowed, '1', allowed)


def layers(function):
    """Return what a function's decorators made of it, one after the other, and the function."""
    while function is not None:
        yield function
        function = getattr(function, '__wrapped__', None)


@pytest.mark.parametrize(
    'function', [calibrated, calibrate_units, verify, predicted, shortest, optimise, montecarlo]
)
def test_what_solves_from_python_is_limited(function):
    assert any(layer.__code__.co_filename == processes.__file__ for layer in layers(function))
