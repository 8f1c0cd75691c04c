"""Load and dump YAML text, by libyaml if PyYAML has it: several times as fast."""

from __future__ import annotations

from typing import Any

import yaml

try:
    from yaml import CSafeDumper as SafeDumper
    from yaml import CSafeLoader as SafeLoader
except ImportError:  # PyYAML without libyaml reads and writes the same texts.
    from yaml import SafeDumper, SafeLoader  # type: ignore[assignment]

__all__ = ['SafeDumper', 'dump', 'load']


def load(text: str) -> Any:
    """Return the value of a text with one document.

    Raises:
        yaml.YAMLError: Not YAML, or more than plain values.
    """
    return yaml.load(text, Loader=SafeLoader)


def dump(value: Any, dumper: type[SafeDumper] = SafeDumper, **form: Any) -> str:
    """Return a value as text, keys in their own order.

    Args:
        value: Of plain values, lists and dictionaries.
        dumper: Replaces the default one.
        form: As in `yaml.dump`: `width`, `default_flow_style`.
    """
    return str(yaml.dump(value, Dumper=dumper, sort_keys=False, **form))
