"""Serves the page in a thread of its own, so that the thread of the nodes need not wait for it."""

from __future__ import annotations

import logging
import socket
import threading

import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse
from nicegui import ui

from ..errors import InputError
from . import page
from .guard import Guard

REPORT = '/report'
"""Where the report is served."""
_GRACE = 1
"""s for viewers to be let go of."""
_PATIENCE = 5.0
"""s for the thread to end; it is left to the process then."""


def listening_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens.

    Args:
        host: Name or address of the interface.
        port: 0 for one that is free.

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
        source: What the page shows.
        listens: As `listening_socket` returns it.

    """

    def __init__(self, source: page.Source, listens: socket.socket) -> None:
        app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @app.get(REPORT)
        def report() -> Response:
            if not source.report.is_file():
                return Response('There is no report yet.\n', 404, media_type='text/plain')
            # It says itself what it may load: nothing.
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
        """Begin to serve."""
        self._thread.start()

    def stop(self) -> None:
        """End it: viewers see that the connection is gone."""
        self._server.should_exit = True
        self._thread.join(_PATIENCE)
