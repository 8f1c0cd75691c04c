"""What the package needs is declared where rosdep reads it, in package.xml."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import pytest
from loopback import CHECKOUT

from imu_calib.recordings import codec

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


def test_what_the_package_imports_is_declared():
    keys = declared(CHECKOUT / 'package.xml', 'depend', 'exec_depend')
    optional = declared(CHECKOUT / 'package.xml', 'test_depend')
    # What a page or a picture is drawn with is imported when it is asked for.
    assert without({*imported('imu_calib'), *imported('launch')}, keys) <= {'matplotlib', 'pandas'}
    assert {'python3-matplotlib', 'python3-pandas'} <= optional
    by_name = {name.partition('.')[0] for name in codec._ZSTD_MODULES}
    assert not without(by_name, keys)


def test_what_tests_import_is_declared():
    keys = declared(CHECKOUT / 'package.xml', 'depend', 'exec_depend', 'test_depend')
    assert not without(set(imported('test')), keys)


def test_what_pip_installs_is_declared_to_rosdep():
    keys = declared(CHECKOUT / 'package.xml', 'depend', 'exec_depend')
    setup = (CHECKOUT / 'setup.py').read_text('utf-8')
    listed = re.search(r'install_requires=\[(.*?)\]', setup, re.DOTALL)
    required = re.findall(r"""['"]([a-z0-9.]+?)>=""", listed[1])
    assert {'numpy', 'scipy', 'pyyaml', 'lz4'} <= set(required)
    names = {'pyyaml': 'yaml', 'pyserial': 'serial'}
    assert not without({names.get(r, r).partition('.')[0] for r in required}, keys)


@pytest.mark.parametrize('name', sorted(UNDECLARED))
def test_nothing_is_left_out_that_is_declared_or_that_nobody_needs(name):
    keys = declared(CHECKOUT / 'package.xml', 'depend', 'exec_depend', 'test_depend')
    assert not {name, f'python3-{name}'} & keys
    needed = {n for folder in ('imu_calib', 'launch', 'test', 'docs') for n in imported(folder)}
    needed |= {module.partition('.')[0] for module in codec._ZSTD_MODULES}
    needed |= set(re.findall(r'[\'"]([a-z0-9]+)(?=>=)', (CHECKOUT / 'setup.py').read_text('utf-8')))
    assert name in needed


def test_the_message_package_declares_what_its_definitions_hold():
    folder = CHECKOUT / 'msg_defs'
    texts = [path.read_text('utf-8') for path in (folder / 'msg').glob('*.msg')]
    held = {m for text in texts for m in re.findall(r'^([a-z_]+)/[A-Z]', text, re.MULTILINE)}
    assert held
    assert held <= declared(folder / 'package.xml', 'depend')


def test_the_runtime_of_ros_has_the_names_of_the_other_and_does_not_load_it():
    folder = CHECKOUT / 'imu_calib' / 'live' / 'middleware'
    ros, other = ((folder / name).read_text('utf-8') for name in ('ros.py', 'dds/__init__.py'))
    names = [re.findall(r'^__all__ = \[(.*?)\]', text, re.DOTALL | re.M) for text in (ros, other)]
    assert names[0]
    assert names[0] == names[1]
    assert 'from .dds' not in ros


def test_the_messages_are_a_package_that_is_released_alone():
    folder = CHECKOUT / 'msg_defs'
    licence = ElementTree.parse(folder / 'package.xml').find('license')
    assert (folder / licence.attrib['file']).read_bytes() == (CHECKOUT / 'LICENSE').read_bytes()
    assert declared(folder / 'package.xml', 'author') == declared(
        folder / 'package.xml', 'maintainer'
    )


def test_the_version_is_the_same_wherever_it_is_stated():
    (version,) = declared(CHECKOUT / 'package.xml', 'version')
    assert declared(CHECKOUT / 'msg_defs' / 'package.xml', 'version') == {version}
    changelog = (CHECKOUT / 'CHANGELOG.rst').read_text('utf-8')
    # Tools of ROS pass over a version without a date (REP 132).
    released = re.findall(r'^([0-9.]+) \(\d{4}-\d\d-\d\d\)\n-+$', changelog, re.MULTILINE)
    assert released[0] == version


def test_pip_installs_the_version_of_package_xml():
    pytest.importorskip('setuptools')
    said = subprocess.run(
        [sys.executable, 'setup.py', '--version'],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert {said.stdout.split()[-1]} == declared(CHECKOUT / 'package.xml', 'version')
