"""The page of `imu-calib stand --web`: its options, its node, and its end."""

from __future__ import annotations

import argparse
import errno
import os
import secrets
import socket
from typing import Any

from ..common.errors import InputError
from ..common.files import require
from ..live.network import LOOPBACK_HOST
from ..live.web.guard import TOKEN, address, exposure
from ..session.keywords import node_parameters
from ..session.plan import load_plan
from .processes import Nodes, free_port
from .terminal import ERRORS, OUTPUT

NODE = 'web_node'
_PORT = 8080  #: TCP port that IANA lists for web servers in addition to 80 (http-alt).
_FIRST_FREE = 1024  #: The first port that any user may serve (ip_unprivileged_port_start, ip(7)).
_OF_THE_SESSION = (*node_parameters(), 'units', 'without', 'journal', 'output')
"""Parameters common to the page and calibrator_node."""
_TICK = 0.2  #: s.


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the page."""
    page = parser.add_argument_group('a page in the browser', 'Needs the extra `web`.')
    page.add_argument(
        '--web',
        type=int,
        nargs='?',
        const=_PORT,
        metavar='PORT',
        help=f'show the session at http://{LOOPBACK_HOST}:PORT (default: {_PORT}; 0: a free one); '
        'the page stays when the session is over, until Ctrl-C',
    )
    page.add_argument(
        '--web-host',
        default=LOOPBACK_HOST,
        metavar='HOST',
        help='interface that serves the page (default: %(default)s, which this machine alone '
        'reaches; 0.0.0.0: all, without encryption)',
    )
    page.add_argument(
        '--control',
        action='store_true',
        help=(
            'let the page lead the plan (start, pause, abort and resume it, with the token '
            'that is printed); the session then survives a stop of the table'
        ),
    )


def check(arguments: argparse.Namespace) -> None:
    """Refuse a page that cannot be served, before anything starts."""
    if arguments.web is None:
        if arguments.control or arguments.web_host != LOOPBACK_HOST:
            name = '--control' if arguments.control else '--web-host'
            raise InputError(f'{name} is for the page in the browser; give --web, too.')
        return
    if not 0 <= arguments.web < 1 << 16:
        raise InputError(f'--web: found {arguments.web}, expected a port from 0 to 65535.')
    if arguments.control and load_plan(arguments.plan).by_hand:
        raise InputError('--control: a hand holds the unit; no table is to be started.')
    require('nicegui', '--web', 'web')
    arguments.web = arguments.web or free_port()
    host, port = arguments.web_host, arguments.web
    nothing = f'nothing can be served at {host}, port {port}'
    try:
        family = socket.getaddrinfo(host, port)[0][0]
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        # Python adds the address to the words of bind; the name of a host has its own numbers.
        if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
            reason = str(error.strerror).partition(' (')[0]
            raise InputError(
                f'--web-host: {nothing}: {reason}. Name an interface of this machine, or 0.0.0.0 '
                'for all.'
            ) from None
        reason = os.strerror(error.errno) if error.errno else str(error)
        other = port + 1 if _FIRST_FREE <= port < (1 << 16) - 1 else _PORT
        raise InputError(f'--web: {nothing}: {reason}. Name another port: --web {other}.') from None


def parameters(
    arguments: argparse.Namespace, of_the_calibrator: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the parameters of the page's node by its name; empty without a page."""
    if arguments.web is None:
        return {}
    shared = {k: v for k, v in of_the_calibrator.items() if k in _OF_THE_SESSION}
    own = {'host': arguments.web_host, 'port': arguments.web, 'control': arguments.control}
    return {NODE: {**shared, **own}}


def start(arguments: argparse.Namespace, processes: Nodes, given: dict[str, Any]) -> None:
    """Start the page, and print its address; the session continues if the page ends."""
    secret = secrets.token_urlsafe(16) if arguments.control else ''
    # By the environment, which others cannot read; parameters and logs are in files.
    processes.start(NODE, given, needed=False, environment={TOKEN: secret} if secret else {})
    OUTPUT.print(f'page: {_address(arguments)}', markup=False)
    if secret:
        OUTPUT.print(f'token for its buttons: {secret}', markup=False)
    if exposed := exposure(arguments.web_host):
        ERRORS.print(exposed, style='yellow', markup=False)


def how_to_lead(arguments: argparse.Namespace) -> str:
    """Return how to pause, resume and abort a plan, in a line."""
    if arguments.control:
        return f'Pause, resume, abort: {_address(arguments)}. Ctrl-C ends the session.'
    return 'Ctrl-C stops the table; it can be resumed. To pause and abort: --web --control.'


def serve_until_interrupted(arguments: argparse.Namespace, processes: Nodes) -> None:
    """Keep the page after the session, until Ctrl-C."""
    if arguments.web is None or not processes.runs(NODE):
        return
    OUTPUT.print(f'The page stays at {_address(arguments)} until Ctrl-C.', markup=False)
    try:
        while processes.runs(NODE):
            processes.wait(_TICK)
    except KeyboardInterrupt:
        return


def _address(arguments: argparse.Namespace) -> str:
    return address(arguments.web_host, arguments.web)
