"""The metadata.yaml of a rosbag2 folder, and the same text inside the storage files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import yaml

from ..common import config as yaml_text
from .remote import AnyPath
from .storage import Topic

NAME = 'metadata.yaml'
VERSION = 9  #: Version of metadata.yaml as written by rosbag2 of Jazzy.
KEY = 'rosbag2_bagfile_information'
_TEXTS = 4  #: Texts cached: a recording has two, and may be compared with another.


@dataclass(frozen=True)
class Metadata:
    """The parts of metadata.yaml used for reading."""

    #: Names of the storage files, in order; None if not stated.
    files: tuple[str, ...] | None = None
    custom_data: Mapping[str, str] = field(default_factory=dict)  #: The user's own entries.
    counts: Mapping[str, int] = field(default_factory=dict)  #: Messages by topic name.
    problem: str = ''  #: Why the metadata is invalid or missing; else empty.


def read_metadata(folder: AnyPath) -> Metadata:
    """Read the metadata of a folder; `problem` names a missing or broken file.

    Raises:
        OSError: The file exists but cannot be read.
    """
    path = folder / NAME
    if not path.is_file():
        return Metadata(problem=f'{NAME} is missing')
    try:
        return _metadata(path.read_text(encoding='utf-8'))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        return Metadata(problem=f'{NAME} is not YAML ({" ".join(str(error).split())[:120]})')


# A command that examines the topics first opens a recording twice.
@lru_cache(maxsize=_TEXTS)
def _metadata(text: str) -> Metadata:
    content = yaml_text.load(text)
    information = content.get(KEY) if isinstance(content, dict) else None
    if not isinstance(information, dict):
        information = {}
    files = information.get('relative_file_paths')
    if not isinstance(files, list):
        return Metadata(problem=f'{NAME} has no {KEY}: relative_file_paths')
    # Before version 4 the paths start with the folder's own name.
    names = tuple(PurePath(str(name)).name for name in files)
    counts = _counts(information.get('topics_with_message_count'))
    return Metadata(names, _strings(information.get('custom_data')), counts)


@lru_cache(maxsize=_TEXTS)
def custom_data_of(text: str) -> Mapping[str, str]:
    """Return the custom data in the metadata that rosbag2 writes into its storage files."""
    try:
        content = yaml_text.load(text)
    except yaml.YAMLError:
        return {}
    return _strings(content.get('custom_data')) if isinstance(content, dict) else {}


def _counts(entries: Any) -> dict[str, int]:
    try:
        return {str(e['topic_metadata']['name']): int(e['message_count']) for e in entries}
    except (TypeError, KeyError, ValueError, OverflowError):
        return {}


def _strings(pairs: Any) -> dict[str, str]:
    if not isinstance(pairs, dict):
        return {}
    return {str(key): str(value) for key, value in pairs.items()}


def qos_profile(*, transient_local: bool = False) -> dict[str, Any]:
    """Return the QoS of the suite's topics as rosbag2 writes it from version 9 on."""
    forever = {'sec': 9223372036, 'nsec': 854775807}
    return {
        'history': 'keep_last' if transient_local else 'keep_all',
        'depth': 1 if transient_local else 0,
        'reliability': 'reliable',
        'durability': 'transient_local' if transient_local else 'volatile',
        'deadline': dict(forever),
        'lifespan': dict(forever),
        'liveliness': 'automatic',
        'liveliness_lease_duration': dict(forever),
        'avoid_ros_namespace_conventions': False,
    }


def offered_profiles(text: str) -> list[dict[str, Any]]:
    """Return the QoS profiles that a recorder wrote as YAML; none if that is not a list."""
    try:
        profiles = yaml_text.load(text)
    except yaml.YAMLError:
        return []
    if not isinstance(profiles, list) or not all(isinstance(p, dict) for p in profiles):
        return []
    return profiles


def dump(value: Any) -> str:
    """Write a value as YAML, in its own order."""
    return yaml_text.dump(value, default_flow_style=False)


@dataclass(frozen=True)
class FileSpan:
    """One storage file: its name, its first and last log time in ns, its number of messages."""

    name: str
    start_ns: int
    end_ns: int
    count: int

    def entry(self) -> dict[str, Any]:
        """Return the file's entry in the metadata."""
        return {
            'path': self.name,
            'starting_time': {'nanoseconds_since_epoch': self.start_ns},
            'duration': {'nanoseconds': self.end_ns - self.start_ns},
            'message_count': self.count,
        }


def information(
    files: Sequence[FileSpan],
    topics: Sequence[Topic],
    profiles: Mapping[str, Sequence[dict[str, Any]]],
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """Build the metadata of a recording in mcap files, as ROS 2 Jazzy writes it.

    It is the content below `rosbag2_bagfile_information`: files in order, topics with their counts,
    QoS offered for each by its name, and the user's own entries.
    """
    filled = [file for file in files if file.count]
    start = min((file.start_ns for file in filled), default=0)
    end = max((file.end_ns for file in filled), default=0)
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end - start},
        'starting_time': {'nanoseconds_since_epoch': start},
        'message_count': sum(topic.count or 0 for topic in topics),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': topic.encoding,
                    'offered_qos_profiles': list(profiles[topic.name]),
                    'type_description_hash': '',
                },
                'message_count': topic.count or 0,
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [file.entry() for file in files],
        'custom_data': dict(custom_data) or None,
        'ros_distro': 'jazzy',
    }


def write_metadata(folder: Path, content: Mapping[str, Any]) -> None:
    """Write metadata.yaml; it appears whole or not at all."""
    partial = folder / f'{NAME}.part'
    partial.write_text(dump({KEY: dict(content)}), encoding='utf-8')
    partial.replace(folder / NAME)
