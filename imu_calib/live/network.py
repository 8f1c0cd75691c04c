"""Network of the nodes: runtime, interface, domain, and keys (docs/access.md)."""

from __future__ import annotations

import contextlib
import io
import os
import platform
import random
import socket
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import deque
from contextlib import AbstractContextManager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ..common.errors import ImuCalibError, InputError
from ..common.files import share_folder
from ..common.processes import with_variable

# The runtime: rclpy if available, else Cyclone DDS, or one process alone.


VARIABLE = 'IMU_CALIB_MIDDLEWARE'
RUNTIMES = ('rclpy', 'dds', 'embedded')
_FIRST, _LAST = (3, 10), (3, 13)
"""Pythons for which cyclonedds 11.0.1 has wheels, on Linux for x86_64 alone."""
BUILD_MESSAGES = (
    'Build it from the folder msg_defs: `colcon build` in a clone alone, in a workspace `ln -s '
    'imu_calib/msg_defs src/imu_calib_msgs` before; then `source install/setup.bash`.'
)
"""How to get the package of messages, below whose folder colcon does not look by itself."""


def runtime() -> str:
    """Return 'rclpy' if a module of that name exists, else 'dds'.

    The environment variable IMU_CALIB_MIDDLEWARE forces one of the three.
    """
    forced = os.environ.get(VARIABLE, '')
    if forced:
        if forced not in RUNTIMES:
            raise ImuCalibError(f'{VARIABLE} is {forced!r}, expected {", ".join(RUNTIMES)}.')
        return forced
    return 'rclpy' if find_spec('rclpy') is not None else 'dds'


def forced(chosen: str) -> AbstractContextManager[None]:
    """Force a runtime in this block, also for the modules of nodes that it loads."""
    return with_variable(VARIABLE, chosen)


def require(chosen: str) -> None:
    """Check that one of `RUNTIMES` works; the error states the remedy."""
    if chosen == 'rclpy':
        _import(
            'rclpy',
            'rclpy does not load: {}. Source a ROS 2 installation of this Python, or set '
            f'{VARIABLE}=dds to do without ROS.',
        )
        _import(
            'imu_calib_msgs.action',
            f'The package imu_calib_msgs is not built, not sourced or old: {{}}. {BUILD_MESSAGES}',
        )
        return
    _import(
        'rosbags.serde',
        'Without ROS 2 the nodes need rosbags, which does not load: {}. Install it '
        '(pip install rosbags), or start them as processes of ROS 2 (imu-calib stand --processes).',
    )
    if chosen == 'dds':
        _import(
            'cyclonedds._clayer',
            "On ROS 2's wire the nodes need Cyclone DDS, which does not load: {}. " + _remedy(),
        )


def _remedy() -> str:
    """Return how to get Cyclone DDS, if a wheel is there, and what works without."""
    instead = (
        '`imu-calib stand` without --processes and all commands on recordings work without it.'
    )
    version, system, machine = sys.version_info[:2], platform.system(), platform.machine()
    if _FIRST <= version <= _LAST and (system, machine) == ('Linux', 'x86_64'):
        return f"Install it with `pip install '.[dds]'`, or source ROS 2; {instead}"
    return (
        f'It has no wheel for Python {version[0]}.{version[1]} on {system} {machine}: source ROS '
        f'2; {instead}'
    )


def _import(module: str, sentence: str) -> None:
    try:
        import_module(module)
    except Exception as error:
        reason = f'{type(error).__name__}: {error}'
        raise ImuCalibError(sentence.format(reason)) from error


LOOPBACK_HOST = '127.0.0.1'
"""Address of this machine for itself alone."""
LOOPBACK = 'lo'
"""The interface that other machines cannot reach."""

REACH = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_DOMAIN = 'ROS_DOMAIN_ID'
_URI = 'CYCLONEDDS_URI'
_STAYS = frozenset({'LOCALHOST', 'OFF'})

LEASES = {'rmw_cyclonedds_cpp': 15.0, 'rmw_fastrtps_cpp': 25.0}
"""s after which a killed process is no longer listed, by the middleware: its lease, 10 s and 20 s,
and 5 s for a busy machine."""
LONGEST_LEASE = max(LEASES.values())
"""s: of any middleware."""

_DOMAINS = range(1, 102)
"""Domains whose ports are below those that Linux gives to other programs."""
_claims: deque[socket.socket] = deque()
_MOST_CLAIMS = 8
"""Most domains kept by a process at once. A choice: a stand that has ended may still be visible for
a while, and the hundred domains are for all."""


def on_interface(name: str) -> str:
    """Return the configuration that restricts Cyclone DDS to a network interface."""
    return (
        f'<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="{name}"/></Interfaces>'
        '</General></Domain></CycloneDDS>'
    )


def names_interface(uri: str) -> bool:
    """Return whether a value of CYCLONEDDS_URI, or a file that it names, sets the interface."""
    texts = [uri]
    for part in uri.split(','):
        path = Path(part.strip().removeprefix('file://'))
        if not part.lstrip().startswith('<') and path.is_file():
            texts.append(path.read_text(encoding='utf-8', errors='replace'))
    return any('NetworkInterface' in text for text in texts)


def check_interface(name: str) -> None:
    """Check that this machine has a network interface."""
    known = [known for _, known in socket.if_nameindex()]
    if name not in known:
        raise InputError(
            f'`network`: found {name!r}, expected an interface of this machine: {", ".join(known)}.'
        )


def check_domain() -> None:
    """Refuse ROS's default domain for a table: every program without a choice uses it."""
    given = os.environ.get(_DOMAIN, '').strip()
    if given not in {'', '0'}:
        return
    raise InputError(
        f'{_DOMAIN} is {given or "not set"}: in the default domain 0 any ROS program could command '
        'the table. Give the stand a domain of its own, in every terminal and for the driver of '
        f'the table: export {_DOMAIN}=42 (1 to 101).'
    )


def interface_variables(interface: str) -> dict[str, str]:
    """Return the variables that restrict nodes to an interface; those set by the user stay."""
    reach = os.environ.get(REACH, '').strip().upper()
    user = os.environ.get(_URI, '').strip()
    named = names_interface(user)
    if interface == LOOPBACK and not named and reach not in {'', *_STAYS}:
        raise InputError(network_refusal(reach, 'name it with `network`'))
    own = {REACH: reach or ('LOCALHOST' if interface == LOOPBACK else 'SUBNET')}
    if not named:
        own[_URI] = ','.join(filter(None, (on_interface(interface), user)))
    return own


_PARTICIPANTS = 10
"""Ports of a domain that are checked: a stand has five nodes, and a few observers."""


def own_domain() -> int:
    """Return a free domain of this machine, and reserve it for this process.

    A node binds the port of its domain only when it has started: until then other processes of the
    suite are kept away by a socket name that Linux gives to one process at a time. It is released
    when the process ends.
    """
    for domain in random.sample(_DOMAINS, len(_DOMAINS)):
        claim = _claim(domain)
        if claim is None:
            continue
        _claims.append(claim)
        if len(_claims) > _MOST_CLAIMS:
            _claims.popleft().close()
        return domain
    raise InputError('All ROS domains from 1 to 101 are in use on this machine.')


def _claim(domain: int) -> socket.socket | None:
    """Return a socket that reserves a domain until closed; None if it is reserved or used."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f'\0imu_calib_domain_{domain}')
        # The process that reserved the domain may have ended before others that still use it.
        for participant in range(_PARTICIPANTS):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                # Port of each participant (RTPS, 9.6.1.1).
                probe.bind((LOOPBACK_HOST, 7410 + 250 * domain + 2 * participant))
    except OSError:
        claim.close()
        return None
    return claim


def network_refusal(reach: str, how: str) -> str:
    """Return why a request for a network is refused; `how` begins with 'name' or 'set'."""
    return (
        f'{REACH} is {reach}, and no network interface is named: anyone on the network could '
        f'command the table. If that is meant, {how}, else unset {REACH} (docs/access.md).'
    )


def host_and_port(url: str) -> tuple[str, int] | None:
    """Return host and port of scheme://host:port, None if one of them is missing or invalid.

    >>> host_and_port('socket://10.0.0.3:5000')
    ('10.0.0.3', 5000)
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    return (host, port) if host and port else None


# SROS 2: the enclave of a node, and the keystore from the policy.


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
    """Refuse unencrypted communication if the environment asks for security."""
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


LAST_DOMAIN = 232
"""The ports of a higher one do not exist (RTPS: 7400 + 250 * domain)."""

ANNOUNCEMENTS = (
    '<CycloneDDS><Domain><Discovery><SPDPInterval>2s</SPDPInterval></Discovery></Domain>'
    '</CycloneDDS>'
)
"""How often a process announces itself. With Cyclone DDS's own 30 s a node whose first announcement
is lost is not found for so long. A choice: 33 addresses, without multicast, take 17 packets a
second."""

_REACHES = ('SUBNET', 'LOCALHOST', 'OFF', 'SYSTEM_DEFAULT')
_HERE = 'localhost'


def domain_id() -> int:
    """Return the domain in ROS_DOMAIN_ID, 0 if it is not set."""
    text = os.environ.get('ROS_DOMAIN_ID', '').strip()
    if not text:
        return 0
    if not text.isdecimal() or int(text) > LAST_DOMAIN:
        raise InputError(
            f'ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to {LAST_DOMAIN}.'
        )
    return int(text)


def configuration() -> str:
    """Return Cyclone DDS's configuration: our own, ROS's range and peers, then CYCLONEDDS_URI.

    The loopback interface is used unless CYCLONEDDS_URI names others: this runtime has no security
    plug-ins, so any sender can command the table.
    """
    given = os.environ.get(REACH, '').strip().upper()
    user = os.environ.get('CYCLONEDDS_URI', '').strip()
    named = names_interface(user)
    reach = given or ('SUBNET' if named else 'LOCALHOST')
    if reach not in _REACHES:
        raise InputError(f'{REACH} is {reach!r}, expected one of {", ".join(_REACHES)}.')
    if os.environ.get('ROS_LOCALHOST_ONLY', '').strip() == '1':
        reach = 'LOCALHOST'
    if not named and reach in {'SUBNET', 'SYSTEM_DEFAULT'}:
        example = on_interface('eth0')
        raise InputError(network_refusal(reach, f"set CYCLONEDDS_URI='{example}' with its name"))
    own = '' if named else on_interface(LOOPBACK)
    return ','.join(part for part in (ANNOUNCEMENTS, own, _reach_settings(reach), user) if part)


def _reach_settings(reach: str) -> str:
    if reach == 'SYSTEM_DEFAULT':
        return ''
    peers = [p for p in os.environ.get('ROS_STATIC_PEERS', '').split(';') if p.strip()]
    if reach == 'OFF':
        peers = []
    if reach == 'LOCALHOST':
        peers.insert(0, _HERE)
    general = (
        '' if reach == 'SUBNET' else '<General><AllowMulticast>false</AllowMulticast></General>'
    )
    if not general and not peers:
        return ''
    # Without multicast peers are found by port: few participants, each with an index.
    listed = ''.join(f'<Peer address="{p.strip()}"/>' for p in peers)
    return (
        f'<CycloneDDS><Domain>{general}<Discovery><ParticipantIndex>auto</ParticipantIndex>'
        f'<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers>{listed}</Peers>'
        '</Discovery></Domain></CycloneDDS>'
    )
