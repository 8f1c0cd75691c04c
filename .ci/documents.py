"""What Sphinx does not know of the pages: links, citations by the code, texts by scripts."""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import yaml

CHECKOUT = Path(__file__).resolve().parents[1]
DOCS = CHECKOUT / 'docs'
sys.path.insert(0, str(DOCS))
import command_line  # noqa: E402
import messages  # noqa: E402

MATHEMATICS = DOCS / 'mathematics.md'
PAGES = sorted([*CHECKOUT.glob('*.md'), *DOCS.rglob('*.md')])
CITING = sorted(
    path
    for folder in ('imu_calib', 'test', 'docs', 'benchmarks', 'config', 'launch', 'msg_defs/msg')
    for path in (CHECKOUT / folder).rglob('*')
    if path.suffix in ('.py', '.yaml', '.msg')
)

FENCE = re.compile(r'^(```|~~~).*?^\1', re.MULTILINE | re.DOTALL)
HEADING = re.compile(r'^#{1,6} +(.+?) *#*$', re.MULTILINE)
NUMBERED = re.compile(r'(\d+)\. +(.+)')
LINK = re.compile(r'\]\(([^()\s]+)\)|<(?:img|a)[^>]+(?:src|href)="([^"]+)"')
INLINE_CODE = re.compile(r'`[^`\n]+`')
INDENTED = re.compile(r'(?:(?<=\n\n)|^)(?: {4}.*\n?)+')
DOTTED = re.compile(r'(?<!`)`([a-z]\w*(?:\.\w+)+)`')
CITATION = re.compile(
    r'(?P<page>[\w/.-]*\w\.md)'
    r"""(?:,? section (?P<number>\d+)\b|"""
    r"""(?:,?| and) (?P<quote>["'])(?P<title>[^"']*(?:'s [^"']*)?)(?P=quote))?"""
)


def prose(text: str) -> str:
    """Return the text of a page without its blocks of code."""
    return INDENTED.sub('', FENCE.sub('', text))


def titles(text: str) -> list[str]:
    """Return the headings of a page as they are read, without marks."""
    found = HEADING.findall(prose(text))
    return [re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', t).replace('`', '').strip('*') for t in found]


@cache
def titles_of(path: Path) -> list[str]:
    """Return the headings of the page in a file."""
    return titles(path.read_text('utf-8'))


def anchors(titles: list[str]) -> set[str]:
    """Return what a link may name of a page: its headings as GitHub and MyST spell them."""
    spelt: list[str] = []
    for title in titles:
        slug = re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')
        again = sum(
            s == slug or re.fullmatch(rf'{re.escape(slug)}-\d+', s) is not None for s in spelt
        )
        spelt.append(f'{slug}-{again}' if again else slug)
    return set(spelt)


def sections(path: Path) -> dict[int, str]:
    """Return the titles of the numbered sections of a page."""
    found = [NUMBERED.fullmatch(title) for title in titles_of(path)]
    return {int(one[1]): one[2] for one in found if one}


def links(text: str) -> Iterator[str]:
    r"""Yield the targets in a page that lie in the checkout.

    >>> list(links('[a](b.md#c) `[d](e.md)` [f](https://x.org/y.md)\n\n    [g](h.md)\n'))
    ['b.md#c']
    >>> list(links('```\n[f](block.md)\n```\n'))
    []
    """
    for match in LINK.finditer(INLINE_CODE.sub('', prose(text))):
        target = match[1] or match[2]
        if not re.match(r'[a-z]+:', target):
            yield target


def broken(path: Path, text: str) -> Iterator[str]:
    r"""Yield the links of a page that lead nowhere.

    >>> page = DOCS / 'not_written.md'
    >>> list(broken(page, '# Page\n\n[in itself](#page) [elsewhere](#elsewhere)\n'))
    ['#elsewhere: not_written.md has no section #elsewhere']
    >>> list(broken(page, '[a](methods.md) [b](nothing.md)'))
    ['nothing.md: there is no nothing.md']
    """
    for target in links(text):
        name, _, anchor = target.partition('#')
        goal = (path.parent / unquote(name)).resolve() if name else path
        if name and not (goal.exists() and goal.is_relative_to(CHECKOUT)):
            yield f'{target}: there is no {name}'
        elif anchor and not (
            goal.suffix == '.md'
            and anchor in anchors(titles(text) if goal == path else titles_of(goal))
        ):
            yield f'{target}: {goal.name} has no section #{anchor}'


def miscited(text: str, where: Path) -> Iterator[str]:
    r"""Yield what a file cites of pages, and no page has.

    >>> for wrong in (
    ...     'Source: methods.md, section 11.',
    ...     'docs/nowhere.md',
    ...     "docs/mathematics.md, 'Nothing of the kind'",
    ...     'docs/mathematics.md, section 99',
    ...     'Source: docs/mathematics.md,\n    # "Of two\n    # lines"',
    ...     'fewer (docs/mathematics.md, rate test).',
    ... ):
    ...     assert len([*miscited(wrong, CHECKOUT / 'imu_calib' / 'gravity.py')]) == 1
    """
    # As one line: a citation may go on after the end of a line and a sign of comment.
    text = re.sub(r'\s*\n\s*(?:# )?', ' ', text)
    for cited in CITATION.finditer(text):
        name = cited['page']
        beside = where.parent if where.is_relative_to(DOCS) else DOCS
        places = (CHECKOUT / name, beside / name, DOCS / name, DOCS / 'files' / name)
        page = next((p for p in places if p.is_file()), None)
        if page is None:
            yield f'{cited[0]}: there is no such page'
            continue
        numbered = sections(page)
        # Sections are cited by titles without their numbers: these may change.
        known = {*numbered.values(), *titles_of(page)}
        if cited['number'] and int(cited['number']) not in numbered:
            yield f'{cited[0]}: {name} has no section {cited["number"]}'
        if cited['title'] and cited['title'] not in known:
            yield f'{cited[0]}: {name} has no section of this title'
        linked = text[: cited.start()].endswith(('[', ']('))
        if page == MATHEMATICS and not (linked or cited['number'] or cited['title']):
            yield f'{cited[0]}{text[cited.end() : cited.end() + 20]}: names no section'


@cache
def names_of_modules() -> dict[str, set[str | None]]:
    """Return what modules define or import, and packages hold, by their last names."""
    found: dict[str, set[str | None]] = {}
    for path in (CHECKOUT / 'imu_calib').rglob('*.py'):
        package = path.name == '__init__.py'
        names: set[str | None] = {p.stem for p in path.parent.iterdir()} if package else set()
        for node in ast.walk(ast.parse(path.read_text('utf-8'))):
            names |= {getattr(node, part, None) for part in ('name', 'asname', 'id')}
        found.setdefault(path.parent.name if package else path.stem, set()).update(names)
    return found


def unknown_names(text: str) -> Iterator[str]:
    """Yield the citations `module.name` of modules of the package that lack the name.

    >>> list(unknown_names('As `modulation.shapes`, not `modulation.forms`.'))
    ['`modulation.forms`: the module has no such name']
    """
    modules = names_of_modules()
    for module, name, *_ in sorted({tuple(cited.split('.')) for cited in DOTTED.findall(text)}):
        if module in modules and name not in modules[module]:
            yield f'`{module}.{name}`: the module has no such name'


def texts() -> Iterator[str]:
    """Yield links that lead nowhere, and citations of what is not there."""
    for path in [*PAGES, *CITING]:
        text = path.read_text('utf-8')
        found = []
        if path.suffix == '.md':
            # Pages have links; where they cite all the same, it is held to what is there as well.
            found += [*broken(path, text), *miscited(INLINE_CODE.sub('', prose(text)), path)]
        else:
            found += miscited(text, path)
        if path.is_relative_to(CHECKOUT / 'imu_calib'):
            found += unknown_names(text)
        yield from (f'{path.relative_to(CHECKOUT)}: {sentence}' for sentence in found)


def pages() -> Iterator[str]:
    """Yield what pages lack or have otherwise than their sources."""
    numbers = list(sections(MATHEMATICS))
    # The title of the page alone has no number.
    if numbers != list(range(1, len(titles_of(MATHEMATICS)))):
        yield 'docs/mathematics.md: its sections are not numbered in order'
    readers = (DOCS / 'interoperability.md').read_text('utf-8').lower()
    pinned = re.findall(r"'([a-z0-9-]+)==([\d.]+)'", (CHECKOUT / 'setup.py').read_text('utf-8'))
    package = json.loads((CHECKOUT / 'test/support/readers/package.json').read_text('utf-8'))
    for pin in map(' '.join, [*pinned, *package['dependencies'].items()]):
        if pin.lower() not in readers:
            yield f'docs/interoperability.md: has another version than {pin}, which is installed'
    findings = CHECKOUT / 'findings'
    index = (findings / 'README.md').read_text('utf-8')
    rows = re.findall(r'^\| \[(\w+)\]\(\1\.sh\) \| ', index, re.M)
    if rows != sorted(path.stem for path in findings.glob('*.sh')):
        yield 'findings/README.md: has not a line for each finding, in order'


def written() -> Iterator[str]:
    """Yield what the pages that scripts write lack of their sources."""
    for script in (command_line, messages):
        if script.PAGE.read_text('utf-8') != script.page():
            yield f'{script.PAGE.relative_to(CHECKOUT)}: is not what its script writes'
    options = command_line.PAGE.read_text('utf-8')
    for source in (CHECKOUT / 'imu_calib' / 'cli').glob('*.py'):
        for option in re.findall(
            r"add_argument\(\s*(?:'-\w', )?'(--[\w-]+)'", source.read_text('utf-8')
        ):
            if option not in options:
                yield f'docs/command_line.md: lacks {option} of {source.name}'
    fields = messages.PAGE.read_text('utf-8')
    for source in messages.FOLDER.glob('*.msg'):
        for line in source.read_text('utf-8').splitlines():
            field = line.partition('#')[0].split()
            if field and f'`{field[1]}`' not in fields:
                yield f'docs/messages.md: lacks {field[1]} of {source.name}'


def rosdoc() -> Iterator[str]:
    """Yield what keeps the documentation job of ROS from finding the pages."""
    named = ElementTree.parse(CHECKOUT / 'package.xml').findtext('export/rosdoc2')
    head, rest = yaml.safe_load_all((CHECKOUT / str(named)).read_text('utf-8'))
    if head != {'type': 'rosdoc2 config', 'version': 1}:
        yield f'{named}: is no configuration of rosdoc2'
    folder = CHECKOUT / rest['builders'][0]['sphinx']['sphinx_sourcedir']
    # It takes an index in reStructuredText, and writes its own beside any other.
    for name in ('conf.py', 'index.rst'):
        if not (folder / name).is_file():
            yield f'{named}: there is no {name} in {folder}'


CHECKS = (texts, pages, written, rosdoc)
