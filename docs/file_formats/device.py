"""The keys of a device's file."""

from __future__ import annotations

from imu_calib.common.units import Dimension
from imu_calib.live.devices import messages as commands
from imu_calib.live.devices.fields import CATALOGUE
from imu_calib.live.devices.format import BAUD, COUNTLESS, LONGEST, TICKS_NS, TYPES
from imu_calib.live.devices.messages import FLETCHER, LENGTH_TYPES, ORDERS, OWN_KINDS, WORDS

from .keys import (
    REQUIRED,
    Key,
    Schema,
    Tables,
    Value,
    absent,
    array,
    choice,
    either,
    flag,
    given,
    has,
    mapping,
    number,
    one_of,
    quantity,
    text,
    when,
    whole,
)

D = Dimension
_WHOLE = [name for name, (kind, _) in TYPES.items() if kind in 'ui']
_UNSIGNED = [name for name, (kind, _) in TYPES.items() if kind == 'u']
_NONE = choice(['none'])
_BYTES = array(whole(0, 255), words='list of bytes')
_ORDER = choice(['little', 'big'])
_NUMBER_ORDER = choice(list(ORDERS))
_NOT_0 = Value({'type': 'number', 'not': {'const': 0}}, 'number, not 0')

_SYNC = Key('sync', _BYTES, 'constant bytes at the start of each frame', REQUIRED)


def _offset(words: str) -> Key:
    return Key('offset', whole(0, LONGEST - 1, 'whole number, from 0'), words, REQUIRED)


def _number(types: list[str], offset: Key | None = None) -> list[Key]:
    """Return the keys of a number in a frame."""
    return [
        Key(
            'type',
            choice(types),
            '`u` unsigned, `i` signed, `f` floating point, `fp` fixed point, and its bits',
            REQUIRED,
        ),
        offset or _offset('of its first byte'),
        Key('byte_order', _NUMBER_ORDER, 'of this number', None, '`byte_order` of the frame'),
        Key(
            'bits',
            array(whole(0, 63), 2, 2, 'list of two whole numbers'),
            'first and last bit used, bit 0 the lowest; only for an unsigned number',
            None,
            'all',
        ),
    ]


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

_XYZ = Key(
    'offset',
    array(whole(0, LONGEST - 1), 3, 3, 'list of three whole numbers'),
    'of the first bytes of x, y, z',
    REQUIRED,
)
_SCALES = Key(
    'scale',
    either(
        _NOT_0,
        Value({'type': 'array', 'items': _NOT_0.schema, 'minItems': 1, 'maxItems': 1}, ''),
        Value({'type': 'array', 'items': _NOT_0.schema, 'minItems': 3, 'maxItems': 3}, ''),
        words='number or list of three, not 0',
    ),
    'value = scale x number; three with signs turn axes around. Not for pulses: their scale factor '
    "is the IMU's",
    1,
)
_SCALE = Key(
    'scale',
    either(
        _NOT_0,
        Value({'type': 'array', 'items': _NOT_0.schema, 'minItems': 1, 'maxItems': 1}, ''),
        words='number, not 0',
    ),
    'value = scale x number + `zero`',
    1,
)
_TRIAD = [*_number(list(TYPES), _XYZ), _SCALES]
_CHANNEL = [
    *_number(list(TYPES)),
    _SCALE,
    Key('zero', number(), 'value at the number 0', 0),
]
_COUNTER = [
    *_number(_WHOLE),
    Key(
        'modulus',
        whole(2, COUNTLESS, 'whole number, from 2'),
        'it restarts at 0 instead of reaching this',
        None,
        'by its type',
    ),
    Key('step', whole(1), 'by which it grows from frame to frame; below `modulus`', 1),
]
_MODULUS = whole(2, 2**64)
_TIME = [
    *_number(list(TYPES)),
    Key('unit', choice(list(TICKS_NS)), 'of the number; this or `ticks`', None, 'one of the two'),
    Key(
        'ticks',
        quantity(D.FREQUENCY, 'above 0'),
        'frequency of its ticks; this or `unit`',
        None,
        'one of the two',
    ),
    Key(
        'modulus',
        either(_MODULUS, array(_MODULUS), words='whole number, or list of them, from 2'),
        'ticks after which it restarts, as `864000000` after a day; a list where models differ',
        None,
        'by its type',
    ),
]
_FAULT = [
    Key(
        'bit',
        whole(0, 63),
        'the bit of the fault, 0 the lowest; this or `mask`',
        None,
        'one of the two',
    ),
    Key(
        'mask',
        whole(1, 2**64 - 1, 'whole number, from 1'),
        'the bits of the fault, any of them; this or `bit`',
        None,
        'one of the two',
    ),
    Key('when', choice(['set', 'clear']), 'which state of the bit is the fault', 'set'),
    Key('says', text(), 'the fault in words, for the screen and /diagnostics', REQUIRED),
    Key('level', choice(['warn', 'error']), 'on /diagnostics', 'error'),
]
_FAULT_VALUE = mapping(_FAULT, one_of('bit', 'mask'))
_STATUS = [
    *_number(_UNSIGNED),
    Key('faults', array(_FAULT_VALUE, words='list of faults, below'), 'its faults', REQUIRED),
]
_DEFS['status'] = mapping(_STATUS, _BITS).schema
_STATUS_VALUE = Value({'$ref': '#/$defs/status'}, '')

_BELOW = 'keys, below'
_FIELDS = [
    Key('gyro', mapping(_TRIAD, _BITS, words=_BELOW), 'the three gyros', REQUIRED),
    Key('accelerometer', mapping(_TRIAD, _BITS, words=_BELOW), 'as `gyro`', REQUIRED),
    Key('skew', mapping(_CHANNEL, _BITS, words=_BELOW), 'a skewed gyro'),
    Key('temperature', mapping(_CHANNEL, _BITS, words=_BELOW), 'degrees Celsius; as `skew`'),
    Key('counter', mapping(_COUNTER, _BITS, words=_BELOW), 'number of the frame'),
    Key(
        'time',
        mapping(_TIME, _BITS, one_of('unit', 'ticks'), words=_BELOW),
        "the device's clock",
    ),
    Key(
        'status',
        either(_STATUS_VALUE, array(_STATUS_VALUE), words='keys, below, or a list of such'),
        'status reported by the device',
    ),
]

_CONSTANT = [
    _offset('of the first of them, behind `sync`'),
    Key('bytes', _BYTES, 'their values', REQUIRED),
]

_KIND = choice([*OWN_KINDS, *CATALOGUE])
_ALGORITHM = [
    Key('kind', _KIND, 'the algorithm; a CRC by its name in the catalogue, or `crc`', REQUIRED),
    Key(
        'width',
        Value({'enum': [8, 16, 24, 32]}, '8, 16, 24 or 32'),
        'bits, of `sum` and `crc`',
        None,
        '`word` for `sum`, must be given for `crc`',
    ),
    Key('word', Value({'enum': list(WORDS)}, '8, 16 or 32'), 'bits of what `sum` adds', 8),
    Key(
        'modulus',
        Value({'enum': list(FLETCHER)}, '255 or 256'),
        "of `fletcher`: 255 as in Fletcher's paper, 256 as MIP and UBX have it",
        None,
        'must be given for `fletcher`',
    ),
    Key('negated', flag(), 'of `sum`: the sent value makes the sum zero', default=False),
    Key('poly', whole(1), 'of `crc`: generator polynomial', None, 'must be given for `crc`'),
    Key('init', whole(0), 'of `crc` and `xor`: initial value', 0),
    Key('refin', flag(), 'of `crc`: bytes go in with their lowest bit first', default=False),
    Key('refout', flag(), 'of `crc`: the result is reflected', default=False),
    Key('xorout', whole(0), 'of `crc`: final XOR value', 0),
]


def _least(names: str, most: int) -> Schema:
    return {'properties': {name: {'maximum': most} for name in names.split()}}


def _algorithm() -> list[Schema]:
    """Return which parameters each kind of checksum takes."""
    names = [key.name for key in _ALGORITHM[1:]]
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

_PLACE = [
    _offset('of its first byte'),
    Key('byte_order', _ORDER, 'of the checksum', None, '`byte_order` of the frame'),
]
_CHECK = [
    *_ALGORITHM,
    *_PLACE,
    Key(
        'covers',
        array(whole(0, LONGEST - 1), 2, 2, 'list of two whole numbers'),
        'first and last byte covered',
        None,
        'all before it',
    ),
    Key('padding', whole(0, 64), 'zero bytes included after them but not sent', 0),
]

_LENGTH = [
    Key('type', choice(list(LENGTH_TYPES)), 'of the number', REQUIRED),
    Key('offset', whole(1, LONGEST), 'of the number, behind `sync`', REQUIRED),
    Key('byte_order', _ORDER, 'of the number', None, '`byte_order` of the frame'),
    Key('zero', whole(-LONGEST, LONGEST), 'added to the number', 0),
]
_OTHER_CHECK = [
    *_ALGORITHM,
    Key(
        'offset',
        whole(-LONGEST, -1),
        'of its first byte, counted back from the end of the message',
        None,
        'its own length: it comes last',
    ),
    _PLACE[1],
    Key(
        'covers',
        array(whole(-LONGEST, LONGEST), 2, 2, 'list of two whole numbers'),
        'first byte, and the last counted back from the end',
        None,
        'all before it',
    ),
]
_NO_CHECK = has('checksum', 'none')
_OTHER = [
    Key('sync', _BYTES, 'its first bytes; if several entries fit, the first is used', REQUIRED),
    Key(
        'length',
        either(
            whole(1, LONGEST),
            mapping(_LENGTH),
            words='whole number to 4096, or keys, below',
        ),
        'its bytes, checksum included, or the number in it that states them',
        REQUIRED,
    ),
    Key(
        'checksum',
        either(_NONE, mapping(_OTHER_CHECK, _KNOWN), words='`none`, or keys, below'),
        'its checksum; with `none` `sync` needs two bytes at least',
        REQUIRED,
    ),
    Key('counted', flag(), 'whether the frame counter counts these messages, too', default=False),
]
_TWO_OF_SYNC: Schema = {'properties': {'sync': {'minItems': 2}}}

_COMMAND = [
    Key(
        'bytes',
        array(whole(0, 255), 1, commands.LONGEST, 'list of bytes'),
        'the bytes sent; this or `text`',
        None,
        'one of the two',
    ),
    Key(
        'text',
        either(
            Value({'type': 'string', 'pattern': r'^[\x00-\x7F]+$'}, 'text of ASCII'),
            Value({'type': 'number'}, ''),
            words='text of ASCII',
        ),
        r'the same as characters; in double quotes `\r` and `\n` end a line; this or `bytes`',
        None,
        'one of the two',
    ),
    Key('wait', quantity(D.TIME, '0 or more'), 'before anything else is sent, 10 s at most', '0 s'),
]
_COMMANDS = array(mapping(_COMMAND, one_of('bytes', 'text')), words='list of commands, below')

KEYS = [
    Key('name', text(), 'of the device, or of its output format', REQUIRED),
    Key(
        'baud',
        whole(*BAUD),
        'rate of its serial port, bit/s',
        None,
        '`--baud`, else 115200',
    ),
    Key('start', _COMMANDS, 'sent when the port opens', None, 'nothing is sent'),
    Key(
        'start_again',
        quantity(D.TIME, 'above 0'),
        'after so long without a byte, 0.5 s or more, `start` is sent again',
        None,
        'it is not',
    ),
    Key(
        'stop',
        _COMMANDS,
        'sent before the port is closed; its waits are 2 s at most',
        None,
        'nothing',
    ),
    _SYNC,
    Key(
        'constant',
        array(mapping(_CONSTANT), words='list of keys, below'),
        'further constant bytes: a frame where they differ is none',
    ),
    Key('length', whole(2, LONGEST), 'bytes of a frame, checksum included', REQUIRED),
    Key('byte_order', _ORDER, 'of numbers that do not state their own', REQUIRED),
    Key('fields', mapping(_FIELDS, words=_BELOW), 'what stands in a frame', REQUIRED),
    Key(
        'checksum',
        either(_NONE, mapping(_CHECK, _KNOWN), words='`none`, or keys, below'),
        'what protects a frame; with `none` it has two constant bytes at least',
        REQUIRED,
    ),
    Key(
        'others',
        array(mapping(_OTHER, when(_NO_CHECK, _TWO_OF_SYNC)), words='list of messages, below'),
        'messages between the frames that are no samples',
    ),
]

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
