"""The command `imu-calib`: one module per subcommand, each a parser and a thin function."""

import os

# Before numpy comes. The matrices are small: threads gain them nothing, and where the cores are
# busy their waiting for each other made solving ten times as slow.
os.environ.setdefault('OMP_NUM_THREADS', '1')
