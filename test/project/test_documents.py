"""Pages, their links and their sections, and what the code cites of them."""

import ast
import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
import yaml
from loopback import CHECKOUT

sys.path.insert(0, str(CHECKOUT / 'docs'))
import command_line
import messages

from imu_calib.cli.main import main

DOCS = CHECKOUT / 'docs'
MATHEMATICS = DOCS / 'mathematics.md'
PAGES = sorted([*CHECKOUT.glob('*.md'), *DOCS.rglob('*.md')])
CITING = sorted(
    path
    for folder in ('imu_calib', 'test', 'docs', 'benchmarks', 'config', 'launch', 'msg_defs/msg')
    for path in (CHECKOUT / folder).rglob('*')
    if path.suffix in ('.py', '.yaml', '.msg') and path != Path(__file__).resolve()
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


def prose(path: Path) -> str:
    """Return the text of a page without its blocks of code."""
    return INDENTED.sub('', FENCE.sub('', path.read_text('utf-8')))


@cache
def titles(path: Path) -> list[str]:
    """Return the headings of a page as they are read, without marks."""
    found = HEADING.findall(prose(path))
    return [re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', t).replace('`', '').strip('*') for t in found]


def anchors(path: Path) -> set[str]:
    """Return what a link may name of a page: its headings as GitHub and MyST spell them."""
    spelt: list[str] = []
    for title in titles(path):
        slug = re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-')
        again = sum(
            s == slug or re.fullmatch(rf'{re.escape(slug)}-\d+', s) is not None for s in spelt
        )
        spelt.append(f'{slug}-{again}' if again else slug)
    return set(spelt)


def sections(path: Path) -> dict[int, str]:
    """Return the titles of the numbered sections of a page."""
    found = [NUMBERED.fullmatch(title) for title in titles(path)]
    return {int(one[1]): one[2] for one in found if one}


def links(path: Path) -> Iterator[str]:
    """Return the targets in a page that lie in the checkout."""
    for match in LINK.finditer(INLINE_CODE.sub('', prose(path))):
        target = match[1] or match[2]
        if not re.match(r'[a-z]+:', target):
            yield target


def broken(path: Path) -> list[str]:
    """Return the links of a page that lead nowhere."""
    wrong = []
    for target in links(path):
        name, _, anchor = target.partition('#')
        goal = (path.parent / unquote(name)).resolve() if name else path
        if name and not (goal.exists() and goal.is_relative_to(CHECKOUT)):
            wrong.append(f'{target}: there is no {name}')
        elif anchor and (goal.suffix != '.md' or anchor not in anchors(goal)):
            wrong.append(f'{target}: {goal.name} has no section #{anchor}')
    return wrong


def miscited(text: str, where: Path) -> list[str]:
    """Return what a file of code cites of pages, and no page has."""
    # As one line: a citation may go on after the end of a line and a sign of comment.
    text = re.sub(r'\s*\n\s*(?:# )?', ' ', text)
    wrong = []
    for cited in CITATION.finditer(text):
        name = cited['page']
        beside = where.parent if where.is_relative_to(DOCS) else DOCS
        places = (CHECKOUT / name, beside / name, DOCS / name, DOCS / 'files' / name)
        page = next((p for p in places if p.is_file()), None)
        if page is None:
            wrong.append(f'{cited[0]}: there is no such page')
            continue
        numbered = sections(page)
        # Sections are cited by titles without their numbers: these may change.
        known = {*numbered.values(), *titles(page)}
        if cited['number'] and int(cited['number']) not in numbered:
            wrong.append(f'{cited[0]}: {name} has no section {cited["number"]}')
        if cited['title'] and cited['title'] not in known:
            wrong.append(f'{cited[0]}: {name} has no section of this title')
        linked = text[: cited.start()].endswith(('[', ']('))
        if page == MATHEMATICS and not (linked or cited['number'] or cited['title']):
            wrong.append(f'{cited[0]}{text[cited.end() : cited.end() + 20]}: names no section')
    return wrong


@pytest.mark.parametrize('page', PAGES, ids=lambda path: str(path.relative_to(CHECKOUT)))
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    assert not broken(page)


def test_every_citation_names_a_page_and_a_section_that_exist() -> None:
    texts = {path: path.read_text('utf-8') for path in CITING}
    # Pages have links; where they cite all the same, it is held to what is there as well.
    texts.update({path: INLINE_CODE.sub('', prose(path)) for path in PAGES})
    wrong = {str(path.relative_to(CHECKOUT)): miscited(text, path) for path, text in texts.items()}
    assert not {name: sentences for name, sentences in wrong.items() if sentences}


def test_the_page_of_readers_has_the_versions_that_are_installed_for_it() -> None:
    page = (DOCS / 'interoperability.md').read_text('utf-8')
    pinned = re.findall(r"'([a-z0-9-]+)==([\d.]+)'", (CHECKOUT / 'setup.py').read_text('utf-8'))
    package = json.loads((CHECKOUT / 'test/support/readers/package.json').read_text('utf-8'))
    pinned += package['dependencies'].items()
    assert len(pinned) > 10
    assert [pin for pin in pinned if ' '.join(pin).lower() not in page.lower()] == []


def test_each_finding_has_a_line_of_its_page() -> None:
    folder = CHECKOUT / 'findings'
    rows = re.findall(
        r'^\| \[(\w+)\]\(\1\.sh\) \| ', (folder / 'README.md').read_text('utf-8'), re.M
    )
    assert rows == sorted(path.stem for path in folder.glob('*.sh'))


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


def unknown_names(text: str) -> list[str]:
    """Return the citations `module.name` of modules of the package that lack the name."""
    cited = {tuple(c.split('.')[:2]) for c in DOTTED.findall(text)}
    modules = names_of_modules()
    return sorted('.'.join(c) for c in cited if c[0] in modules and c[-1] not in modules[c[0]])


def test_a_name_that_the_code_cites_of_a_module_exists() -> None:
    files = (CHECKOUT / 'imu_calib').rglob('*.py')
    wrong = {str(path): unknown_names(path.read_text('utf-8')) for path in files}
    assert not {name: names for name, names in wrong.items() if names}
    assert unknown_names('As `modulation.shapes`, not `modulation.forms`.') == ['modulation.forms']


def test_the_sections_of_the_mathematics_are_numbered_in_order() -> None:
    numbers = list(sections(MATHEMATICS))
    assert numbers == list(range(1, len(numbers) + 1))
    # The title of the page alone has no number.
    assert len(numbers) == len(titles(MATHEMATICS)) - 1


@pytest.mark.parametrize(
    'wrong',
    [
        'Source: methods.md, section 11.',
        'docs/nowhere.md',
        "docs/mathematics.md, 'Nothing of the kind'",
        'docs/mathematics.md, section 99',
        'Source: docs/mathematics.md,\n    # "Of two\n    # lines"',
        'fewer (docs/mathematics.md, rate test).',
    ],
)
def test_a_citation_of_what_is_not_there_is_found(wrong: str) -> None:
    assert len(miscited(wrong, CHECKOUT / 'imu_calib' / 'gravity.py')) == 1


def test_links_to_pages_and_sections_that_are_not_there_are_found(tmp_path: Path) -> None:
    page = DOCS / 'not_written.md'
    text = (
        '[a](methods.md#no-such-section) [b](nothing.md) `[c](code.md)` [d](https://x.org/y.md)\n'
    )
    written = tmp_path / page.name
    written.write_text(f'# Page\n\n{text}\n    [e](an_equation.md)\n\n```\n[f](block.md)\n```\n')
    assert list(links(written)) == ['methods.md#no-such-section', 'nothing.md']
    written.write_text('# Page\n\n[in itself](#page) [elsewhere](#elsewhere)\n')
    assert broken(written) == ['#elsewhere: not_written.md has no section #elsewhere']


@pytest.mark.parametrize('script', [command_line, messages])
def test_pages_of_options_and_messages_are_what_their_scripts_write(script: ModuleType) -> None:
    assert script.PAGE.read_text('utf-8') == script.page()


def test_every_option_and_every_field_is_on_its_page() -> None:
    options = command_line.PAGE.read_text('utf-8')
    for source in (CHECKOUT / 'imu_calib' / 'cli').glob('*.py'):
        added = re.findall(r"add_argument\(\s*(?:'-\w', )?'(--[\w-]+)'", source.read_text('utf-8'))
        assert not [option for option in added if option not in options]
    fields = messages.PAGE.read_text('utf-8')
    for source in messages.FOLDER.glob('*.msg'):
        for line in source.read_text('utf-8').splitlines():
            if line.strip() and not line.strip().startswith('#'):
                assert f'`{line.split("#")[0].split()[1]}`' in fields, line


def test_the_ros_documentation_job_finds_the_pages() -> None:
    named = ElementTree.parse(CHECKOUT / 'package.xml').findtext('export/rosdoc2')
    head, rest = yaml.safe_load_all((CHECKOUT / str(named)).read_text('utf-8'))
    assert head == {'type': 'rosdoc2 config', 'version': 1}
    (builder,) = rest['builders']
    folder = CHECKOUT / builder['sphinx']['sphinx_sourcedir']
    # It takes an index in reStructuredText, and writes its own beside any other.
    assert (folder / 'conf.py').is_file()
    assert (folder / 'index.rst').is_file()


@pytest.mark.parametrize(
    ('page', 'begins', 'ends_with'),
    [
        ('first_calibration', '## Look before you run', {'report': 3}),
        ('at_home', 'A simulated one:', {}),
    ],
)
def test_the_commands_of_a_page_print_what_it_shows(
    page: str,
    begins: str,
    ends_with: dict[str, int],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f'{page}.md').read_text('utf-8').partition(begins)[2].partition('## Is it')[0]
    blocks = ''.join(INDENTED.findall(FENCE.sub('', text))).splitlines()
    lines = [line.strip() for line in blocks if line.strip() not in ('', '...')]
    commands = [line for line in lines if re.match('imu-calib [a-z_]+ ', line)]
    printed = []
    for command in commands:
        words = command.split()[1:]
        assert main(words) == ends_with.get(words[0], 0), command
        printed += ''.join(capsys.readouterr()).splitlines()
    said = {' '.join(line.split()) for line in printed}
    assert [
        line for line in lines if line not in commands and ' '.join(line.split()) not in said
    ] == []
    assert len(commands) > 1 and len(lines) > len(commands)
