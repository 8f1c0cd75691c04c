"""--ros-args: parameters, parameter files, remap rules and log levels."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ....common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_NODE = re.compile(r'[A-Za-z_]\w*', re.ASCII)
_TOPIC = re.compile(r'(~(?=/|$)|/)?([A-Za-z_]\w*)?(/[A-Za-z_]\w*)*', re.ASCII)


@dataclass(frozen=True)
class Remap:
    """One rule of -r: from one name to another, for one node or for all."""

    node: str
    source: str
    target: str


def check_node_name(name: str) -> str:
    """Return a valid node name."""
    if not _NODE.fullmatch(name):
        raise InputError(
            f'{name!r} is not a valid node name: expected letters, digits and underscores, no '
            'digit first.'
        )
    return name


def namespace_of(text: str) -> str:
    """Return a namespace with a leading and without a trailing slash."""
    name = '/' + text.strip('/')
    if not _TOPIC.fullmatch(name):
        raise InputError(f'{text!r} is not a valid namespace.')
    return name


def fully_qualified(namespace: str, name: str) -> str:
    """Return namespace and name joined."""
    return f'{namespace.rstrip("/")}/{name}'


def expand(name: str, namespace: str, node: str) -> str:
    """Return the absolute name of an absolute, relative or private (~/name) topic or service."""
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


_TAKES_VALUE = {
    '-p': 'parameter',
    '--param': 'parameter',
    '--params-file': 'file',
    '-r': 'remap',
    '--remap': 'remap',
    '--log-level': 'level',
}
# Accepted for launch files; they have no effect on DDS.
_SWITCHES = re.compile(r'--(enable|disable)-(rosout-logs|stdout-logs|external-lib-logs)')


class _Loader(yaml.SafeLoader):
    """YAML as ROS reads it: 1e-3 is a number."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
    list('-+0123456789.'),
)


@dataclass(frozen=True)
class Arguments:
    """The arguments between --ros-args and its end."""

    #: (pattern of nodes, name, value), later ones win.
    parameters: tuple[tuple[str, str, Any], ...] = ()
    remaps: tuple[Remap, ...] = ()  #: Rules in their order, the first match wins.
    levels: tuple[tuple[str, str], ...] = ()  #: (logger, level), the empty logger for all.
    others: tuple[str, ...] = ()  #: The arguments that are not ROS's.

    def special(self, key: str, node: str) -> str | None:
        """Return the target of a rule for __node or __ns, None without one."""
        for rule in self.remaps:
            if rule.source == key and rule.node in {'', node}:
                return rule.target
        return None

    def parameters_of(self, full_name: str) -> dict[str, Any]:
        """Return the parameters for a node."""
        return {n: v for pattern, n, v in self.parameters if _fits(pattern, full_name)}


def parse(args: Sequence[str]) -> Arguments:
    """Parse a command line; words outside of --ros-args ... -- are ignored."""
    parameters: list[tuple[str, str, Any]] = []
    remaps: list[Remap] = []
    levels: list[tuple[str, str]] = []
    others: list[str] = []
    for kind, text in _split(args):
        if kind == 'parameter':
            parameters.append(_parameter(text))
        elif kind == 'file':
            parameters += _file(Path(text))
        elif kind == 'remap':
            remaps.append(Remap(*_assignment(text, '-r')))
        elif kind == 'level':
            logger, _, level = text.rpartition(':=')
            levels.append((logger, level))
        else:
            others.append(text)
    return Arguments(tuple(parameters), tuple(remaps), tuple(levels), tuple(others))


def load(text: str) -> Any:
    """Return the value of a parameter as YAML."""
    return yaml.load(text, _Loader)


def _split(args: Sequence[str]) -> Iterator[tuple[str, str]]:
    words = iter(args)
    inside = False
    for word in words:
        if word == '--ros-args':
            inside = True
        elif not inside:
            yield 'other', word
        elif word == '--':
            inside = False
        elif word in _TAKES_VALUE:
            value = next(words, None)
            if value is None:
                raise InputError(f'--ros-args: {word} lacks its value.')
            yield _TAKES_VALUE[word], value
        elif not _SWITCHES.fullmatch(word):
            known = ', '.join(_TAKES_VALUE)
            raise InputError(f'--ros-args: {word!r} is not understood, expected one of {known}.')


def _assignment(text: str, option: str) -> tuple[str, str, str]:
    left, sign, right = text.partition(':=')
    node, _, name = left.rpartition(':')
    if not sign or not name or (option == '-r' and not right):
        raise InputError(f'--ros-args: {option} {text!r}, expected name:=value.')
    return node and check_node_name(node), name, right


def _parameter(text: str) -> tuple[str, str, Any]:
    node, name, value = _assignment(text, '-p')
    try:
        return node or '/**', name, load(value)
    except yaml.YAMLError as error:
        raise InputError(f'--ros-args: -p {text!r} is not YAML: {error}') from error


def _file(path: Path) -> list[tuple[str, str, Any]]:
    try:
        content = load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}.') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f'{path}: not YAML: {error}') from error
    found = list(_nodes(path, '', content))
    if not found and content:
        raise InputError(f'{path}: holds no node with the key ros__parameters.')
    return found


def _nodes(path: Path, prefix: str, content: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield the parameters of every node in a file."""
    if not isinstance(content, dict):
        raise InputError(f'{path}: {prefix or "the file"} is not a mapping of nodes.')
    for key, value in content.items():
        if key == 'ros__parameters':
            if not isinstance(value, dict):
                raise InputError(f'{path}: {prefix}: ros__parameters is not a mapping.')
            for name, leaf in _leaves('', value):
                yield prefix, name, leaf
        else:
            joined = f'{prefix}/{str(key).lstrip("/")}' if prefix else str(key)
            yield from _nodes(path, joined, value)


def _leaves(prefix: str, content: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        name = f'{prefix}.{key}' if prefix else str(key)
        if isinstance(value, dict):
            yield from _leaves(name, value)
        else:
            yield name, value


def _fits(pattern: str, full_name: str) -> bool:
    """Return whether a pattern with * (one part) and ** (any) matches a node."""
    absolute = pattern if pattern.startswith('/') else f'/{pattern}'
    parts = {'**': '(/[^/]+)*', '*': '/[^/]+'}
    expression = ''.join(parts.get(p) or f'/{re.escape(p)}' for p in absolute.split('/')[1:])
    return re.fullmatch(expression, full_name) is not None
