"""The records of an mcap file: what is taken in of each kind, and what is refused."""

import struct

import numpy as np
import pytest
from mcap_bytes import (
    CHANNEL,
    CHUNK_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    block,
    channel,
    metadata,
    schema,
    text,
    texts,
)

from imu_calib.recordings import mcap_records
from imu_calib.recordings.cdr import Bytes, Indices
from imu_calib.recordings.mcap_records import (
    FOOTER_SIZE,
    MAGIC,
    Catalogue,
    ChunkIndex,
    Fields,
    Op,
    RecordError,
    record,
    string,
    strings,
    walk,
)
from imu_calib.recordings.storage import Described

KINDS = {SCHEMA, CHANNEL, METADATA, CHUNK_INDEX, Op.ATTACHMENT_INDEX, METADATA_INDEX, STATISTICS}


def learnt(*whole: bytes) -> Catalogue:
    catalogue = Catalogue()
    for one in whole:
        catalogue.add_record(one[0], one[9:])
    return catalogue


def test_records_are_built_as_the_specification_says():
    assert record(Op.CHANNEL, b'abc') == b'\x04\x03\0\0\0\0\0\0\0abc'
    assert string('grün') == b'\x05\0\0\0gr\xc3\xbcn'
    assert strings({'a': 'bc', '': 'd'}) == b'\x14\0\0\0\x01\0\0\0a\x02\0\0\0bc\0\0\0\0\x01\0\0\0d'
    assert strings({}) == b'\0\0\0\0'
    assert len(record(Op.FOOTER, bytes(20)) + MAGIC) == FOOTER_SIZE


def test_opcodes_are_those_of_the_specification():
    known = {op.name: op.value for op in Op}
    assert list(known.values()) == list(range(1, 16))
    assert list(known)[:4] == ['HEADER', 'FOOTER', 'SCHEMA', 'CHANNEL']
    assert list(known)[4:8] == ['MESSAGE', 'CHUNK', 'MESSAGE_INDEX', 'CHUNK_INDEX']


def test_a_channel_knows_its_schema_and_the_qos_it_was_offered_with():
    described = channel(3, 7, '/a', offered_qos_profiles='q')
    found = learnt(schema(7, 'a_msgs/msg/A', 'int8 x'), described)
    one = found.channels[3]
    assert found.schemas == {7: ('a_msgs/msg/A', 'ros2msg', 'int8 x')}
    assert (one.id, one.topic, one.type, one.encoding) == (3, '/a', 'a_msgs/msg/A', 'cdr')
    assert one.described == Described('int8 x', 'ros2msg', 'q')


def test_a_channel_of_an_unknown_schema_has_no_type():
    one = learnt(schema(7, 'a_msgs/msg/A'), channel(3, 8, '/a')).channels[3]
    assert one.type == ''
    assert one.described == Described()


def test_a_definition_that_is_no_text_keeps_its_bytes():
    content = struct.pack('<H', 1) + text('A') + text('ros2msg') + block(b'int8 \xff')
    definition = learnt(record(Op.SCHEMA, content)).schemas[1][2]
    assert definition.encode(errors='surrogateescape') == b'int8 \xff'


def test_metadata_of_one_name_are_one():
    found = learnt(metadata('n', a='1', b='2'), metadata('n', b='3', c='4'), metadata('m'))
    assert found.metadata == {'n': {'a': '1', 'b': '3', 'c': '4'}, 'm': {}}


def test_every_field_of_a_chunk_index_has_its_place():
    offsets = struct.pack('<HQHQ', 11, 12, 13, 14)
    content = struct.pack('<QQQQ', 1, 2, 3, 4) + block(offsets)
    content += struct.pack('<Q', 5) + text('lz4') + struct.pack('<QQ', 6, 7)
    assert learnt(record(Op.CHUNK_INDEX, content)).chunks == [
        ChunkIndex((1, 2), 3, 4, {11: 12, 13: 14}, 5, 'lz4', (6, 7))
    ]


def test_statistics_tell_messages_of_each_channel_and_the_records_there_are():
    counts = struct.pack('<HQHQ', 1, 30, 2, 40)
    # Messages, schemas, channels, attachments, metadata, chunks, first and last log time.
    content = struct.pack('<QHIIIIQQ', 70, 91, 92, 93, 5, 6, 94, 95) + block(counts)
    found = learnt(record(Op.STATISTICS, content))
    assert found.totals == (5, 6)
    assert found.counts == {1: 30, 2: 40}


def test_the_index_of_metadata_tells_where_they_are():
    content = struct.pack('<QQ', 50, 60) + text('n')
    found = learnt(record(Op.METADATA_INDEX, content), record(Op.METADATA_INDEX, content[8:] * 2))
    assert found.metadata_at[0] == (50, 60)
    assert len(found.metadata_at) == 2


def test_records_of_other_kinds_say_nothing_of_the_file():
    for op in range(1, 20):
        found = Catalogue()
        # Zeros are empty fields of any kind.
        found.add_record(op, bytes(100))
        assert (found == Catalogue()) is (op not in KINDS), op


@pytest.mark.parametrize(
    ('op', 'content', 'problem'),
    [
        (SCHEMA, b'\x01', 'requires a buffer'),
        (SCHEMA, struct.pack('<HI', 1, 3) + b'ab', 'a field of 3 bytes reaches beyond the record'),
        (CHANNEL, struct.pack('<HHI', 1, 1, 1) + b'\xff', 'invalid start byte'),
        (CHUNK_INDEX, bytes(32) + block(bytes(9)) + bytes(40), 'requires a buffer of a multiple'),
    ],
)
def test_what_contradicts_the_format_is_refused_by_its_opcode(op, content, problem):
    with pytest.raises(RecordError, match=f'^record with opcode {op}: .*{problem}'):
        Catalogue().add_record(op, content)


def test_a_field_may_end_with_the_record():
    fields = Fields(b'xx' + text('ab') + b'y' + texts(a='b', c=''), 2)
    assert fields.string() == 'ab'
    assert fields.position == 8
    fields.skip(1)
    assert fields.strings() == {'a': 'b', 'c': ''}
    assert fields.position == len(fields._content)


def runs(*lengths: int) -> list[int]:
    """Number the records from which on those of one length are found at once."""
    content = b''.join(record(Op.MESSAGE, bytes(n)) for n in lengths)
    starts = [0, *np.cumsum([9 + n for n in lengths]).tolist()]
    begun, run = [], mcap_records._run

    def noted(buffer: Bytes, position: int, length: int) -> Indices:
        begun.append(starts.index(position))
        return run(buffer, position, length)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_records, '_run', noted)
        offsets, end = walk(np.frombuffer(content, np.uint8))
    assert [*offsets.tolist(), end] == starts
    return begun


def test_a_run_begins_with_the_ninth_record_of_a_length():
    assert runs(*(1, 2) * 10) == []
    assert runs(*(7,) * 8) == []
    assert runs(*(0,) * 9) == [8]
    assert runs(*(7,) * 9) == [8]
    # Another length counts anew.
    assert runs(3, *(7,) * 12, *(5,) * 12) == [9, 21]
