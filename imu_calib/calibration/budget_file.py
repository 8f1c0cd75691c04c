"""The uncertainty budget as `uncertainty_budget` of calibration.yaml: SI units, named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.budget import LEAST_FREEDOM, PROBABILITY, Budget, BudgetLine, Source
from ..common.config import Section, numbers_of
from ..common.errors import InputError
from ..common.stream import Floats
from ..common.units import LARGEST
from ..model.parameters import Parameter

_NOTHING = 1e-24
"""Variance in SI of what is held at its value: what rounding leaves of it is no contradiction."""
_ROUNDED = 1e-3
"""Ratio by which the sum of the sources may differ from a variance: certificates state two digits
of an uncertainty. Differences of nearly equal covariances lose some 1e-5 in exact sessions."""
_FOLLOWS = (
    'units',
    'standard_uncertainty',
    'effective_degrees_of_freedom',
    'coverage_probability',
    'coverage_factor',
    'expanded_uncertainty',
)
"""Keys of the file that are for the reader: they follow from the sources."""


def budget_document(
    budget: Budget, parameters: Sequence[Parameter], known: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the mapping of a budget in a file.

    Args:
        budget: Of n parameters.
        parameters: Their names.
        known: (n,) mask of the estimated ones; the others are left out.
    """

    def row(values: Floats) -> list[float]:
        return [float(v) for v in values[known]]

    estimated = [p for p, k in zip(parameters, known, strict=True) if k]
    return {
        'parameters': [p.name for p in estimated],
        'units': [p.unit.si for p in estimated],
        'standard_uncertainty': row(budget.std),
        'effective_degrees_of_freedom': row(budget.freedom),
        'coverage_probability': PROBABILITY,
        'coverage_factor': row(budget.coverage_factor),
        'expanded_uncertainty': row(budget.expanded),
        'sources': [
            {
                'source': line.source.value,
                'evaluation': line.source.evaluation,
                'description': line.source.words,
                'standard_uncertainty': row(line.std),
                'degrees_of_freedom': row(line.freedom),
            }
            for line in budget.lines
        ],
    }


def read_budget(section: Section, parameters: Sequence[Parameter], variances: Floats) -> Budget:
    """Read a budget from its mapping; quantities that follow from the sources are recomputed.

    Args:
        section: The mapping.
        parameters: Those of the calibration, n.
        variances: (n,) theirs, NaN for those that were not estimated.

    Raises:
        InputError: Other parameters, an unknown source, no standard deviations, or sources that do
            not add up to the variances.
    """
    known = np.isfinite(variances)
    names = [p.name for p, k in zip(parameters, known, strict=True) if k]
    if section.items('parameters') != names:
        raise InputError(
            f'{section.key("parameters")}: not the {len(names)} parameters of the covariance in '
            'their order.'
        )
    lines = []
    for entry in section.sections('sources'):
        source = entry.choice('source', {s.value: s for s in Source})
        std = _row(entry, 'standard_uncertainty', known)
        freedom = _row(entry, 'degrees_of_freedom', known)
        if not (std[known] <= LARGEST).all():
            raise InputError(f'{entry.key("standard_uncertainty")}: expected finite numbers.')
        if not (freedom[known] >= LEAST_FREEDOM).all():
            raise InputError(
                f'{entry.key("degrees_of_freedom")}: expected {LEAST_FREEDOM:g} or more each.'
            )
        for key in ('evaluation', 'description'):
            entry.text(key, '')
        entry.finish()
        lines.append(BudgetLine(source, std, freedom))
    for key in _FOLLOWS:
        section.has(key)
    section.finish()
    budget = Budget(tuple(lines))
    doubt = np.abs(budget.variances.sum(axis=0) - variances)[known]
    if not (doubt <= _ROUNDED * variances[known] + _NOTHING).all():
        raise InputError(
            f'{section.key("sources")}: their squares do not add up to the variances in covariance.'
        )
    return budget


def _row(entry: Section, key: str, known: NDArray[np.bool_]) -> Floats:
    """Return a row of non-negative numbers, NaN for parameters not estimated."""
    values = numbers_of(entry.items(key))
    if values is None:
        raise InputError(f'{entry.key(key)}: found no numbers.')
    count = int(known.sum())
    if values.shape != (count,) or not (values >= 0).all():
        raise InputError(f'{entry.key(key)}: expected {count} numbers, none of them negative.')
    row = np.full(len(known), np.nan)
    row[known] = values
    return row
