"""Numbers, checksums and commands that a device's file can describe."""

import contextlib
import os
import socket
import struct
import time

import numpy as np
import pytest
from device_frames import pseudo_terminal
from hypothesis import given, settings
from hypothesis import strategies as st
from loopback import until

from imu_calib.common.config import Section
from imu_calib.common.errors import InputError
from imu_calib.live.devices.decoder import Decoder
from imu_calib.live.devices.fields import Checksums, Fletcher, Sum
from imu_calib.live.devices.format import read_format
from imu_calib.live.devices.messages import Command, Commands
from imu_calib.live.devices.source import DeviceReader

FIELDS = {
    'gyro': {'type': 'i16', 'offset': [2, 4, 6]},
    'accelerometer': {'type': 'i16', 'offset': [8, 10, 12]},
}


def described(checksum=None, **keys):
    data = {
        'name': 'x',
        'sync': [0xAA, 0x55],
        'length': 24,
        'byte_order': 'little',
        'fields': FIELDS,
        'checksum': checksum or {'kind': 'sum', 'offset': 23},
    }
    return read_format(Section(data | keys, 'device.yaml'))


def refusal(**keys):
    with pytest.raises(InputError) as error:
        described(**keys)
    return str(error.value)


# Test vectors of the literature: en.wikipedia.org/wiki/Fletcher's_checksum.
@pytest.mark.parametrize(
    ('text', 'value'), [(b'abcde', 0xC8F0), (b'abcdef', 0x2057), (b'abcdefgh', 0x0627)]
)
def test_fletcher_of_modulus_255_is_that_of_the_literature(text, value):
    rows = np.frombuffer(text, np.uint8)[None]
    assert Checksums(Fletcher(255), len(text)).of_rows(rows).tolist() == [value]


# Printed in the manuals: MIP's ping and its answer, and a poll of UBX (b5 62 0a 04 00 00 0e 34).
@pytest.mark.parametrize(
    ('covered', 'sent'),
    [('75 65 01 02 02 01', 'e0 c6'), ('75 65 01 02 02 06', 'e5 cb'), ('0a 04 00 00', '0e 34')],
)
def test_fletcher_of_modulus_256_is_that_of_mip_and_ubx(covered, sent):
    data = bytes.fromhex(covered)
    rows = np.frombuffer(data, np.uint8)[None]
    (value,) = Checksums(Fletcher(256), len(data)).of_rows(rows).tolist()
    assert value.to_bytes(2, 'little') == bytes.fromhex(sent)


@settings(max_examples=50)
@given(st.lists(st.binary(min_size=300, max_size=300), min_size=1, max_size=5))
@pytest.mark.parametrize('modulus', [255, 256])
def test_fletcher_of_many_long_messages_is_that_of_each(modulus, messages):
    def alone(message):
        first = second = 0
        for byte in message:
            first = (first + byte) % modulus
            second = (second + first) % modulus
        return second * 256 + first

    rows = np.frombuffer(b''.join(messages), np.uint8).reshape(-1, 300)
    assert Checksums(Fletcher(modulus), 300).of_rows(rows).tolist() == list(map(alone, messages))


@settings(max_examples=50)
@given(st.lists(st.binary(min_size=16, max_size=16), min_size=1, max_size=5))
@pytest.mark.parametrize(('order', 'name'), [('<', 'little'), ('>', 'big')])
@pytest.mark.parametrize('word', [16, 32])
def test_sums_of_words_add_words(word, order, name, messages):
    rows = np.frombuffer(b''.join(messages), np.uint8).reshape(-1, 16)
    size = word // 8
    added = [
        sum(int.from_bytes(m[k : k + size], name) for k in range(0, 16, size)) for m in messages
    ]
    found = Checksums(Sum(32, negated=False, word=word, order=order), 16).of_rows(rows)
    assert found.tolist() == [a % 2**32 for a in added]
    negated = Checksums(Sum(16, negated=True, word=word, order=order), 16).of_rows(rows).tolist()
    assert all((a + n) % 2**16 == 0 for a, n in zip(added, negated, strict=True))


def test_the_words_of_a_sum_have_the_byte_order_of_the_checksum():
    body = b'\xaa\x55' + bytes(range(20))
    high, low = struct.unpack('>11H', body), struct.unpack('<11H', body)
    check = {'kind': 'sum', 'word': 16, 'offset': 22}
    assert (
        Decoder(described(check)).decode_bytes(body + struct.pack('<H', sum(low) % 2**16)).end.size
    )
    check |= {'byte_order': 'big'}
    line = body + struct.pack('>H', sum(high) % 2**16)
    assert Decoder(described(check)).decode_bytes(line).end.size
    assert (
        not Decoder(described(check))
        .decode_bytes(body + struct.pack('<H', sum(low) % 2**16))
        .end.size
    )


def test_other_messages_whose_bytes_are_no_whole_words_are_none():
    check = {'kind': 'sum', 'word': 16, 'offset': -2}
    other = {'sync': [1, 2], 'length': {'type': 'u8', 'offset': 2, 'zero': 0}, 'checksum': check}
    for length, known in ((7, 0), (8, 1)):
        body = bytes([1, 2, length]) + bytes(length - 5)
        total = sum(struct.unpack(f'<{len(body) // 2}H', body[: len(body) // 2 * 2]))
        decoder = Decoder(described(others=[other]))
        decoder.decode_bytes(body + struct.pack('<H', total) + bytes(30))
        assert decoder.counts.others == known


# A number of two words, 0x0102 and 0x0304, and one of four.
SWAPPED = {
    ('u32', 'low_word_first'): ('03 04 01 02', 0x01020304),
    ('u32', 'high_word_first'): ('02 01 04 03', 0x01020304),
    ('i32', 'low_word_first'): ('00 01 ff fe', -0x20000 + 1),
    ('i32', 'high_word_first'): ('fe ff 01 00', -0x20000 + 1),
    ('u64', 'low_word_first'): ('06 07 04 05 02 03 00 01', 0x0001020304050607),
    ('u64', 'high_word_first'): ('01 00 03 02 05 04 07 06', 0x0001020304050607),
    ('u16', 'low_word_first'): ('01 02', 0x0102),
    ('u16', 'high_word_first'): ('02 01', 0x0102),
    # 1.5 is 0x3FC00000 as a float of 32 bits, 0x3FF8000000000000 as one of 64.
    ('f32', 'low_word_first'): ('00 00 3f c0', 1.5),
    ('f32', 'high_word_first'): ('c0 3f 00 00', 1.5),
    ('f64', 'low_word_first'): ('00 00 00 00 00 00 3f f8', 1.5),
    # 32 bits of fraction before 16 of the whole number; -2.25 is -3 and three quarters.
    ('fp16.32', 'big'): ('c0 00 00 00 ff fd', -2.25),
    ('fp16.32', 'little'): ('00 00 00 c0 fd ff', -2.25),
    ('i24', 'big'): ('ff fe 00', -0x200),
    ('i24', 'little'): ('00 fe ff', -0x200),
    ('u24', 'big'): ('ff fe 00', 0xFFFE00),
}


@pytest.mark.parametrize(('kind', 'order'), SWAPPED)
def test_numbers_of_every_order_are_read(kind, order):
    sent, value = SWAPPED[kind, order]
    fields = FIELDS | {'temperature': {'type': kind, 'offset': 14, 'byte_order': order}}
    frames = described('none', fields=fields)
    line = (b'\xaa\x55' + bytes(12) + bytes.fromhex(sent)).ljust(24, b'\0')
    assert Decoder(frames).decode_bytes(2 * line).celsius.tolist() == [value, value]


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('order', ['little', 'low_word_first'])
def test_a_signalling_nan_is_no_number_and_no_warning(order):
    sent = {'little': '01 00 80 7f', 'low_word_first': '00 01 7f 80'}[order]
    fields = {
        'gyro': {'type': 'f32', 'offset': [2, 6, 10], 'byte_order': order},
        'accelerometer': {'type': 'i16', 'offset': [14, 16, 18]},
    }
    decoder = Decoder(described('none', fields=fields))
    samples = decoder.decode_bytes(b'\xaa\x55' + bytes.fromhex(sent) + bytes(18))
    assert len(samples) == 0
    assert decoder.counts.unusable == 1


@settings(max_examples=100)
@given(st.integers(-(2**47), 2**47 - 1))
def test_fp16_32_is_exact(number):
    fields = {
        'gyro': {'type': 'fp16.32', 'byte_order': 'big', 'offset': [2, 2, 2]},
        'accelerometer': {'type': 'i16', 'offset': [8, 10, 12]},
    }
    whole, fraction = divmod(number, 2**32)
    line = b'\xaa\x55' + struct.pack('>Ih', fraction, whole) + bytes(16)
    assert Decoder(described('none', fields=fields)).decode_bytes(line).gyro[0, 0] * 2**32 == number


def test_what_has_a_fraction_is_no_counter_and_a_time_of_its_own_unit():
    number = {'type': 'fp16.32', 'offset': 14}
    assert 'a counter is a whole number' in refusal(fields=FIELDS | {'counter': number})
    frames = described('none', fields=FIELDS | {'time': {**number, 'unit': 's'}})
    line = b'\xaa\x55' + bytes(12) + struct.pack('<Ih', 2**31, 3) + bytes(4)
    assert Decoder(frames).decode_bytes(line).time * frames.time.unit == 3_500_000_000


@pytest.mark.parametrize(
    ('keys', 'words'),
    [
        ({'checksum': {'kind': 'sum', 'word': 24, 'offset': 22}}, 'expected 8, 16 or 32'),
        ({'checksum': {'kind': 'crc', 'width': 12, 'offset': 22}}, 'found 12, expected 8, 16, 24'),
        ({'checksum': 'none', 'sync': [0xAA]}, 'without a checksum a frame needs two'),
        ({'fields': FIELDS | {'status': {'type': 'i16', 'offset': 14}}}, 'a status is unsigned'),
        (
            {'fields': FIELDS | {'gyro': {'type': 'i16', 'offset': [14, 16, 23]}}},
            'found 23, but 2 bytes from there reach beyond',
        ),
    ],
)
def test_a_description_that_cannot_be_is_refused(keys, words):
    assert words in refusal(**keys)


@pytest.mark.parametrize(
    ('kind', 'order'), [('u8', 'low_word_first'), ('i24', 'high_word_first'), ('fp16.32', 'low')]
)
def test_a_byte_order_that_a_number_cannot_have_is_refused(kind, order):
    fields = FIELDS | {'temperature': {'type': kind, 'offset': 14, 'byte_order': order}}
    assert 'temperature: byte_order: found' in refusal(fields=fields)


# --- commands ------------------------------------------------------------------------------------

BEGIN = (Command(b'\xfe\x00\r', 0.01), Command(b'$GO\r\n'))
END = (Command(b'$STOP\r\n', 0.01),)


class Device:
    """A TCP server that keeps what it is sent."""

    def __init__(self):
        self.server = socket.create_server(('127.0.0.1', 0))
        self.url = f'socket://127.0.0.1:{self.server.getsockname()[1]}'
        self.line = None
        self.got = b''

    def accept(self):
        self.line, _ = self.server.accept()
        self.line.settimeout(0.02)
        self.got = b''

    def has(self, expected):
        with contextlib.suppress(TimeoutError):
            self.got += self.line.recv(4096)
        assert expected.startswith(self.got)
        return self.got == expected

    def close(self):
        self.line.close()
        self.server.close()


@pytest.fixture
def device():
    made = Device()
    yield made
    made.close()


def test_commands_start_a_device_whenever_the_line_opens_and_stop_it_at_the_end(device):
    source = DeviceReader(device.url, time.time_ns, commands=Commands(BEGIN, None, END))
    source.start()
    device.accept()
    assert until(lambda: device.has(b'\xfe\x00\r$GO\r\n'))
    device.line.close()
    device.accept()
    assert until(lambda: device.has(b'\xfe\x00\r$GO\r\n'))
    device.line.sendall(b'a sample')
    assert until(lambda: sum(len(c.data) for c in source.pop_chunks()))
    source.stop()
    assert until(lambda: device.has(b'\xfe\x00\r$GO\r\n$STOP\r\n'))


def test_a_listener_that_leaves_the_device_as_it_is_does_not_stop_it(device):
    source = DeviceReader(
        device.url, time.time_ns, commands=Commands(BEGIN, None, END), restarts=False
    )
    source.start()
    device.accept()
    assert until(lambda: device.has(b'\xfe\x00\r$GO\r\n'))
    source.stop()
    # Nothing more until the line is closed.
    device.line.settimeout(None)
    assert device.line.recv(100) == b''


def test_a_device_that_fell_silent_is_started_again(device):
    source = DeviceReader(device.url, time.time_ns, commands=Commands((Command(b'go'),), 0.5))
    source.start()
    device.accept()
    assert until(lambda: device.has(b'go'))
    assert until(lambda: device.has(b'gogo'))
    source.stop()


def test_a_serial_port_is_sent_the_commands():
    pytest.importorskip('serial')
    with pseudo_terminal() as (ours, _, name):
        source = DeviceReader(name, time.time_ns, commands=Commands(BEGIN, None, END))
        source.start()
        got = b''
        while len(got) < 8:
            got += os.read(ours, 100)
        source.stop()
        while len(got) < 15:
            got += os.read(ours, 100)
        assert got == b'\xfe\x00\r$GO\r\n$STOP\r\n'


def test_a_recording_is_sent_nothing(tmp_path):
    (tmp_path / 'line.bin').write_bytes(b'recorded')
    commands = Commands(BEGIN, 0.5, END)
    source = DeviceReader(str(tmp_path / 'line.bin'), time.time_ns, commands=commands)
    source.start()
    assert until(lambda: source.state.ended)
    assert b''.join(c.data for c in source.pop_chunks()) == b'recorded'
    source.stop()
