"""The keys of a file of fields of a certificate."""

from __future__ import annotations

from imu_calib.reports.certificate_fields import CONDITIONS, LOCATIONS, Rule

from .keys import REQUIRED, Key, Tables, Value, array, choice, mapping, number, text

_BELOW = 'keys, below'
_NOT_STATED = 'named as missing'


def _asked(name: str, meaning: str, clause: str, value: Value | None = None) -> Key:
    """Return a key that the standard asks for: without it there is no certificate but a draft."""
    return Key(name, value or text(), f'{meaning} ({clause})', None, _NOT_STATED)


_DAY = Value(
    {'type': 'string', 'pattern': '^[0-9]{4}-(0[1-9]|1[0-2])-(0[1-9]|[12][0-9]|3[01])$'},
    'date, as `2026-01-31`',
)
_COUNTRY = Value({'type': 'string', 'pattern': '^[A-Z]{2}$'}, 'two capitals (ISO 3166-1)')


def _contact(clause: str, *, street: bool) -> list[Key]:
    where = Key('street', text(), 'street and number')
    if street:
        where = _asked('street', 'street and number', clause)
    return [
        _asked('name', 'full name', clause),
        where,
        Key('postcode', text(), 'of the town'),
        _asked('city', 'town', clause),
        Key('country', _COUNTRY, 'a DCC requires it'),
        Key('email', text(), 'a DCC requires it'),
        Key('phone', text(), 'telephone'),
    ]


_LABORATORY = [
    *_contact('7.8.2.1 b', street=True),
    Key('accreditation', text(), 'code of the accreditation; state none that you do not have'),
]
_CUSTOMER = _contact('7.8.2.1 e', street=False)
_ITEM = [
    _asked('description', 'what it is', '7.8.2.1 g'),
    _asked('manufacturer', 'its maker', '7.8.2.1 g'),
    _asked('model', 'type', '7.8.2.1 g'),
    Key(
        'serial_number',
        text(),
        'of the unit; another one than that of the calibration is refused (7.8.2.1 g)',
        None,
        'that of the calibration',
    ),
    Key('customer_id', text(), 'name given by the customer'),
    _asked('condition', 'condition on receipt', '7.8.2.1 g'),
    _asked('adjustment', 'adjustments or repairs, or a statement of none', '7.8.4.1 d'),
]
_PERIOD = [
    Key('from', _DAY, 'first day', REQUIRED),
    Key('to', _DAY, 'last day', None, '`from`'),
]
_PROCEDURE = [
    _asked('name', 'in words', '7.8.2.1 f'),
    _asked('reference', 'document and revision', '7.8.2.1 f'),
]
_CONDITION = [
    Key('value', number(), 'mean', REQUIRED),
    Key(
        'within', number(least=0), 'half the width of its interval during the calibration', REQUIRED
    ),
]
_ENVIRONMENT = [
    Key(key, mapping(_CONDITION, words=_BELOW), f'{words}, {unit}')
    for key, (words, unit) in CONDITIONS.items()
]
_ENVIRONMENT[0] = _asked(
    'temperature', 'air temperature, \u00b0C', '7.8.4.1 b', mapping(_CONDITION, words=_BELOW)
)
_EQUIPMENT = [
    _asked('name', 'what it is', '7.8.4.1 c'),
    Key('manufacturer', text(), 'its maker'),
    Key('model', text(), 'type'),
    _asked('serial_number', 'serial number', '7.8.4.1 c'),
    _asked('certificate', 'number of its certificate', '7.8.4.1 c'),
    _asked('issued_by', 'who calibrated it', '7.8.4.1 c'),
    Key('valid_until', _DAY, 'last day of use by the laboratory'),
    _asked('traceability', 'traceability of its values to the SI', '7.8.4.1 c'),
]
_CONFORMITY = [
    Key(
        'rule',
        choice([rule.value for rule in Rule]),
        'decision rule ([certificate.md](../certificate.md#conformity))',
        None,
        'no statement of conformity',
    ),
    Key(
        'requirement',
        text(),
        'the document with the limits (7.8.6.2)',
        None,
        'with a rule: ' + _NOT_STATED,
    ),
]
_SIGNATURE = [_asked('name', 'of a person', '7.8.2.1 o'), _asked('role', 'function', '7.8.2.1 o')]

KEYS = [
    _asked('number', 'of the certificate, unique', '7.8.2.1 d'),
    Key('replaces', text(), 'number of a certificate that this one replaces (7.8.8)'),
    _asked('laboratory', 'who calibrated', '7.8.2.1 b', mapping(_LABORATORY, words=_BELOW)),
    Key('location', choice(LOCATIONS), 'where it was calibrated (7.8.2.1 c)', 'laboratory'),
    _asked('customer', 'for whom', '7.8.2.1 e', mapping(_CUSTOMER, words=_BELOW)),
    _asked('item', 'the unit', '7.8.2.1 g', mapping(_ITEM, words=_BELOW)),
    _asked('received', 'date of receipt of the unit', '7.8.2.1 h', _DAY),
    Key(
        'calibrated',
        mapping(_PERIOD, words=_BELOW),
        'period of the calibration; it must include the day of the recording (7.8.2.1 i)',
        None,
        'the day of the recording',
    ),
    _asked('issued', 'when the certificate is issued', '7.8.2.1 j', _DAY),
    _asked('procedure', 'of the calibration', '7.8.2.1 f', mapping(_PROCEDURE, words=_BELOW)),
    _asked('environment', 'of the calibration', '7.8.4.1 b', mapping(_ENVIRONMENT, words=_BELOW)),
    _asked(
        'equipment',
        'references',
        '7.8.4.1 c',
        array(mapping(_EQUIPMENT), words='list of references, below'),
    ),
    Key('conformity', mapping(_CONFORMITY, words=_BELOW), 'requirement and rule (7.8.6)'),
    Key('remarks', array(text(), 0), 'additions, deviations and exclusions (7.8.2.1 n)'),
    _asked(
        'signatures',
        'who authorizes it, the main signer first',
        '7.8.2.1 o',
        array(mapping(_SIGNATURE), words='list of persons, below'),
    ),
]

TABLES: Tables = {
    'certificate': KEYS,
    'laboratory': _LABORATORY,
    'customer': _CUSTOMER,
    'item': _ITEM,
    'calibrated': _PERIOD,
    'procedure': _PROCEDURE,
    'environment': _ENVIRONMENT,
    'condition': _CONDITION,
    'equipment': _EQUIPMENT,
    'conformity': _CONFORMITY,
    'signatures': _SIGNATURE,
}
VALUE = mapping(KEYS)
TITLE = 'Fields of a calibration certificate: what the laboratory states'
