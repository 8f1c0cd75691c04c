"""How far the words of nodes reach: the network interface, and the ROS domain (docs/access.md)."""

from __future__ import annotations

import os
import random
import socket
from collections import deque
from pathlib import Path

from .errors import InputError

LOOPBACK = 'lo'
"""The interface that no other machine hears."""

REACH = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_DOMAIN = 'ROS_DOMAIN_ID'
_URI = 'CYCLONEDDS_URI'
_STAYS = frozenset({'LOCALHOST', 'OFF'})

_DOMAINS = range(1, 102)
"""Those whose ports lie below what Linux gives to other programs."""
_claims: deque[socket.socket] = deque()
_MOST_CLAIMS = 8
"""Domains that a process keeps at once. A choice: what is left of a stand that has ended may be
heard for a while, and a hundred domains are for all."""


def on_interface(name: str) -> str:
    """Return the configuration that keeps Cyclone DDS to a network interface."""
    return (
        f'<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="{name}"/></Interfaces>'
        '</General></Domain></CycloneDDS>'
    )


def names_interface(uri: str) -> bool:
    """Say whether a value of CYCLONEDDS_URI, or a file that it names, says which interface."""
    texts = [uri]
    for part in uri.split(','):
        path = Path(part.strip().removeprefix('file://'))
        if not part.lstrip().startswith('<') and path.is_file():
            texts.append(path.read_text(encoding='utf-8', errors='replace'))
    return any('NetworkInterface' in text for text in texts)


def check_interface(name: str) -> None:
    """Make sure that this machine has a network interface.

    Raises:
        InputError: It has not; names those that it has.
    """
    known = [known for _, known in socket.if_nameindex()]
    if name not in known:
        raise InputError(
            f'`network`: found {name!r}, expected an interface of this machine: {", ".join(known)}.'
        )


def check_domain(whose: str) -> None:
    """Refuse ROS's default domain, on which every program without a choice is.

    Args:
        whose: What is to have a domain of its own, for a person.

    Raises:
        InputError: ROS_DOMAIN_ID is not set, or 0.
    """
    given = os.environ.get(_DOMAIN, '').strip()
    if given not in {'', '0'}:
        return
    raise InputError(
        f'{_DOMAIN} is {given or "not set"}: {whose} is not led in the default domain 0, which '
        'every ROS program uses unless told otherwise. Give the stand a domain of its own, in '
        f'every terminal and for the driver of the table: export {_DOMAIN}=42 (1 to 101).'
    )


def kept_to(interface: str) -> dict[str, str]:
    """Return the variables that keep nodes to an interface; what the user has set of them stays.

    Raises:
        InputError: Nothing but the loopback interface is named, and the user asks for more.
    """
    reach = os.environ.get(REACH, '').strip().upper()
    user = os.environ.get(_URI, '').strip()
    named = names_interface(user)
    if interface == LOOPBACK and not named and reach not in {'', *_STAYS}:
        raise InputError(leaving(reach, 'name it with `network`'))
    own = {REACH: reach or ('LOCALHOST' if interface == LOOPBACK else 'SUBNET')}
    if not named:
        own[_URI] = ','.join(filter(None, (on_interface(interface), user)))
    return own


_PARTICIPANTS = 10
"""Ports of a domain that are looked at: a stand has five nodes, and a few who watch."""


def own_domain() -> int:
    """Return a domain that is free on this machine, and keep it for this process.

    A node takes the port of its domain only when it has started: until then a name that Linux gives
    to one process at a time keeps others of the suite away. It is free when the process has ended.

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
    """Return what keeps a domain until it is closed; None where somebody has it, or is on it."""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f'\0imu_calib_domain_{domain}')
        # Whoever took the domain first may have ended before others that are still on it.
        for participant in range(_PARTICIPANTS):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                # Of each participant (RTPS, 9.6.1.1).
                probe.bind(('127.0.0.1', 7410 + 250 * domain + 2 * participant))
    except OSError:
        claim.close()
        return None
    return claim


def leaving(reach: str, how: str) -> str:
    """Return the sentence for who asks for a network without naming the interface.

    Args:
        reach: What ROS_AUTOMATIC_DISCOVERY_RANGE is.
        how: What to do, from 'name' or 'set' on.
    """
    return (
        f'{REACH} is {reach}, and no network interface is named. Who is on that network could '
        f'lead the table: {how} if that is meant, else unset {REACH} (docs/access.md).'
    )
