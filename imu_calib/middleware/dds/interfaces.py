"""What messages consist of, their type hashes and their bytes: rosbags, out of the definitions."""

from __future__ import annotations

import re
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

from rosbags.interfaces import Nodetype
from rosbags.serde.cdr import (
    generate_deserialize_cdr,
    generate_getsize_cdr,
    generate_serialize_cdr,
)
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from ...definitions import message_text

if TYPE_CHECKING:
    from collections.abc import Callable

# A field with a number behind its name, which rosbags reads and forgets.
_DEFAULT = re.compile(r'^\w+ +(\w+) +([-+.\d]+)', re.MULTILINE)


class Interface:
    """A message as the code that rosbags makes asks for it.

    rosbags' own store makes eight functions of every message at once, for both byte orders and for
    ROS 1; a process needs one or two of each that it knows, and starts sooner with those.

    Attributes:
        name: Full name.
        constants: (name, type, value) of each.
        fields: (name, description) of each; a description is (kind, details).
        defaults: Numbers that fields begin with, as texts.
        cls: Makes a message of the values of its fields, in their order.

    """

    cls: Callable[..., Any]

    def __init__(self, name: str) -> None:
        text = message_text(name)
        # rosbags names what it parses after the folder msg.
        ((self.constants, self.fields),) = get_types_from_msg(
            text, name.replace('/srv/', '/msg/')
        ).values()
        self.name = name
        self.defaults: dict[str, str] = dict(_DEFAULT.findall(text))

    @cached_property
    def _sized(self) -> Any:
        return generate_getsize_cdr(self.fields, STORE)

    @property
    def getsize_cdr(self) -> Any:
        """The function that tells where the bytes of a message end."""
        return self._sized[0]

    @property
    def size_cdr(self) -> int:
        """Bytes of every message, 0 where they differ."""
        return int(self._sized[1])

    @cached_property
    def serialize_cdr_le(self) -> Any:
        """The function that writes a message, little-endian."""
        return generate_serialize_cdr(self.fields, STORE, 'le')

    @cached_property
    def deserialize_cdr_le(self) -> Any:
        """The function that reads a message, little-endian."""
        return generate_deserialize_cdr(self.fields, STORE, 'le')

    @cached_property
    def deserialize_cdr_be(self) -> Any:
        """The function that reads a message, big-endian."""
        return generate_deserialize_cdr(self.fields, STORE, 'be')


class _Store(Typestore):
    """Typestore of the messages that are asked for."""

    def get_msgdef(self, typename: str) -> Any:
        """Return what reads and writes a message."""
        return interface(typename)


STORE = _Store()


@cache
def interface(name: str) -> Interface:
    """Return a message's fields and what reads and writes it.

    Args:
        name: Full name, for instance sensor_msgs/msg/Imu.

    Raises:
        InputError: There is no definition.

    """
    found = Interface(name)
    STORE.fielddefs[name] = found.constants, found.fields
    for _, (kind, details) in found.fields:
        inner = details[0] if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE} else (kind, details)
        if inner[0] == Nodetype.NAME:
            interface(inner[1])
    return found


def type_hash(name: str) -> str:
    """Return the hash of a message's definition (REP 2016), as ROS 2 computes it."""
    interface(name)
    return STORE.hash_rihs01(name)
