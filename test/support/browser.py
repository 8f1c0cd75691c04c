"""What a browser makes of a page: measured in Chromium, where there is one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import processes
import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome')
CHROMIUM = next(filter(None, [os.environ.get('CHROMIUM'), *map(shutil.which, NAMES)]), None)
_ARGUMENTS = [
    # WebGL without a graphics card.
    '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader',
    # WebGL alone goes that way: to put pages together so, too, takes a fifth of a core at rest.
    '--disable-gpu-compositing',
    # Its own sandbox refuses root, which containers are run as.
    *(['--no-sandbox'] if os.geteuid() == 0 else []),
]
A4 = 695
"""CSS px between the margins of the report's pages: 184 mm."""

needs_chromium = pytest.mark.skipif(
    CHROMIUM is None or find_spec('playwright') is None,
    reason='chromium or playwright is not installed',
)

_TEXTS = """
() => {
  const seen = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walk.nextNode(); node; node = walk.nextNode()) {
    const parent = node.parentElement;
    if (!node.data.trim() || parent.tagName === 'title') continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    let clip = {left: -1e9, right: 1e9};
    for (let box = parent; box; box = box.parentElement)
      if (getComputedStyle(box).overflowX !== 'visible' && box !== document.body) {
        const around = box.getBoundingClientRect();
        clip = {left: Math.max(clip.left, around.left), right: Math.min(clip.right, around.right)};
      }
    for (const box of range.getClientRects()) {
      // A line's box is higher than its letters: what stands above and below them is empty.
      const spare = 0.2 * box.height;
      const left = Math.max(box.left, clip.left), right = Math.min(box.right, clip.right);
      if (right - left > 1 && box.height > 1)
        seen.push({text: node.data.trim().slice(0, 60), left, right,
                   top: box.top + spare, bottom: box.bottom - spare});
    }
  }
  return seen;
}
"""
_OVERFULL = """
() => [...document.querySelectorAll('td, th, dt, dd, figcaption, p, li, h1, h2, h3')]
  .filter(box => box.scrollWidth > box.clientWidth + 1 && getComputedStyle(box).display != 'none')
  .map(box => box.textContent.slice(0, 60))
"""
_WIDTH = '() => document.documentElement.scrollWidth'
_CONTRAST = """
() => {
  const parts = c => (c.match(/[\\d.]+/g) || []).map(Number);
  const linear = v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = c => { const [r, g, b] = parts(c).map(linear);
                       return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const found = [];
  for (const box of document.querySelectorAll('body *')) {
    const own = [...box.childNodes].some(n => n.nodeType === 3 && n.data.trim());
    if (!own || box.tagName === 'title' || box.classList.contains('inside')) continue;
    const style = getComputedStyle(box);
    const ink = box.namespaceURI.endsWith('svg') ? style.fill : style.color;
    let paper = box;
    while (paper && (parts(getComputedStyle(paper).backgroundColor)[3] ?? 1) === 0)
      paper = paper.parentElement;
    const a = light(ink);
    const b = light(paper ? getComputedStyle(paper).backgroundColor : 'rgb(255, 255, 255)');
    found.push({text: box.textContent.slice(0, 40), ratio: (Math.max(a, b) + 0.05)
                / (Math.min(a, b) + 0.05), paper: b});
  }
  return found;
}
"""


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser that is started; the test is skipped where there is none."""
    if CHROMIUM is None:
        pytest.skip(f'no Chromium is installed (looked for {", ".join(NAMES)})')
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=_ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@pytest.fixture(scope='module')
def browser():
    """A browser for all tests of a file: to start one takes longer than to look at a page."""
    with ExitStack() as started:
        with processes.kept():
            found = started.enter_context(chromium())
        yield found


@contextmanager
def opened(browser: Any, path: Path) -> Iterator[Any]:
    """A page in a window, see `look_at`; a request to anywhere fails."""
    window = browser.new_context(offline=True)
    page = window.new_page()
    page.goto(path.resolve().as_uri())
    try:
        yield page
    finally:
        window.close()


def look_at(page: Any, width: int, *, dark: bool = False, paper: bool = False) -> None:
    """Have a page laid out in a window of a width, in the light or the dark, or on paper."""
    page.set_viewport_size({'width': width, 'height': 900})
    page.emulate_media(
        media='print' if paper else 'screen', color_scheme='dark' if dark else 'light'
    )


def overlaps(page: Any) -> list[tuple[str, str]]:
    """Pairs of texts that stand on each other by more than a pixel in both directions."""
    boxes = sorted(page.evaluate(_TEXTS), key=lambda b: b['top'])
    assert boxes
    found = []
    for k, one in enumerate(boxes):
        for other in boxes[k + 1 :]:
            if other['top'] > one['bottom'] - 1:
                break
            across = min(one['right'], other['right']) - max(one['left'], other['left'])
            if across > 1:
                found.append((one['text'], other['text']))
    return found


def overfull(page: Any) -> list[str]:
    """Texts that are wider than the box that they stand in."""
    return list(page.evaluate(_OVERFULL))


def width(page: Any) -> int:
    """How wide the page is: beyond the window's width it has to be pushed about."""
    return int(page.evaluate(_WIDTH))


def contrasts(page: Any) -> list[dict[str, Any]]:
    """Of every text its contrast with what it stands on, and the luminance of that (WCAG 2.1)."""
    return list(page.evaluate(_CONTRAST))
