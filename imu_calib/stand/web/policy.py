"""What the browser may do with the page: security headers, and a nonce for its own scripts.

Source: W3C, Content Security Policy Level 3, 2.3.1 and 6.7.3 ('nonce-source').
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, TypeAlias

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
