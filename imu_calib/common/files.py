"""Paths and files: read, write whole, those shipped with the code, those of other software."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Protocol

from .errors import InputError

_LONGEST = 100
"""Characters of a path that are shown if the system refuses it, as it does names beyond 255."""
_KEPT = 40
"""Characters of a name in that of a file half written: of four bytes each they leave room."""


def user_path(name: str | Path) -> Path:
    """Return a path with a leading `~` or `~user` expanded."""
    try:
        path = Path(name).expanduser()
        path.stat()
    except RuntimeError:
        raise InputError(f'{name}: there is no such home folder.') from None
    except (FileNotFoundError, NotADirectoryError):
        return path
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f'{str(name)[:_LONGEST]!r}: no file can be found there ({reason}).'
        ) from None
    return path


def printable(text: str) -> str:
    """Return a text as UTF-8 can hold it: names of files may have bytes of another encoding."""
    return text.encode('utf-8', 'backslashreplace').decode('utf-8')


class AnyFile(Protocol):
    """A path, local or remote."""

    @property
    def suffix(self) -> str:
        """Ending of its name."""

    def exists(self) -> bool:
        """Return whether there is anything."""

    def is_file(self) -> bool:
        """Return whether it is a file, no device and no pipe."""

    def is_dir(self) -> bool:
        """Return whether it is a folder."""

    def open(self, mode: str) -> Any:
        """Open it."""


def refuse_device(path: AnyFile) -> None:
    """Refuse a device or a pipe, whose contents may never come, or never end."""
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f'{path}: found a device or a pipe, expected a file.')


def unreadable(path: object, error: OSError) -> str:
    """Return the sentence on what the system refuses to read."""
    return f'{path}: cannot be read ({error.strerror or error}).'


def unwritable(path: object, error: OSError) -> str:
    """Return the sentence on what the system refuses to write."""
    return f'{path}: cannot be written ({error.strerror or error}).'


def read_bytes(path: AnyFile) -> bytes:
    """Return the contents of a file."""
    refuse_device(path)
    try:
        with path.open('rb') as file:
            return bytes(file.read())
    except OSError as error:
        raise InputError(unreadable(path, error)) from None


def first_bytes(path: AnyFile) -> bytes:
    """Return how a file begins; empty if it cannot be read."""
    try:
        with path.open('rb') as file:
            return bytes(file.read(512))
    except OSError:
        return b''


def read_text(path: AnyFile) -> str:
    """Return the text of a file in UTF-8, without a byte order mark."""
    try:
        return read_bytes(path).decode('utf-8-sig')
    except UnicodeDecodeError:
        raise InputError(f'{path}: found binary data, expected text in UTF-8.') from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, as `write_by`; a text in UTF-8."""
    if isinstance(content, str):
        content = content.encode('utf-8', 'backslashreplace')
    write_by(path, lambda file: file.write(content))


def write_by(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file whole or not at all, by a function of the open file.

    A link is kept, and its target is written. A device or a pipe, /dev/null or /dev/stdout, is
    written directly: a file in its place would hide it from all programs.
    """
    target = path.resolve()
    temporary = target.with_name(f'.{target.name[:_KEPT]}.{os.urandom(4).hex()}.part')
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open('wb') as file:
                write(file)
            return
        with temporary.open('wb') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            temporary.chmod(path.stat().st_mode)
        temporary.replace(target)
    except OSError as error:
        raise InputError(unwritable(path, error)) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


_PACKAGE = Path(__file__).resolve().parents[1]
_CHECKOUT = _PACKAGE.parent


def share_folder() -> Path:
    """Return the folder that holds `config`.

    In a checkout (including an editable install) it is the checkout; else it is share/imu_calib of
    the prefix of the installation, a ROS workspace or a Python environment.
    """
    candidates = [_CHECKOUT, *(p / 'share' / 'imu_calib' for p in _PACKAGE.parents)]
    for folder in candidates:
        if (folder / 'config' / 'plans').is_dir():
            return folder
    raise InputError(
        'The files of imu_calib are not installed: there is no share/imu_calib/config/plans '
        f'above {_PACKAGE}.'
    )


def message_folder() -> Path:
    """Return the folder of the suite's .msg files."""
    folder = share_folder()
    for candidate in (folder / 'msg_defs' / 'msg', folder.parent / 'imu_calib_msgs' / 'msg'):
        if candidate.is_dir():
            return candidate
    raise InputError(f'The message definitions of imu_calib are not installed beside {folder}.')


def named_file(kind: str, name: str | Path) -> Path:
    """Return the YAML file for a name or path given by the user.

    Args:
        kind: Folder below config: 'plans', 'imus', 'tables', 'truths', 'devices' or
            'imperfections'.
        name: A shipped name ('twelve_position'), or a path to the user's file.
    """
    path = user_path(name)
    if path.suffix in {'.yaml', '.yml'} or path.parent != Path():
        if path.is_file():
            return path
        what = 'a folder' if path.is_dir() else 'a device or a pipe'
        raise InputError(
            f'{path}: {what}, expected a file.' if path.exists() else f'{path}: no such file.'
        )
    file = share_folder() / 'config' / kind / f'{path.name}.yaml'
    if file.is_file():
        return file
    if path.is_file():
        return path
    raise InputError(f'No {kind.rstrip("s")} is called {str(name)!r}; there are: {shipped(kind)}.')


def is_shipped(kind: str, name: str) -> bool:
    """Return whether a file of a kind is shipped under a name."""
    return name in shipped(kind).split(', ')


def shipped(kind: str) -> str:
    """List the shipped names of a kind of file, as for `named_file`."""
    return ', '.join(sorted(p.stem for p in (share_folder() / 'config' / kind).glob('*.yaml')))


def version() -> str:
    """Return the version, which setup.py takes from package.xml; '0+unknown' if not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version('imu_calib')
    except PackageNotFoundError:
        return '0+unknown'


def require(library: str, what: str, extra: str) -> None:
    """Refuse the feature `what` if an optional library, which `extra` installs, is missing."""
    if find_spec(library) is None:
        raise InputError(
            f'{what} needs {library}, which is not installed. Run '
            f"{sys.executable} -m pip install '.[{extra}]' in a clone of imu_calib, or install "
            f'{library}.'
        )


# Recordings of other software, by file ending, and the way to make recordings of them.

_TABLES = ('.csv', '.txt', '.tsv', '.dat')
TEXT_FILES = (*_TABLES, '.log', '.asc')
"""Endings of tables of numbers, of which .log is that of other texts as well."""
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
    **dict.fromkeys(_TABLES, _TEXT),
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
ENDINGS = (*_RECORDINGS, *OTHERS, *TEXT_FILES)
"""Endings that a folder does not have."""


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


def beginning(head: bytes) -> str:
    """Return how a file begins, in words that follow its name; empty files have no bytes.

    Examples:
        >>> beginning(b'id: mine'), beginning(bytes([31, 139, 8]))
        ("begins with the text 'id: mine'", 'begins with the bytes 1f 8b 08')
    """
    if not head:
        return 'is empty'
    if head.isascii() and (text := ' '.join(head.decode().split())).isprintable():
        return f'begins with the text {text!r}'
    return f'begins with the bytes {head.hex(" ")}'


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
