"""Certificates of a calibration: HTML and PDF for people, DCC for machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..calibration.calibration import Calibration
from ..calibration.thermal import AnyCalibration, ThermalCalibration, load_calibration
from ..common.config import Section, checked
from ..common.errors import InputError
from ..common.files import user_path, write_whole
from ..reports.certificate import Certificate, certificate_of
from ..reports.certificate_fields import Fields, read_fields
from ..reports.certificate_page import certificate_page, pdf
from ..reports.dcc import dcc
from ..session.imu import ImuSpec
from .named import Named, as_calibration, as_imu, as_list

if TYPE_CHECKING:
    from ..calibration.results import Result

FORMATS = ('.html', '.pdf', '.xml')
"""Formats by file ending."""


@checked
def certificate(
    calibration: Result | AnyCalibration | Named,
    fields: Fields | Named,
    output: Named | Sequence[Named] = 'certificate.html',
    *,
    imu: ImuSpec | Named | None = None,
    draft: bool = False,
) -> Certificate:
    """Write a calibration certificate by ISO/IEC 17025:2017, 7.8 (docs/certificate.md).

    Args:
        calibration: calibration.yaml with an uncertainty budget, or a result of `calibrate`.
        fields: Statements of the laboratory, a YAML file (docs/files/certificate.md).
        output: Files to write; the ending selects the format: .html for A4, .pdf (needs WeasyPrint
            or Chromium), .xml for PTB's Digital Calibration Certificate 3.1.2.
        imu: The unit's file with its specification, for statements of conformity.
        draft: Allow missing fields, and mark every page of the certificate as a draft.

    Returns:
        The written files.

    Raises:
        InputError: Something that the standard requires is missing (everything missing is named),
            the fields contradict the calibration, or a file cannot be read or written.
    """
    targets = [user_path(name) for name in as_list(output)]
    kinds = [t.suffix.lower() for t in targets]
    for target, kind in zip(targets, kinds, strict=True):
        if kind not in FORMATS:
            raise InputError(f'{target}: expected a name that ends in {", ".join(FORMATS)}.')
    if draft and '.xml' in kinds:
        raise InputError(
            'A draft may have gaps, and a DCC may not. Leave the .xml out, or state '
            'what is missing.'
        )
    found = _single(calibration)
    if not isinstance(fields, Fields):
        fields = read_fields(Section.load(user_path(fields), 'the fields of a certificate'))
    specification = None if imu is None else as_imu(imu).specification
    made = certificate_of(found, fields, specification, dcc='.xml' in kinds, draft=draft)
    html = certificate_page(made)
    for target, kind in zip(targets, kinds, strict=True):
        write_whole(target, _bytes(kind, html, made))
    return made


def _single(calibration: Result | AnyCalibration | Named) -> Calibration:
    """Return a calibration at one temperature."""
    if isinstance(calibration, str | Path):
        calibration = load_calibration(calibration)
    if isinstance(calibration, ThermalCalibration):
        if len(calibration.calibrations) > 1:
            raise InputError(
                'The calibration combines several temperatures, and has no uncertainty budget: '
                'write a certificate for each that it was combined from.'
            )
        return calibration.calibrations[0]
    return as_calibration(calibration)


def _bytes(kind: str, html: str, made: Certificate) -> bytes:
    if kind == '.pdf':
        return pdf(html)
    return (html if kind == '.html' else dcc(made)).encode()
