"""Any of the zstd packages will do; none is missed before it is needed, or unpacks too much."""

import struct
import tracemalloc

import pytest

from imu_calib.common.errors import InputError
from imu_calib.recordings import codec

CONTENT = b'0123456789' * 5000
PACKAGES = [name for name in codec._ZSTD_MODULES if codec._optional(name) is not None]
GIB = 1 << 30
STATED = 100_000


def with_package(name, monkeypatch):
    monkeypatch.setattr(codec, '_ZSTD_MODULES', (name,))
    codec._errors.cache_clear()


@pytest.fixture(params=PACKAGES)
def package(request, monkeypatch):
    with_package(request.param, monkeypatch)
    yield request.param
    codec._errors.cache_clear()


@pytest.fixture(params=['lz4', *PACKAGES])
def compression(request, monkeypatch):
    """A compression, by each package."""
    if request.param == 'lz4':
        pytest.importorskip('lz4')
        yield 'lz4'
        return
    with_package(request.param, monkeypatch)
    yield 'zstd'
    codec._errors.cache_clear()


def zstd_frame(content: bytes, size: int | None = None, repeated: int = 0) -> bytes:
    """A frame (RFC 8878) of blocks of 128 KiB of zeros and of content, stating a size if told."""
    blocks = [struct.pack('<I', (1 << 20) | 1 << 1)[:3] + b'\0'] * repeated
    parts = [content[k : k + 65536] for k in range(0, len(content), 65536)]
    blocks += [struct.pack('<I', len(part) << 3)[:3] + part for part in parts]
    blocks.append(struct.pack('<I', 1)[:3])
    # The size in four bytes or none; a window of 128 KiB.
    head = bytes([0 if size is None else 2 << 6, 7 << 3])
    head += b'' if size is None else struct.pack('<I', size)
    return codec.ZSTD_MAGIC + head + b''.join(blocks)


def peak(function) -> int:
    """Return the most bytes that a call holds at once."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_blocks_survive_the_round_trip(compression):
    packed = codec.compressor(compression)(CONTENT)
    assert codec.unpack(packed, compression, len(CONTENT)) == CONTENT
    assert codec.unpack(packed, compression, 2 * len(CONTENT)) == CONTENT
    for damaged in (packed[:-3], packed[:4] + bytes(20), b''):
        with pytest.raises(codec.CodecError):
            codec.unpack(damaged, compression, len(CONTENT))


@pytest.mark.parametrize('content', [CONTENT, b''])
def test_frames_that_do_not_state_their_size_unpack(package, content):
    assert codec.unpack(zstd_frame(content), 'zstd', len(CONTENT)) == content


def test_a_block_is_refused_at_the_first_byte_too_much(compression):
    packed = codec.compressor(compression)(CONTENT)
    for most in (0, 1, len(CONTENT) - 1):
        with pytest.raises(codec.CodecError):
            codec.unpack(packed, compression, most)


@pytest.mark.parametrize('size', [None, STATED])
def test_a_frame_of_two_gibibytes_is_refused_before_it_is_unpacked(package, size):
    packed = zstd_frame(b'', size, repeated=2 * GIB >> 17)
    assert len(packed) < STATED

    def refused():
        with pytest.raises(codec.CodecError):
            codec.unpack(packed, 'zstd', STATED)
        assert not codec.unpacked_into(memoryview(bytearray(STATED)), packed, 'zstd')

    assert peak(refused) < 10 * STATED


def test_an_lz4_frame_that_unpacks_to_more_is_refused_before_it_is_unpacked():
    frame = pytest.importorskip('lz4.frame')
    packed = frame.compress(bytes(64 << 20))

    def refused():
        with pytest.raises(codec.CodecError, match='more than 100000 bytes'):
            codec.unpack(packed, 'lz4', STATED)
        assert not codec.unpacked_into(memoryview(bytearray(STATED)), packed, 'lz4')

    assert peak(refused) < 10 * STATED


def test_files_of_several_frames_unpack_as_far_as_they_go(tmp_path, package):
    source, target = tmp_path / 'a.zst', tmp_path / 'a'
    packed = zstd_frame(CONTENT, len(CONTENT)) + codec.compressor('zstd')(CONTENT)
    source.write_bytes(packed + zstd_frame(b'end'))
    assert codec.unpack_file(source, target) == ''
    assert target.read_bytes() == CONTENT + CONTENT + b'end'
    source.write_bytes(packed + packed[:-400])
    assert codec.unpack_file(source, target)
    assert target.read_bytes().startswith(CONTENT + CONTENT)


@pytest.mark.parametrize('size', [STATED, 10 * STATED])
def test_a_file_unpacks_to_no_more_than_it_states(tmp_path, package, size):
    source, target = tmp_path / 'a.zst', tmp_path / 'a'
    source.write_bytes(zstd_frame(CONTENT) + zstd_frame(b'', size, repeated=2 * GIB >> 17))
    problem = codec.unpack_file(source, target)
    # A frame that states less than its window is refused by the library itself.
    assert size == STATED or problem == f'a frame unpacks to more than the {size} bytes it states'
    assert problem
    written = target.read_bytes()
    assert len(written) <= len(CONTENT) + size
    assert written.startswith(CONTENT)


def test_a_file_that_states_no_size_is_unpacked_in_bounded_memory(tmp_path, package):
    source, target = tmp_path / 'a.zst', tmp_path / 'a'
    source.write_bytes(zstd_frame(b'', repeated=GIB >> 19))
    # What is fed at once unpacks to 64 MiB; the packages collect it in parts before they join it.
    assert peak(lambda: codec.unpack_file(source, target)) < 150 << 20
    assert target.stat().st_size == GIB >> 2


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_missing_package_is_named(monkeypatch, compression):
    monkeypatch.setattr(codec, '_optional', lambda name: None)
    with pytest.raises(InputError, match=f'python3-{compression[0]}'):
        codec.unpack(b'', compression, 0)
    with pytest.raises(InputError, match=f'python3-{compression[0]}'):
        codec.compressor(compression)


def test_an_unknown_compression_is_named():
    with pytest.raises(InputError, match="Unknown compression 'brotli'"):
        codec.unpack(b'', 'brotli', 0)
    with pytest.raises(InputError, match="Unknown compression 'brotli'"):
        codec.compressor('brotli')


@pytest.mark.parametrize('size', [1, 1 << 15, 1 << 17, 3 * (1 << 17) + 1])
def test_a_block_of_known_size_unpacks_into_memory(compression, size):
    content = (CONTENT * 9)[:size]
    memory = memoryview(bytearray(size + 1))
    packed = codec.compressor(compression)(content)
    assert codec.unpacked_into(memory[:size], packed, compression)
    assert bytes(memory) == content + b'\0'


def test_a_block_that_is_no_sound_frame_of_its_size_is_left_to_others(compression):
    packed = codec.compressor(compression)(CONTENT)
    for size in (len(CONTENT) - 1, len(CONTENT) + 1, 0):
        assert not codec.unpacked_into(memoryview(bytearray(size)), packed, compression)
    memory = memoryview(bytearray(len(CONTENT)))
    for other in (packed[:-1], packed + packed, packed + b'x', packed[:9] + b'\xff' * 99, b''):
        assert not codec.unpacked_into(memory, other, compression)


def test_a_frame_goes_into_memory_where_it_states_its_size_and_nothing_can_be_missed(monkeypatch):
    # zstandard, which Ubuntu has, does not notice that a checksum is cut off.
    zstandard = pytest.importorskip('zstandard')
    with_package('zstandard', monkeypatch)
    memory = memoryview(bytearray(len(CONTENT)))
    for sized, checked in ((False, False), (True, True)):
        pack = zstandard.ZstdCompressor(write_content_size=sized, write_checksum=checked)
        assert not codec.unpacked_into(memory, pack.compress(CONTENT), 'zstd')
        assert codec.unpack(pack.compress(CONTENT), 'zstd', len(CONTENT)) == CONTENT
        if checked:
            with pytest.raises(codec.CodecError):
                codec.unpack(pack.compress(CONTENT)[:-1], 'zstd', len(CONTENT))
    assert not any(memory)
    assert codec.unpacked_into(memory, zstandard.ZstdCompressor().compress(CONTENT), 'zstd')
    codec._errors.cache_clear()
