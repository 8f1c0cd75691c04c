"""The page: draws snapshots of a board with NiceGUI, and passes on its viewers' commands."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse
from nicegui import ui

from ...common.errors import InputError
from ...reports.charts import tag
from ...session.imu import ImuSpec
from ..rules import Phase, Severity
from . import drawing
from .board import Snapshot, UnitRow
from .drawing import STYLE, sign
from .guard import RequestGuard, Token
from .sentences import in_plain_words
from .shape import Link, Solid

# The notice that the server is lost: made by the browser, since no server can send it.


_TEXT = 'Nothing on this page is newer. Look at the stand: its table may still move.'
SCRIPT = files(__package__).joinpath('page.js').read_text(encoding='utf-8')
"""Marks the page as `lost` while it is not connected, with the time of the last message."""


def notice(now: datetime) -> str:
    """Return the headline of a page that has lost its server, which the style hides until then."""
    clock = tag('span', f'{now:%H:%M:%S}', id='lost-since', data_clock=f'{now:%Y-%m-%dT%H:%M:%S}')
    words = sign(Severity.ERROR) + 'Connection lost at ' + clock
    return tag('h2', words) + tag('p', _TEXT, class_='detail')


_GLANCE = 0.5
"""s between two checks of the state: reports change once or twice a second."""
_MOTION = 0.1
"""s between two poses of the table. A choice, as `_FPS`."""
_LEAST_ANGLE = 1e-4
"""rad: smaller differences of a pose give the same picture."""
_KEY = (
    '<div class="key"><span><i></i>standard deviation so far</span>'
    '<span><i class="predicted"></i>what the plan reaches with the bias drift of the data sheet; '
    'with less drift the session ends below</span>'
    '<span><i class="allowed"></i>half the limit of the specification, at the edge if far off'
    '</span></div>'
)
_FPS = 10
"""Pictures of the table per second: the rate of joint states."""
_HEIGHT = 340
"""px of the table's picture."""


@dataclass(frozen=True)
class PageContent:
    """Content of a page, and target of its viewers' commands."""

    title: str  #: Of the page.
    #: Descriptions of the samples by the names of the units; for a single unit by an empty name.
    imus: Mapping[str, ImuSpec]
    shape: Link | None  #: The table; None if a hand holds the unit.
    #: Returns the present state of the unit with that name; empty: of all units.
    snapshot: Callable[[str], Snapshot]
    #: Returns a line for each of several units; empty for a single one.
    units: Callable[[], Sequence[UnitRow]]
    #: Returns the present angles of the joints by name, rad.
    angles: Callable[[], dict[str, float]]
    command: Callable[[str], None]  #: Takes 'start', 'pause' or 'abort' of an authorised viewer.
    token: Token  #: Authorises viewers.
    report: Path  #: The report's file; it may not exist yet.


@dataclass
class _LiveElement:
    """A part of a page that is sent when it changes."""

    element: Any
    draw: Callable[[Snapshot], str]
    sent: str = ''

    def update(self, shown: Snapshot) -> None:
        """Send what has changed."""
        text = self.draw(shown)
        if text != self.sent:
            self.sent = text
            self.element.set_content(text)


def build(source: PageContent) -> None:
    """Lay out the page for one viewer, and update it while it is open."""
    ui.add_css(STYLE)
    ui.add_body_html(f'<script>{SCRIPT}</script>')
    # White text is on the first and the last: contrast 4.5 to 1 and more (WCAG 2.1, 1.4.3).
    ui.colors(primary='#0b5394', negative='#b3261e')
    page = _Page(source)
    part = page.part
    with ui.element('main').classes('stand'):
        _head(source)
        ui.html(notice(datetime.now()), sanitize=False).classes('wide notice').props('role=alert')
        part(lambda s: drawing.banner(s, datetime.now()), 'wide')
        control = _Control(source) if source.token.exists else None
        with _card('Is anything wrong?', 'wide'):
            part(drawing.troubles)
        with _card('The report', 'wide report') as finished:
            part(drawing.report)
        if several := source.units():
            with _card('The units', 'wide'):
                _chooser(several, page.choose)
                part(page.draw_units)
        with ui.element('div').classes('column'):
            with _card('The plan'):
                part(drawing.plan)
            with _card('The samples'):
                part(page.draw_streams, of_unit=True)
        with _card('The table' if source.shape else 'Noise: Allan deviation'):
            scene = _Scene(source.shape) if source.shape else None
            part(drawing.joints if source.shape else page.draw_noise)
        with _card('How well the parameters are known', 'wide'):
            part(drawing.parameters, of_unit=True)
            ui.html(_KEY, sanitize=False)
        if source.shape:
            with _card('Noise: Allan deviation', 'wide'):
                part(page.draw_noise, of_unit=True)
        with ui.element('details').classes('card wide'):
            with ui.element('summary').classes('title'):
                ui.html('All reports in full', sanitize=False, tag='span')
            part(drawing.diagnostics)

    def refresh() -> None:
        page.refresh()
        shown = source.snapshot('')
        finished.set_visibility(shown.outcome.has_result)
        if control is not None:
            control.update(shown)

    refresh()
    ui.timer(_GLANCE, refresh)
    if scene is not None:
        ui.timer(_MOTION, lambda: scene.update(source.angles()))


class _Page:
    """The changing parts of a viewer's page: of all units, and of the selected one."""

    def __init__(self, source: PageContent) -> None:
        self._source = source
        self._parts: list[_LiveElement] = []
        self._of_unit: list[_LiveElement] = []
        self._noise = _Noise()
        self._chosen = ''

    def part(
        self, draw: Callable[[Snapshot], str], kind: str = '', *, of_unit: bool = False
    ) -> None:
        """Add a part, optionally of the selected unit."""
        # `drawing` escapes all text: a node's text is not interpreted as markup.
        element = ui.html('', sanitize=False).classes(kind)
        (self._of_unit if of_unit else self._parts).append(_LiveElement(element, draw))

    def choose(self, name: str) -> None:
        """Show another unit; all for an empty name."""
        self._chosen = name
        self.refresh()

    def refresh(self) -> None:
        """Send what has changed."""
        for parts, name in ((self._parts, ''), (self._of_unit, self._chosen)):
            shown = self._source.snapshot(name)
            for one in parts:
                one.update(shown)

    def draw_units(self, _: Snapshot) -> str:
        """Return a line for each unit."""
        return drawing.units(self._source.units(), self._chosen)

    def draw_streams(self, shown: Snapshot) -> str:
        """Return the results from the samples."""
        return drawing.streams(shown, self._source.imus.get(self._chosen))

    def draw_noise(self, shown: Snapshot) -> str:
        """Return the noise of the dwells."""
        return self._noise.draw(shown, self._chosen, self._source.imus.get(self._chosen))


def _head(source: PageContent) -> None:
    shown = source.snapshot('').expected
    where = f' on table {shown.table}' if shown.table else ' in the hand'
    with ui.element('header').classes('wide top'):
        ui.html(escape(source.title), sanitize=False, tag='h1')
        what = shown.imu if source.units() else f'IMU {shown.imu}'
        ui.label(f'plan {shown.plan}{where}, {what}').classes('small')


def _card(title: str, kind: str = '') -> Any:
    card = ui.element('section').classes(f'card {kind}')
    with card:
        ui.label(title).classes('title')
    return card


def _chooser(rows: Sequence[UnitRow], choose: Callable[[str], None]) -> None:
    """Let a viewer select the unit whose samples, parameters and noise are shown."""
    names = {'': 'All units: the least known'}
    names |= {row.name: row.serial_number for row in rows}
    select = ui.select(names, value='', label='Unit', on_change=lambda e: choose(e.value))
    select.props('dense outlined options-dense').classes('chooser')


class _Noise:
    """Draws the Allan deviation again only if it has grown, or for another unit."""

    def __init__(self) -> None:
        self._of: tuple[int, str] | None = None
        self._drawn = ''

    def draw(self, shown: Snapshot, unit: str, imu: ImuSpec | None) -> str:
        """Return the drawing."""
        revision = 0 if shown.streams is None else shown.streams.revision
        if self._of != (revision, unit):
            self._of, self._drawn = (revision, unit), drawing.noise(shown, imu)
        return self._drawn


class _Control:
    """The buttons, for a viewer with the token."""

    def __init__(self, source: PageContent) -> None:
        self._source = source
        self._may = False
        with _card('Control', 'wide control'):
            with ui.element('div').classes('controls') as self._locked:
                self._input = ui.input('Token').props('dense outlined type=password')
                self._input.on('keydown.enter', self._unlock)
                ui.button('Unlock', on_click=self._unlock).props('no-caps unelevated')
                self._said = ui.label('The terminal that runs the stand shows it.')
                self._said.classes('small').props('role=status')
            with ui.element('div').classes('controls') as self._open:
                self._start = self._button('Start', self._ask)
                # Commands that stop the table are always offered: the page's state may be outdated.
                self._button('Pause', lambda: self._command('pause'), 'warning')
                self._button('Abort', lambda: self._command('abort'), 'negative')
                self._answer = ui.label('').classes('small').props('role=status')
        self._open.set_visibility(False)
        with ui.dialog() as self._dialog, ui.card():
            ui.label('The table will move. Is everybody clear of it?')
            with ui.element('div').classes('controls'):
                ui.button('Yes, move', on_click=self._start_confirmed).props('no-caps unelevated')
                ui.button('No', on_click=self._dialog.close).props('no-caps flat')

    def _button(self, text: str, action: Callable[[], None], colour: str = 'primary') -> ui.button:
        button = ui.button(text, on_click=action, color=colour).props('no-caps unelevated')
        # White text is illegible on yellow.
        return button.props('text-color=black') if colour == 'warning' else button

    def _unlock(self) -> None:
        self._may = self._source.token.fits((self._input.value or '').strip())
        self._input.set_value('')
        self._locked.set_visibility(not self._may)
        self._open.set_visibility(self._may)
        self._said.set_text('' if self._may else 'That is not the token: nothing was sent.')

    def _ask(self) -> None:
        if self._may:
            self._dialog.open()

    def _start_confirmed(self) -> None:
        self._dialog.close()
        self._command('start')

    def _command(self, name: str) -> None:
        # A browser may send commands that its page does not show: authorisation is checked here.
        if self._may:
            self._source.command(name)

    def update(self, shown: Snapshot) -> None:
        """Offer the commands that are possible now."""
        phase = None if shown.table is None else shown.table.phase
        self._start.set_text('Resume' if phase is Phase.PAUSED else 'Start')
        ready = phase is not None and not phase.at_a_step and not shown.silent
        self._start.set_enabled(ready)
        self._answer.set_text(in_plain_words(shown.answer))


class _Scene:
    """The moving table."""

    def __init__(self, base: Link) -> None:
        self._moving: dict[str, tuple[Link, Any, float]] = {}
        background = '#8d99a6'
        with ui.scene(height=_HEIGHT, grid=False, background_color=background, fps=_FPS).classes(
            'table-picture'
        ) as self._scene:
            self._hang(base)
        self._scene.move_camera(x=1.0, y=-1.15, z=0.5, look_at_x=0, look_at_y=0, look_at_z=-0.12)

    def _hang(self, link: Link) -> None:
        with self._scene.group() as frame:
            frame.move(*link.at).rotate_R(link.turned.tolist())
            with self._scene.group() as body:
                if link.joint:
                    body.rotate_R(link.pose(0.0).tolist())
                    self._moving[link.joint] = link, body, 0.0
                for solid in link.solids:
                    self._add_solid(solid)
                for hung in link.links:
                    self._hang(hung)

    def _add_solid(self, solid: Solid) -> None:
        turned = solid.turned
        body: Any
        if solid.kind == 'box':
            width, depth, height = solid.size
            body = self._scene.box(width, depth, height)
        elif solid.kind == 'cylinder':
            radius, length = solid.size
            body = self._scene.cylinder(radius, radius, length, 40)
            # Along y there, along z here.
            turned = turned @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        else:
            body = self._scene.sphere(solid.size[0])
        body.material(solid.colour).move(*solid.at).rotate_R(turned.tolist())

    def update(self, angles: dict[str, float]) -> None:
        """Turn the joints to their angles, rad."""
        for name, angle in angles.items():
            if name not in self._moving:
                continue
            link, body, before = self._moving[name]
            if abs(angle - before) > _LEAST_ANGLE:
                body.rotate_R(link.pose(angle).tolist())
                self._moving[name] = link, body, angle


# Serve the page in a separate thread, so that the thread of the nodes need not wait for it.

REPORT = '/report'
"""Address of the report."""
_GRACE = 1
"""s for viewers to be disconnected. A choice."""
_PATIENCE = 5.0
"""s for the thread to end; after that it ends with the process."""


def listening_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens at an interface; port 0: any free one."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise InputError(
            f'The page cannot be served at {host}, port {port}: {reason}. Name another port.'
        ) from None


class Server:
    """A web server of one page."""

    def __init__(self, source: PageContent, listens: socket.socket) -> None:
        app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

        @app.get(REPORT)
        def report() -> Response:
            if not source.report.is_file():
                return Response('There is no report yet.\n', 404, media_type='text/plain')
            # The report's own policy states that it may load nothing.
            return FileResponse(source.report, media_type='text/html')

        @ui.page('/', title=source.title, dark=None)
        def index() -> None:
            build(source)

        ui.run_with(app, show_welcome_message=False, tailwind=False)
        host, port = listens.getsockname()[:2]
        config = uvicorn.Config(
            RequestGuard(app, host, port),
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
