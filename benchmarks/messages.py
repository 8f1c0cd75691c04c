"""Message objects to bytes and back, compared with the classes of rosbags and of cyclonedds.

rosbags' classes take any value and have no defaults; those of the dds runtime check assigned values
and store them as rclpy does. All are run in turns in one process, on the same messages; the measure
is processor time.

    python benchmarks/messages.py [--messages 2000]

Exit code 1: a ratio is below the package's promise.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np

os.environ['IMU_CALIB_MIDDLEWARE'] = 'dds'

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imu_calib.live.middleware import deserialize_message, messages, serialize_message
from imu_calib.live.middleware.dds.wire import idl_type
from imu_calib.recordings.cdr import definition

if TYPE_CHECKING:
    from collections.abc import Callable

ROUNDS = 7
OF_ROSBAGS = 0.4
OVER_WHEEL = 1.3

SENT = {
    'Imu': messages.Imu(header=messages.Header(frame_id='imu')),
    'JointState': messages.JointState(name=['outer', 'inner'], position=[0.1, 0.2]),
    'TurntableSetpoint': messages.TurntableSetpoint(
        plan='twelve_position', joint_names=['outer', 'inner'], positions=[0.1, 0.2]
    ),
}


def of_rosbags(name: str) -> tuple[Callable[[Any], bytes], Callable[[bytes], Any]]:
    """Return writer and reader of a message with rosbags alone."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition(name), name))
    return (
        lambda message: bytes(store.serialize_cdr(message, name)),
        lambda payload: store.deserialize_cdr(payload, name),
    )


def ways(sent: Any) -> dict[str, tuple[Callable[[], Any], Callable[[], Any]]]:
    """Return writer and reader of one message, for each class."""
    kind, name, payload = type(sent), sent.TYPE_NAME, serialize_message(sent)
    write, read = of_rosbags(name)
    plain = read(payload)
    wheel = idl_type(name)
    typed = wheel.deserialize(payload)
    return {
        'dds runtime': (
            lambda: serialize_message(sent),
            lambda: deserialize_message(payload, kind),
        ),
        'rosbags': (lambda: write(plain), lambda: read(payload)),
        'cyclonedds': (typed.serialize, lambda: wheel.deserialize(payload)),
    }


def rate(work: Callable[[], Any], count: int) -> float:
    """Return the number of calls per second of one core."""
    begin = time.process_time()
    for _ in range(count):
        work()
    return count / (time.process_time() - begin)


def main() -> int:
    """Measure, print, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--messages', type=int, default=2000)
    count = parser.parse_args().messages
    good = True
    for name, sent in SENT.items():
        every = ways(sent)
        for step, what in enumerate(('written', 'read')):
            rates = {way: [] for way in every}
            for _ in range(ROUNDS):
                for way, works in every.items():
                    rates[way].append(rate(works[step], count))
            ours = np.array(rates['dds runtime'])
            of_rosbags, over_wheel = (
                float(np.median(ours / rates[other])) for other in ('rosbags', 'cyclonedds')
            )
            good &= of_rosbags >= OF_ROSBAGS and over_wheel >= OVER_WHEEL
            print(
                f'{name:18} {what:8} {ours.max():9,.0f}/s   {of_rosbags:5.2f} of rosbags'
                f'   {over_wheel:5.1f} of cyclonedds'
            )
    print(f'promised: {OF_ROSBAGS} of rosbags, {OVER_WHEEL} of cyclonedds')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
