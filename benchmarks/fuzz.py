"""Feed damaged bytes to all readers of foreign data, and check the outcome.

    python benchmarks/fuzz.py [--inputs 2000] [--seed 1] [--only frames ...]
    python benchmarks/fuzz.py --of-a-kind 1000000 --memory 50 --keep FOLDER

Targets: frames of devices, CDR on the wire in bulk and message by message, mcap and sqlite3 files,
metadata of recordings, files of users (YAML, CSV). Each input is a valid one with changes in a few
places: bits, bytes, lengths, pieces removed, doubled or inserted. The same seed gives the same
inputs. Allowed is a result or an error class of the suite. Not allowed is any other exception, more
memory than ten times the input and `FLOOR` (as allocated by Python and numpy; allocations of C
libraries are not measured), or more than `LONGEST` seconds of the processor, after which an input
is aborted.

Exit code 1: something that is not allowed happened; the input's number is printed, and
`--from NUMBER --inputs 1` runs only it. `--keep FOLDER` writes such inputs there, and continues.
"""

from __future__ import annotations

import argparse
import math
import random
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from imu_calib.calibration.thermal import read_calibration
from imu_calib.common.config import Section
from imu_calib.common.errors import ImuCalibError
from imu_calib.common.stream import (
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    TemperatureBlock,
)
from imu_calib.fleet.recordings import read_manifest
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.format import FrameFormat, load_format, read_format
from imu_calib.recordings import cdr_codec as cdr
from imu_calib.recordings.cdr import Malformed, Messages
from imu_calib.recordings.cdr_codec import (
    Kind,
    encode_imu,
    encode_joints,
    encode_setpoints,
    encode_temperatures,
)
from imu_calib.recordings.rosbag2 import open_recording
from imu_calib.reports.certificate_fields import read_fields
from imu_calib.session.imu import read_imu
from imu_calib.session.keywords import Stated
from imu_calib.session.plan import read_plan
from imu_calib.session.table import load_table, read_table
from imu_calib.session.units_file import read_units
from imu_calib.simulation.options import StandOptions, read_imperfections

FLOOR = 8 << 20
"""Bytes that a target may take in addition to ten times its input: tables of checksums, a page
cache."""
LONGEST = 10.0
"""s of the processor for one input of at most 100 kB: a hundred times the slowest."""
_CONFIG = Path(__file__).resolve().parents[1] / 'config'
_NS = 1_000_000_000

Feed = Callable[[bytes], object]


@dataclass(frozen=True)
class Target:
    """Valid inputs, and their reader."""

    name: str
    sound: list[bytes]
    feed: Feed

    @property
    def kind(self) -> str:
        """Kind of the target: files of users are of one kind, whatever their format."""
        first = self.name.split()[0]
        return 'file' if first in {'csv', 'yaml'} else first


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Change some bytes in a few places."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data)) if data else 0
        rng.choice(_CHANGES)(data, at, rng)
    return bytes(data)


def _flip(data: bytearray, at: int, rng: random.Random) -> None:
    if data:
        data[at] ^= 1 << rng.randrange(8)


def _overwrite(data: bytearray, at: int, rng: random.Random) -> None:
    width = rng.choice((1, 2, 4, 8))
    extreme = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, rng.getrandbits(64)))
    data[at : at + width] = (extreme % 2 ** (8 * width)).to_bytes(width, 'little')


def _leave_out(data: bytearray, at: int, rng: random.Random) -> None:
    del data[at : at + rng.choice((1, 4, 16, 100))]


def _cut(data: bytearray, at: int, rng: random.Random) -> None:
    del rng
    del data[at:]


def _double(data: bytearray, at: int, rng: random.Random) -> None:
    data[at:at] = data[at : at + rng.choice((1, 8, 64, 500))]


def _put_in(data: bytearray, at: int, rng: random.Random) -> None:
    data[at:at] = rng.randbytes(rng.choice((1, 3, 20)))


def _copy(data: bytearray, at: int, rng: random.Random) -> None:
    if data:
        width, other = rng.choice((4, 16, 64)), rng.randrange(len(data))
        data[at : at + width] = data[other : other + width]


_CHANGES = (_flip, _overwrite, _leave_out, _cut, _double, _put_in, _copy)


# --- targets -------------------------------------------------------------------------------------


def _blocks() -> dict[Kind, list[bytes]]:
    """Return valid messages of every kind."""
    rng = np.random.default_rng(1)
    stamp = 1_700_000_000 * _NS + 10_000_000 * np.arange(20)
    imu = ImuBlock(stamp, rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), 'imu_link')
    names = ('outer', 'middle', 'inner')
    joints = JointBlock(stamp, names, rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    steps = [
        Setpoint(int(t), 'p', k, str(k), Mode.POSITION, names, (0.1, 0.2, 0.3), (), 0.0, 9.0)
        for k, t in enumerate(stamp.tolist())
    ]
    return {
        Kind.IMU: encode_imu(imu).payloads(),
        Kind.JOINTS: encode_joints(joints).payloads(),
        Kind.SETPOINTS: encode_setpoints(SetpointBlock(tuple(steps))).payloads(),
        Kind.TEMPERATURES: encode_temperatures(
            TemperatureBlock(stamp, rng.normal(size=20))
        ).payloads(),
    }


def _of_frames() -> Iterator[Target]:
    for path in sorted((_CONFIG / 'devices').glob('*.yaml')):
        frames = load_format(path)
        yield Target(f'frames {path.stem}', [_line(frames)], partial(_decode_line, frames))


def _line(frames: FrameFormat) -> bytes:
    """Create valid frames of a format with arbitrary content."""
    rng, line = np.random.default_rng(2), []
    sums, check = frames.checksums(), frames.check
    for _ in range(20):
        row = rng.integers(0, 256, (1, frames.length), np.uint8)
        for at, value in frames.constant:
            row[0, at] = value
        if sums is not None and check is not None:
            value = int(sums.of_rows(row[:, check.first : check.end])[0])
            order = 'little' if check.number.order == '<' else 'big'
            content = value.to_bytes(check.number.size, order)
            row[0, check.number.offset : check.number.end] = np.frombuffer(content, np.uint8)
        line.append(row.tobytes())
    return b''.join(line)


def _decode_line(frames: FrameFormat, data: bytes) -> None:
    decoder = Decoder(frames)
    for start in range(0, len(data), 97):
        decoder.decode_bytes(data[start : start + 97])


def _of_wire() -> Iterator[Target]:
    for kind, payloads in _blocks().items():
        yield Target(f'wire {kind.name.lower()}', payloads, partial(_decode_message, kind))


def _decode_message(kind: Kind, data: bytes) -> None:
    kind.decode(Messages.join([data]), Malformed())
    if kind is Kind.IMU:
        cdr.ImuDecoder().decode([data], Malformed())


def _of_messages() -> Iterator[Target]:
    # Only the runtime without ROS reads single messages itself.
    from imu_calib.live.middleware.dds import message_types as codec
    from imu_calib.live.middleware.dds.message_types import message_class
    from imu_calib.live.middleware.shared import MESSAGES

    filled = {
        'ImuCalibration': {'serial_number': 'A1', 'covariance': [1.0] * 300},
        'CalibrationProgress': {'plan': 'p', 'text': 'words', 'repeat_steps': [1, 2]},
        'JointState': {'name': ['outer', 'inner'], 'position': [1.0, 2.0]},
    }
    for short, name in MESSAGES.items():
        kind = message_class(name)
        known = kind.get_fields_and_field_types()
        given = {key: value for key, value in filled.get(short, {}).items() if key in known}
        sound = [codec.serialize_message(kind()), codec.serialize_message(kind(**given))]
        yield Target(f'message {short}', sound, partial(_read_one, codec.deserialize_message, kind))


def _read_one(read: Callable[[bytes, object], object], kind: object, data: bytes) -> None:
    read(data, kind)


def _of_bags(folder: Path) -> Iterator[Target]:
    # Only fuzzing of bags requires rosbags, which writes them.
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    messages = _blocks()
    for name, plugin, mode in (
        ('mcap', StoragePlugin.MCAP, CompressionMode.NONE),
        ('mcap_zstd', StoragePlugin.MCAP, CompressionMode.STORAGE),
        ('sqlite3', StoragePlugin.SQLITE3, CompressionMode.NONE),
    ):
        path = folder / name
        writer = Writer(path, version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            for topic, kind in (('/imu', Kind.IMU), ('/joints', Kind.JOINTS)):
                connection = writer.add_connection(topic, kind.type_name, typestore=store)
                for k, payload in enumerate(messages[kind]):
                    writer.write(connection, 1_700_000_000 * _NS + k, payload)
        (file,) = (p for p in path.iterdir() if p.suffix in {'.mcap', '.db3'})
        target = folder / f'damaged{file.suffix}'
        yield Target(f'bag {name}', [file.read_bytes()], partial(_read_bag, target))
        if name == 'mcap':
            metadata = path / 'metadata.yaml'
            yield Target(
                'bag metadata', [metadata.read_bytes()], partial(_read_described, metadata)
            )


def _read_described(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    _read_all(path.parent)


def _read_bag(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    _read_all(path)


def _read_all(path: Path) -> None:
    with open_recording(path) as recording:
        kinds = {kind.type_name: kind for kind in Kind}
        topics = {t.name: kinds[t.type] for t in recording.topics if t.type in kinds}
        for _ in recording.messages():
            pass
        for _ in recording.read(topics):
            pass


def _of_manifests(folder: Path) -> Iterator[Target]:
    rows = (
        'recording,serial,plan,latitude,operator,date\n'
        'a.mcap,A1,twelve_position,48.1,me,2026-01-02\nb,B2,,,,\n'
    )
    columns, *content = [line.split(',') for line in rows.splitlines()]
    listed = [dict(zip(columns, row, strict=True)) for row in content]
    for path, sound in (
        (folder / 'manifest.csv', rows),
        (folder / 'manifest.yaml', yaml.safe_dump(listed)),
    ):
        read = partial(_read_manifest, path)
        yield Target(f'{path.suffix[1:]} manifest', [sound.encode()], read)


def _read_manifest(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    list(read_manifest(path, Stated()))


def _of_yaml() -> Iterator[Target]:
    units = 'units: [{serial_number: A1, imu: fog_medium, topic: a/imu, mount: [y, -x, z]}, '
    units += '{serial_number: B2, imu: fog_navigation, topic: b/imu, place: left}]'
    yield Target('yaml units', [_without_comments(units)], partial(_read_yaml, read_units))
    table, options = load_table('three_axis'), StandOptions()
    readers = {
        'certificates': read_fields,
        'imperfections': lambda part: read_imperfections(part, options, table, 1),
        'devices': read_format,
        'imus': read_imu,
        'plans': read_plan,
        'tables': read_table,
        'truths': read_calibration,
    }
    for folder, read in readers.items():
        files = sorted((_CONFIG / folder).glob('*.yaml'))
        sound = [_without_comments(path.read_text(encoding='utf-8')) for path in files]
        yield Target(f'yaml {folder}', sound, partial(_read_yaml, read))


def _without_comments(text: str) -> bytes:
    """Return the same document without comments, so that changes affect its content."""
    return yaml.safe_dump(yaml.safe_load(text), default_flow_style=None, width=200).encode()


def _read_yaml(read: Callable[[Section], object], data: bytes) -> None:
    read(Section.parse(data.decode('utf-8', 'replace'), 'fuzz.yaml'))


# --- running -------------------------------------------------------------------------------------


class TooLongError(BaseException):
    """An input took too long; handlers of Exception do not catch this."""


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Abort after too much processor time, when Python next runs."""

    def over(*_: object) -> None:
        raise TooLongError

    before = signal.signal(signal.SIGVTALRM, over)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def trouble(target: Target, data: bytes, *, measured: bool = True, longest: float = LONGEST) -> str:
    """Feed one input; return the fault of its outcome, else empty."""
    if measured:
        tracemalloc.start()
    start = time.process_time()
    try:
        with _limited(longest):
            target.feed(data)
    except TooLongError:
        return f'broken off after {longest:g} s: an input of {len(data)} bytes\n'
    except ImuCalibError:
        pass
    except Exception:
        return traceback.format_exc()
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    taken = time.process_time() - start
    if peak > 10 * len(data) + FLOOR:
        return f'{peak} bytes for an input of {len(data)}\n'
    return f'{taken:.1f} s for an input of {len(data)} bytes\n' if taken > longest else ''


def run(
    target: Target,
    seed: int,
    first: int,
    count: int,
    longest: float = float('inf'),
    every: int = 1,
    keep: Path | None = None,
) -> int:
    """Feed a target its inputs; return their number, negative if one failed.

    The memory of one in `every` inputs is measured, which takes several times as long. It stops at
    the first failure, or writes all failures into the folder `keep`.
    """
    wrong = 0
    deadline = time.monotonic() + longest
    for number in range(first, first + count):
        if time.monotonic() > deadline:
            return -wrong or number - first
        rng = random.Random(f'{seed} {target.name} {number}')
        data = mutated(rng.choice(target.sound), rng)
        if found := trouble(target, data, measured=number % every == 0):
            print(f'{target.name}: input {number} of seed {seed}:\n{found}')
            wrong += 1
            if keep is None:
                break
            (keep / f'{target.name} {seed} {number}'.replace(' ', '_')).write_bytes(data)
    return -wrong or count


def targets(folder: Path) -> Iterator[Target]:
    """Yield all targets; recordings are written to a folder."""
    yield from _of_frames()
    yield from _of_wire()
    yield from _of_messages()
    yield from _of_bags(folder)
    yield from _of_manifests(folder)
    yield from _of_yaml()


def main() -> int:
    """Run all targets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--inputs', type=int, default=2000, help='of each target')
    parser.add_argument(
        '--of-a-kind', type=int, help='of frames, wire, message, bag and file, among their targets'
    )
    parser.add_argument('--from', type=int, default=0, dest='first', help='number of the first')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--seconds', type=float, default=float('inf'), help='most for each target')
    parser.add_argument('--memory', type=int, default=1, help='measured of one input in so many')
    parser.add_argument('--keep', type=Path, help='write the inputs that go wrong, and go on')
    parser.add_argument('--only', nargs='+', default=[''], help='beginnings of names of targets')
    given = parser.parse_args()
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        every = list(targets(Path(folder)))
        kinds = Counter(target.kind for target in every)
        for target in every:
            if not target.name.startswith(tuple(given.only)):
                continue
            begun = time.process_time()
            inputs = given.inputs
            if given.of_a_kind is not None:
                inputs = math.ceil(given.of_a_kind / kinds[target.kind])
            done = run(
                target,
                given.seed,
                given.first,
                inputs,
                given.seconds,
                given.memory,
                given.keep,
            )
            wrong += done < 0
            words = f'{done:9,} inputs, no trouble' if done >= 0 else f'{-done:9,} went wrong'
            seconds = time.process_time() - begun
            print(f'{target.name:28} {words}, {seconds:.0f} s of the processor', flush=True)
    return 1 if wrong else 0


if __name__ == '__main__':
    sys.exit(main())
