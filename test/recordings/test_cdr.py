"""The bulk decoder and encoder hold to what rosbags does message by message."""

import math

import numpy as np
import pytest
from bag_files import NS, STORE
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_calib.common.stream import (
    ImuBlock,
    JointBlock,
    Mode,
    Setpoint,
    SetpointBlock,
    TemperatureBlock,
)
from imu_calib.recordings import cdr_codec as decode
from imu_calib.recordings.cdr import CdrError, Malformed, Messages
from imu_calib.recordings.cdr_codec import (
    PULSES,
    RATES,
    ImuDecoder,
    Kind,
    decode_imu,
    decode_joints,
    decode_setpoints,
    decode_temperatures,
    encode_imu,
    encode_joints,
    encode_rates,
    encode_setpoints,
    encode_temperatures,
    part,
    rates_payloads,
)

stamps = st.integers(-(2**31) * NS, 2**31 * NS - 1)
numbers = st.floats(width=64, allow_nan=False)
texts = st.text(st.characters(exclude_categories=['Cs'], exclude_characters='\0'), max_size=9)


def build(name, *fields):
    return STORE.types[name](*fields)


def header(stamp, frame):
    time = build('builtin_interfaces/msg/Time', *divmod(stamp, NS))
    return build('std_msgs/msg/Header', time, frame)


def serialise(message, little_endian=True):
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def imu_message(stamp, frame, gyro, accel, first=PULSES):
    covariances = [np.array([value, *[0.0] * 8]) for value in first]
    vector = 'geometry_msgs/msg/Vector3'
    return build(
        Kind.IMU.type_name,
        header(stamp, frame),
        build('geometry_msgs/msg/Quaternion', 0.0, 0.0, 0.0, 1.0),
        covariances[0],
        build(vector, *gyro),
        covariances[1],
        build(vector, *accel),
        covariances[2],
    )


def joint_message(stamp, frame, names, position, velocity, effort=()):
    arrays = [np.array(a, np.float64) for a in (position, velocity, effort)]
    return build(Kind.JOINTS.type_name, header(stamp, frame), list(names), *arrays)


def setpoint_message(s, frame=''):
    return build(
        Kind.SETPOINTS.type_name,
        header(s.stamp, frame),
        s.plan,
        s.step,
        s.position,
        int(s.mode),
        list(s.joints),
        np.array(s.angles, np.float64),
        np.array(s.rates, np.float64),
        s.turns,
        s.dwell,
    )


def setpoint(stamp=0, step=3, mode=Mode.RATE):
    joints, angles = ('outer', 'inner'), (0.5, math.pi)
    return Setpoint(stamp, 'twelve', step, 'x_up', mode, joints, angles, (0.0, 1.0), 2.0, 60.0)


def imu_block(count=5, frame='imu_link'):
    rng = np.random.default_rng(1)
    gyro, accel = rng.normal(size=(2, count, 3))
    return ImuBlock(1_700_000_000 * NS + np.arange(count) * 123_456_789, gyro, accel, frame)


triples = st.tuples(numbers, numbers, numbers)
imu_samples = st.tuples(stamps, st.sampled_from(['', 'imu', 'imu_link']) | texts, triples, triples)


@settings(max_examples=50)
@given(st.lists(st.tuples(imu_samples, st.booleans()), max_size=12))
def test_imu_of_any_frame_and_byte_order_equals_rosbags_in_order(samples):
    payloads = [serialise(imu_message(*sample), little) for sample, little in samples]
    blocks = decode_imu(Messages.join(payloads))
    decoded = [
        (int(b.stamp[i]), b.frame_id, tuple(b.gyro[i]), tuple(b.accel[i]))
        for b in blocks
        for i in range(len(b))
    ]
    assert decoded == [sample for sample, _ in samples]


def test_one_by_one_gives_what_all_at_once_gives():
    payloads = [
        *encode_imu(imu_block()).payloads(),
        *encode_imu(imu_block(frame='other_link')).payloads(),
        encode_imu(imu_block()).payloads()[0][:77],
        *encode_imu(imu_block(frame='imu_lynx')).payloads(),
    ]
    decoder, malformed, expected_malformed = ImuDecoder(), Malformed(), Malformed()
    found = [b for p in payloads for b in decoder.decode([p], malformed)]
    expected = decode_imu(Messages.join(payloads), expected_malformed)
    for name in ('stamp', 'gyro', 'accel'):
        joined = [np.concatenate([getattr(b, name) for b in all_]) for all_ in (found, expected)]
        assert np.array_equal(*joined)
    assert [b.frame_id for b in found] == [b.frame_id for b in expected for _ in range(len(b))]
    assert malformed == expected_malformed


@pytest.mark.parametrize('frame', ['', 'imu_link', 'the_frame_of_an_imu'])
@pytest.mark.parametrize('count', [0, 1, 5])
def test_rates_carry_their_covariances(count, frame):
    block, rng = imu_block(count, frame), np.random.default_rng(2)
    rate, force = rng.normal(size=(2, len(block), 9))
    payloads = encode_rates(block, rate, force).payloads()
    assert len(payloads) == count
    assert rates_payloads(block, rate, force) == payloads
    for k, payload in enumerate(payloads):
        message = STORE.deserialize_cdr(payload, Kind.IMU.type_name)
        assert message.orientation_covariance[0] == -1
        assert message.header.frame_id == frame
        assert message.angular_velocity.y == block.gyro[k, 1]
        assert np.array_equal(message.angular_velocity_covariance, rate[k])
        assert np.array_equal(message.linear_acceleration_covariance, force[k])


@pytest.mark.parametrize(('covariances', 'known'), [(PULSES, -1), (RATES, 0)])
def test_pulses_are_no_rates_to_a_filter_and_rates_of_unknown_covariance_are(covariances, known):
    # REP 145: -1 as the first element says that a message does not carry this quantity, zeros that
    # its covariance is unknown.
    payload = encode_imu(imu_block(1), covariances).payload(0)
    message = STORE.deserialize_cdr(payload, Kind.IMU.type_name)
    assert message.orientation_covariance[0] == -1
    assert message.angular_velocity_covariance[0] == known
    assert message.linear_acceleration_covariance[0] == known


@st.composite
def joint_samples(draw):
    names = draw(st.lists(texts, max_size=3))
    values = st.lists(numbers, min_size=len(names), max_size=len(names))
    empty = st.just([])
    return (
        draw(stamps),
        draw(texts),
        tuple(names),
        draw(values | empty),
        draw(values | empty),
        draw(st.lists(numbers, max_size=3)),
    )


@settings(max_examples=50)
@given(st.lists(st.tuples(joint_samples(), st.booleans()), max_size=8))
def test_joint_states_of_any_shape_equal_rosbags_and_missing_arrays_are_nan(samples):
    payloads = [serialise(joint_message(*sample), little) for sample, little in samples]
    blocks = decode_joints(Messages.join(payloads))
    decoded = [
        (int(b.stamp[i]), b.names, b.position[i].tolist(), b.velocity[i].tolist())
        for b in blocks
        for i in range(len(b))
    ]
    expected = [
        (stamp, names, position or [math.nan] * len(names), velocity or [math.nan] * len(names))
        for (stamp, _, names, position, velocity, _), _ in samples
    ]
    np.testing.assert_equal(decoded, expected)


setpoints = st.builds(
    Setpoint,
    stamp=stamps,
    plan=texts,
    step=st.integers(0, 2**32 - 1),
    position=texts,
    mode=st.sampled_from(Mode),
    joints=st.lists(texts, max_size=3).map(tuple),
    angles=st.lists(numbers, max_size=3).map(tuple),
    rates=st.lists(numbers, max_size=3).map(tuple),
    turns=numbers,
    dwell=numbers,
)


@given(st.lists(st.tuples(setpoints, texts, st.booleans()), max_size=5))
def test_setpoints_equal_rosbags(samples):
    payloads = [serialise(setpoint_message(s, frame), little) for s, frame, little in samples]
    blocks = decode_setpoints(Messages.join(payloads))
    assert [s for block in blocks for s in block.setpoints] == [s for s, _, _ in samples]


@given(st.lists(st.tuples(stamps, texts, numbers, st.booleans()), max_size=8))
def test_temperatures_equal_rosbags(samples):
    payloads = [
        serialise(build(Kind.TEMPERATURES.type_name, header(t, frame), value, 0.5), little)
        for t, frame, value, little in samples
    ]
    blocks = decode_temperatures(Messages.join(payloads))
    decoded = [pair for b in blocks for pair in zip(b.stamp, b.celsius, strict=True)]
    assert decoded == [(t, value) for t, _, value, _ in samples]


@given(texts, st.lists(st.tuples(stamps, triples, triples), max_size=4), st.booleans())
def test_encoded_imu_is_the_bytes_that_rosbags_writes(frame, samples, pulses):
    first = PULSES if pulses else RATES
    block = ImuBlock(
        np.array([s[0] for s in samples], np.int64),
        np.array([s[1] for s in samples]).reshape(-1, 3),
        np.array([s[2] for s in samples]).reshape(-1, 3),
        frame,
    )
    expected = [serialise(imu_message(s[0], frame, s[1], s[2], first)) for s in samples]
    assert encode_imu(block, first).payloads() == expected


@given(texts, st.lists(texts, max_size=3), st.booleans(), st.booleans())
def test_encoded_joints_are_the_bytes_that_rosbags_writes(frame, names, with_position, with_rate):
    values = np.arange(2.0 * len(names)).reshape(2, -1)
    missing = np.full_like(values, np.nan)
    block = JointBlock(
        np.array([5, NS + 6]),
        tuple(names),
        values if with_position else missing,
        values if with_rate else missing,
    )
    expected = [
        serialise(
            joint_message(
                stamp, frame, names, row if with_position else (), row if with_rate else ()
            )
        )
        for stamp, row in zip(block.stamp.tolist(), values, strict=True)
    ]
    assert encode_joints(block, frame).payloads() == expected


@given(texts, setpoints)
def test_encoded_setpoints_are_the_bytes_that_rosbags_writes(frame, one):
    payloads = encode_setpoints(SetpointBlock((one,)), frame).payloads()
    assert payloads == [serialise(setpoint_message(one, frame))]


def test_encoded_temperatures_are_the_bytes_that_rosbags_writes():
    block = TemperatureBlock(np.array([1, NS]), np.array([21.5, -3.0]))
    expected = [
        serialise(build(Kind.TEMPERATURES.type_name, header(t, 'imu'), value, 0.25))
        for t, value in ((1, 21.5), (NS, -3.0))
    ]
    assert encode_temperatures(block, 'imu', 0.25).payloads() == expected


def test_a_change_of_frame_starts_a_new_block_and_the_order_stays():
    first, second = imu_block(4, 'left'), imu_block(4, 'rght')
    pieces = [part(first, 0, 2), part(second, 0, 3), part(first, 2, 4), part(second, 3, 4)]
    payloads = [p for piece in pieces for p in encode_imu(piece).payloads()]
    blocks = decode_imu(Messages.join(payloads))
    assert [(b.frame_id, len(b)) for b in blocks] == [
        ('left', 2), ('rght', 3), ('left', 2), ('rght', 1),
    ]  # fmt: skip
    np.testing.assert_array_equal(blocks[2].gyro, first.gyro[2:])


def test_messages_are_found_wherever_they_lie_in_the_buffer():
    block = imu_block(3)
    payloads = encode_imu(block).payloads()
    buffer = np.frombuffer(b'xyz' + payloads[2] + b'?' + payloads[0] + payloads[1], np.uint8)
    size = len(payloads[0])
    offset = np.array([4 + size, 4 + 2 * size, 3])
    (decoded,) = decode_imu(Messages(buffer, offset, np.full(3, size)))
    np.testing.assert_array_equal(decoded.accel, block.accel)


@pytest.mark.parametrize('order', [(0, 1, 2, 3), (0, 2, 1, 3), (3, 2, 1, 0), (1, 1, 2, 2), (2,)])
def test_messages_in_a_row_are_not_copied_and_others_are(order):
    size, before = 6, 5
    buffer = np.arange(4 * size + 9, dtype=np.uint8)
    offset = before + size * np.array(order)
    rows = Messages(buffer, offset, np.full(len(order), size)).leading_bytes(size)
    assert rows.tolist() == [list(range(at, at + size)) for at in offset.tolist()]
    assert np.shares_memory(rows, buffer) == (order in {(0, 1, 2, 3), (2,)})


def test_messages_with_gaps_between_them_are_gathered():
    buffer = np.arange(40, dtype=np.uint8)
    for offset in ([5, 12], [5, 10], [0, 7, 14]):
        rows = Messages(buffer, np.array(offset), np.full(len(offset), 6)).leading_bytes(6)
        assert rows.tolist() == [list(range(at, at + 6)) for at in offset]
    assert Messages.join([]).leading_bytes(8).shape == (0, 8)


@pytest.mark.parametrize(
    ('offset', 'size'),
    [([0, 5], [4, 6]), ([0, -1], [4, 4]), ([0, 4], [4, -1]), ([5], [6]), ([-1], [4]), ([4], [-1])],
)
def test_messages_beyond_their_buffer_are_refused(offset, size):
    with pytest.raises(ValueError, match='beyond their buffer of 10 bytes'):
        Messages(np.zeros(10, np.uint8), np.array(offset), np.array(size))


@pytest.mark.parametrize(('offset', 'size'), [([0, 5], [5, 5]), ([10, 0], [0, 10]), ([4], [6])])
def test_messages_may_fill_their_buffer(offset, size):
    messages = Messages(np.arange(10, dtype=np.uint8), np.array(offset), np.array(size))
    assert [len(payload) for payload in messages.payloads()] == size


@pytest.fixture
def parsed(monkeypatch):
    """List the messages that are read field by field to learn what they look like."""
    parse, found = decode._imu_layout, []

    def counting(payload):
        found.append(payload)
        return parse(payload)

    monkeypatch.setattr(decode, '_imu_layout', counting)
    return found


def test_a_stream_is_read_once_for_what_its_messages_look_like(parsed):
    decoder, malformed = ImuDecoder(), Malformed()
    first, other = encode_imu(imu_block(3)).payloads(), encode_imu(imu_block(3, 'other')).payloads()
    decoder.decode(first[:1], malformed)
    count = len(parsed)
    (block,) = decoder.decode(first[1:2], malformed)
    assert block.stamp.tolist() == imu_block(3).stamp[1:2].tolist()
    assert len(parsed) == count
    # Several at once are all decoded, and the last is what the next one is held against.
    blocks = decoder.decode(first[:2], malformed)
    assert [len(b) for b in blocks] == [2]
    decoder.decode([first[0], other[0]], malformed)
    count = len(parsed)
    (block,) = decoder.decode(other[1:2], malformed)
    assert block.frame_id == 'other'
    assert len(parsed) == count


def test_a_part_that_is_the_whole_is_the_block_itself():
    block = imu_block(4)
    for stop in (4, 5):
        assert part(block, 0, stop) is block
    assert part(block, 0, 3) is not block
    assert len(part(block, 1, 4)) == 3


def test_padding_of_a_middleware_is_accepted_but_not_another_type():
    payload = encode_imu(imu_block(1)).payload(0)
    for padding in (4, 7):
        (block,) = decode_imu(Messages.join([payload + bytes(padding)]))
        assert len(block) == 1
    # Two messages in one are none, either.
    for more in (bytes(8), bytes(16), payload):
        with pytest.raises(CdrError, match=f' {len(more)} more than the fields take'):
            decode_imu(Messages.join([payload + more]))


def test_options_in_the_encapsulation_header_do_not_matter():
    payload = bytearray(encode_imu(imu_block(1)).payload(0))
    payload[2:4] = b'\x00\x03'
    (block,) = decode_imu(Messages.join([encode_imu(imu_block(1)).payload(0), bytes(payload)]))
    assert len(block) == 2


@pytest.mark.parametrize(
    'broken',
    [
        b'',
        b'\x00\x01',
        b'\x00\x07\x00\x00' + bytes(400),
        b'\x01' + encode_imu(imu_block(1)).payload(0)[1:],
        encode_imu(imu_block(1)).payload(0)[:-1],
        encode_imu(imu_block(1)).payload(0)[:12] + b'\xff\xff\xff\xff' + bytes(400),
        encode_imu(imu_block(1, 'frame')).payload(0).replace(b'frame\0', b'frame!'),
        # A length that ends before the zero: all else is as in the sound messages.
        encode_imu(imu_block(1)).payload(0).replace(b'\x09\0\0\0imu', b'\x08\0\0\0imu'),
        encode_imu(imu_block(1, 'frame')).payload(0).replace(b'frame\0', b'\xff\xfeame\0'),
    ],
)
def test_a_malformed_message_is_counted_and_the_others_are_decoded(broken):
    sound = encode_imu(imu_block(4)).payloads()
    messages = Messages.join([sound[0], broken, *sound[1:], broken])
    malformed = Malformed()
    (block,) = decode_imu(messages, malformed)
    np.testing.assert_array_equal(block.gyro, imu_block(4).gyro)
    assert malformed.count == 2
    assert malformed.reason
    with pytest.raises(CdrError, match='Malformed message'):
        decode_imu(messages)


def test_joint_arrays_that_do_not_fit_the_names_are_malformed():
    malformed = Malformed()
    message = joint_message(1, '', ['a', 'b'], [1.0], [])
    assert decode_joints(Messages.join([serialise(message)]), malformed) == []
    assert malformed.reason == '1 values of position for 2 joint names'


def test_an_unknown_mode_of_a_setpoint_is_malformed_once_per_message():
    payload = serialise(setpoint_message(setpoint())).replace(b'x_up\0\x01', b'x_up\0\x09')
    malformed = Malformed()
    assert decode_setpoints(Messages.join([payload] * 3), malformed) == []
    assert malformed.count == 3
    assert 'mode 9' in malformed.reason


def test_repeated_setpoints_differ_in_their_stamp():
    repeated = SetpointBlock(tuple(setpoint(stamp, step=1 + stamp // 4) for stamp in range(8)))
    assert decode_setpoints(encode_setpoints(repeated)) == [repeated]


@pytest.mark.parametrize('count', [1, 2])
@pytest.mark.parametrize('sec', [-(2**31) - 1, -(2**31), 2**31 - 1, 2**31])
def test_stamps_that_do_not_fit_a_header_are_refused(sec, count):
    block = TemperatureBlock(np.arange(count) + sec * NS, np.zeros(count))
    if -(2**31) <= sec < 2**31:
        (decoded,) = decode_temperatures(encode_temperatures(block))
        assert decoded.stamp.tolist() == block.stamp.tolist()
        return
    with pytest.raises(CdrError, match='do not fit a ROS header'):
        encode_temperatures(block)


def test_the_variance_of_a_temperature_is_unknown_by_default():
    block = TemperatureBlock(np.array([1]), np.array([21.5]))
    assert encode_temperatures(block).payloads() == encode_temperatures(block, '', 0.0).payloads()


@pytest.mark.parametrize(
    ('payload', 'reason'),
    [
        (b'\x00\x01', 'encapsulation header 00 01, expected'),
        (b'', 'encapsulation header missing, expected'),
        (b'\x00\x01\x00\x00', '4 bytes, but a field of 4 bytes starts at 4'),
        (b'\x00\x01\x00\x00' + bytes(6), '10 bytes, but a field of 4 bytes starts at 8'),
    ],
)
def test_what_is_wrong_with_a_message_is_said(payload, reason):
    with pytest.raises(CdrError, match=reason):
        decode_imu(Messages.join([payload]))


@settings(max_examples=40)
@given(st.data())
def test_damaged_bytes_never_do_worse_than_being_counted(data):
    payload = bytearray(encode_joints(joint_block()).payload(0))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    messages = Messages.join([bytes(payload[: data.draw(st.integers(0, len(payload)))])])
    for kind in Kind:
        malformed = Malformed()
        blocks = kind.decode(messages, malformed)
        assert sum(len(block) for block in blocks) + malformed.count == 1


def joint_block():
    angles = np.arange(6.0).reshape(2, 3)
    return JointBlock(np.array([1, 2]), ('outer', 'middle', 'inner'), angles, -angles)


def test_no_messages_give_no_blocks():
    for kind in Kind:
        assert list(kind.decode(Messages.join([]))) == []
