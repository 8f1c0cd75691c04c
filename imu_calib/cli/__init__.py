"""The command `imu-calib`: a module per subject holds the options and a thin function of each."""

import os

# Must be set before numpy is imported. The matrices are small and gain nothing from threads; on
# busy cores, waiting threads made solving ten times as slow.
os.environ.setdefault('OMP_NUM_THREADS', '1')
