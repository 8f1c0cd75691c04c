"""Load and dump YAML text, by libyaml if PyYAML has it: several times as fast."""

from __future__ import annotations

import re
from collections import Counter
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
_DATE = 'tag:yaml.org,2002:timestamp'
_MOST_BITS = 10_000
"""Of a whole number, some 3000 digits; Python converts no more than 4300 to text."""
_MOST_VALUES = 10_000_000
"""Values of a document; a calibration of 40 parameters has 4000."""
_SHOWN = 40
"""Characters of a value that are shown."""
_WHOLE_NUMBER = re.compile(r'[-+]?(?:0|[1-9][0-9_]*|0b[01_]+|0x[0-9a-fA-F_]+)$')


class _Loader(SafeLoader):
    """Refuses a key that stands twice in a mapping; reads 0012, 12:30 and 2026-02-30 as texts.

    Of two values the first would silently count for nothing. By YAML 1.1 these numbers are octal
    and sexagesimal, 10 and 750: a serial number would silently become another. Dates are checked
    by those who ask for one, with the key: PyYAML raises ValueError for a day that does not exist.
    """

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            found = super().construct_object(node, deep)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            # What PyYAML raises for `!!int x`, `0x_`, `!!timestamp x`, `!!bool x`, 5000 digits.
            raise yaml.constructor.ConstructorError(
                problem=f'found {str(node.value)[:_SHOWN]!r}, which is no value of its kind',
                problem_mark=node.start_mark,
            ) from None
        if isinstance(found, int) and found.bit_length() > _MOST_BITS:
            raise yaml.constructor.ConstructorError(
                problem='found a whole number of thousands of digits', problem_mark=node.start_mark
            )
        return found

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted(key for key, count in Counter(keys).items() if count > 1):
            raise yaml.constructor.ConstructorError(
                problem=f'found the key {twice[0]} more than once', problem_mark=node.start_mark
            )
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [
        (tag, _WHOLE_NUMBER if tag == _INT else form) for tag, form in resolvers if tag != _DATE
    ]
    for first, resolvers in SafeLoader.yaml_implicit_resolvers.items()
}


def load(text: str) -> Any:
    """Return the value of a text with one document.

    Raises:
        yaml.YAMLError: Not YAML, or more than plain values.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _values(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f'found more than {_MOST_VALUES} values by its aliases')
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError('found lists or mappings within each other without end') from None
    finally:
        loader.dispose()


def _values(node: yaml.Node, counts: dict[int, float]) -> float:
    """Return the number of values below a node, its aliases written out; infinite in a circle."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in counts:
        counts[id(node)] = float('inf')
        of_mapping = isinstance(node, yaml.MappingNode)
        parts = [p for pair in node.value for p in pair] if of_mapping else node.value
        counts[id(node)] = 1 + sum(_values(part, counts) for part in parts)
    return counts[id(node)]


def dump(value: Any, dumper: type[SafeDumper] = SafeDumper, **form: Any) -> str:
    """Return a value as text, keys in their own order.

    Args:
        value: Of plain values, lists and dictionaries.
        dumper: Replaces the default one.
        form: As in `yaml.dump`: `width`, `default_flow_style`.
    """
    return str(yaml.dump(value, Dumper=dumper, sort_keys=False, **form))
