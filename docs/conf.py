"""How Sphinx makes the documentation site: `sphinx-build -W -n docs OUTPUT`."""

import os
import re
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

# The checkout: above this file, or where rosdoc2, which builds from a copy, finds the package.
ROOT = Path(__file__).resolve().parents[1]
if not (ROOT / 'imu_calib' / '__init__.py').is_file():
    ROOT = Path(str(import_module('imu_calib').__file__)).resolve().parents[1]
sys.path.insert(0, str(ROOT))
DOCS = ROOT / 'docs'

project = 'imu_calib'
author = 'The imu_calib developers'
copyright = author  # noqa: A001
version = release = import_module('imu_calib.common.files').version()

# Where only the parser of pages is installed, as on the ROS build farm, notebooks are left out.
NOTEBOOKS = find_spec('myst_nb') is not None
PARSER, PAGE = ('myst_nb', 'myst-nb') if NOTEBOOKS else ('myst_parser', 'markdown')
extensions = [PARSER, 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
source_suffix = {'.md': PAGE, '.rst': 'restructuredtext'}
if NOTEBOOKS:
    source_suffix['.ipynb'] = PAGE
# What they print is committed; tests run them.
nb_execution_mode = 'off'
# rosdoc2 puts copies of README and the like beside the pages, which are there already.
exclude_patterns = [
    '_build',
    '**/.ipynb_checkpoints',
    'README.md',
    'CONTRIBUTING.md',
    'CHANGELOG.rst',
    '__*',
]

# For `-b linkcheck`: a page served on the reader's own machine answers nobody else.
linkcheck_ignore = [r'http://127\.0\.0\.1']

html_theme = 'furo'
html_title = 'imu_calib'
html_show_sphinx = False
html_show_copyright = False
html_static_path = ['_static']
html_css_files = ['site.css']

# Anchors as GitHub spells them, so that one link leads there in both.
myst_heading_anchors = 4

# Docstrings set code between single marks.
default_role = 'literal'
autodoc_typehints = 'description'
autodoc_typehints_description_target = 'documented_params'
autodoc_member_order = 'bysource'
autodoc_class_signature = 'mixed'
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# What other packages document: no inventory is fetched, so that a build needs no network.
nitpick_ignore_regex = [
    (
        r'py:.*',
        r'(numpy|np|numpy\.typing|collections|pathlib|typing|types|contextlib|datetime|pandas|matplotlib)\..*',
    ),
    ('py:class', 'Figure|TopicClock|datetime'),
    # Values within others, which have no page, and names for a choice of types.
    (
        'py:class',
        r'imu_calib\.(common\.(parallel\.Show|files\.AnyFile)|session\.imu\.Verdict|recordings\.remote\..*'
        r'|estimation\.(search|common_unknowns|checks)\..*|calibration\.(agreement|results|noise_at_rest)\..*'
        r'|live\.stand_client\.RunFeedback|segmentation\.course\..*|simulation\.repetition\.RunStatistics|reports\..*|session\.keywords\..*|api\.(inspect|session)\..*|fleet\.batch\..*)',
    ),
    (
        'py:class',
        'Named|Floats|ArrayLike|Recorded|LabelledValues|AnyCalibration|Progress|Fields|Assessed|StreamContents|Topic|Stated|Basis|SearchResult|Path'
        '|pa.Table',
    ),
]

BORROWED = {
    DOCS / 'contributing.md': ROOT / 'CONTRIBUTING.md',
    DOCS / 'changelog.rst': ROOT / 'CHANGELOG.rst',
}
"""Pages whose text lies where GitHub and ROS look for it."""

# A table of contents of a folder.
_GLOB = re.compile(r'\.\. toctree::\n(?: +:.*\n)* +:glob:\n\n +(\w+)/\S+\n(?: +\S+\n)*\n')
_LINK = re.compile(r'(?P<text>\[[^][]*\])\((?P<target>[^()\s#:]+)(?P<anchor>#[^()\s]*)?\)')


def read_source(app: Sphinx, page: str, source: list[str]) -> None:
    """Take a borrowed page from where it lies, and lead links out of this folder."""
    here = DOCS / app.env.doc2path(page, base=False)
    lies = BORROWED.get(here, here)
    if lies != here:
        app.env.note_dependency(str(lies))
        source[0] = lies.read_text('utf-8')
    if here.suffix == '.md':
        source[0] = led(source[0], lies.parent, here.parent, Path(app.srcdir))
    elif page == 'index':
        # Sphinx warns of patterns that nothing matches.
        source[0] = _GLOB.sub(lambda t: t[0] if any(DOCS.glob(f'{t[1]}/*.md')) else '', source[0])


def led(text: str, lies: Path, page: Path, source: Path) -> str:
    """Return the text of a page with its links as the site has them.

    Pages lead to pages, files beside the documentation are for download, folders are named.

    Args:
        text: Of a page in Markdown.
        lies: The folder to which its links are relative.
        page: The folder below docs in which the site has it.
        source: The folder from which Sphinx builds: docs, or a copy of it.
    """
    borrowed = {theirs: ours for ours, theirs in BORROWED.items()}

    def replace(link: re.Match[str]) -> str:
        goal = (lies / link['target']).resolve()
        goal = borrowed.get(goal, goal)
        if goal.is_dir():
            return '`' + link['text'][1:-1].strip('`') + '`'
        inside = goal.is_relative_to(DOCS)
        way = os.path.relpath(goal, page if inside else source / page.relative_to(DOCS))
        # A page that is called by the name of its file is called by its title.
        named = inside and link['text'][1:-1] in (goal.name, link['target'])
        text = '[]' if named and not link['anchor'] else link['text']
        return f'{text}({way}{link["anchor"] or ""})' if goal.exists() else link[0]

    return _LINK.sub(replace, text)


def whole_words(
    _app: Sphinx, what: str, _name: str, _obj: Any, _options: Any, lines: list[str]
) -> None:
    """Keep napoleon from reading `Of the unit: ...` beside a field as a type and its words."""
    if what == 'attribute':
        # An escaped space: a first line without a colon.
        lines.insert(0, '\\ ')


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect what the pages need."""
    app.connect('source-read', read_source)
    app.connect('autodoc-process-docstring', whole_words, priority=400)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
