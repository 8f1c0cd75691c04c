"""The notice that the server is lost: made by the browser, since no server can send it."""

from __future__ import annotations

from datetime import datetime

from ...reports.charts import tag
from ..devices.health import Severity
from .drawing import sign

_TEXT = 'Nothing on this page is newer. Look at the stand: its table may still move.'
SCRIPT = """
addEventListener('load', () => {
  const since = document.getElementById('lost-since'), lost = document.body.classList;
  // The stand's clock, which the rest of the page shows; the viewer may be in another time zone.
  const ahead = new Date(since.dataset.clock) - Date.now();
  let heard = Date.now();
  const hear = () => { heard = Date.now(); };
  const lose = () => {
    if (!lost.contains('lost'))
      since.textContent = new Date(heard + ahead).toTimeString().slice(0, 8);
    lost.add('lost');
  };
  socket.onAny(hear);
  // The server's sign of life, every few seconds.
  socket.io.on('ping', hear);
  socket.on('connect', () => { hear(); lost.remove('lost'); });
  socket.on('disconnect', lose);
  socket.on('connect_error', lose);
});
"""
"""Marks the page as `lost` while it is not connected, with the time of the last message."""


def notice(now: datetime) -> str:
    """Return the headline of a page that has lost its server, which the style hides until then.

    Args:
        now: Of the stand's wall clock.
    """
    clock = tag('span', f'{now:%H:%M:%S}', id='lost-since', data_clock=f'{now:%Y-%m-%dT%H:%M:%S}')
    words = sign(Severity.ERROR) + 'Connection lost at ' + clock
    return tag('h2', words) + tag('p', _TEXT, class_='detail')
