"""Any of the zstd packages will do, and none is missed before it is needed."""

from __future__ import annotations

import importlib.util

import pytest
import zstandard
from backports import zstd

from imu_calib.bags import codec
from imu_calib.errors import InputError

CONTENT = b'0123456789' * 5000
PACKAGES = [name for name in ('backports.zstd', 'zstandard') if importlib.util.find_spec(name)]


@pytest.fixture(params=PACKAGES)
def package(request, monkeypatch):
    monkeypatch.setattr(codec, '_ZSTD_MODULES', (request.param,))
    codec._errors.cache_clear()
    yield request.param
    codec._errors.cache_clear()


def test_blocks_survive_the_round_trip(package):
    packed = codec.compressor('zstd')(CONTENT)
    assert codec.decompressor('zstd')(packed) == CONTENT
    for damaged in (packed[:-3], b'\x28\xb5\x2f\xfd' + bytes(20)):
        with pytest.raises(codec.CodecError):
            codec.decompressor('zstd')(damaged)


def test_frames_that_do_not_state_their_size_unpack(package):
    stream = zstd.ZstdCompressor()
    packed = stream.compress(CONTENT) + stream.flush()
    assert codec.decompressor('zstd')(packed) == CONTENT


def test_files_of_several_frames_unpack_as_far_as_they_go(tmp_path, package):
    source, target = tmp_path / 'a.zst', tmp_path / 'a'
    packed = zstd.compress(CONTENT)
    source.write_bytes(packed + zstd.compress(b'end'))
    assert codec.unpack_file(source, target) == ''
    assert target.read_bytes() == CONTENT + b'end'
    source.write_bytes(packed + packed[:-4])
    assert codec.unpack_file(source, target)
    assert target.read_bytes().startswith(CONTENT)


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
def test_a_missing_package_is_named(monkeypatch, compression):
    monkeypatch.setattr(codec, '_optional', lambda name: None)
    with pytest.raises(InputError, match=f'python3-{compression[0]}'):
        codec.decompressor(compression)


def test_an_unknown_compression_is_named():
    with pytest.raises(InputError, match="Unknown compression 'brotli'"):
        codec.decompressor('brotli')


@pytest.fixture(params=['lz4', *PACKAGES])
def compression(request, monkeypatch):
    """A compression, by each package."""
    if request.param == 'lz4':
        return 'lz4'
    monkeypatch.setattr(codec, '_ZSTD_MODULES', (request.param,))
    return 'zstd'


@pytest.mark.parametrize('size', [1, codec._PIECE, 3 * codec._PIECE + 1])
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
    # zstandard does not notice that a checksum is cut off.
    monkeypatch.setattr(codec, '_ZSTD_MODULES', ('zstandard',))
    memory = memoryview(bytearray(len(CONTENT)))
    for sized, checked in ((False, False), (True, True)):
        pack = zstandard.ZstdCompressor(write_content_size=sized, write_checksum=checked)
        assert not codec.unpacked_into(memory, pack.compress(CONTENT), 'zstd')
        assert codec.decompressor('zstd')(pack.compress(CONTENT)) == CONTENT
        if checked:
            with pytest.raises(codec.CodecError):
                codec.decompressor('zstd')(pack.compress(CONTENT)[:-1])
    assert not any(memory)
    assert codec.unpacked_into(memory, zstandard.ZstdCompressor().compress(CONTENT), 'zstd')


def test_the_package_that_unpacks_into_memory_comes_first():
    assert codec._zstd() is zstandard
