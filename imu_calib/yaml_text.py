"""Load and dump YAML text, by libyaml if PyYAML has it: several times as fast."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

try:
    from yaml import CSafeDumper as SafeDumper
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML without libyaml reads and writes the same texts.
    from yaml import SafeDumper, SafeLoader  # type: ignore[assignment]

__all__ = ['SafeDumper', 'dump', 'load']

_INT = 'tag:yaml.org,2002:int'
_WHOLE_NUMBER = re.compile(r'[-+]?(?:0|[1-9][0-9_]*|0b[01_]+|0x[0-9a-fA-F_]+)$')


class _Loader(SafeLoader):
    """Refuses a key that stands twice in a mapping, and reads 0012 and 12:30 as texts.

    Of two values the first would silently count for nothing. By YAML 1.1 these numbers are octal
    and sexagesimal, 10 and 750: a serial number would silently become another.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise yaml.constructor.ConstructorError(
                problem=f'found the key {twice[0]} more than once', problem_mark=node.start_mark
            )
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, _WHOLE_NUMBER if tag == _INT else form) for tag, form in resolvers]
    for first, resolvers in SafeLoader.yaml_implicit_resolvers.items()
}


def load(text: str) -> Any:
    """Return the value of a text with one document.

    Raises:
        yaml.YAMLError: Not YAML, or more than plain values.
    """
    return yaml.load(text, Loader=_Loader)


def dump(value: Any, dumper: type[SafeDumper] = SafeDumper, **form: Any) -> str:
    """Return a value as text, keys in their own order.

    Args:
        value: Of plain values, lists and dictionaries.
        dumper: Replaces the default one.
        form: As in `yaml.dump`: `width`, `default_flow_style`.
    """
    return str(yaml.dump(value, Dumper=dumper, sort_keys=False, **form))
