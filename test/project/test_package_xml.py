"""pip installs the version that package.xml states."""

import subprocess
import sys
from xml.etree import ElementTree

import pytest
from loopback import CHECKOUT


def test_pip_installs_the_version_of_package_xml():
    pytest.importorskip('setuptools')
    said = subprocess.run(
        [sys.executable, 'setup.py', '--version'],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert {said.stdout.split()[-1]} == {
        ElementTree.parse(CHECKOUT / 'package.xml').findtext('version')
    }
