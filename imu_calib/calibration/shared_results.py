"""Combine several units on one table: estimate shared unknowns once, from all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ..common.errors import ImuCalibError
from ..estimation import joint
from ..estimation.common_unknowns import Contradicting, TableEstimate, join
from ..estimation.search import Search
from ..estimation.table_effects import shares_a_table
from .basis import Basis
from .calibrator_results import Result

_NOBODY = (
    'What it says of the table contradicts the other unit (chi-square {square:.0f} with {freedom} '
    'degrees of freedom): it is unknown which of the two is right, and each is calibrated by '
    'itself. A third unit would show which.'
)
_ODD = (
    'What it says of the table contradicts the other units (chi-square {square:.0f} with {freedom} '
    'degrees of freedom): it is calibrated by itself. Possible causes: a unit that is loose on the '
    'fixture, samples that froze, a clock that jumps, and sensors that differ from their '
    'description.'
)


_PARTIAL = (
    'It saw {seen} of the {of_all} static dwells of all units, and is calibrated by itself: its '
    'samples ended, froze or began late.'
)


@dataclass(frozen=True, eq=False)
class SharedResults:
    """Results of several units.

    Attributes:
        results: One for each unit: with the shared unknowns if it took part, else unchanged.
        table: Errors of the table estimated from all; None if fewer than two took part.
        shared: Places of the units that took part.
        left_out: Why others did not, by their place.
    """

    results: tuple[Result | None, ...]
    table: TableEstimate | None
    shared: tuple[int, ...]
    left_out: Mapping[int, str]


def estimate_together(alone: Sequence[Result | None], names: Sequence[str]) -> SharedResults:
    """Estimate the shared unknowns of several units on one table once, from all of them.

    Results of the joint estimate on a table with known joint angles take part: closed forms, units
    in the hand and failures remain unchanged.

    Args:
        alone: The result of each unit by itself; None if it failed.
        names: Name of each, for messages and for the provenance of the others.
    """
    results = list(alone)
    parts = {k: part for k, one in enumerate(alone) if one and (part := _basis_and_search(one))}
    places = list(parts)
    if len(places) < 2:
        return SharedResults(tuple(results), None, (), {})
    try:
        joined = join([search.estimate for _, search in parts.values()])
    except ImuCalibError as error:
        finding = f'What the units share could not be estimated from all of them: {error}'
        return SharedResults(_noted(results, dict.fromkeys(places, finding)), None, (), {})
    shared, left_out = [], {}
    for i, estimate in joined.estimates.items():
        place = places[i]
        basis, search = parts[place]
        found = replace(search, estimate=estimate)
        try:
            solution = joint.concluded(found, basis.setup.terms, basis.setup.changes)
            results[place] = basis.concluded(solution)
        except ImuCalibError as error:
            left_out[place] = f'With what the units share it is refused: {error}'
            continue
        shared.append(place)
    for place in shared:
        others = [names[other] for other in shared if other != place]
        results[place] = _with_others(results[place], others)
    for i, seen, of_all in joined.partial:
        left_out[places[i]] = _PARTIAL.format(seen=seen, of_all=of_all)
    for odd in joined.contradicting:
        left_out[places[odd.unit]] = _words(odd, others=len(shared))
    if joined.contradicting and not joined.estimates:
        # Of the last two, which one is wrong cannot be determined.
        last = [p for p in places if p not in left_out]
        left_out |= {p: _words(joined.contradicting[-1], others=0) for p in last}
    return SharedResults(_noted(results, left_out), joined.table, tuple(shared), left_out)


def _with_others(result: Result | None, others: Sequence[str]) -> Result | None:
    """Return a result whose provenance names the units that share its estimate of the table."""
    if result is None or not others:
        return result
    calibration = result.calibration
    provenance = {**calibration.provenance, 'shared_with': list(others)}
    return replace(result, calibration=replace(calibration, provenance=provenance))


def _basis_and_search(result: Result) -> tuple[Basis, Search] | None:
    basis, search = result.basis, result.solution.search
    if basis is None or search is None or not shares_a_table(search.estimate.equations):
        return None
    return basis, search


def _words(odd: Contradicting, *, others: int) -> str:
    words = _ODD if others else _NOBODY
    return words.format(square=odd.chi_square, freedom=odd.freedom)


def _noted(
    results: Sequence[Result | None], findings: Mapping[int, str]
) -> tuple[Result | None, ...]:
    """Return results with one more sentence on some of them."""
    found = list(results)
    for place, sentence in findings.items():
        if (result := found[place]) is not None:
            calibration = result.calibration
            noted = replace(calibration, findings=(*calibration.findings, sentence))
            found[place] = replace(result, calibration=noted)
    return tuple(found)
