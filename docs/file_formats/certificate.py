"""The keys of a file of fields of a certificate."""

from __future__ import annotations

from imu_calib.reports.certificate_fields import (
    Condition,
    Contact,
    Environment,
    Equipment,
    Fields,
    Item,
    Laboratory,
    Period,
    Procedure,
    Requirement,
    Signature,
    read_country,
    read_date,
    read_period,
    read_size,
)

from .keys import CONDITIONS, VALUES, Tables, Value, given, keys_of, mapping_of, number, when

_DAY = Value(
    {'type': 'string', 'pattern': '^[0-9]{4}-(0[1-9]|1[0-2])-(0[1-9]|[12][0-9]|3[01])$'},
    'date, as `2026-01-31`',
)
_COUNTRY = Value({'type': 'string', 'pattern': '^[A-Z]{2}$'}, 'two capitals (ISO 3166-1)')
VALUES.update(
    {
        read_date: lambda: _DAY,
        read_country: lambda: _COUNTRY,
        read_size: lambda: number(least=0),
        read_period: lambda: mapping_of(Period),
    }
)
CONDITIONS[Requirement] = [when(given('requirement'), given('rule'))]

TABLES: Tables = {
    'certificate': keys_of(Fields),
    'laboratory': keys_of(Laboratory),
    'customer': keys_of(Contact),
    'item': keys_of(Item),
    'calibrated': keys_of(Period),
    'procedure': keys_of(Procedure),
    'environment': keys_of(Environment),
    'condition': keys_of(Condition),
    'equipment': keys_of(Equipment),
    'conformity': keys_of(Requirement),
    'signatures': keys_of(Signature),
}
VALUE = mapping_of(Fields)
TITLE = 'Fields of a calibration certificate: what the laboratory states'
