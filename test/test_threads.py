"""Commands and nodes leave the cores to each other: small matrices gain nothing by threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from loopback import CHECKOUT

_COUNT = """
import os, {module}, numpy
numpy.ones((500, 500)) @ numpy.ones((500, 500))
print(len(os.listdir('/proc/self/task')))
"""


@pytest.mark.skipif(
    not Path('/proc/self/task').is_dir(), reason='threads are counted as Linux does'
)
@pytest.mark.parametrize('module', ['imu_calib.cli.main', 'imu_calib.nodes.live'])
def test_a_product_of_matrices_takes_one_thread(module):
    environ = {k: v for k, v in os.environ.items() if not k.endswith('_NUM_THREADS')}
    environ['PYTHONPATH'] = os.pathsep.join([str(CHECKOUT), os.environ.get('PYTHONPATH', '')])
    run = [sys.executable, '-c', _COUNT.format(module=module)]
    counted = subprocess.run(run, env=environ, capture_output=True, text=True, check=True)
    assert int(counted.stdout) == 1
