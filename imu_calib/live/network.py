"""Reach of the nodes' communication: network interface and ROS domain (docs/access.md)."""

from __future__ import annotations

import os
import random
import socket
from collections import deque
from pathlib import Path
from urllib.parse import urlsplit

from ..common.errors import InputError

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
    """Check that this machine has a network interface.

    Raises:
        InputError: It does not; lists the existing ones.
    """
    known = [known for _, known in socket.if_nameindex()]
    if name not in known:
        raise InputError(
            f'`network`: found {name!r}, expected an interface of this machine: {", ".join(known)}.'
        )


def check_domain() -> None:
    """Refuse ROS's default domain for a table: every program without a choice uses it.

    Raises:
        InputError: ROS_DOMAIN_ID is not set, or 0.
    """
    given = os.environ.get(_DOMAIN, '').strip()
    if given not in {'', '0'}:
        return
    raise InputError(
        f'{_DOMAIN} is {given or "not set"}: in the default domain 0 any ROS program could command '
        'the table. Give the stand a domain of its own, in every terminal and for the driver of '
        f'the table: export {_DOMAIN}=42 (1 to 101).'
    )


def interface_variables(interface: str) -> dict[str, str]:
    """Return the variables that restrict nodes to an interface; those set by the user stay.

    Raises:
        InputError: The user asks for a wider reach without naming another interface.
    """
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

    Raises:
        InputError: All are in use.
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
    """Return the sentence for a request for a network without an interface.

    Args:
        reach: Value of ROS_AUTOMATIC_DISCOVERY_RANGE.
        how: Remedy, beginning with 'name' or 'set'.
    """
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
