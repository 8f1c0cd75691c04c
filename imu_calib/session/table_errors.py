"""Errors of a table beyond its description: levelling, positioning, axes, zeros and encoders.

A joint nominally turns by R(axis, a): its axis may lean, its zero be off, its encoder err within
the turn and its axis wobble with the angle a. Errors are small: attitudes follow them to first
order.

Source: docs/mathematics.md, "The table's own errors".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.config import Section
from ..common.errors import InputError
from ..common.rotations import across
from ..common.stream import Floats
from ..common.units import ARCSEC, DEG, Dimension

LEVELLED = 20 * ARCSEC
"""Standard deviation of a table's tilt about either axis: a tenth of a millimetre on a metre, five
divisions of a machinist's level of 0.02 mm/m."""

ASSUMED: Mapping[str, float] = {
    'positioning': 2 * ARCSEC,
    'level': LEVELLED,
    'zeros': 30 * ARCSEC,
    'orthogonality': 30 * ARCSEC,
    'wobble': 2 * ARCSEC,
    'encoder': 3 * ARCSEC,
}
"""Standard deviations assumed where a table's file states none, rad: those of a good laboratory
table.

For units of navigation grade Ruyang Precision, a manufacturer of such tables, requires positions
within 10 arcsec and axes perpendicular within 5 arcsec ("Standard process for IMU two-dimensional
calibration using a dual axis turntable", ruya-t.com). As limits of a uniform law (GUM 4.3.7) these
are 5.8 and 2.9 arcsec. The 5.8 are shared among positioning errors, the encoder's two harmonics and
those of the wobble: the root of 2^2 + 2 x 3^2 + 2 x 2^2 is 5.5.

A zero is an angle between two joints. Without an autocollimator it is set with the level used for
levelling the table: on the plate, against gravity, with the axis before vertical to 20 arcsec. The
root of 20^2 + 20^2 is 28, rounded up. With the 20 arcsec of one levelling, 4 of 60 sessions on
zeros off by 60 were wrong by up to 6.5 deviations ("zeros 60 arcsec" of docs/imperfect_stands.py);
only the frame depends on a zero.

Right angles are assumed to be less accurate. A session shows worse positions, but a lean of the
axes is mostly a rotation of all misalignments, which sensors cannot show. So the assumption is the
accuracy of a mechanic's square and dial gauge: 0.05 mm on 200 mm, 52 arcsec, and 30 as a uniform
law (a judgement). With 3 arcsec six of 60 sessions on axes off by 60 were wrong by up to 24
deviations ("orthogonality 60 arcsec" of docs/imperfect_stands.py). Each session estimates the
errors of the axes that its moves determine.
"""

FINEST = 1 * ARCSEC
"""Least standard deviation assumed for any error of a table.

Makers of the best tables, on rotary air bearings, state a wobble below 1 arcsec
(physikinstrumente.com, "Air Bearing Technology"), and for axes on custom-built air bearings right
angles within 2 arcsec (Dover Motion, "Motion Control Handbook", linear positioning accuracy), as a
uniform law 1.2. Autocollimators and polygons, by which tables are measured, are not better (a
judgement).
"""

_BETWEEN_JOINTS = {'zeros', 'orthogonality'}
_ROUNDING = 1e-9
"""Relative tolerance for a number read with its unit."""
_WORST = 1 * DEG
"""Largest error: beyond it the description is wrong, since angles follow errors to first order."""


@dataclass(frozen=True)
class TableErrors:
    """Standard deviations of a table's unknown errors, rad; 0 for none.

    Attributes:
        zeros: Of each joint's zero except the first's, which is the azimuth.
        orthogonality: Of each joint's axis about either direction across it, except the first's,
            which is the tilt.
        wobble: Of an axis about either direction across it, once and twice per turn, each.
        encoder: Error of an encoder within the turn, once and twice per turn, each.
    """

    zeros: float = 0.0
    orthogonality: float = 0.0
    wobble: float = 0.0
    encoder: float = 0.0

    @property
    def exact(self) -> bool:
        """Whether there are no unknown errors."""
        return not any((self.zeros, self.orthogonality, self.wobble, self.encoder))


@dataclass(frozen=True)
class ErrorSizes:
    """Errors stated in a table's file.

    Attributes:
        sizes: Standard deviations by key, rad.
        assumed: Keys missing in the file: their values are those of `ASSUMED`.
        raised: Keys with stated values below `FINEST`, which replaces them.
    """

    sizes: Mapping[str, float]
    assumed: tuple[str, ...]
    raised: tuple[str, ...]


def read_error_sizes(section: Section, joints: int) -> ErrorSizes:
    """Read a table's own errors from its mapping, and fill in the missing ones.

    Args:
        section: The mapping. A simulated table may be exact: its stated values are not raised.
        joints: Number of joints: a single one has no orthogonality.

    Raises:
        InputError: Key, what was found and what was expected.
    """
    counts = counting(joints)
    least = 0.0 if section.flag('simulated', default=False) else FINEST
    sizes, raised = {}, []
    for key, usual in ASSUMED.items():
        size = section.quantity(key, Dimension.ANGLE, usual if key in counts else 0.0)
        if not 0 <= size <= _WORST or (key == 'level' and not size):
            lowest = 'more than 0' if key == 'level' else '0'
            raise InputError(
                f'{section.key(key)}: found {size / DEG:g} deg, expected {lowest} to '
                f'{_WORST / DEG:g} deg.'
            )
        if key in counts and key != 'level' and size < least * (1 - _ROUNDING):
            size = least
            raised.append(key)
        sizes[key] = size
    left_out = tuple(key for key in counts if not section.has(key))
    return ErrorSizes(sizes, left_out, tuple(raised))


def counting(joints: int) -> list[str]:
    """Return the keys of `ASSUMED` that apply to so many joints."""
    return [key for key in ASSUMED if joints > 1 or key not in _BETWEEN_JOINTS]


def assumption(table: str, assumed: Sequence[str], raised: Sequence[str]) -> str:
    """Return the sentences on the assumptions for a table, by the keys of `ErrorSizes`."""
    figures = ', '.join(f'{key} {ASSUMED[key] / ARCSEC:g} arcsec' for key in assumed)
    sentences = []
    if assumed:
        sentences.append(
            f'Table {table} is assumed to be as good as a laboratory table where its file says '
            f'nothing: {figures} (standard deviations); state its own under these keys.'
        )
    if raised:
        sentences.append(
            f'No error of a table is known below {FINEST / ARCSEC:g} arcsec: as much is assumed of '
            f'{", ".join(raised)} of table {table}, of which its file states less.'
        )
    return ' '.join(sentences)


@dataclass(frozen=True, eq=False)
class JointPoses:
    """A joint at n attitudes of a table.

    Attributes:
        axis: (3,) in the frame of the joint before it.
        read: (n,) its encoder readings, rad.
        turned: (n, 3, 3) its rotation.
        body: (n, 3, 3) from body axes to its rotated frame.
    """

    axis: Floats
    read: Floats
    turned: Floats
    body: Floats


def attitude_errors(joints: Sequence[JointPoses], errors: TableErrors) -> Floats:
    """Return the rotation of attitudes about the body axes by one standard deviation of each error.

    Returns:
        (n, 3, e) rad.
    """
    columns: list[Floats] = []
    for k, joint in enumerate(joints):
        inside = np.swapaxes(joint.body, 1, 2)
        # From the frame of the joint before, in which its axis wobbles and leans.
        outside = inside @ np.swapaxes(joint.turned, 1, 2)
        # Cosine and sine share the variance, so that the error itself has the stated size.
        waves = [f(m * joint.read) / math.sqrt(2) for m in (1, 2) for f in (np.cos, np.sin)]
        about = inside @ joint.axis
        if errors.encoder:
            columns += [errors.encoder * wave[:, None] * about for wave in waves]
        if k and errors.zeros:
            columns.append(errors.zeros * about)
        for direction in across(joint.axis):
            if errors.wobble:
                columns += [errors.wobble * wave[:, None] * (outside @ direction) for wave in waves]
            if k and errors.orthogonality:
                columns.append(errors.orthogonality * (outside - inside) @ direction)
    return np.stack(columns, axis=2) if columns else np.zeros((len(joints[0].read), 3, 0))
