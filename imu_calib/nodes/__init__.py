"""ROS 2 nodes: thin shells around the core, on either runtime of `imu_calib.middleware`."""

import os

# Before numpy comes. The matrices are small: threads gain them nothing, and where the cores are
# busy their waiting for each other made solving ten times as slow.
os.environ.setdefault('OMP_NUM_THREADS', '1')
