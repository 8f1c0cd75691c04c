"""Keys of files, each declared once: on the field that holds its value.

Loaders read by these declarations; docs/file_formats makes the schemas and tables of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from .config import Section
from .errors import InputError
from .units import Dimension

Record = TypeVar('Record')

REQUIRED = object()  #: The default of a key that must be given.


@dataclass(frozen=True)
class FieldKey:
    """What a field declares of its key."""

    meaning: str  #: For a person.
    read: Callable[..., Any]  #: Method of a section, or a function of it: called with the name.
    arguments: tuple[Any, ...]  #: What `read` takes after the name.
    bounds: Mapping[str, Any]  #: What it takes by keyword.
    #: Read where the key is left out or empty; `REQUIRED` where it must not be, None where the
    #: default of the field counts.
    default: object
    otherwise: str  #: Words in place of the default.
    name: str  #: As it is written.
    source: str = ''  #: Clause of a standard that asks for it; empty if none does.

    def value(self, section: Section) -> Any:
        """Read the key or its default."""
        if self.default is not REQUIRED and not section.has(self.name):
            section = Section({self.name: self.default}, section.where)
        return self.read(section, self.name, *self.arguments, **self.bounds)

    @property
    def usual(self) -> Any:
        """The value of a file that leaves the key out."""
        return self.value(Section({}, self.meaning))


def key(
    meaning: str,
    read: Callable[..., Any] | Dimension,
    *arguments: Any,
    default: object = REQUIRED,
    value: Any = MISSING,
    otherwise: str = '',
    name: str = '',
    source: str = '',
    variants: Sequence[object] = ('key',),
    **bounds: Any,
) -> Any:
    """Return a field with a key of a file, as `FieldKey` describes it; a dimension is a quantity.

    `value` is the default of the field where it is not that of the file, `name` the key's where it
    is not the field's. Where `otherwise` is stated, the key needs not be given.
    """
    if otherwise and default is REQUIRED:
        default = None
    if isinstance(read, Dimension):
        read, arguments = Section.quantity, (read,)
    declared = FieldKey(meaning, read, arguments, bounds, default, otherwise, name, source)
    metadata = dict.fromkeys(variants, declared)
    if isinstance(value, np.ndarray):
        return field(default_factory=value.copy, metadata=metadata)
    if value is MISSING and default is not REQUIRED:
        value = None if default is None else declared.usual
    return field(default=value, metadata=metadata)


def part(kind: type) -> Any:
    """Return a field for a record whose keys stand among those of the record around it."""
    return field(default_factory=kind, metadata={'part': kind})


def field_keys(kind: type, variant: object = 'key') -> dict[str, FieldKey]:
    """Return the keys that the fields of a record declare, by field.

    A field whose key differs from file to file has the keys under their variants in its metadata.
    """
    return {
        each.name: replace(declared, name=declared.name or each.name)
        for each in fields(kind)
        if (declared := each.metadata.get(variant))
    }


def parts(kind: type) -> dict[str, type]:
    """Return the records whose keys stand among those of a record, by field."""
    return {f.name: f.metadata['part'] for f in fields(kind) if 'part' in f.metadata}


def read_record(section: Section, kind: type[Record], variant: object = 'key') -> Record:
    """Read a whole mapping by the keys that the fields of a record declare.

    Keys are checked before values: a misspelt one is named, and not what follows from its absence.
    """
    _refuse_others(section, kind, variant)
    return read_part(section, kind, variant)


def read_onto(section: Section, base: Record, variant: object = 'key') -> Record:
    """Read a whole mapping as `read_record`, on top of a record.

    What the mapping leaves out stays as it is, unless its key has a default.
    """
    _refuse_others(section, type(base), variant)
    result: Record = _read_onto(section, base, variant)
    return result


def _refuse_others(section: Section, kind: type, variant: object) -> None:
    """Refuse a mapping that lacks a key of a record, or has one that nothing asked for."""
    keys = list(_all_keys(kind, variant))
    # All are looked for first: none of them is then taken for a misspelling of a missing one.
    lacking = [each for each in keys if not section.has(each.name)]
    for each in lacking:
        if each.default is REQUIRED:
            section.raw(each.name)
    section.refuse_unknown_keys()


def _all_keys(kind: type, variant: object) -> Iterator[FieldKey]:
    """Yield the keys of a record and of its parts."""
    yield from field_keys(kind, variant).values()
    for within in parts(kind).values():
        yield from _all_keys(within, variant)


def read_part(section: Section, kind: type[Record], variant: object = 'key') -> Record:
    """Read a record whose keys stand among others, which are not looked at."""
    within: dict[str, Any] = {
        name: read_part(section, each, variant) for name, each in parts(kind).items()
    }
    return kind(**_values(section, kind, variant), **within)


def _read_onto(section: Section, base: Any, variant: object) -> Any:
    kind = type(base)
    within = {name: _read_onto(section, getattr(base, name), variant) for name in parts(kind)}
    return replace(base, **_values(section, kind, variant), **within)


def _values(section: Section, kind: type, variant: object) -> dict[str, Any]:
    """Return the values of what a mapping states, and of defaults, by field."""
    return {
        name: declared.value(section)
        for name, declared in field_keys(kind, variant).items()
        if declared.default is not None or section.has(declared.name)
    }


def read_key(
    section: Section, kind: type, name: str, *, required: bool = False, **bounds: Any
) -> Any:
    """Read one key of a record; None if it is left out and has no default.

    Args:
        section: The mapping, whose other keys the caller reads.
        kind: The record.
        name: The key's name, which is the field's.
        required: Whether it must be given here, though not everywhere.
        **bounds: Take the place of those of the field, where other keys narrow them.
    """
    declared = field_keys(kind)[name]
    if declared.default is None and not required and not section.has(name):
        return None
    default = REQUIRED if required else declared.default
    return replace(declared, default=default, bounds={**declared.bounds, **bounds}).value(section)


def _needed(kind: type, variant: object) -> list[str]:
    """Return the names of the keys that must be given, or else of all."""
    keys = list(_all_keys(kind, variant))
    return [each.name for each in keys if each.default is REQUIRED] or [k.name for k in keys]


def record(section: Section, name: str, kind: type[Record], variant: object = 'key') -> Record:
    """Read the mapping behind a key."""
    return read_record(section.section(name, *_needed(kind, variant)), kind, variant)


def records(
    section: Section, name: str, kind: type[Record], most: int | None = None
) -> tuple[Record, ...]:
    """Read the list of mappings behind a key."""
    rows = section.sections(name, *_needed(kind, 'key'))
    values = tuple(read_record(each, kind) for each in rows)
    if most is not None and len(values) > most:
        raise InputError(f'{section.key(name)}: found {len(values)} {name}, expected 1 to {most}.')
    return values
