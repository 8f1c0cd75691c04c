"""A certificate as a value: statements of the laboratory, and results of the calibration."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta

import numpy as np

from ..calibration.calibration import Calibration
from ..common.budget import Budget
from ..common.errors import InputError
from ..common.stream import Units
from ..common.units import counted
from ..model.parameters import Parameter
from ..session.imu import Specification
from .certificate_fields import Conformity, Fields, decide, missing

OUTPUT = {
    Units.PULSES: 'pulse',
    Units.COUNTS: 'count',
    Units.INCREMENTS: 'unit of the output',
    Units.RATES: 'unit of the output',
    Units.SI: 'unit of the output',
}
"""What a nominal scale factor refers to."""

_ZONES = timedelta(days=1)
"""Largest difference between a local date and the UTC date of the same instant: one day."""


_HINT = re.compile(
    r'(?:^|(?<=[.;:]) )(?:Calibrate|Check|Describe|Give|Hold|Keep|Leave|Let|Level|Look|Measure|'
    r'Mount|Name|Raise|Record|Repeat|Run|Set|State|Turn|Use|Wait) (?=[a-z`]).*?(?:[.](?= |$)|$)',
    re.IGNORECASE,
)
"""A sentence, or its last clause, that tells the operator what to do."""


@dataclass(frozen=True)
class Stated:
    """A result, SI units."""

    parameter: Parameter  #: The parameter.
    value: float  #: The estimate.
    expanded: float  #: U, the uncertainty expanded to `PROBABILITY`.
    factor: float  #: k, the factor on the standard uncertainty.
    freedom: float  #: Effective degrees of freedom; infinite for known values.
    limit: float | None = None  #: Largest amount that the specification allows; None without one.
    conformity: Conformity | None = None  #: Statement on that limit; None if none is requested.


@dataclass(frozen=True, eq=False)
class Certificate:
    """Contents of a certificate."""

    fields: Fields  #: Statements of the laboratory.
    calibration: Calibration  #: The result.
    budget: Budget  #: Of its uncertainties.
    results: tuple[Stated, ...]  #: Every estimated parameter.
    missing: tuple[str, ...] = ()  #: Required but missing statements; only a draft has any.
    draft: bool = False  #: Whether it is not yet a certificate.

    def __repr__(self) -> str:
        """Return one line."""
        kind = 'a draft' if self.draft else counted(len(self.results), 'result')
        return f'<Certificate of {self.calibration}: {kind}>'

    @property
    def remarks(self) -> tuple[str, ...]:
        """The laboratory's remarks, and the findings without what they advise the operator."""
        found = (_HINT.sub('', text).strip() for text in self.calibration.findings)
        return (*self.fields.remarks, *(re.sub('[;:]$', '.', text) for text in found if text))

    @property
    def conformity(self) -> Conformity | None:
        """The worst statement on any parameter; None without statements."""
        found = [r.conformity for r in self.results if r.conformity is not None]
        return max(found, key=list(Conformity).index) if found else None


def certificate_of(
    calibration: Calibration,
    fields: Fields,
    specification: Specification | None = None,
    *,
    dcc: bool = False,
    draft: bool = False,
) -> Certificate:
    """Return the contents of a certificate.

    Args:
        calibration: With a budget of its uncertainties.
        fields: Statements of the laboratory; missing serial number and date of the recording are
            taken from the calibration.
        specification: Limits of the unit.
        dcc: Whether a DCC is written too.
        draft: Whether missing statements are allowed, and the result is marked as a draft.

    Raises:
        InputError: The calibration has no budget, something that ISO/IEC 17025 requires is missing
            (everything missing is named), or the fields contradict the calibration.
    """
    budget = calibration.budget
    if budget is None or not np.nanmax(calibration.std) > 0:
        raise InputError(
            'The calibration has no uncertainty budget, and ISO/IEC 17025 asks for uncertainties '
            'with their coverage: expected one with uncertainty_budget (docs/budget.md).'
        )
    fields = _completed(fields, calibration)
    _check(fields, calibration)
    lacking = missing(fields, dcc=dcc, limits=specification is not None)
    if not calibration.serial_number:
        lacking.append(
            'a serial number in the calibration, without which nothing says that it is of this '
            'unit: calibrate again with `serial` (7.8.2.1 g)'
        )
    if lacking and not draft:
        raise InputError(
            f'{fields.where}: {len(lacking)} of the entries that a certificate needs '
            f'{"is" if len(lacking) == 1 else "are"} missing: '
            f'{"; ".join(lacking)}. State them, or write a draft (`draft`), which is marked as one.'
        )
    results = _results(calibration, budget, fields, specification or Specification())
    return Certificate(fields, calibration, budget, results, tuple(lacking), draft)


def _completed(fields: Fields, calibration: Calibration) -> Fields:
    """Fill in fields from the calibration."""
    day = recorded(calibration)
    if fields.calibrated is None and day is not None:
        fields = replace(fields, calibrated=(day, day))
    if not fields.item.serial_number:
        item = replace(fields.item, serial_number=calibration.serial_number)
        fields = replace(fields, item=item)
    return fields


def recorded(calibration: Calibration) -> date | None:
    """Return the date on which the recording began, UTC; None if it is not stated."""
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
    if day is not None and fields.received is not None and fields.received > day + _ZONES:
        raise InputError(
            f'{fields.where}: received: found {fields.received}, after {day}, when the recording '
            'of the calibration began.'
        )
    if day is not None and fields.issued is not None and fields.issued < day - _ZONES:
        raise InputError(
            f'{fields.where}: issued: found {fields.issued}, before {day}, when the recording of '
            'the calibration began.'
        )
    _check_references(fields)


def _check_references(fields: Fields) -> None:
    """Refuse references that were no longer valid (ISO/IEC 17025:2017, 6.4.4 and 6.5.1)."""
    if fields.calibrated is None:
        return
    _, last = fields.calibrated
    for k, one in enumerate(fields.equipment):
        if one.valid_until is not None and one.valid_until < last:
            raise InputError(
                f'{fields.where}: equipment[{k}]: valid_until: found {one.valid_until}, before the '
                f'end of the calibration, {last}: the results are not traceable to it. State the '
                'certificate that was valid then, or calibrate again with a valid reference.'
            )


def _results(
    calibration: Calibration, budget: Budget, fields: Fields, specification: Specification
) -> tuple[Stated, ...]:
    expanded, factor, freedom = budget.expanded, budget.coverage_factor, budget.freedom
    found = []
    for k, parameter in enumerate(calibration.parameters):
        # Parameters that define the frame are zero by definition, not results.
        if not calibration.std[k] > 0:
            continue
        value, limit = float(calibration.values[k]), specification.limit(parameter)
        decision = None
        if fields.conformity.rule is not None and limit is not None:
            decision = decide(value, float(expanded[k]), limit, fields.conformity.rule)
        numbers = (float(expanded[k]), float(factor[k]), float(freedom[k]))
        found.append(Stated(parameter, value, *numbers, limit, decision))
    return tuple(found)


def groups(results: Sequence[Stated]) -> list[tuple[str, list[Stated]]]:
    """Return the results of gyros and of accelerometers, with a heading."""
    named = [('Gyros', 'g'), ('Accelerometers', 'a')]
    found = [
        (title, [r for r in results if r.parameter.triad == letter]) for title, letter in named
    ]
    return [(title, some) for title, some in found if some]
