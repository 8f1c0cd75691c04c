"""Recordings of other software, by file ending, and the way to make recordings of them."""

from __future__ import annotations

from typing import Protocol

_TEXT = (
    'a text file',
    'imu-calib convert {path} -o OUT --stamp NAME:UNIT --gyro NAME,NAME,NAME:UNIT --accel '
    'NAME,NAME,NAME:UNIT makes a recording of it',
)
_FORMATS = {
    '.bag': ('a bag of ROS 1', 'imu-calib convert {path} -o OUT makes a recording of it'),
    '.ulg': (
        'a log of PX4',
        'ulog2csv (pyulog) makes text files of it, and imu-calib convert a recording of those',
    ),
    '.mat': (
        'a file of MATLAB',
        'writematrix there, or scipy.io.loadmat and numpy.savetxt in Python, make a text file of '
        'it, and imu-calib convert a recording of that',
    ),
    **dict.fromkeys(('.csv', '.txt', '.tsv', '.dat'), _TEXT),
    **{
        ending: ('a packed file', f'{program} {{path}} unpacks it')
        for ending, program in (
            ('.gz', 'gunzip -k'),
            ('.bz2', 'bunzip2 -k'),
            ('.xz', 'unxz -k'),
            ('.zip', 'unzip'),
            ('.tar', 'tar -xf'),
            ('.tgz', 'tar -xf'),
        )
    },
}
BAG_OF_ROS_1 = b'#ROSBAG V'
"""First bytes of a bag of ROS 1, of any ending (wiki.ros.org/Bags/Format)."""
_ENCODINGS = {
    'ros1': 'of ROS 1: imu-calib convert reads the .bag that it was made of',
    'json': 'in JSON',
    'protobuf': 'in Protobuf',
}
_DECODED = (
    'write stamps, rates and accelerations to a text file (the Python package mcap reads them), '
    'and imu-calib convert makes a recording of that'
)
_RECORDINGS = ('.mcap', '.db3')
CONVERTIBLE = tuple(ending for ending, (_, way) in _FORMATS.items() if way.startswith('imu-calib'))
"""Endings of files that imu-calib convert reads."""
OTHERS = tuple(_FORMATS)
"""Endings of files that are converted, or unpacked, before a command reads them."""


class AnyFile(Protocol):
    """A path, local or remote."""

    @property
    def suffix(self) -> str:
        """Ending of its name."""


def other_format(path: AnyFile, expected: str = '') -> str | None:
    """Return a sentence on a file by its ending: what it is, and the way; None for other endings.

    Args:
        path: Of a file that cannot be used as it is.
        expected: What it was given for, if not for a recording.

    Examples:
        >>> from pathlib import Path
        >>> other_format(Path('a.bag'), 'a plan').split(':')[0]
        'a.bag is a bag of ROS 1, expected a plan'
        >>> other_format(Path('plan.yaml')) is None
        True
    """
    ending = path.suffix.lower()
    wanted = f', expected {expected}' if expected else ''
    if ending in _RECORDINGS and expected:
        return f'{path} is a recording{wanted}.'
    if ending not in _FORMATS:
        return None
    return _way(path, ending, wanted)


def bag_of_ros_1(path: AnyFile) -> str:
    """Return the sentence on a file that its first bytes show to be a bag of ROS 1."""
    return _way(path, '.bag', '')


def _way(path: AnyFile, ending: str, wanted: str) -> str:
    what, way = _FORMATS[ending]
    return f'{path} is {what}{wanted}: {way.format(path=path)}.'


def other_encoding(topic: str, encoding: str) -> str:
    """Return a sentence on a topic whose messages are not serialised as those of ROS 2 are.

    Examples:
        >>> other_encoding('/imu', 'json').split(',')[0]
        'the messages of /imu are in JSON'
    """
    known = _ENCODINGS.get(encoding, f'serialised as {encoding!r}')
    either = 'or else ' if encoding == 'ros1' else ''
    return f'the messages of {topic} are {known}, expected CDR of ROS 2; {either}{_DECODED}.'
