"""Any of the zstd packages will do, and none is missed before it is needed."""

from __future__ import annotations

import importlib.util
import types

import pytest
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


@pytest.fixture(params=['zstd', 'lz4'])
def compression(request):
    return request.param


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


def test_zstandard_unpacks_at_once(monkeypatch):
    fake = types.SimpleNamespace(__name__='zstandard', ZstdError=ValueError)
    monkeypatch.setattr(codec, '_zstd', lambda: fake)
    assert not codec.unpacked_into(memoryview(bytearray(9)), b'', 'zstd')
