"""Names of nodes, topics and services: validity, namespaces, remap rules."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ....common.errors import InputError

_NODE = re.compile(r'[A-Za-z_]\w*', re.ASCII)
_TOPIC = re.compile(r'(~(?=/|$)|/)?([A-Za-z_]\w*)?(/[A-Za-z_]\w*)*', re.ASCII)


@dataclass(frozen=True)
class Remap:
    """One rule of -r: from one name to another, for one node or for all."""

    node: str
    source: str
    target: str


def check_node_name(name: str) -> str:
    """Return a valid node name.

    Raises:
        InputError: It has other characters than letters, digits and underscores.
    """
    if not _NODE.fullmatch(name):
        raise InputError(
            f'{name!r} is not a valid node name: expected letters, digits and underscores, no '
            'digit first.'
        )
    return name


def namespace_of(text: str) -> str:
    """Return a namespace with a leading and without a trailing slash.

    Raises:
        InputError: It is not a valid namespace.
    """
    name = '/' + text.strip('/')
    if not _TOPIC.fullmatch(name):
        raise InputError(f'{text!r} is not a valid namespace.')
    return name


def fully_qualified(namespace: str, name: str) -> str:
    """Return namespace and name joined."""
    return f'{namespace.rstrip("/")}/{name}'


def expand(name: str, namespace: str, node: str) -> str:
    """Return the absolute name of a topic or service.

    Args:
        name: Absolute, relative, or private (~/name).
        namespace: Namespace of the node.
        node: Name of the node.

    Raises:
        InputError: It is not a valid topic name.
    """
    if not name or not _TOPIC.fullmatch(name):
        raise InputError(f'{name!r} is not a valid name of a topic or service.')
    if name.startswith('/'):
        return name
    if name.startswith('~'):
        return fully_qualified(namespace, node) + name[1:]
    return fully_qualified(namespace, name)


def remapped(name: str, namespace: str, node: str, rules: tuple[Remap, ...]) -> str:
    """Return the absolute name after the first matching rule."""
    absolute = expand(name, namespace, node)
    for rule in rules:
        if rule.source.startswith('__') or rule.node not in {'', node}:
            continue
        if expand(rule.source, namespace, node) == absolute:
            return expand(rule.target, namespace, node)
    return absolute
