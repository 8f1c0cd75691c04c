"""The HTML elements of the report, well-formed also as XML."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from importlib.resources import files

from ..common.units import as_options, typeset
from .charts import tag

_STATIC = "default-src 'none'; style-src 'unsafe-inline'"
"""Policy of a static page: only its own style."""


def document(title: str, body: str, style: str, policy: str = _STATIC) -> str:
    """Return a complete HTML file: its title is plain text, its body HTML, its style CSS."""
    head = ''.join(
        [
            tag('meta', charset='utf-8'),
            tag('meta', http_equiv='Content-Security-Policy', content=policy),
            tag('meta', name='viewport', content='width=device-width, initial-scale=1'),
            tag('title', escape(title)),
            tag('style', style),
        ]
    )
    return f'<!DOCTYPE html>\n{tag("html", tag("head", head) + tag("body", body), lang="en")}\n'


def table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], kind: str = '', numbers: str = ''
) -> str:
    """Return a table.

    Args:
        headings: Plain texts.
        rows: Cells as HTML.
        kind: Class of the table.
        numbers: For every column 'r' if it is right-aligned, else 'l'.
    """
    sides = numbers or 'l' * len(headings)
    head = ''.join(
        tag('th', escape(h) or ' ', scope='col', class_=side)
        for h, side in zip(headings, sides, strict=True)
    )
    body = ''.join(
        tag(
            'tr',
            ''.join(
                # Shown beside the cell where a narrow screen stacks the cells of a row.
                tag('td', cell or ' ', class_=side, data_name=heading or None)
                for cell, side, heading in zip(row, sides, headings, strict=True)
            ),
        )
        for row in rows
    )
    inside = tag('thead', tag('tr', head)) + tag('tbody', body or ' ')
    return scrolling(tag('table', inside, class_=kind or None))


def scrolling(content: str) -> str:
    """Return content that scrolls by itself on a narrow screen."""
    return tag('div', content, class_='wide')


def named_rows(rows: Sequence[tuple[str, str]]) -> str:
    """Return a table of plain texts with their names."""
    body = ''.join(
        tag('tr', tag('th', escape(name), scope='row') + tag('td', escape(value) or '-'))
        for name, value in rows
    )
    return scrolling(tag('table', tag('tbody', body), class_='facts')) if rows else ''


def section(title: str, *content: str, kind: str = '') -> str:
    """Return a section with a heading; empty without content."""
    inside = ''.join(content)
    if not inside:
        return ''
    return tag('section', tag('h2', escape(title)) + inside, class_=kind or None)


def paragraph(text: str, kind: str = '') -> str:
    """Return a paragraph of plain text."""
    return tag('p', _sentence(text), class_=kind or None)


def bullets(sentences: Sequence[str]) -> str:
    """Return a list of plain texts; empty without any."""
    return tag('ul', ''.join(tag('li', _sentence(s)) for s in sentences)) if sentences else ''


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Return names with values, plain texts."""
    inside = ''.join(
        tag('div', tag('dt', escape(name)) + tag('dd', escape(value) or '-'))
        for name, value in pairs
    )
    return tag('dl', inside)


def _sentence(text: str) -> str:
    """Return plain text with units as pages show them, and keywords as options, set as code."""
    text = as_options(escape(typeset(text)), '<code>{}</code>')
    return re.sub('`([^`]+)`', r'<code>\1</code>', text)


def sheet(name: str) -> str:
    """Return a style sheet of pages, with that of tables on a phone."""
    folder = files(__package__)
    return ''.join(f'\n{folder.joinpath(one).read_text("utf-8")}' for one in (name, 'stacked.css'))


STYLE = sheet('report.css')
"""On a screen, light or dark, on a phone, and on A4 paper."""
