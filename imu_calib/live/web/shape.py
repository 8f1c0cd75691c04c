"""A turntable as solids on links: from its URDF, or from the joints of its own file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from xml.etree import ElementTree

import numpy as np

from ...common.errors import InputError
from ...common.files import read_text, share_folder, user_path
from ...common.rotations import rotation
from ...common.stream import Floats
from ...session.table import Table

Triple: TypeAlias = tuple[float, float, float]

_ORIGIN = (0.0, 0.0, 0.0)
_GREY = '#8c949e'
_COLOURS = ('#33609a', '#d98c26', '#4d8c4d')
"""Colours of the joints from the base outwards, as in the supplied URDF."""
_UNIT = '#1a1a1a'
_REACH = (0.45, 0.37, 0.29)
"""m from the centre to the arms of the links; sizes are only for display."""
_THICK = 0.06
"""m, of arms and bars."""
_X, _UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
_AXES = (('#d92626', 0), ('#2e9e41', 1), ('#2f6fde', 2))
"""Colours of x, y and z, and their indices."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A body of a link; lengths in m."""

    kind: str  #: 'box', 'cylinder' (along its own z) or 'sphere'.
    size: tuple[float, ...]  #: Edges of a box; radius and length of a cylinder; radius of a sphere.
    at: Triple  #: Its centre, in the link's frame.
    turned: Floats  #: (3, 3) its axes in the link's frame.
    colour: str  #: In HTML notation.


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid part of the table, and its joint to the previous one."""

    joint: str  #: Name of the joint that moves it; empty if it is fixed.
    axis: Floats  #: Of the joint, in the joint's frame.
    at: Triple  #: Origin of the joint's frame in the previous link's frame, m.
    turned: Floats  #: (3, 3) axes of the joint's frame there.
    zero: float  #: Angle to add to the encoder's, rad.
    solids: tuple[Solid, ...]  #: Its visible bodies.
    links: tuple[Link, ...]  #: The links attached to it.

    def pose(self, angle: float) -> Floats:
        """Return the (3, 3) rotation of the link against its joint's frame at an encoder angle."""
        return rotation(self.axis, angle + self.zero) if self.joint else np.eye(3)

    def walk(self) -> Iterator[Link]:
        """Yield this link and all links attached to it."""
        yield self
        for link in self.links:
            yield from link.walk()


def table_shape(table: Table, urdf: str = '') -> Link:
    """Return the base of a table with all links attached to it.

    Args:
        table: Its joints.
        urdf: File with its appearance; empty for the supplied one of its name, or one made from its
            joints.
    """
    path = user_path(urdf) if urdf else share_folder() / 'urdf' / f'{table.name}.urdf'
    if not urdf and not path.is_file():
        return _links_of_joints(table)
    base = _links_of_urdf(path)
    found = {link.joint for link in base.walk()}
    if lacking := [name for name in table.names if name not in found]:
        raise InputError(
            f'{path}: found the joints {", ".join(sorted(found - {""})) or "none"}, expected those '
            f'of table {table.name}: {", ".join(lacking)} missing.'
        )
    return base


def _links_of_urdf(path: Path) -> Link:
    """Read a URDF (XML as described in wiki.ros.org/urdf/XML); meshes are ignored."""
    try:
        robot = ElementTree.fromstring(read_text(path))
    except ElementTree.ParseError as error:
        raise InputError(f'{path}: is not XML: {error}.') from None
    try:
        return _robot(robot)
    except (KeyError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f'{path}: is not a URDF that can be shown: {error!r}.') from None


def _robot(robot: ElementTree.Element) -> Link:
    materials = {m.attrib['name']: _colour(m) for m in robot.findall('material')}
    solids = {
        link.attrib['name']: tuple(_solids(link, materials)) for link in robot.findall('link')
    }
    joints = robot.findall('joint')
    children = {_named(joint, 'child') for joint in joints}
    roots = [name for name in solids if name not in children]
    if len(roots) != 1:
        raise ValueError(f'found {len(roots)} links without a parent, expected one')

    def hung(name: str) -> tuple[Link, ...]:
        return tuple(link_of(joint) for joint in joints if _named(joint, 'parent') == name)

    def link_of(joint: ElementTree.Element) -> Link:
        at, turned = _origin(joint)
        element, child = joint.find('axis'), _named(joint, 'child')
        axis = _X if element is None else np.array(_numbers(element.attrib['xyz']))
        moves = joint.attrib['type'] in {'revolute', 'continuous'}
        name = joint.attrib['name'] if moves else ''
        axis = axis / np.linalg.norm(axis)
        return Link(name, axis, at, turned, 0.0, solids[child], hung(child))

    return Link('', _UP, _ORIGIN, np.eye(3), 0.0, solids[roots[0]], hung(roots[0]))


def _named(joint: ElementTree.Element, end: str) -> str:
    found = joint.find(end)
    if found is None:
        raise ValueError(f'joint {joint.attrib["name"]} has no {end}')
    return found.attrib['link']


def _solids(link: ElementTree.Element, materials: dict[str, str | None]) -> Iterator[Solid]:
    for visual in link.findall('visual'):
        at, turned = _origin(visual)
        material = visual.find('material')
        colour = None
        if material is not None:
            colour = _colour(material) or materials.get(material.attrib.get('name', ''))
        for body in visual.findall('geometry/*'):
            size: tuple[float, ...]
            if body.tag == 'box':
                size = _numbers(body.attrib['size'])
            elif body.tag == 'cylinder':
                size = float(body.attrib['radius']), float(body.attrib['length'])
            elif body.tag == 'sphere':
                size = (float(body.attrib['radius']),)
            else:
                continue
            yield Solid(body.tag, size, at, turned, colour or _GREY)


def _colour(material: ElementTree.Element) -> str | None:
    colour = material.find('color')
    if colour is None:
        return None
    shares = [float(part) for part in colour.attrib['rgba'].split()[:3]]
    return '#' + ''.join(f'{round(255 * min(max(share, 0.0), 1.0)):02x}' for share in shares)


def _origin(element: ElementTree.Element) -> tuple[Triple, Floats]:
    """Return position and (3, 3) axes of an element's frame: roll, pitch, yaw about fixed axes."""
    origin = element.find('origin')
    if origin is None:
        return _ORIGIN, np.eye(3)
    roll, pitch, yaw = _numbers(origin.attrib.get('rpy', '0 0 0'))
    turned = rotation(_UP, yaw) @ rotation(np.array([0.0, 1.0, 0.0]), pitch) @ rotation(_X, roll)
    return _numbers(origin.attrib.get('xyz', '0 0 0')), turned


def _numbers(text: str) -> Triple:
    x, y, z = (float(part) for part in text.split())
    if not all(math.isfinite(v) for v in (x, y, z)):
        raise ValueError(f'{text} are not numbers')
    return x, y, z


def _links_of_joints(table: Table) -> Link:
    """Draw links that show the motion of the joints: a yoke spans the axis of the next joint."""
    axes = [np.array(joint.axis) for joint in table.joints]
    link: Link | None = None
    for k in reversed(range(len(axes))):
        joint, colour = table.joints[k], _COLOURS[k]
        if link is None:
            solids = (*_plate(axes[k], colour), *_unit(table.mount))
            hung: tuple[Link, ...] = ()
        else:
            solids, hung = tuple(_yoke(axes[k], axes[k + 1], _REACH[k], colour)), (link,)
        link = Link(joint.name, axes[k], _ORIGIN, np.eye(3), joint.zero, solids, hung)
    assert link is not None
    foot = _seen_from(axes[0], -0.55)
    base = Solid('cylinder', (0.28, 0.10), foot, _along(axes[0]), _GREY)
    return Link('', _UP, _ORIGIN, np.eye(3), 0.0, (base,), (link,))


def _plate(axis: Floats, colour: str) -> Iterator[Solid]:
    """Yield the plate that carries the unit, and its shaft."""
    yield Solid('cylinder', (0.22, 0.03), _seen_from(axis, -0.12), _along(axis), colour)
    if abs(axis @ _UP) < 0.5:
        yield Solid('cylinder', (0.03, 0.70), _ORIGIN, _along(axis), colour)


def _yoke(axis: Floats, after: Floats, reach: float, colour: str) -> Iterator[Solid]:
    """Yield a bar below and an arm at either end of the next joint."""
    turned = np.column_stack([after, np.cross(axis, after), axis])
    if abs(axis @ after) > 0.5:
        yield Solid('cylinder', (reach, 0.04), _seen_from(axis, -reach), _along(axis), colour)
        return
    yield Solid('box', (2 * reach, 0.16, _THICK), _seen_from(axis, -reach), turned, colour)
    for side in (-reach, reach):
        x, y, z = (side * after - reach / 2 * axis).tolist()
        yield Solid('box', (_THICK, 0.16, reach + _THICK), (x, y, z), turned, colour)


def _unit(mount: Floats) -> Iterator[Solid]:
    """Yield the unit, and its axes X, Y, Z in red, green and blue."""
    yield Solid('box', (0.20, 0.16, 0.12), _ORIGIN, mount, _UNIT)
    for colour, k in _AXES:
        x, y, z = (0.17 * mount[:, k]).tolist()
        yield Solid('cylinder', (0.012, 0.16), (x, y, z), _along(mount[:, k]), colour)


def _seen_from(axis: Floats, distance: float) -> Triple:
    x, y, z = (distance * axis).tolist()
    return x, y, z


def _along(axis: Floats) -> Floats:
    """Return (3, 3) axes whose z is parallel to a unit vector."""
    helper = _X if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(helper, axis)
    across = across / np.linalg.norm(across)
    return np.column_stack([np.cross(across, axis), across, axis])
