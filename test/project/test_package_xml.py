"""pip installs the version that package.xml states."""

import sys
from xml.etree import ElementTree

import pytest
from loopback import CHECKOUT, completed


def test_pip_installs_the_version_of_package_xml():
    pytest.importorskip('setuptools')
    said = completed([sys.executable, 'setup.py', '--version'], cwd=CHECKOUT, check=True)
    assert {said.stdout.split()[-1]} == {
        ElementTree.parse(CHECKOUT / 'package.xml').findtext('version')
    }
