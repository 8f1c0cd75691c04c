"""Statements of a laboratory for a certificate: read from YAML, with a list of missing ones.

Source: ISO/IEC 17025:2017, 7.8.2 and 7.8.4; docs/certificate.md.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from dataclasses import fields as keys_of
from datetime import date
from enum import Enum
from itertools import pairwise

from ..common.config import Section
from ..common.errors import InputError

# Source: ILAC-G8:09/2019, 4.2; JCGM 106:2012, 8; ISO/IEC 17025:2017, 7.8.6.


class Rule(Enum):
    """How the uncertainty is taken into account in a decision on a limit."""

    SIMPLE = 'simple_acceptance'
    GUARDED = 'guard_band'
    GUARDED_BOTH = 'guard_band_both'

    @property
    def words(self) -> str:
        """The rule and its risk, as text."""
        return _WORDS[self]


_WORDS = {
    Rule.SIMPLE: (
        'Simple acceptance (ILAC-G8:09/2019, 4.2.1): pass where the value lies within its limits, '
        'else fail. A value at a limit is accepted, or rejected, wrongly with a probability of up '
        'to 50 %.'
    ),
    Rule.GUARDED: (
        'Guard band w = U (ILAC-G8:09/2019, 4.2.2): pass where the value lies within its limits '
        'by at least the expanded uncertainty U, else fail. An item that passes is beyond a limit '
        'with a probability of at most 2.5 %.'
    ),
    Rule.GUARDED_BOTH: (
        'Guard band w = U on both sides (ILAC-G8:09/2019, 4.2.3): pass where the value lies within '
        'its limits by at least the expanded uncertainty U, fail where it lies beyond by more '
        'than U; between, conditional pass within the limits and conditional fail beyond. Pass '
        'and fail are wrong with a probability of at most 2.5 %.'
    ),
}


class Conformity(Enum):
    """The statement on a value, in the terms of the DCC; the worst last."""

    PASS = 'pass'
    CONDITIONAL_PASS = 'conditionalPass'
    CONDITIONAL_FAIL = 'conditionalFail'
    FAIL = 'fail'

    @property
    def words(self) -> str:
        """The statement as text."""
        return self.name.lower().replace('_', ' ')


def decide(value: float, expanded: float, limit: float, rule: Rule) -> Conformity:
    """Return the statement on a value with a limit on both sides of zero.

    Args:
        value: The estimate.
        expanded: Its expanded uncertainty, in the same unit.
        limit: Largest amount allowed.
        rule: Decision rule.
    """
    amount = abs(value)
    guard = 0.0 if rule is Rule.SIMPLE else expanded
    if amount <= limit - guard:
        return Conformity.PASS
    if rule is not Rule.GUARDED_BOTH or amount > limit + guard:
        return Conformity.FAIL
    return Conformity.CONDITIONAL_PASS if amount <= limit else Conformity.CONDITIONAL_FAIL


_DATE = re.compile(r'[0-9]{4}-[0-9]{2}-[0-9]{2}')
_COUNTRY = re.compile(r'[A-Z]{2}')
LOCATIONS = ('laboratory', 'customer', 'laboratoryBranch', 'customerBranch', 'other')
"""Places of calibration, in the terms of the DCC."""
_OF_PERSON = ('name', 'role')
_OF_ITEM = ('description', 'manufacturer', 'model', 'serial_number', 'condition')
"""Fields of the unit that ISO/IEC 17025 requires in one clause."""
CONDITIONS = {
    'temperature': ('air temperature', '\u00b0C'),
    'relative_humidity': ('relative humidity', '%'),
    'air_pressure': ('air pressure', 'hPa'),
}
"""Keys of `environment`, their texts, and the units of their numbers."""


@dataclass(frozen=True)
class Contact:
    """A laboratory or a customer; texts that are not stated are empty."""

    name: str = ''
    street: str = ''
    postcode: str = ''
    city: str = ''
    country: str = ''
    email: str = ''
    phone: str = ''

    @property
    def lines(self) -> list[str]:
        """The lines of the address."""
        town = f'{self.postcode} {self.city}'.strip()
        place = ', '.join(part for part in (town, self.country) if part)
        return [line for line in (self.name, self.street, place, self.email, self.phone) if line]


@dataclass(frozen=True)
class Item:
    """The calibrated unit."""

    description: str = ''
    manufacturer: str = ''
    model: str = ''
    serial_number: str = ''
    customer_id: str = ''
    condition: str = ''
    adjustment: str = ''


@dataclass(frozen=True)
class Condition:
    """A quantity of the environment."""

    key: str  #: A key of `CONDITIONS`.
    value: float  #: In its unit.
    within: float  #: Half the width of the interval of its variation.


@dataclass(frozen=True)
class Equipment:
    """A reference, with its certificate."""

    name: str = ''
    manufacturer: str = ''
    model: str = ''
    serial_number: str = ''
    certificate: str = ''
    issued_by: str = ''
    valid_until: date | None = None
    traceability: str = ''


@dataclass(frozen=True)
class Signature:
    """Who authorizes the certificate, or worked on it."""

    name: str = ''
    role: str = ''


@dataclass(frozen=True)
class Fields:
    """All statements for a certificate; missing ones are empty or None."""

    number: str = ''
    replaces: str = ''
    laboratory: Contact = Contact()
    accreditation: str = ''
    location: str = 'laboratory'
    customer: Contact = Contact()
    item: Item = Item()
    received: date | None = None
    calibrated: tuple[date, date] | None = None
    issued: date | None = None
    procedure: str = ''
    procedure_reference: str = ''
    environment: tuple[Condition, ...] = ()
    equipment: tuple[Equipment, ...] = ()
    rule: Rule | None = None
    requirement: str = ''
    remarks: tuple[str, ...] = ()
    signatures: tuple[Signature, ...] = field(default=())
    where: str = ''


def read_fields(section: Section) -> Fields:
    """Read a file of fields.

    Raises:
        InputError: A key is unknown or of another kind; a missing one is not an error here.
    """
    contacts = [_contact(section, key) for key in ('laboratory', 'customer')]
    procedure = _below(section, 'procedure')
    conformity = _below(section, 'conformity')
    rules = {rule.value: rule for rule in Rule}
    laboratory = _below(section, 'laboratory')
    found = Fields(
        number=section.text('number', ''),
        replaces=section.text('replaces', ''),
        laboratory=contacts[0],
        accreditation=laboratory.text('accreditation', ''),
        location=section.choice('location', {word: word for word in LOCATIONS}, 'laboratory'),
        customer=contacts[1],
        item=_item(section),
        received=_date(section, 'received'),
        calibrated=_period(section),
        issued=_date(section, 'issued'),
        procedure=procedure.text('name', ''),
        procedure_reference=procedure.text('reference', ''),
        environment=_environment(section),
        equipment=tuple(map(_equipment, _listed(section, 'equipment'))),
        rule=conformity.choice('rule', rules) if conformity.has('rule') else None,
        requirement=conformity.text('requirement', ''),
        remarks=section.texts('remarks'),
        signatures=tuple(map(_signature, _listed(section, 'signatures'))),
        where=section.where,
    )
    for part in (procedure, conformity, section):
        part.finish()
    _check_order(found, section)
    return found


def _below(section: Section, name: str) -> Section:
    """Return a mapping below, or an empty one."""
    return section.section(name) if section.has(name) else Section({}, section.key(name))


def _listed(section: Section, name: str) -> list[Section]:
    return section.sections(name) if section.has(name) else []


def _contact(section: Section, name: str) -> Contact:
    own = _below(section, name)
    country = own.text('country', '')
    if own.has('country') and not (
        isinstance(own.raw('country'), str) and _COUNTRY.fullmatch(country)
    ):
        raise InputError(
            f'{own.key("country")}: found {own.raw("country")!r}, expected two capitals as in ISO '
            '3166-1, for instance DE.'
        )
    texts = {
        key: own.text(key, '') for key in ('name', 'street', 'postcode', 'city', 'email', 'phone')
    }
    if name == 'laboratory':
        own.has('accreditation')
    own.finish()
    return Contact(country=country, **texts)


def _item(section: Section) -> Item:
    own = _below(section, 'item')
    found = Item(**{key.name: own.text(key.name, '') for key in keys_of(Item)})
    own.finish()
    return found


def _date(section: Section, name: str) -> date | None:
    if not section.has(name):
        return None
    raw = section.raw(name)
    if isinstance(raw, str) and _DATE.fullmatch(raw):
        try:
            return date.fromisoformat(raw)
        except ValueError:
            pass
    raise InputError(f'{section.key(name)}: found {raw!r}, expected a date as 2026-01-31.')


def _period(section: Section) -> tuple[date, date] | None:
    if not section.has('calibrated'):
        return None
    own = section.section('calibrated')
    first, last = _date(own, 'from'), _date(own, 'to')
    own.finish()
    if first is None:
        raise InputError(f"{own.where}: the key 'from' is missing.")
    return first, last or first


def _environment(section: Section) -> tuple[Condition, ...]:
    own = _below(section, 'environment')
    found = []
    for key in CONDITIONS:
        if own.has(key):
            part = own.section(key)
            within = part.number('within')
            if within < 0:
                raise InputError(f'{part.key("within")}: found {within:g}, expected 0 or more.')
            found.append(Condition(key, part.number('value'), within))
            part.finish()
    own.finish()
    return tuple(found)


def _equipment(section: Section) -> Equipment:
    keys = ('name', 'manufacturer', 'model', 'serial_number', 'certificate', 'issued_by')
    texts = {key: section.text(key, '') for key in (*keys, 'traceability')}
    found = Equipment(valid_until=_date(section, 'valid_until'), **texts)
    section.finish()
    return found


def _signature(section: Section) -> Signature:
    found = Signature(section.text('name', ''), section.text('role', ''))
    section.finish()
    return found


def _check_order(fields: Fields, section: Section) -> None:
    """Refuse impossible dates of a calibration."""
    first, last = fields.calibrated or (None, None)
    steps = [('received', fields.received), ('calibrated: from', first)]
    steps += [('calibrated: to', last), ('issued', fields.issued)]
    known = [(name, day) for name, day in steps if day is not None]
    for (name, day), (after, later) in pairwise(known):
        if later < day:
            raise InputError(f'{section.key(after)}: found {later}, before {name}, {day}.')


def missing(fields: Fields, *, dcc: bool, limits: bool) -> list[str]:
    """Return the missing fields that ISO/IEC 17025 requires: key and clause.

    Args:
        fields: The statements.
        dcc: Whether a DCC is written, which requires more.
        limits: Whether there is a specification for statements of conformity.
    """
    item, lab, customer = fields.item, fields.laboratory, fields.customer
    required = [
        ('number', '7.8.2.1 d', fields.number),
        *((f'laboratory: {k}', '7.8.2.1 b', getattr(lab, k)) for k in ('name', 'street', 'city')),
        *((f'customer: {k}', '7.8.2.1 e', getattr(customer, k)) for k in ('name', 'city')),
        *((f'item: {k}', '7.8.2.1 g', getattr(item, k)) for k in _OF_ITEM),
        ('item: adjustment', '7.8.4.1 d', item.adjustment),
        ('received', '7.8.2.1 h', fields.received),
        ('calibrated', '7.8.2.1 i', fields.calibrated),
        ('issued', '7.8.2.1 j', fields.issued),
        ('procedure: name', '7.8.2.1 f', fields.procedure),
        ('procedure: reference', '7.8.2.1 f', fields.procedure_reference),
        ('environment: temperature', '7.8.4.1 b', _has(fields, 'temperature')),
        ('equipment', '7.8.4.1 c', fields.equipment),
        ('signatures', '7.8.2.1 o', fields.signatures),
    ]
    references = ('name', 'serial_number', 'certificate', 'issued_by', 'traceability')
    for k, one in enumerate(fields.equipment):
        required += [(f'equipment[{k}]: {n}', '7.8.4.1 c', getattr(one, n)) for n in references]
    for k, person in enumerate(fields.signatures):
        required += [(f'signatures[{k}]: {n}', '7.8.2.1 o', getattr(person, n)) for n in _OF_PERSON]
    if fields.rule is not None:
        required.append(('conformity: requirement', '7.8.6.2', fields.requirement))
        required.append(('a specification of the unit (`imu`)', '7.8.6.2', limits))
    if dcc:
        required += [
            (f'{name}: {key}', 'DCC 3.1.2', getattr(contact, key))
            for name, contact in (('laboratory', lab), ('customer', customer))
            for key in ('email', 'country')
        ]
    return [f'{key} ({clause})' for key, clause, value in required if not value]


def _has(fields: Fields, key: str) -> bool:
    found = [c for c in fields.environment if c.key == key]
    return bool(found) and math.isfinite(found[0].value)
