"""Who may view the page, and who may move the table.

A page on the loopback interface can be reached by every page in the same browser, and by names that
a foreign server resolves to it (DNS rebinding). Therefore requests are accepted only for hosts of
this server, and from pages that it has served (OWASP, 'Cross-Site Request Forgery Prevention':
verifying origin; RFC 6454, section 7; Fetch Metadata, W3C).
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, TypeAlias

# What the browser may do with the page: security headers, and a nonce for its own scripts.
#
# Source: W3C, Content Security Policy Level 3, 2.3.1 and 6.7.3 ('nonce-source').


Scope: TypeAlias = MutableMapping[str, Any]
Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]
Headers: TypeAlias = tuple[tuple[bytes, bytes], ...]

_LIBRARY = '/_nicegui'
"""Start of the paths of NiceGUI's own files, large ones, which are compressed."""
_PAGE = b'x-nicegui-content'
"""Header that NiceGUI gives to every page, its pages of errors included."""
_POLICY = (
    # Nothing is loaded from or sent to other hosts, and no other page may frame this one. A script
    # in the text runs only with the nonce. NiceGUI needs 'unsafe-eval': the browser compiles its
    # templates (Vue) and evaluates its messages; and inline styles: it makes style elements that
    # bear no nonce.
    "default-src 'self'; script-src 'self' 'unsafe-eval'{nonce}; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self'; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'self'"
)
_SCRIPT = re.compile(rb'<script(?=[\s>])')
"""A script of the page as served: NiceGUI escapes all texts of elements and the title in it."""


def headers(nonce: str = '') -> Headers:
    """Return the security headers of a response, optionally with a nonce of its scripts."""
    allowed = f" 'nonce-{nonce}'" if nonce else ''
    return (
        (b'content-security-policy', _POLICY.format(nonce=allowed).encode()),
        (b'x-frame-options', b'SAMEORIGIN'),
        (b'x-content-type-options', b'nosniff'),
        (b'referrer-policy', b'no-referrer'),
        (b'cross-origin-resource-policy', b'same-origin'),
        (b'cross-origin-opener-policy', b'same-origin'),
    )


async def serve(app: App, scope: Scope, receive: Receive, send: Send) -> None:
    """Serve a request with the security headers, and a page with a nonce in its scripts."""
    if not scope['path'].startswith(_LIBRARY):
        # Scripts are marked in plain text.
        kept = [(k, v) for k, v in scope['headers'] if k.lower() != b'accept-encoding']
        scope = {**scope, 'headers': kept}
    await app(scope, receive, _with_headers(send))


def _with_headers(send: Send) -> Send:
    page: Message = {}
    parts: list[bytes] = []

    async def sends(message: Message) -> None:
        if message['type'] == 'http.response.start':
            given = list(message.get('headers', ()))
            if any(name.lower() == _PAGE for name, _ in given):
                page.update(message)
                return
            message = {**message, 'headers': [*given, *headers()]}
        elif page:
            parts.append(message.get('body', b''))
            if not message.get('more_body'):
                await _send_page(send, page, b''.join(parts))
            return
        await send(message)

    return sends


async def _send_page(send: Send, start: Message, body: bytes) -> None:
    """Send a page with a nonce in each of its scripts."""
    nonce = secrets.token_urlsafe(16)
    body = _SCRIPT.sub(b'<script nonce="%s"' % nonce.encode(), body)
    kept = [(k, v) for k, v in start['headers'] if k.lower() != b'content-length']
    length = (b'content-length', str(len(body)).encode())
    await send({**start, 'headers': [*kept, length, *headers(nonce)]})
    await send({'type': 'http.response.body', 'body': body})


TOKEN = 'IMU_CALIB_WEB_TOKEN'
"""Environment variable with the token; without it the node creates one, and prints it."""
_SAFE = frozenset({'GET', 'HEAD'})
_FAR = frozenset({'cross-site', 'same-site'})


def is_loopback(host: str) -> bool:
    """Return whether a name or address is that of this machine only."""
    if host == 'localhost':
        return True
    try:
        return ipaddress.ip_address(host.strip('[]')).is_loopback
    except ValueError:
        return False


def address(host: str, port: int) -> str:
    """Return the address for a browser on this machine, or on another one."""
    name = host.strip('[]')
    if name in {'0.0.0.0', '::', ''}:
        name = socket.gethostname()
    return f'http://{f"[{name}]" if ":" in name else name}:{port}'


def exposure(host: str) -> str:
    """Return a sentence on who can see the page, if others can; else empty."""
    if is_loopback(host):
        return ''
    return (
        f'The page is served at {host} without encryption: anyone on that network can see the '
        'session and read the token. Use a network of your own, or the loopback interface and '
        'ssh -L.'
    )


class RequestGuard:
    """Passes only requests that are addressed to a page and come from it (ASGI)."""

    def __init__(self, app: App, host: str, port: int) -> None:
        self._app = app
        self._port = port
        self._names = {'localhost', host.strip('[]').lower()}
        if not is_loopback(host):
            own = socket.gethostname().lower()
            self._names |= {own, f'{own}.local', socket.getfqdn().lower()}
        self._anywhere = not is_loopback(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Accept a request, or refuse it."""
        if scope['type'] not in {'http', 'websocket'}:
            await self._app(scope, receive, send)
            return
        reason = self.refusal(scope)
        if not reason:
            await serve(self._app, scope, receive, send)
        elif scope['type'] == 'websocket':
            # Before it is accepted: the browser receives 403.
            await send({'type': 'websocket.close', 'code': 1008, 'reason': reason})
        else:
            plain = [(b'content-type', b'text/plain; charset=utf-8'), *headers()]
            await send({'type': 'http.response.start', 'status': 403, 'headers': plain})
            await send({'type': 'http.response.body', 'body': f'{reason}\n'.encode()})

    def refusal(self, scope: Scope) -> str:
        """Return why a request is refused; else empty."""
        headers: dict[str, list[str]] = {}
        for name, value in scope['headers']:
            headers.setdefault(name.decode('latin-1').lower(), []).append(value.decode('latin-1'))
        hosts, origins = headers.get('host', []), headers.get('origin', [])
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return 'The page is not served under this name: use the address that was printed.'
        socket_asked = scope['type'] == 'websocket'
        if len(origins) > 1 or any(not _same(origin, hosts[0]) for origin in origins):
            return 'Requests from another page are refused.'
        if socket_asked and not origins:
            # Every browser names the origin of a websocket (RFC 6455, section 10.2).
            return 'A websocket without an origin is refused.'
        if headers.get('sec-fetch-site', [''])[0] in _FAR and (
            socket_asked
            or scope['method'] not in _SAFE
            or headers.get('sec-fetch-mode', [''])[0] != 'navigate'
            or headers.get('sec-fetch-dest', [''])[0] != 'document'
        ):
            return 'Requests from another page are refused.'
        return ''

    def _is_ours(self, value: str) -> bool:
        """Return whether a Host header names this server.

        An address in place of a name was not resolved by a name server: it cannot be rebound.
        """
        name, port = _split(value.lower())
        if port != str(self._port):
            return False
        if name in self._names:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return self._anywhere or address.is_loopback


def _split(host: str) -> tuple[str, str]:
    """Split host:port; a missing port is that of http."""
    if host.startswith('['):
        name, _, rest = host[1:].partition(']')
        return name, rest.removeprefix(':') or '80'
    name, _, port = host.partition(':')
    return name, port or '80'


def _same(origin: str, host: str) -> bool:
    return origin.lower() == f'http://{host.lower()}'


class Token:
    """The secret that authorises a viewer to command the table; empty: no viewer may."""

    def __init__(self, secret: str) -> None:
        self._secret = secret.encode()

    @property
    def exists(self) -> bool:
        """Whether any viewer may command the table."""
        return bool(self._secret)

    def fits(self, given: str) -> bool:
        """Return whether it is the token, in constant time."""
        return self.exists and hmac.compare_digest(given.encode(), self._secret)
