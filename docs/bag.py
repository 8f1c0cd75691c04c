"""Draw how a unit is held and turned in the hand, for docs/bag.md: `python docs/bag.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imu_calib.common.rotations import rotation

PICTURE = Path(__file__).with_name('bag.svg')

Floats = NDArray[np.float64]

CELL, ROWS, COLUMNS = 150, 2, 5
HALF = np.array([1.0, 0.72, 0.3])
"""Of the board: X along its long edge, Z out of its upper face."""
SCALE = 34.0
UP = np.array([0.0, 0.0, 1.0])
AXES = {'X': '#c0392b', 'Y': '#1e8449', 'Z': '#1f5fbf'}
DEG = np.pi / 180

ABOUT = {name: np.eye(3)[k] for k, name in enumerate(AXES)}
HOLDS = [
    ('Z up', []),
    ('Z down', [('X', 180)]),
    ('X up', [('Y', -90)]),
    ('X down', [('Y', 90)]),
    ('Y up', [('X', 90)]),
    ('Y down', [('X', -90)]),
    ('on an edge', [('X', 45)]),
    ('on an edge', [('Y', -45)]),
    ('on a corner', [('X', 45), ('Y', -35)]),
    ('on a corner', [('X', -135), ('Y', 35)]),
]
"""What is up, and by which turns (about axes of the room, deg) the board gets there."""


def attitude(turns: list[tuple[str, float]]) -> Floats:
    """Return the rotation (3, 3) from the board to the room."""
    turned = np.eye(3)
    for axis, degrees in turns:
        turned = rotation(ABOUT[axis], degrees * DEG) @ turned
    return turned


def projected(points: Floats) -> Floats:
    """Return points (n, 3) of the room in the picture, (n, 2): seen from front and above."""
    across, into = 30 * DEG, 24 * DEG
    x, y, z = points.T
    right = x * np.cos(across) - y * np.sin(across)
    depth = x * np.sin(across) + y * np.cos(across)
    return np.column_stack([right, -(z * np.cos(into) + depth * np.sin(into))]) * SCALE


def towards() -> Floats:
    """Return the direction (3,) to the eye."""
    across, into = 30 * DEG, 24 * DEG
    return np.array([-np.sin(across) * np.cos(into), -np.cos(across) * np.cos(into), np.sin(into)])


def board(turned: Floats, left: float, top: float) -> list[str]:
    """Draw the board with its axes: those that point away from the eye are behind it."""
    middle = np.array([left, top])
    away = [turned[:, k] @ towards() < 0 for k in range(len(AXES))]
    arrows = [arrow(turned, k, middle) for k in range(len(AXES))]
    behind = [one for one, hidden in zip(arrows, away, strict=True) if hidden]
    before = [one for one, hidden in zip(arrows, away, strict=True) if not hidden]
    return [*behind, *faces(turned, middle), *before]


def faces(turned: Floats, middle: Floats) -> list[str]:
    """Draw the faces that are seen; the side with the parts on it is green."""
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * HALF
    parts = []
    for axis in range(3):
        for sign in (-1, 1):
            normal = turned[:, axis] * sign
            if normal @ towards() <= 0:
                continue
            mine = corners[np.sign(corners[:, axis]) == sign]
            # Around the face: the last two corners change places.
            around = projected(mine[[0, 1, 3, 2]] @ turned.T) + middle
            shade = int(150 + 90 * max(0.0, float(normal @ UP)))
            colour = '#a9d8bb' if (axis, sign) == (2, 1) else f'rgb({shade},{shade},{shade - 12})'
            points = ' '.join(f'{x:.1f},{y:.1f}' for x, y in around)
            parts.append(f'<polygon points="{points}" fill="{colour}" class="edge"/>')
    return parts


def arrow(turned: Floats, axis: int, middle: Floats) -> str:
    """Draw an axis from the face that it comes out of."""
    name = 'XYZ'[axis]
    colour, direction = AXES[name], turned[:, axis]
    reach = np.array([HALF[axis], HALF[axis] + 0.65, HALF[axis] + 0.95])
    begin, end, beyond = projected(reach[:, None] * direction) + middle
    return (
        f'<line x1="{begin[0]:.1f}" y1="{begin[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" '
        f'stroke="{colour}" stroke-width="2.5" marker-end="url(#{name})"/>'
        f'<text x="{beyond[0]:.1f}" y="{beyond[1] + 4:.1f}" fill="{colour}" class="axis">'
        f'{name}</text>'
    )


def picture() -> str:
    """Return the SVG."""
    width, height = COLUMNS * CELL, ROWS * (CELL + 32) + 10
    heads = ''.join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="5" refY="4" markerWidth="5" markerHeight="5" '
        f'orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="{colour}"/></marker>'
        for name, colour in AXES.items()
    )
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" '
        'aria-label="Ten attitudes of a circuit board: each face up, edges and corners">',
        f'<defs>{heads}</defs>',
        '<style>text{font:13px sans-serif;text-anchor:middle}.axis{font-weight:bold}'
        '.edge{stroke:#333;stroke-width:1}.word{fill:#333}.floor{stroke:#bbb;stroke-width:1}'
        '</style>',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for k, (words, turns) in enumerate(HOLDS):
        left = (k % COLUMNS + 0.5) * CELL
        top = (k // COLUMNS) * (CELL + 32) + CELL / 2 + 6
        parts += board(attitude(turns), left, top)
        parts.append(
            f'<text x="{left:.0f}" y="{top + CELL / 2 + 14:.0f}" class="word">'
            f'{k + 1}. {words}</text>'
        )
    return '\n'.join([*parts, '</svg>', ''])


if __name__ == '__main__':
    PICTURE.write_text(picture(), encoding='utf-8')
