"""Statements of a laboratory for a certificate: read from YAML, with a list of missing ones.

Source: ISO/IEC 17025:2017, 7.8.2 and 7.8.4; docs/certificate.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date
from enum import Enum
from itertools import pairwise
from typing import Any

from ..common.config import Section
from ..common.errors import InputError
from ..common.keys import field_keys, key, read_record, record, records

# Source: ILAC-G8:09/2019, 4.2; JCGM 106:2012, 8; ISO/IEC 17025:2017, 7.8.6.


class Rule(Enum):
    """How the uncertainty is taken into account in a decision on a limit."""

    SIMPLE = 'simple_acceptance'
    GUARDED = 'guard_band'
    GUARDED_BOTH = 'guard_band_both'

    def words(self, parameters: int) -> str:
        """Return the rule and its risk as text, for an item with limits of some parameters.

        Source of the sum: Bonferroni's inequality, which also holds for correlated parameters.
        """
        return _WORDS[self].format(n=parameters, sum=min(100.0, 2.5 * parameters))


_WORDS = {
    Rule.SIMPLE: (
        'Simple acceptance (ILAC-G8:09/2019, 4.2.1): pass where the value lies within its limits, '
        'else fail. Each parameter at its limit is accepted, or rejected, wrongly with a '
        'probability of up to 50 %.'
    ),
    Rule.GUARDED: (
        'Guard band w = U (ILAC-G8:09/2019, 4.2.2): pass where the value lies within its limits '
        'by at least the expanded uncertainty U, else fail. For each parameter a pass is wrong '
        'with a probability of at most 2.5 %; for the item, with {n} parameters, of at most their '
        'sum, {sum:g} %.'
    ),
    Rule.GUARDED_BOTH: (
        'Guard band w = U on both sides (ILAC-G8:09/2019, 4.2.3): pass where the value lies within '
        'its limits by at least the expanded uncertainty U, fail where it lies beyond by more '
        'than U; between, conditional pass within the limits and conditional fail beyond. For '
        'each parameter pass and fail are wrong with a probability of at most 2.5 %; for the item, '
        'with {n} parameters, of at most their sum, {sum:g} %.'
    ),
}


class Conformity(Enum):
    """The statement on a value, in the terms of the DCC if it has one; the worst last."""

    PASS = 'pass'
    CONDITIONAL_PASS = 'conditionalPass'
    NOT_ASSESSED = ''
    CONDITIONAL_FAIL = 'conditionalFail'
    FAIL = 'fail'

    @property
    def words(self) -> str:
        """The statement as text."""
        return self.name.lower().replace('_', ' ')


def decide(value: float, expanded: float, limit: float, rule: Rule) -> Conformity:
    """Return the statement on a value with a limit on both sides of zero.

    Where U exceeds the limit, a measurement capability index below 1 (JCGM 106:2012, 7.6), no value
    could pass with confidence: only what lies beyond the limit by more than U is decided.
    """
    amount = abs(value)
    if expanded > limit and amount <= limit + expanded:
        return Conformity.NOT_ASSESSED
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


def read_date(section: Section, name: str) -> date:
    """Read a day."""
    raw = section.raw(name)
    if isinstance(raw, str) and _DATE.fullmatch(raw):
        try:
            return date.fromisoformat(raw)
        except ValueError:
            pass
    raise InputError(f'{section.key(name)}: found {raw!r}, expected a date as 2026-01-31.')


def read_country(section: Section, name: str) -> str:
    """Read the code of a country."""
    raw, country = section.raw(name), section.text(name)
    if not (isinstance(raw, str) and _COUNTRY.fullmatch(country)):
        raise InputError(
            f'{section.key(name)}: found {raw!r}, expected two capitals as in ISO 3166-1, for '
            'instance DE.'
        )
    return country


def read_size(section: Section, name: str) -> float:
    """Read a number of 0 or more."""
    size = section.number(name)
    if size < 0:
        raise InputError(f'{section.key(name)}: found {size:g}, expected 0 or more.')
    return size


def _asked(
    meaning: str,
    clause: str,
    *read: Any,
    value: Any = '',
    otherwise: str = 'named as missing',
) -> Any:
    """Return a field that the standard asks for: without it there is no certificate but a draft."""
    return key(meaning, *(read or (Section.text,)), value=value, otherwise=otherwise, source=clause)


def _free(meaning: str, *read: Any, value: Any = '') -> Any:
    """Return a field that may be left out."""
    return key(meaning, *(read or (Section.text,)), default=None, value=value)


@dataclass(frozen=True)
class Contact:
    """A customer; texts that are not stated are empty."""

    name: str = _asked('full name', '7.8.2.1 e')
    street: str = _free('street and number')
    postcode: str = _free('of the town')
    city: str = _asked('town', '7.8.2.1 e')
    country: str = _free('a DCC requires it', read_country)
    email: str = _free('a DCC requires it')
    phone: str = _free('telephone')

    @property
    def lines(self) -> list[str]:
        """The lines of the address."""
        town = f'{self.postcode} {self.city}'.strip()
        place = ', '.join(part for part in (town, self.country) if part)
        return [line for line in (self.name, self.street, place, self.email, self.phone) if line]


@dataclass(frozen=True)
class Laboratory(Contact):
    """A laboratory; its address is asked for."""

    name: str = _asked('full name', '7.8.2.1 b')
    street: str = _asked('street and number', '7.8.2.1 b')
    city: str = _asked('town', '7.8.2.1 b')
    accreditation: str = _free('code of the accreditation; state none that you do not have')


@dataclass(frozen=True)
class Item:
    """The calibrated unit."""

    description: str = _asked('what it is', '7.8.2.1 g')
    manufacturer: str = _asked('its maker', '7.8.2.1 g')
    model: str = _asked('type', '7.8.2.1 g')
    serial_number: str = _asked(
        'of the unit; another one than that of the calibration is refused',
        '7.8.2.1 g',
        otherwise='that of the calibration',
    )
    customer_id: str = _free('name given by the customer')
    condition: str = _asked('condition on receipt', '7.8.2.1 g')
    adjustment: str = _asked('adjustments or repairs, or a statement of none', '7.8.4.1 d')


@dataclass(frozen=True)
class Period:
    """First and last day of a calibration."""

    first: date = key('first day', read_date, name='from')
    last: date | None = key('last day', read_date, otherwise='`from`', name='to')


def read_period(section: Section, name: str) -> tuple[date, date]:
    """Read the first and the last day, which may be one."""
    period = record(section, name, Period)
    return period.first, period.last or period.first


@dataclass(frozen=True)
class Procedure:
    """How it was calibrated."""

    name: str = _asked('in words', '7.8.2.1 f')
    reference: str = _asked('document and revision', '7.8.2.1 f')


@dataclass(frozen=True)
class Condition:
    """A quantity of the environment, in its unit."""

    value: float = key('mean', Section.number)
    #: Uniform.
    within: float = key('half the width of its interval during the calibration', read_size)


@dataclass(frozen=True)
class Environment:
    """Conditions during the calibration."""

    temperature: Condition | None = _asked(
        'air temperature, \u00b0C', '7.8.4.1 b', record, Condition, value=None
    )
    relative_humidity: Condition | None = _free(
        'relative humidity, %', record, Condition, value=None
    )
    air_pressure: Condition | None = _free('air pressure, hPa', record, Condition, value=None)

    @property
    def stated(self) -> dict[str, tuple[str, str, Condition]]:
        """Words, unit and values of those that are stated, by key."""
        return {
            name: (*declared.meaning.split(', '), found)
            for name, declared in field_keys(type(self)).items()
            if (found := getattr(self, name)) is not None
        }


@dataclass(frozen=True)
class Equipment:
    """A reference, with its certificate."""

    name: str = _asked('what it is', '7.8.4.1 c')
    manufacturer: str = _free('its maker')
    model: str = _free('type')
    serial_number: str = _asked('serial number', '7.8.4.1 c')
    certificate: str = _asked('number of its certificate', '7.8.4.1 c')
    issued_by: str = _asked('who calibrated it', '7.8.4.1 c')
    valid_until: date | None = _free('last day of use by the laboratory', read_date, value=None)
    traceability: str = _asked('traceability of its values to the SI', '7.8.4.1 c')


@dataclass(frozen=True)
class Requirement:
    """A statement of conformity."""

    rule: Rule | None = key(
        'decision rule ([certificate.md](../certificate.md#conformity))',
        Section.choice,
        {rule.value: rule for rule in Rule},
        otherwise='no statement of conformity',
    )
    requirement: str = key(
        'the document with the limits (7.8.6.2)',
        Section.text,
        value='',
        otherwise='with a rule: named as missing',
    )


@dataclass(frozen=True)
class Signature:
    """Who authorizes the certificate, or worked on it."""

    name: str = _asked('of a person', '7.8.2.1 o')
    role: str = _asked('function', '7.8.2.1 o')


@dataclass(frozen=True)
class Fields:
    """All statements for a certificate; missing ones are empty or None."""

    number: str = _asked('of the certificate, unique', '7.8.2.1 d')
    replaces: str = _free('number of a certificate that this one replaces (7.8.8)')
    laboratory: Laboratory = _asked(
        'who calibrated', '7.8.2.1 b', record, Laboratory, value=Laboratory()
    )
    location: str = key(
        'where it was calibrated (7.8.2.1 c)',
        Section.choice,
        {word: word for word in LOCATIONS},
        default='laboratory',
    )
    customer: Contact = _asked('for whom', '7.8.2.1 e', record, Contact, value=Contact())
    item: Item = _asked('the unit', '7.8.2.1 g', record, Item, value=Item())
    received: date | None = _asked(
        'date of receipt of the unit', '7.8.2.1 h', read_date, value=None
    )
    calibrated: tuple[date, date] | None = _asked(
        'period of the calibration; it must include the day of the recording',
        '7.8.2.1 i',
        read_period,
        value=None,
        otherwise='the day of the recording',
    )
    issued: date | None = _asked(
        'when the certificate is issued', '7.8.2.1 j', read_date, value=None
    )
    procedure: Procedure = _asked(
        'of the calibration', '7.8.2.1 f', record, Procedure, value=Procedure()
    )
    environment: Environment = _asked(
        'of the calibration', '7.8.4.1 b', record, Environment, value=Environment()
    )
    equipment: tuple[Equipment, ...] = _asked(
        'references', '7.8.4.1 c', records, Equipment, value=()
    )
    conformity: Requirement = key(
        'requirement and rule (7.8.6)', record, Requirement, default=None, value=Requirement()
    )
    remarks: tuple[str, ...] = _free(
        'additions, deviations and exclusions (7.8.2.1 n)', Section.texts, value=()
    )
    signatures: tuple[Signature, ...] = _asked(
        'who authorizes it, the main signer first', '7.8.2.1 o', records, Signature, value=()
    )
    where: str = ''  #: The file, for messages.


def read_fields(section: Section) -> Fields:
    """Read a file of fields."""
    found = replace(read_record(section, Fields), where=section.where)
    first, last = found.calibrated or (None, None)
    steps = [('received', found.received), ('calibrated: from', first)]
    steps += [('calibrated: to', last), ('issued', found.issued)]
    known = [(name, day) for name, day in steps if day is not None]
    for (name, day), (after, later) in pairwise(known):
        if later < day:
            raise InputError(f'{section.key(after)}: found {later}, before {name}, {day}.')
    if found.replaces and found.replaces == found.number:
        raise InputError(
            f'{section.key("replaces")}: found {found.replaces}, the number of this certificate: '
            'state that of the one it replaces.'
        )
    if found.conformity.requirement and found.conformity.rule is None:
        raise InputError(
            f'{section.key("conformity: rule")}: missing, but a requirement is stated: state the '
            'rule by which it is decided, or leave the requirement out.'
        )
    return found


def missing(fields: Fields, *, dcc: bool, limits: bool) -> list[str]:
    """Return the missing fields that ISO/IEC 17025 requires: key and clause."""
    found = list(_unstated(fields, ''))
    for name in ('equipment', 'signatures'):
        for k, one in enumerate(getattr(fields, name)):
            found += _unstated(one, f'{name}[{k}]: ')
    others: list[tuple[str, str, object]] = []
    if fields.conformity.rule is not None:
        others.append(('conformity: requirement', '7.8.6.2', fields.conformity.requirement))
        others.append(('a specification of the unit (`imu`)', '7.8.6.2', limits))
    if dcc:
        others += [
            (f'{name}: {key}', 'DCC 3.1.2', getattr(contact, key))
            for name, contact in (('laboratory', fields.laboratory), ('customer', fields.customer))
            for key in ('email', 'country')
        ]
    return found + [f'{key} ({clause})' for key, clause, value in others if not value]


def _unstated(stated: Any, where: str) -> Iterator[str]:
    """Yield what is not stated of a record, and of the records in it."""
    for name, declared in field_keys(type(stated)).items():
        value = getattr(stated, name)
        if declared.source and not value:
            yield f'{where}{name} ({declared.source})'
        elif declared.read is record and value is not None:
            yield from _unstated(value, f'{where}{name}: ')
