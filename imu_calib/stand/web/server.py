"""Serve the page in a separate thread, so that the thread of the nodes need not wait for it."""

from __future__ import annotations

import logging
import socket
import threading

import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse
from nicegui import ui

from ...common.errors import InputError
from . import page
from .guard import Guard

REPORT = '/report'
"""Address of the report."""
_GRACE = 1
"""s for viewers to be disconnected. A choice."""
_PATIENCE = 5.0
"""s for the thread to end; after that it ends with the process."""


def listening_socket(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Args:
        host: Name or address of the interface.
        port: 0 for any free one.

    Raises:
        InputError: The port is taken, or there is no such interface.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise InputError(
            f'The page cannot be served at {host}, port {port}: {reason}. Name another port.'
        ) from None


class Server:
    """A web server of one page.

    Args:
        source: Content of the page.
        listens: As `listening_socket` returns it.
    """

    def __init__(self, source: page.Source, listens: socket.socket) -> None:
        app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @app.get(REPORT)
        def report() -> Response:
            if not source.report.is_file():
                return Response('There is no report yet.\n', 404, media_type='text/plain')
            # The report's own policy states that it may load nothing.
            return FileResponse(source.report, media_type='text/html')

        @ui.page('/', title=source.title, dark=None)
        def index() -> None:
            page.build(source)

        ui.run_with(app, show_welcome_message=False, tailwind=False)
        host, port = listens.getsockname()[:2]
        config = uvicorn.Config(
            Guard(app, host, port),
            log_level=logging.WARNING,
            access_log=False,
            server_header=False,
            lifespan='on',
            timeout_graceful_shutdown=_GRACE,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={'sockets': [listens]}, name='page', daemon=True
        )

    def start(self) -> None:
        """Start serving."""
        self._thread.start()

    def stop(self) -> None:
        """Stop; viewers see that the connection is closed."""
        self._server.should_exit = True
        self._thread.join(_PATIENCE)
