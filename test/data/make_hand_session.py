"""Write test/data/hand_session from imucal's example session (CSV of raw counts, 204.8 Hz).

Usage: python test/data/make_hand_session.py hand_session_counts.csv

The stamps are those of the column `samples`; counts are left as they are.
"""

import csv
import sys
from pathlib import Path

import numpy as np

from imu_calib.common.stream import ImuBlock
from imu_calib.recordings.cdr_codec import RATES, encode_imu
from imu_calib.recordings.writer import RecordingWriter

RATE = 204.8


def main() -> None:
    with Path(sys.argv[1]).open(newline='') as file:
        rows = sorted(csv.DictReader(file), key=lambda row: int(row['samples']))
    index = np.array([int(row['samples']) for row in rows])
    stamp = np.rint(1_600_000_000e9 + (index + 1) / RATE * 1e9).astype(np.int64)
    gyro = np.array([[float(row[f'gyr_{a}']) for a in 'xyz'] for row in rows])
    accel = np.array([[float(row[f'acc_{a}']) for a in 'xyz'] for row in rows])
    block = ImuBlock(stamp, gyro, accel, 'imu')
    target = Path(__file__).parent / 'hand_session'
    with RecordingWriter(target, compression='zstd') as writer:
        writer.write('/imu/raw', 'sensor_msgs/msg/Imu', encode_imu(block, RATES), stamp)


if __name__ == '__main__':
    main()
