"""A table whose file states implausibly small errors: which results depend on that.

The file is used as stated until the session shows an error of the table. So small an error cannot
be identified: a zero error looks like a joint axis that leans, and a wobble like an encoder error.
From then on all errors stated too small are taken as those of the best tables. Of eight simulated
navigation-grade sessions on tables 1 to 3 arcsec off errors are 1.0 of the standard deviations
(root mean square), up to 3.9; with the errors that the session shows alone 1.5, up to 8.7.

Source: docs/mathematics.md, 'Tables that are stated exact'.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.finding import Finding, warning
from ..common.stream import Floats
from ..common.units import ARCSEC, significant
from ..session.table_errors import FINEST
from .equations import Equations
from .estimate import Estimate
from .evidence import Evidence
from .information import Information
from .search import SearchResult

SHOWN = 0.99
"""Probability from which on positioning errors are reported. A judgement."""
_WIDER = 1.12
"""Ratio of standard deviations from which on it is reported: for 4.5 stated deviations the true
number is then 4.0."""
_FIGURE = f'{significant(FINEST / ARCSEC)} arcsec'


def with_least_errors(evidence: Evidence) -> Evidence:
    """Replace the table's implausibly small errors by those of the best known table."""
    if evidence.table is None:
        return evidence
    table = evidence.table.as_the_best()
    return replace(evidence, table=table, positioning=table.positioning)


def contradicted(search: SearchResult) -> bool:
    """Return whether a session contradicts a table file that states too small errors."""
    evidence = search.estimate.equations.evidence
    if evidence.plan.by_hand or evidence.table is None or not evidence.table.understated_errors:
        return False
    of_table = any(one.family.of_table and not one.steps for one in search.found)
    return of_table or search.estimate.scatter.positioning_probability >= SHOWN


def std_on_best_table(equations: Equations, state: Floats, std: Floats) -> Floats:
    """Return the standard deviations (n,) of parameters on a table as good as the best.

    `std` are those by the equations, on the table as its file describes it, at their solution.
    """
    better = replace(equations, evidence=with_least_errors(equations.evidence))
    variances = [
        np.diag(Information.from_jacobian(one.whitened(state)[0]).covariance)[: len(std)]
        for one in (equations, better)
    ]
    return np.asarray(np.sqrt(std**2 + np.maximum(variances[1] - variances[0], 0.0)))


def exactness_findings(estimate: Estimate) -> list[str]:
    """Return sentences on results that depend on implausibly small errors in a table's file."""
    equations, n = estimate.equations, estimate.equations.sensors
    table = equations.evidence.table
    if table is None:
        return []
    if table.described is not None:
        return [
            warning(
                f'The session contradicts table {table.described.name}, which states less than '
                f'{_FIGURE} of {", ".join(table.described.understated_errors)}: {_FIGURE} of each '
                'is used instead. State what the table has.'
            )
        ]
    std = np.sqrt(np.diag(estimate.covariance)[:n])
    return best_table_findings(equations, estimate.state, std)


def best_table_findings(equations: Equations, state: Floats, std: Floats) -> list[str]:
    """Return a sentence on parameters that depend on a table better than any known one.

    Arguments as for `std_on_best_table`.
    """
    table = equations.evidence.table
    if equations.evidence.plan.by_hand or table is None or not table.understated_errors:
        return []
    there = std_on_best_table(equations, state, std)
    times = np.divide(there, std, out=np.ones(len(std)), where=std > 0)
    worst: dict[tuple[str, str], int] = {}
    for k in np.argsort(-times):
        parameter = equations.parameters[k]
        if times[k] > _WIDER:
            worst.setdefault((parameter.kind.value.symbol, parameter.triad), int(k))
    if not worst:
        return []
    each = [
        f'{p.name} {significant(there[k] / p.unit.scale)} {p.unit.shown} '
        f'({significant(times[k])} times)'
        for k, p in ((k, equations.parameters[k]) for k in worst.values())
    ]
    return [
        Finding(
            f'Table {table.name} is described as better than any real one (less than {_FIGURE} of '
            f'{", ".join(table.understated_errors)}). With {_FIGURE} of each the standard '
            f'deviations would be: {", ".join(each)}.',
            effect=float(times.max()) - 1,
        )
    ]
