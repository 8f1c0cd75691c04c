"""The elements of a Digital Calibration Certificate."""

from __future__ import annotations

import xml.etree.ElementTree as ET

DCC, SI = 'https://ptb.de/dcc', 'https://ptb.de/si'


def element(name: str, *parts: ET.Element | None, text: str = '', **attributes: str) -> ET.Element:
    """Return an element of the DCC; parts that are None are omitted."""
    made = ET.Element(f'{{{DCC}}}{name}', attributes)
    made.text = text or None
    made.extend([part for part in parts if part is not None])
    return made


def of_si(name: str, text: str, *parts: ET.Element) -> ET.Element:
    """Return an element of D-SI."""
    made = ET.Element(f'{{{SI}}}{name}')
    made.text = text or None
    made.extend(parts)
    return made


def text_element(name: str, text: object) -> ET.Element | None:
    """Return an element with a text; None without a text."""
    return element(name, text=str(text)) if text not in (None, '') else None


def content(name: str, *texts: str, **attributes: str) -> ET.Element:
    """Return an element of English texts."""
    contents = [element('content', text=text, lang='en') for text in texts]
    return element(name, *contents, **attributes)


def identification(issuer: str, value: str, name: str, kind: str = '') -> ET.Element:
    """Return an identification: a number or name, and its issuer."""
    attributes = {'refType': kind} if kind else {}
    return element(
        'identification',
        text_element('issuer', issuer),
        text_element('value', value),
        content('name', name),
        **attributes,
    )


def statement(
    words: str, kind: str, name: str = 'statement', **more: ET.Element | None
) -> ET.Element:
    """Return a statement; elements in the order of the schema."""
    return element(
        name,
        more.get('traceable'),
        more.get('norm'),
        content('declaration', words),
        more.get('date'),
        more.get('conformity'),
        more.get('data'),
        refType=kind,
    )


def number_with_unit(
    value: float, unit: str, uncertainty: ET.Element | None = None, label: str = ''
) -> ET.Element:
    """Return a value in a unit of D-SI, with its uncertainty if it has one."""
    parts = [of_si('label', label)] if label else []
    parts += [of_si('value', _number(value)), of_si('unit', unit)]
    parts += [] if uncertainty is None else [uncertainty]
    return of_si('real', '', *parts)


def _number(value: float) -> str:
    return f'{value:.12g}'


def expanded(uncertainty: float, factor: float, probability: float, shape: str) -> ET.Element:
    """Return an expanded uncertainty with its coverage."""
    return of_si(
        'expandedUnc',
        '',
        of_si('uncertainty', _number(uncertainty)),
        of_si('coverageFactor', f'{factor:.6f}'),
        of_si('coverageProbability', f'{probability:.4g}'),
        of_si('distribution', shape),
    )
