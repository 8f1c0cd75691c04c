"""The keys of a device's file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from imu_calib.common.config import Section
from imu_calib.live.devices import format as frame
from imu_calib.live.devices import messages
from imu_calib.live.devices.fields import CATALOGUE
from imu_calib.live.devices.format import TYPES

from .keys import (
    VALUES,
    Key,
    Schema,
    Tables,
    Value,
    absent,
    array,
    choice,
    either,
    given,
    has,
    keys_of,
    mapping,
    one_of,
    when,
    whole,
)

_WHOLE = [name for name, (kind, _) in TYPES.items() if kind in 'ui']
_UNSIGNED = [name for name, (kind, _) in TYPES.items() if kind == 'u']
_NONE = choice(['none'])
_NOT_0 = Value({'type': 'number', 'not': {'const': 0}}, 'number, not 0')
_BELOW = 'keys, below'


def _one_of(values: Sequence[int]) -> Value:
    return Value({'enum': list(values)}, f'{", ".join(map(str, values[:-1]))} or {values[-1]}')


def _whole_list(lower: int, upper: int, count: int) -> Value:
    words = f'list of {"two" if count == 2 else "three"} whole numbers'
    return array(whole(lower, upper), count, count, words)


def _scales(most: int) -> Value:
    lists = [array(_NOT_0, count, count) for count in (1, 3) if count <= most]
    return either(_NOT_0, *lists, words=f'number{" or list of three" * (most > 1)}, not 0')


def _number(kind: type, types: list[str]) -> list[Key]:
    """Return the keys of a number in a frame, of some types."""
    first, *others = keys_of(kind)
    return [replace(first, value=choice(types)), *others]


VALUES.update(
    {
        messages.byte_list: lambda: array(whole(0, 255), words='list of bytes'),
        messages.one_of: _one_of,
        messages.whole_list: _whole_list,
        messages.scales: _scales,
    }
)
_OTHERS = [name for name in TYPES if name not in _UNSIGNED]
_UNSWAPPED = [name for name, (_, size) in TYPES.items() if size not in {2, 4, 8}]
_DEFS: Schema = {
    'bits': {
        'allOf': [
            *(
                when(
                    {'allOf': [given('bits'), has('type', name)]},
                    {'properties': {'bits': {'items': {'maximum': 8 * TYPES[name][1] - 1}}}},
                )
                for name in _UNSIGNED
            ),
            when(has('type', *_OTHERS), {'properties': {'bits': {'type': 'null'}}}),
            when(
                has('type', *_UNSWAPPED),
                {'properties': {'byte_order': {'enum': ['little', 'big', None]}}},
            ),
        ]
    },
}
_BITS: Schema = {'$ref': '#/$defs/bits'}


_TRIAD = keys_of(frame.TriadKeys)
_CHANNEL = keys_of(frame.ChannelKeys)
_COUNTER = _number(frame.CounterKeys, _WHOLE)
_FAULT = keys_of(frame.FaultKeys)
_MODULUS = whole(2, 2**64)
VALUES.update(
    {
        frame.read_moduli: lambda: either(
            _MODULUS, array(_MODULUS), words='whole number, or list of them, from 2'
        ),
        frame.read_faults: lambda: array(
            mapping(_FAULT, one_of('bit', 'mask')), words='list of faults, below'
        ),
    }
)
_TIME = keys_of(frame.TimeKeys)
_STATUS = _number(frame.StatusKeys, _UNSIGNED)
_DEFS['status'] = mapping(_STATUS, _BITS).schema
_STATUS_VALUE = Value({'$ref': '#/$defs/status'}, '')
_ALGORITHM = keys_of(messages.AlgorithmKeys)


def _least(names: str, most: int) -> Schema:
    return {'properties': {name: {'maximum': most} for name in names.split()}}


def _algorithm() -> list[Schema]:
    """Return which parameters each kind of checksum takes."""
    names = [key.name for key in _ALGORITHM[1:] if key.name != 'byte_order']
    known = [
        when(
            has('kind', 'sum'),
            absent(*(n for n in names if n not in {'width', 'negated', 'word'})),
        ),
        when(has('kind', 'fletcher'), absent(*(n for n in names if n != 'modulus'))),
        when(has('kind', 'fletcher'), given('modulus')),
        when(has('kind', 'xor'), absent(*(n for n in names if n != 'init'))),
        when(has('kind', 'xor'), _least('init', 255)),
        when(
            has('kind', 'crc'),
            {'allOf': [absent('negated', 'word', 'modulus'), given('width', 'poly')]},
        ),
        when(has('kind', *CATALOGUE), absent(*names)),
    ]
    return known + [
        when(
            {'allOf': [has('kind', 'crc'), has('width', bits)]},
            _least('poly init xorout', (1 << bits) - 1),
        )
        for bits in (8, 16, 24, 32)
    ]


_DEFS['algorithm'] = {'allOf': _algorithm()}
_KNOWN: Schema = {'$ref': '#/$defs/algorithm'}

_CHECK = keys_of(frame.CheckKeys)
_LENGTH = keys_of(messages.LengthKeys)
_OTHER_CHECK = keys_of(messages.MessageCheckKeys)
_NO_CHECK = has('checksum', 'none')
_TWO_OF_SYNC: Schema = {'properties': {'sync': {'minItems': 2}}}
_CONSTANT = keys_of(frame.ConstantKeys)
_ASCII = either(
    Value({'type': 'string', 'pattern': r'^[\x00-\x7F]+$'}, 'text of ASCII'),
    Value({'type': 'number'}, ''),
    words='text of ASCII',
)
_LONGEST: Schema = {'properties': {'bytes': {'maxItems': messages.LONGEST_COMMAND}}}


def _check(keys: list[Key]) -> Value:
    return either(_NONE, mapping(keys, _KNOWN), words='`none`, or keys, below')


VALUES.update(
    {
        frame.read_triad: lambda: mapping(_TRIAD, _BITS, words=_BELOW),
        frame.read_channel: lambda: mapping(_CHANNEL, _BITS, words=_BELOW),
        frame.read_counter: lambda: mapping(_COUNTER, _BITS, words=_BELOW),
        frame.read_time: lambda: mapping(_TIME, _BITS, one_of('unit', 'ticks'), words=_BELOW),
        frame.read_status: lambda: either(
            _STATUS_VALUE, array(_STATUS_VALUE), words='keys, below, or a list of such'
        ),
        frame.read_constant: lambda: array(mapping(_CONSTANT), words='list of keys, below'),
        frame.read_check: lambda: _check(_CHECK),
        frame.read_others: lambda: array(
            mapping(_OTHER, when(_NO_CHECK, _TWO_OF_SYNC)), words='list of messages, below'
        ),
        messages.read_commands: lambda: array(
            mapping(_COMMAND, one_of('bytes', 'text'), _LONGEST), words='list of commands, below'
        ),
        messages.read_ascii: lambda: _ASCII,
        messages.read_length: lambda: either(
            whole(1, messages.LONGEST),
            mapping(_LENGTH),
            words='whole number to 4096, or keys, below',
        ),
        messages.read_message_check: lambda: _check(_OTHER_CHECK),
        Section.section: lambda: mapping(_FIELDS, words=_BELOW),
    }
)
_COMMAND = keys_of(messages.CommandKeys)
_OTHER = keys_of(messages.MessageKeys)
_FIELDS = keys_of(frame.FieldKeys)
KEYS = keys_of(frame.DeviceKeys)

TABLES: Tables = {
    'device': KEYS,
    'fields': _FIELDS,
    'gyro': _TRIAD,
    'skew': _CHANNEL,
    'counter': _COUNTER,
    'time': _TIME,
    'status': _STATUS,
    'faults': _FAULT,
    'constant': _CONSTANT,
    'start': _COMMAND,
    'checksum': _CHECK,
    'others': _OTHER,
    'others length': _LENGTH,
    'others checksum': _OTHER_CHECK[len(_ALGORITHM) :],
}
_AGAIN: Schema = when(given('start_again'), given('start'))
_TWO_BYTES: Schema = {'anyOf': [_TWO_OF_SYNC, given('constant')]}
VALUE = Value({'$defs': _DEFS, **mapping(KEYS, when(_NO_CHECK, _TWO_BYTES), _AGAIN).schema}, '')
TITLE = 'A device: where things stand in its frames'
