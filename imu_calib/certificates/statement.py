"""A certificate as a value: what the laboratory stated, and what the calibration found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta

from ..budget import PROBABILITY, Budget
from ..calibration import Calibration
from ..errors import InputError
from ..model import Parameter
from ..specification import Specification
from .decision import WORST_LAST, Conformity, decide
from .fields import Fields, missing

_ZONES = timedelta(days=1)
"""Between a date at a place and the same instant in UTC: at most one day."""


@dataclass(frozen=True)
class Stated:
    """A result, SI units.

    Attributes:
        parameter: Which.
        value: As estimated.
        expanded: U, the uncertainty expanded to `PROBABILITY`.
        factor: k, by which the standard uncertainty was multiplied.
        freedom: Effective degrees of freedom; infinite for what is known.
        limit: Largest amount that the specification allows; None without one.
        conformity: What is stated of that limit; None where no statement is asked for.

    """

    parameter: Parameter
    value: float
    expanded: float
    factor: float
    freedom: float
    limit: float | None = None
    conformity: Conformity | None = None


@dataclass(frozen=True, eq=False)
class Certificate:
    """All that a certificate is written from.

    Attributes:
        fields: What the laboratory stated.
        calibration: What was found.
        budget: Of its uncertainties.
        results: Every parameter that was estimated.
        missing: What is required and not stated; only a draft has any.
        draft: Whether it is no certificate yet.

    """

    fields: Fields
    calibration: Calibration
    budget: Budget
    results: tuple[Stated, ...]
    missing: tuple[str, ...] = ()
    draft: bool = False

    @property
    def conformity(self) -> Conformity | None:
        """The worst statement on any parameter; None without statements."""
        found = [r.conformity for r in self.results if r.conformity is not None]
        return max(found, key=WORST_LAST.index) if found else None


def certificate_of(
    calibration: Calibration,
    fields: Fields,
    specification: Specification | None = None,
    *,
    dcc: bool = False,
    draft: bool = False,
) -> Certificate:
    """Put a certificate together.

    Args:
        calibration: With a budget of its uncertainties.
        fields: What the laboratory states; the unit's serial number and the date of the recording
            are the calibration's where the fields say nothing.
        specification: Limits of the unit.
        dcc: Whether a DCC is to be written, too.
        draft: Whether what is missing is left open, and the result marked as a draft.

    Raises:
        InputError: The calibration has no budget, something that ISO/IEC 17025 asks for is
            missing (all of it is named), or the fields contradict the calibration.

    """
    budget = calibration.budget
    if budget is None:
        raise InputError(
            'The calibration has no uncertainty budget, and ISO/IEC 17025 asks for uncertainties '
            'with their coverage: expected one with uncertainty_budget (docs/budget.md).'
        )
    fields = _completed(fields, calibration)
    _check(fields, calibration)
    lacking = missing(fields, dcc=dcc, limits=specification is not None)
    if lacking and not draft:
        raise InputError(
            f'{fields.where}: {len(lacking)} of the things that a certificate needs '
            f'{"is" if len(lacking) == 1 else "are"} missing: '
            f'{"; ".join(lacking)}. State them, or write a draft (`draft`), which is marked as one.'
        )
    results = _results(calibration, budget, fields, specification or Specification())
    return Certificate(fields, calibration, budget, results, tuple(lacking), draft)


def _completed(fields: Fields, calibration: Calibration) -> Fields:
    """Take from the calibration what it knows."""
    day = recorded(calibration)
    if fields.calibrated is None and day is not None:
        fields = replace(fields, calibrated=(day, day))
    if not fields.item.serial_number:
        item = replace(fields.item, serial_number=calibration.serial_number)
        fields = replace(fields, item=item)
    return fields


def recorded(calibration: Calibration) -> date | None:
    """Return the day on which the recording began, UTC; None where it does not say."""
    text = calibration.provenance.get('recorded')
    try:
        found = datetime.fromisoformat(str(text).replace('Z', '+00:00'))
    except ValueError:
        return None
    return found.date()


def _check(fields: Fields, calibration: Calibration) -> None:
    """Refuse fields of another unit or another session."""
    found, expected = fields.item.serial_number, calibration.serial_number
    if found and expected and found != expected:
        raise InputError(
            f'{fields.where}: item: serial_number: found {found}, expected {expected} as in the '
            'calibration.'
        )
    day = recorded(calibration)
    if day is not None and fields.calibrated is not None:
        first, last = fields.calibrated
        if not first - _ZONES <= day <= last + _ZONES:
            raise InputError(
                f'{fields.where}: calibrated: found {first} to {last}, expected {day}, when the '
                'recording of the calibration began.'
            )


def _results(
    calibration: Calibration, budget: Budget, fields: Fields, specification: Specification
) -> tuple[Stated, ...]:
    expanded, factor, freedom = budget.expanded, budget.coverage_factor, budget.freedom
    found = []
    for k, parameter in enumerate(calibration.parameters):
        # What a frame is chosen by is zero by definition, and no result.
        if not calibration.std[k] > 0:
            continue
        value, limit = float(calibration.values[k]), specification.limit(parameter)
        said = None
        if fields.rule is not None and limit is not None:
            said = decide(value, float(expanded[k]), limit, fields.rule)
        numbers = (float(expanded[k]), float(factor[k]), float(freedom[k]))
        found.append(Stated(parameter, value, *numbers, limit, said))
    return tuple(found)


def groups(results: Sequence[Stated]) -> list[tuple[str, list[Stated]]]:
    """Return the results of gyros and of accelerometers, with a heading."""
    named = [('Gyros', 'g'), ('Accelerometers', 'a')]
    found = [
        (title, [r for r in results if r.parameter.triad == letter]) for title, letter in named
    ]
    return [(title, some) for title, some in found if some]


__all__ = ['PROBABILITY', 'Certificate', 'Stated', 'certificate_of', 'groups', 'recorded']
