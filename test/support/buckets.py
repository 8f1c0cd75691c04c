"""An S3 server on the loopback interface, with recordings in a bucket of it."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

_NUMBERS = count()
"""Of buckets: all servers of a process have the same."""


@contextmanager
def served() -> Iterator[str]:
    """Serve an empty bucket, reachable as long as it is; yield its URL."""
    server_of = pytest.importorskip('moto.server', reason='moto is not installed')
    pytest.importorskip('s3fs', reason='s3fs is not installed')
    import fsspec

    name = f'lab-{next(_NUMBERS)}'
    server = server_of.ThreadedMotoServer('127.0.0.1', 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patched:
        for key in ('AWS_ACCESS_KEY_ID', 'AWS_SECRET_ACCESS_KEY'):
            patched.setenv(key, 'test')
        endpoint = {'endpoint_url': f'http://{host}:{port}', 'skip_instance_cache': True}
        patched.setitem(fsspec.config.conf, 's3', endpoint)
        try:
            fsspec.filesystem('s3').mkdir(name)
            yield f's3://{name}'
        finally:
            server.stop()


def put(here: Path, url: str) -> str:
    """Copy a file, or a folder with all below it, into the bucket; return where it is then."""
    import fsspec

    files = fsspec.filesystem('s3')
    for file in [here] if here.is_file() else sorted(p for p in here.rglob('*') if p.is_file()):
        below = '' if here.is_file() else f'/{file.relative_to(here)}'
        files.put_file(str(file), f'{url}{below}')
    return url
