"""The DDS domain: its number and its range, from ROS 2's environment variables."""

from __future__ import annotations

import os

from ...common.errors import InputError
from ..network import LOOPBACK, REACH, names_interface, network_refusal, on_interface

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
    """Return the domain in ROS_DOMAIN_ID, 0 if it is not set.

    Raises:
        InputError: It is not a number, or out of range.
    """
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

    Raises:
        InputError: ROS_AUTOMATIC_DISCOVERY_RANGE is none of its four values, or requests more than
            the loopback interface while no other is named.
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
    return ','.join(part for part in (ANNOUNCEMENTS, own, _of_reach(reach), user) if part)


def _of_reach(reach: str) -> str:
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
