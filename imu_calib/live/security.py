"""SROS 2 enclave of a node, and the keystore from the policy (docs/access.md)."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import xml.etree.ElementTree as ET
from importlib import import_module
from pathlib import Path
from typing import Any

from ..common.errors import ImuCalibError, InputError
from ..common.files import share_folder
from .network import check_domain

OVERRIDE = 'ROS_SECURITY_ENCLAVE_OVERRIDE'
_ENABLE = 'ROS_SECURITY_ENABLE'
_FAMILY = '/imu_calib'


def enclave(name: str) -> str:
    """Return the enclave of a node, or of a role: operator, stop_button, observer."""
    return f'{_FAMILY}/{name}'


def in_enclave(name: str) -> dict[str, str]:
    """Return the variable that sets a node's enclave, unless the user has set one."""
    return {} if OVERRIDE in os.environ else {OVERRIDE: enclave(name)}


def refuse_to_pretend() -> None:
    """Refuse unencrypted communication if the environment asks for security.

    Raises:
        InputError: It does, and this runtime has no security plug-ins.
    """
    if os.environ.get(_ENABLE, '').strip().lower() == 'true':
        raise InputError(
            f'{_ENABLE} is true, and without ROS 2 there is no security: source ROS 2, or unset '
            f'{_ENABLE} and stay on the loopback interface (docs/access.md).'
        )


def policy_file() -> Path:
    """Return the shipped policy."""
    return share_folder() / 'config' / 'security' / 'policy.xml'


def make_keystore(keystore: Path, namespace: str = '', policy: Path | None = None) -> list[str]:
    """Make or update the keystore of a policy; existing keys are kept.

    Args:
        keystore: Folder, of one stand.
        namespace: Of the stand's nodes.
        policy: Of the user; None for the shipped one.

    Returns:
        The enclaves.

    Raises:
        ImuCalibError: sros2 is not installed, or cannot make the keystore.
        InputError: The default domain, an unreadable policy, or a keystore of another domain.
    """
    # The keys of a stand are for its domain, which sros2 takes from the environment.
    check_domain()
    domain = os.environ['ROS_DOMAIN_ID'].strip()
    _check_domain_of(keystore, domain)
    file = policy or policy_file()
    api, policies = _sros2()
    try:
        tree = policies.load_policy(file)
        for profile in tree.iter('profile'):
            # With several units, each has a namespace below the stand's.
            below = str(profile.get('ns')).strip('/')
            profile.set('ns', '/' + '/'.join(filter(None, [namespace.strip('/'), below])))
        with tempfile.TemporaryDirectory(prefix='imu_calib_policy_') as folder:
            placed = Path(folder) / file.name
            with placed.open('w', encoding='utf-8') as out:
                policies.dump_policy(tree, out)
            with contextlib.redirect_stdout(io.StringIO()):  # It prints each step.
                api.generate_artifacts(keystore, [], [placed])
    except OSError as error:
        raise InputError(f'{error.filename or keystore}: {error.strerror or error}.') from error
    except Exception as error:  # sros2, lxml and cryptography have their own exceptions.
        raise InputError(f'{file}: {type(error).__name__}: {error}') from error
    return [str(one.get('path')) for one in tree.iter('enclave')]


def _check_domain_of(keystore: Path, domain: str) -> None:
    governance = keystore / 'enclaves' / 'governance.xml'
    if not governance.is_file():
        return
    found = [one.text for one in ET.parse(governance).getroot().iter('id')]
    if found != [domain]:
        raise InputError(
            f'{keystore} is for domain {", ".join(map(str, found))}, and ROS_DOMAIN_ID is '
            f'{domain}: name another folder, or set ROS_DOMAIN_ID to that domain.'
        )


def _sros2() -> tuple[Any, Any]:
    try:
        return import_module('sros2.api._artifact_generation'), import_module('sros2.policy')
    except ImportError as error:
        raise ImuCalibError(
            f'Keystores are made by sros2, which does not load: {error}. Source ROS 2 and install '
            'it: sudo apt install ros-jazzy-sros2.'
        ) from error
