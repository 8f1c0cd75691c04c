"""Who may view the page, and who may move the table.

A page on the loopback interface can be reached by every page in the same browser, and by names that
a foreign server resolves to it (DNS rebinding). Therefore requests are accepted only for hosts of
this server, and from pages that it has served (OWASP, 'Cross-Site Request Forgery Prevention':
verifying origin; RFC 6454, section 7; Fetch Metadata, W3C).
"""

from __future__ import annotations

import hmac
import ipaddress
import socket

from . import policy
from .policy import App, Receive, Scope, Send

LOOPBACK_HOST = '127.0.0.1'
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
        f'The page is served at {host}, without encryption: whoever can reach that interface sees '
        'the session, and whoever can read the traffic reads a token. Use a network of your own, '
        'or the loopback interface and ssh -L.'
    )


class Guard:
    """Passes only requests that are addressed to a page and come from it (ASGI).

    Args:
        app: The page.
        host: Interface that the server listens on.
        port: Its port.
    """

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
            await policy.serve(self._app, scope, receive, send)
        elif scope['type'] == 'websocket':
            # Before it is accepted: the browser receives 403.
            await send({'type': 'websocket.close', 'code': 1008, 'reason': reason})
        else:
            plain = [(b'content-type', b'text/plain; charset=utf-8'), *policy.headers()]
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
    """The secret that authorises a viewer to command the table.

    Args:
        secret: Empty if no viewer may.
    """

    def __init__(self, secret: str) -> None:
        self._secret = secret.encode()

    @property
    def exists(self) -> bool:
        """Whether any viewer may command the table."""
        return bool(self._secret)

    def fits(self, given: str) -> bool:
        """Return whether it is the token, in constant time."""
        return self.exists and hmac.compare_digest(given.encode(), self._secret)
