"""A certificate as PTB's Digital Calibration Certificate, version 3.1.2, with units of D-SI.

Source: PTB, dcc.xsd 3.1.2 and SI_Format.xsd 2.1.0.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from datetime import date

from ..common.budget import PROBABILITY
from .certificate import Certificate
from .certificate_fields import Contact, Fields
from .dcc import measurement, software
from .dcc_elements import DCC, SI, content, element, identification, statement, text_element

_XSI = 'http://www.w3.org/2001/XMLSchema-instance'
_LOCATION = 'https://ptb.de/dcc https://ptb.de/dcc/v3.1.2/dcc.xsd'


def dcc(certificate: Certificate) -> str:
    """Return a certificate as XML.

    It contains the complete calibration file, with the covariance of all parameters.
    """
    for prefix, name in (('dcc', DCC), ('si', SI), ('xsi', _XSI)):
        ET.register_namespace(prefix, name)
    root = ET.Element(
        f'{{{DCC}}}digitalCalibrationCertificate',
        {'schemaVersion': '3.1.2', f'{{{_XSI}}}schemaLocation': _LOCATION},
    )
    root.append(_administration(certificate))
    root.append(element('measurementResults', measurement(certificate)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding='unicode') + '\n'


def _administration(certificate: Certificate) -> ET.Element:
    fields = certificate.fields
    laboratory = element(
        'calibrationLaboratory',
        text_element('calibrationLaboratoryCode', fields.accreditation),
        _contact('contact', fields.laboratory),
    )
    return element(
        'administrativeData',
        element('dccSoftware', software()),
        _core(fields),
        element('items', _item(certificate)),
        laboratory,
        element('respPersons', *_persons(fields)),
        _contact('customer', fields.customer),
        element('statements', *_statements(certificate)),
    )


def _core(fields: Fields) -> ET.Element:
    assert fields.calibrated is not None
    first, last = fields.calibrated
    identifications = None
    if fields.replaces:
        identifications = element(
            'identifications',
            identification('calibrationLaboratory', fields.replaces, 'replaces certificate'),
        )
    return element(
        'coreData',
        text_element('countryCodeISO3166_1', fields.laboratory.country),
        text_element('usedLangCodeISO639_1', 'en'),
        text_element('mandatoryLangCodeISO639_1', 'en'),
        text_element('uniqueIdentifier', fields.number),
        identifications,
        text_element('receiptDate', fields.received),
        text_element('beginPerformanceDate', first),
        text_element('endPerformanceDate', last),
        text_element('performanceLocation', fields.location),
    )


def _item(certificate: Certificate) -> ET.Element:
    item = certificate.fields.item
    known = [
        identification('manufacturer', item.serial_number, 'serial number', 'basic_serialNumber')
    ]
    if item.customer_id:
        known.append(identification('customer', item.customer_id, 'identification'))
    return element(
        'item',
        content('name', item.description),
        content('description', f'Condition: {item.condition}', f'Adjustment: {item.adjustment}'),
        element('manufacturer', content('name', item.manufacturer)),
        text_element('model', item.model),
        element('identifications', *known),
    )


def _contact(name: str, contact: Contact) -> ET.Element:
    location = element(
        'location',
        text_element('city', contact.city),
        text_element('countryCode', contact.country),
        text_element('postCode', contact.postcode),
        text_element('street', contact.street),
    )
    return element(
        name,
        content('name', contact.name),
        text_element('eMail', contact.email),
        text_element('phone', contact.phone),
        location,
    )


def _persons(fields: Fields) -> Iterable[ET.Element]:
    for k, signature in enumerate(fields.signatures):
        yield element(
            'respPerson',
            element('person', content('name', signature.name)),
            text_element('role', signature.role),
            text_element('mainSigner', 'true' if k == 0 else 'false'),
        )


def _statements(certificate: Certificate) -> list[ET.Element]:
    fields, worst = certificate.fields, certificate.conformity
    found = [
        statement(
            'Date of issue.', 'basic_dateOfIssue', date=text_element('date', _day(fields.issued))
        ),
        statement(
            f"Coverage probability {PROBABILITY:.0%}; coverage factors by Student's t for the "
            'effective degrees of freedom (Welch-Satterthwaite).',
            'basic_measurementUncertainty',
            norm=text_element('norm', 'JCGM 100:2008'),
        ),
        *(
            statement(
                f'{e.name}: {e.traceability}',
                'basic_traceability',
                traceable=text_element('traceable', 'true'),
            )
            for e in fields.equipment
        ),
    ]
    if fields.rule is not None and worst is not None:
        found.append(
            statement(
                f'{fields.requirement}. {fields.rule.words}',
                'basic_conformity',
                norm=text_element('norm', 'ILAC-G8:09/2019'),
                conformity=text_element('conformity', worst.value),
            )
        )
    found += [statement(remark, 'basic_remark') for remark in certificate.remarks]
    return found


def _day(day: date | None) -> str:
    return '' if day is None else day.isoformat()
