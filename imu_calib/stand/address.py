"""Parse host and port from a socket's URL."""

from __future__ import annotations

from urllib.parse import urlsplit


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
