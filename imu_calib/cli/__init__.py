"""The command `imu-calib`: one module per subcommand, each with a parser and a thin function."""

import os

# Must be set before numpy is imported. The matrices are small and gain nothing from threads; on
# busy cores, waiting threads made solving ten times as slow.
os.environ.setdefault('OMP_NUM_THREADS', '1')
