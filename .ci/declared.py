"""What package.xml declares, of what the package, its tests and its messages need."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from imu_calib.recordings import codec

CHECKOUT = Path(__file__).resolve().parents[1]

UNDECLARED = {
    'lz4': 'rosdep has no key for its Python module; docs/ros.md names the package of apt',
    'compression': 'part of Python from 3.14 on',
    'backports': 'rosdep has no key; zstandard, which docs/ros.md names, does the same',
    'typing_extensions': 'the type checker alone reads it; no program loads it',
    'threadpoolctl': 'no key of rosdep is known; without it threads are not limited',
    'zstandard': 'rosdep has no key; docs/ros.md names the package of apt',
    'cyclonedds': 'the runtime without ROS, which takes no dependency of a ROS package',
    'rosbags': 'its key installs by pip, which no package that is released may depend on; '
    'the runtime without ROS needs it, and who converts a ROS 1 recording',
    'allantools': 'rosdep has no key; an oracle, its tests are skipped without it',
    'fastcrc': 'rosdep has no key; an oracle, its tests are skipped without it',
    'dsi_unit': 'rosdep has no key; an oracle, its tests are skipped without it',
    'mcap': 'rosdep has no key; another reader, its test is skipped without it',
    'mcap_ros2': 'rosdep has no key; another reader, its test is skipped without it',
    'imucal': 'rosdep has no key; an oracle, its tests are skipped without it',
    'dcc_json_toolkit': 'rosdep has no key; a reader of certificates, skipped without it',
    **dict.fromkeys(
        ('cv2', 'dcc', 'foxglove', 'polars', 'rerun', 'signxml'),
        'readers of others, in the extra readers of pip; their tests are skipped without it',
    ),
    'moto': 'rosdep has no key; a server of S3 for the tests of remote recordings',
    'playwright': 'rosdep has no key; the browser in which pages are measured',
    'pypdfium2': 'rosdep has no key; reads the PDF of a certificate',
    'nbclient': 'rosdep has no key; runs the notebooks of the documentation',
    'ipykernel': 'rosdep has no key; runs the notebooks of the documentation',
    **dict.fromkeys(
        ('bokeh', 'dask', 'distributed', 'duckdb', 'fsspec', 'pyarrow', 's3fs'),
        'batches run where pip installs the extra fleet; no node needs them',
    ),
    **dict.fromkeys(
        ('fastapi', 'nicegui', 'uvicorn'),
        'the page in the browser is the extra web of pip; a robot needs none',
    ),
    'weasyprint': 'certificates as PDF are the extra pdf of pip, or Chromium makes them',
}
"""Modules that package.xml leaves out, and why."""

OWN = {
    path.stem
    for folder in ('test', 'test/support', 'benchmarks', 'docs')
    for path in (CHECKOUT / folder).glob('*')
}


@cache
def imported(folder: str) -> frozenset[str]:
    """Return the modules from elsewhere that the files of a folder import, by their first names."""
    return frozenset(_imported(folder))


def _imported(folder: str) -> Iterator[str]:
    for path in (CHECKOUT / folder).rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text('utf-8'))):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names = [str(node.module)]
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith('importorskip'):
                names = [''.join(re.findall(r"^f?'([\w.]+)", ast.unparse(node.args[0])))]
            else:
                continue
            for name in names:
                first = name.partition('.')[0]
                if first not in sys.stdlib_module_names and first not in OWN | {'imu_calib'}:
                    yield first


def declared(package: Path, *kinds: str) -> set[str]:
    """Return what a package.xml declares to need."""
    root = ElementTree.parse(package).getroot()
    return {str(found.text) for kind in kinds for found in root.findall(kind)}


def without(names: set[str], keys: set[str]) -> set[str]:
    """Return the modules that neither have a key among those declared nor a reason to have none."""
    return {n for n in names if not {n, f'python3-{n}'} & keys} - set(UNDECLARED)


def imports() -> Iterator[str]:
    """Yield what is imported or installed and not declared to rosdep."""
    package = CHECKOUT / 'package.xml'
    keys = declared(package, 'depend', 'exec_depend')
    for_tests = keys | declared(package, 'test_depend')
    zstd = {name.partition('.')[0] for name in codec._ZSTD_MODULES}
    setup = (CHECKOUT / 'setup.py').read_text('utf-8')
    required = re.findall(
        r"""['"]([a-z0-9.]+?)>=""", re.search(r'install_requires=\[(.*?)\]', setup, re.S)[1]
    )
    names = {'pyyaml': 'yaml', 'pyserial': 'serial'}
    installed = {names.get(name, name).partition('.')[0] for name in required}
    # What a page or a picture is drawn with is imported when it is asked for.
    drawn = without({*imported('imu_calib'), *imported('launch')}, keys) - {'matplotlib', 'pandas'}
    missing = drawn | without(zstd | installed, keys)
    missing |= without({*imported('test'), 'matplotlib', 'pandas'}, for_tests)
    yield from (f'package.xml: {name} is needed and not declared' for name in sorted(missing))
    needed = {n for folder in ('imu_calib', 'launch', 'test', 'docs') for n in imported(folder)}
    needed |= zstd | set(re.findall(r'[\'"]([a-z0-9]+)(?=>=)', setup))
    for name in sorted(UNDECLARED):
        if {name, f'python3-{name}'} & for_tests or name not in needed:
            yield f'{Path(__file__).name}: {name} is declared, or nobody needs it'


def messages() -> Iterator[str]:
    """Yield what the package of messages, which is released alone, lacks."""
    folder = CHECKOUT / 'msg_defs'
    package = folder / 'package.xml'
    texts = [path.read_text('utf-8') for path in (folder / 'msg').glob('*.msg')]
    held = {m for text in texts for m in re.findall(r'^([a-z_]+)/[A-Z]', text, re.MULTILINE)}
    for name in sorted(held - declared(package, 'depend')):
        yield f'msg_defs/package.xml: {name} is in a definition and not declared'
    licence = folder / ElementTree.parse(package).find('license').attrib['file']
    if licence.read_bytes() != (CHECKOUT / 'LICENSE').read_bytes():
        yield f'{licence.relative_to(CHECKOUT)}: differs from LICENSE'
    if declared(package, 'author') != declared(package, 'maintainer'):
        yield 'msg_defs/package.xml: author and maintainer differ'


def versions() -> Iterator[str]:
    """Yield where another version is stated than in package.xml."""
    stated = declared(CHECKOUT / 'package.xml', 'version')
    if declared(CHECKOUT / 'msg_defs' / 'package.xml', 'version') != stated:
        yield 'msg_defs/package.xml: states another version than package.xml'
    changelog = (CHECKOUT / 'CHANGELOG.rst').read_text('utf-8')
    # Tools of ROS pass over a version without a date (REP 132).
    released = re.findall(r'^([0-9.]+) \(\d{4}-\d\d-\d\d\)\n-+$', changelog, re.MULTILINE)
    if {released[0]} != stated:
        yield f'CHANGELOG.rst: {released[0]} is its last release, package.xml states another'


def runtimes() -> Iterator[str]:
    """Yield where the two runtimes of nodes differ in their names."""
    folder = CHECKOUT / 'imu_calib' / 'live' / 'middleware'
    ros, other = ((folder / name).read_text('utf-8') for name in ('ros.py', 'dds/__init__.py'))
    names = [re.findall(r'^__all__ = \[(.*?)\]', text, re.S | re.M) for text in (ros, other)]
    if not names[0] or names[0] != names[1]:
        yield 'imu_calib/live/middleware/ros.py: has other names than dds/__init__.py'
    if 'from .dds' in ros:
        yield 'imu_calib/live/middleware/ros.py: loads the other runtime'


CHECKS = (imports, messages, versions, runtimes)
