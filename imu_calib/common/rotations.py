"""Rotations: matrices from axes, angles and rotation vectors, and their inverses.

Closed forms serve single rotations and the samples of one motion: scipy.spatial.transform takes
0.3 s to import, which reading a plan or a table would pay, and for one rotation twice (matrix) to
fifteen times (vector) as long. It is used for inverses of many rotations of up to half a turn.
Source of the closed forms: Rodrigues; docs/mathematics.md, "Moves", has those of paths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .stream import Floats

GENERATORS = np.array(
    [
        [[0.0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0.0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ]
)
"""Derivatives of rotations about x, y and z at zero."""
_IDENTITY = np.eye(3)
_NONE = 1e-20  #: rad: replaces a zero angle in divisions; its sine is equal to it.


def cross_matrix(vector: Floats) -> Floats:
    """Return the (3, 3) matrix of the cross product with (3,)."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation(axis: Floats, angle: Floats | float) -> Floats:
    """Return the rotation matrices (..., 3, 3) about a unit axis (3,) by (...) rad (Rodrigues)."""
    cross = cross_matrix(axis)
    sine = np.sin(angle)[..., None, None]
    versine = (1 - np.cos(angle))[..., None, None]
    return np.asarray(_IDENTITY + sine * cross + versine * (cross @ cross))


def in_rotated_frame(rows: Floats, axis: Floats, angle: Floats) -> Floats:
    """Return rows @ rotation(axis, angle): vectors (..., 3) in the rotated frame.

    The axis is a unit vector (3,); the angles, rad, are (...), or one for all.
    """
    return all_in_rotated_frame([rows], axis, angle)[0]


def all_in_rotated_frame(several: Sequence[Floats], axis: Floats, angle: Floats) -> list[Floats]:
    """Return `in_rotated_frame` of several arrays of vectors, by the same angles."""
    if angle.size == 1:
        turn = rotation(axis, float(angle.flat[0]))
        return [rows @ turn for rows in several]
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    project, cross = np.outer(axis, axis), cross_matrix(axis)
    turned = []
    for rows in several:
        along = rows @ project
        turned.append(along + cosine * (rows - along) + sine * (rows @ cross))
    return turned


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (n, 3, 3) of (n, 3) rotation vectors (Rodrigues)."""
    return np.ascontiguousarray(np.moveaxis(rotations_last(vectors), -1, 0))


def rotations_last(vectors: Floats) -> Floats:
    """Return `rotations` with the index of the vector last, (3, 3, n), as `product` takes them."""
    along = np.ascontiguousarray(vectors.T)
    square = (along**2).sum(axis=0)
    half = np.sqrt(square) / 2
    half[half == 0] = _NONE
    ratio = np.sin(half) / half
    versine = 0.5 * ratio**2
    # The square of a cross product's matrix is v v' - v'v.
    result = along[:, None] * (versine * along)
    result[range(3), range(3)] += 1 - versine * square
    crossed = ratio * np.cos(half) * along
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        result[i, j] -= crossed[k]
        result[j, i] += crossed[k]
    return np.asarray(result)


def product(first: Floats, second: Floats) -> Floats:
    """Return the products of n matrices with n others, (3, 3, n) each.

    NumPy multiplies small matrices one by one, and takes ten times as long.
    """
    result = first[:, 0, None] * second[0]
    result += first[:, 1, None] * second[1]
    result += first[:, 2, None] * second[2]
    return np.asarray(result)


def _twice_sine(matrix: Floats) -> Floats:
    """Return the axes of rotations (..., 3, 3) times twice the sine of their angles, (..., 3)."""
    back = np.swapaxes(matrix, -1, -2)
    return np.asarray((matrix - back)[..., (2, 0, 1), (1, 2, 0)])


def rotation_vector(matrix: Floats) -> Floats:
    """Return the rotation vectors (..., 3) of rotations below half a turn, (..., 3, 3)."""
    axis = _twice_sine(matrix)
    sine = np.linalg.norm(axis, axis=-1) / 2
    cosine = (np.trace(matrix, axis1=-2, axis2=-1) - 1) / 2
    turned = sine > 0
    ratio = np.where(turned, np.arctan2(sine, cosine) / np.where(turned, 2 * sine, 1.0), 0.5)
    return np.asarray(axis * ratio[..., None])


def rotation_vectors(matrices: Floats) -> Floats:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3) by up to half a turn."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrices).as_rotvec())


def angle_between(first: Floats, second: Floats) -> Floats:
    """Return the angles (...) of the rotations between attitudes (..., 3, 3), rad."""
    cosine = (np.einsum('...ij,...ij->...', first, second) - 1) / 2
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def angle_about(axis: Floats, matrix: Floats) -> float:
    """Return the angle of the rotation about an axis that comes closest to a matrix."""
    sine = float(axis @ _twice_sine(matrix))
    return math.atan2(sine, float(np.trace(matrix) - axis @ matrix @ axis))


def shortest(start: Floats, end: Floats) -> Floats:
    """Return the rotation (3, 3) that takes a unit vector to another the short way.

    The opposite vector is excluded: all ways to it are equally short.
    """
    cross = cross_matrix(np.cross(start, end))
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + float(start @ end)))


def cross(first: Floats, second: Floats) -> Floats:
    """Return the cross products (..., 3) of vectors (..., 3) with others.

    Equal to `numpy.cross`, which takes twice as long for the few vectors here.
    """
    x, y, z = first[..., 0], first[..., 1], first[..., 2]
    u, v, w = second[..., 0], second[..., 1], second[..., 2]
    result = np.empty(np.broadcast_shapes(first.shape, second.shape))
    result[..., 0] = y * w - z * v
    result[..., 1] = z * u - x * w
    result[..., 2] = x * v - y * u
    return result


def across(direction: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors (..., 3) at right angles to (..., 3) unit vectors and to each other.

    With the direction as the third they are right-handed.
    """
    other = np.eye(3)[np.abs(direction).argmin(axis=-1)]
    first = cross(direction, other)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return first, cross(direction, first)
