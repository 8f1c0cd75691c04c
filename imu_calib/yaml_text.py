"""Load and dump YAML text, by libyaml if PyYAML has it: several times as fast."""

from __future__ import annotations

import re
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
    """Reads 0012 and 12:30 as texts: by YAML 1.1 they are octal and sexagesimal, 10 and 750.

    A serial number would silently become another.
    """


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
