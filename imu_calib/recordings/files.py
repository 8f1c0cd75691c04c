"""Find the storage files of a recording and open them."""

from __future__ import annotations

import re
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from ..common.files import refuse_device
from ..common.other_formats import BAG_OF_ROS_1, bag_of_ros_1, other_format
from .codec import ZSTD_MAGIC, unpack_file
from .mcap import McapStorage
from .metadata import NAME, Metadata, read_metadata
from .remote import AnyPath, RemotePath, local
from .storage import Losses, RecordingError, Storage

_STORAGE = ('.mcap', '.db3')
_PACKED = ('.zstd', '.zst')


@dataclass(frozen=True)
class Found:
    """The storage files of a recording, in order, and its metadata."""

    paths: tuple[AnyPath, ...]
    metadata: Metadata


class Scratch:
    """A temporary folder, created when needed and removed afterwards."""

    def __init__(self) -> None:
        self._folder: Path | None = None

    def folder(self) -> Path:
        """Return the folder."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix='imu_calib_'))
        return self._folder

    def remove(self) -> None:
        """Remove the folder with all unpacked files."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def find_files(path: AnyPath, losses: Losses) -> Found:
    """Find the storage files of a recording.

    Args:
        path: Folder of rosbag2, or one storage file.
        losses: Receives sentences on missing files.

    Returns:
        The files.

    Raises:
        RecordingError: There is nothing to read.
        OSError: The folder cannot be read.
        InputError: Its connection was lost.
    """
    if path.is_file():
        if (sentence := other_format(path)) is not None:
            raise RecordingError(sentence)
        if path.name == NAME:
            raise RecordingError(f'{path} describes a recording: give the folder that holds it.')
        return Found((path,), Metadata())
    if not path.is_dir():
        # A recording is read in several places.
        found = 'found a device or a pipe' if path.exists() else 'no such recording'
        raise RecordingError(f'{path}: {found}; expected a rosbag2 folder or file.')
    present = sorted((p for p in path.iterdir() if is_storage(p)), key=_natural)
    metadata = read_metadata(path)
    if not present:
        held = ', '.join(sorted(p.name for p in path.iterdir())[:8]) or 'nothing'
        raise RecordingError(
            f'{path} is not a recording: expected *.mcap or *.db3 files, found {held}.'
        )
    if metadata.files is None:
        names = ', '.join(p.name for p in present)
        losses.add(f'{path.name}: {metadata.problem}; the storage files found are used: {names}.')
        return Found(tuple(present), metadata)
    return Found(_listed(metadata.files, present, path.name, losses), metadata)


def _listed(
    names: tuple[str, ...], present: list[AnyPath], folder: str, losses: Losses
) -> tuple[AnyPath, ...]:
    """Return the files named in the metadata, in its order."""
    by_name = {p.name: p for p in present} | {_bare(p.name): p for p in present}
    paths: list[AnyPath] = []
    for name in names:
        path = by_name.get(name) or by_name.get(_bare(name))
        if path is None:
            losses.add(f'{folder}: {name}, which {NAME} names, is missing; its messages are lost.')
        elif path not in paths:
            paths.append(path)
    extra = [p.name for p in present if p not in paths]
    if not paths:
        raise RecordingError(
            f'{folder}: none of the files that {NAME} names is there ({", ".join(names) or "none"}'
            f'); found {", ".join(extra)}.'
        )
    if extra:
        losses.add(f'{folder}: {", ".join(extra)} not named by {NAME}, left out.')
    return tuple(paths)


def is_storage(path: AnyPath) -> bool:
    """Say whether a file has the name of a recording, compressed or not, also in capitals."""
    return _bare(path.name.lower()).endswith(_STORAGE)


def _bare(name: str) -> str:
    """Return a file name without the suffix of file compression."""
    for suffix in _PACKED:
        name = name.removesuffix(suffix)
    return name


def _natural(path: AnyPath) -> list[tuple[int, str]]:
    """Return a sort key that puts name_2 before name_10."""
    return [(int(t or 0), s) for t, s in re.findall(r'(\d*)(\D*)', path.name)]


def open_storage(path: AnyPath, scratch: Scratch, losses: Losses) -> Storage:
    """Open one storage file; unpack it first if the whole file is compressed.

    Args:
        path: The file.
        scratch: Folder for unpacked files.
        losses: Receives sentences on unreadable data.

    Returns:
        The storage.

    Raises:
        RecordingError: The file is neither mcap nor sqlite3, or not readable.
    """
    refuse_device(path)
    try:
        with path.open('rb') as file:
            magic = file.read(16)
        if magic.startswith(BAG_OF_ROS_1):
            raise RecordingError(bag_of_ros_1(path))
        if magic.startswith(ZSTD_MAGIC):
            path = _unpack(path, scratch, losses)
            with path.open('rb') as file:
                magic = file.read(16)
        if magic.startswith(b'SQLite format 3') or (not magic and path.suffix.lower() == '.db3'):
            # Imported here: it loads SQLite, which few recordings need.
            from .sqlite3 import SqliteStorage

            return SqliteStorage(_with_its_log(path), losses)
        return McapStorage(path, losses)
    except OSError as error:
        raise RecordingError(f'{path} cannot be read: {error.strerror or error}.') from None


def _with_its_log(path: AnyPath) -> Path:
    """Return a path at which SQLite can open a database together with its writer's log."""
    here = local(path)
    if isinstance(path, RemotePath):
        log = path.with_name(f'{path.name}-wal')
        if log.is_file():
            shutil.copyfile(local(log), here.with_name(log.name))
    return here


def _unpack(path: AnyPath, scratch: Scratch, losses: Losses) -> Path:
    target = scratch.folder() / _bare(path.name)
    problem = unpack_file(path, target)
    if problem:
        losses.add(
            f'{path.name} is damaged ({problem}); the {target.stat().st_size} bytes that unpack '
            'are used.'
        )
    return target
