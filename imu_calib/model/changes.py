"""Changes of parameters with time or temperature in a session: a value and its section of a file.

Source: docs/mathematics.md, 'Terms of a session'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..common.config import Section
from ..common.errors import InputError
from ..common.rotations import is_covariance
from ..common.stream import Floats
from ..common.units import significant
from .model_parameters import Parameter
from .session_terms import Change, Course, change, names_of

KEY = 'session_terms'
"""Section in calibration.yaml."""
_ROUNDED = 1e-6
"""Ratio by which a stated standard deviation may differ from that of the covariance."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Estimated coefficients of a session's terms.

    Attributes:
        changes: The k coefficients.
        values: (k,) SI units.
        covariance: (k, k) of them.
        cross: (n, k) covariance of the parameters of the sensors and them.
        time_constant: Of a warm-up, s; NaN without one.
        instant: Of a step, s by the stamps of the table; NaN without one.
    """

    changes: tuple[Change, ...]
    values: Floats
    covariance: Floats
    cross: Floats
    time_constant: float = float('nan')
    instant: float = float('nan')

    @property
    def std(self) -> Floats:
        """(k,) standard deviations, SI units."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def follows_temperature(self) -> bool:
        """Whether parameters change with the temperature, for which compensation corrects."""
        return any(c.course is Course.THERMAL for c in self.changes)

    def by_kelvin(self, parameters: Sequence[Parameter]) -> Floats:
        """Return the derivatives of parameters by the coefficients, per K, (n, k)."""
        found = np.zeros((len(parameters), len(self.changes)))
        for k, one in enumerate(self.changes):
            if one.course is Course.THERMAL:
                found[[parameters.index(p) for p in one.parameters], k] = 1.0
        return found

    def shown(self) -> list[tuple[str, str, float, float, str]]:
        """Return term, coefficient, value, standard deviation and unit as shown to engineers."""
        rows = []
        for one, value, std in zip(self.changes, self.values, self.std, strict=True):
            words, per = one.course.shown_per
            scale = one.unit.scale * per
            rows.append(
                (
                    one.course.value,
                    one.name,
                    float(value / scale),
                    float(std / scale),
                    f'{one.unit.shown}{words}',
                )
            )
        return rows

    def document(self) -> dict[str, Any]:
        """Return its section of a file."""
        found: dict[str, Any] = {
            'coefficients': [
                {
                    'term': one.course.value,
                    'of': one.name,
                    'value': float(value),
                    'std': float(std),
                    'unit': one.si,
                }
                for one, value, std in zip(self.changes, self.values, self.std, strict=True)
            ],
            'covariance': [[float(v) for v in row] for row in self.covariance],
            'cross_covariance': [[float(v) for v in row] for row in self.cross],
        }
        if np.isfinite(self.time_constant):
            found['time_constant'] = float(self.time_constant)
        if np.isfinite(self.instant):
            found['instant'] = float(self.instant)
        return found


def read_changes(section: Section, parameters: Sequence[Parameter], covariance: Floats) -> Changes:
    """Read a file's section.

    Args:
        section: The mapping.
        parameters: Those of the calibration, n.
        covariance: (n, n) theirs, NaN for those that were not estimated.

    Raises:
        InputError: A wrong name or number; names the key.
    """
    coefficients, values, deviations = [], [], []
    for row in section.sections('coefficients'):
        course = row.choice('term', {course.value: course for course in Course})
        try:
            coefficients.append(change(course, row.text('of')))
        except InputError as error:
            raise InputError(f'{row.key("of")}: {error}') from None
        values.append(row.number('value'))
        deviations.append(row.number('std'))
        if (unit := row.text('unit')) != coefficients[-1].si:
            raise InputError(
                f'{row.key("unit")}: found {unit!r}, expected {coefficients[-1].si!r}.'
            )
        row.finish()
    k = len(coefficients)
    own = section.array('covariance', (k, k))
    cross = section.array('cross_covariance', (len(parameters), k))
    known = np.isfinite(np.diag(covariance))
    square = covariance[np.ix_(known, known)]
    if not is_covariance(np.block([[square, cross[known]], [cross[known].T, own]])):
        raise InputError(
            f'{section.where}: covariance and cross_covariance: not those of any errors (with that '
            'of the parameters they must be symmetric and positive semidefinite).'
        )
    found, expected = np.array(deviations), np.sqrt(np.diag(own))
    if not (np.abs(found - expected) <= _ROUNDED * expected).all():
        raise InputError(
            f'{section.key("coefficients")}: std: not the square roots of the variances in '
            'covariance.'
        )
    shapes = (section.number(key, float('nan')) for key in ('time_constant', 'instant'))
    read = Changes(tuple(coefficients), np.array(values), own, cross, *shapes)
    section.finish()
    return read


def sentence(changes: Changes) -> str:
    """Return a sentence on the terms, with their largest ratio to the standard deviation."""
    names = ' and '.join(names_of(changes.changes))
    far = np.abs(changes.values) / changes.std
    worst = int(np.argmax(far))
    _, name, value, std, unit = changes.shown()[worst]
    found = f'{name} {significant(value, 3)} +- {significant(std)} {unit}'
    return f'{names}: {found} is the most, {far[worst]:.1f} sigma'
