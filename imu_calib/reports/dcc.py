"""A certificate as PTB's Digital Calibration Certificate, version 3.1.2, with units of D-SI.

Source: PTB, dcc.xsd 3.1.2 and SI_Format.xsd 2.1.0.
"""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..calibration.calibration import Calibration
from ..common.budget import PROBABILITY
from ..common.files import version
from ..common.stream import Units
from ..common.units import ARCMIN, ARCSEC, DEG_H, PPM
from ..model.parameters import Parameter
from . import provenance
from .budget import MANY, assumed_inputs
from .certificate import OUTPUT, Certificate, Stated, groups
from .certificate_fields import Conformity, Contact, Equipment, Fields

DCC, SI = 'https://ptb.de/dcc', 'https://ptb.de/si'


def element(name: str, *parts: ET.Element | None, text: str = '', **attributes: str) -> ET.Element:
    """Return an element of the DCC; parts that are None are omitted."""
    made = ET.Element(f'{{{DCC}}}{name}', attributes)
    made.text = text or None
    made.extend([part for part in parts if part is not None])
    return made


def si_element(name: str, text: str, *parts: ET.Element) -> ET.Element:
    """Return an element of D-SI."""
    made = ET.Element(f'{{{SI}}}{name}')
    made.text = text or None
    made.extend(parts)
    return made


def text_element(name: str, text: object) -> ET.Element | None:
    """Return an element with a text; None without a text."""
    return element(name, text=str(text)) if text not in (None, '') else None


def content(name: str, *lines: str, **attributes: str) -> ET.Element:
    """Return an element of one English text: PTB's rules want one in each language."""
    return element(name, element('content', text='\n'.join(lines), lang='en'), **attributes)


def identification(issuer: str, value: str, name: str, kind: str = '') -> ET.Element:
    """Return an identification: a number or name, and its issuer."""
    attributes = {'refType': kind} if kind else {}
    return element(
        'identification',
        text_element('issuer', issuer),
        text_element('value', value),
        content('name', name),
        **attributes,
    )


def statement(
    words: str, kind: str, name: str = 'statement', **more: ET.Element | None
) -> ET.Element:
    """Return a statement; elements in the order of the schema."""
    return element(
        name,
        more.get('traceable'),
        more.get('norm'),
        content('declaration', words),
        more.get('date'),
        more.get('conformity'),
        more.get('data'),
        refType=kind,
    )


def _status(conformity: Conformity) -> ET.Element | None:
    return text_element('conformity', conformity.value) if conformity.value else None


def number_with_unit(
    value: float, unit: str, uncertainty: ET.Element | None = None, label: str = ''
) -> ET.Element:
    """Return a value in a unit of D-SI, with its uncertainty if it has one."""
    parts = [si_element('label', label)] if label else []
    parts += [si_element('value', _number(value)), si_element('unit', unit)]
    parts += [] if uncertainty is None else [uncertainty]
    return si_element('real', '', *parts)


def _number(value: float) -> str:
    return f'{value:.12g}'


def expanded(uncertainty: float, factor: float, probability: float, shape: str) -> ET.Element:
    """Return an expanded uncertainty with its coverage."""
    return si_element(
        'expandedUnc',
        '',
        si_element('uncertainty', _number(uncertainty)),
        si_element('coverageFactor', f'{factor:.6f}'),
        si_element('coverageProbability', f'{probability:.4g}'),
        si_element('distribution', shape),
    )


# Units of parameters in D-SI, the notation of digital certificates.
#
# D-SI has no unit for standard gravity, and no multiple of 1/(m/s^2): such numbers are converted.
# `\per` is deprecated; negative exponents are written.
#
# Source: D-SI (doi 10.5281/zenodo.3366901), BIPM SI brochure, 9th edition.


@dataclass(frozen=True)
class Digital:
    """A unit in D-SI, and its SI value."""

    unit: str
    scale: float


ONE = Digital(r'\one', 1.0)
ARCSECOND = r'\arcsecond'
_HOURLY = r'\degree\hour\tothe{-1}'
_BY_SHOWN = {
    '': ONE,
    'ppm': Digital(r'\ppm', PPM),
    'arcmin': Digital(r'\arcminute', ARCMIN),
    'deg/h': Digital(_HOURLY, DEG_H),
    'ug': Digital(r'\micro\metre\second\tothe{-2}', 1e-6),
    '(deg/h)/g': Digital(_HOURLY + r'\metre\tothe{-1}\second\tothe{2}', DEG_H),
    '(deg/h)/g^2': Digital(_HOURLY + r'\metre\tothe{-2}\second\tothe{4}', DEG_H),
    'ug/g^2': Digital(r'\metre\tothe{-1}\second\tothe{2}', 1.0),
    'ug/g^3': Digital(r'\metre\tothe{-2}\second\tothe{4}', 1.0),
    'mm': Digital(r'\milli\metre', 1e-3),
    'ms': Digital(r'\milli\second', 1e-3),
}
"""D-SI units by engineering units."""


def digital(parameter: Parameter) -> Digital:
    """Return the unit of a parameter."""
    return _BY_SHOWN[parameter.unit.shown]


_CONDITIONS = {
    'temperature': (r'\degreecelsius', 'basic_temperature'),
    'relative_humidity': (r'\percent', 'basic_humidityRelative'),
    'air_pressure': (r'\hecto\pascal', 'basic_pressure'),
}
"""Units and types of the conditions."""
_UNIFORM = float(np.sqrt(3.0))
"""Half the width of a uniform distribution over its standard deviation (GUM 4.3.7)."""
_TWO, _OF_TWO = 2.0, 0.9545
"""Coverage factor of gravity, and the probability that it gives for a normal distribution."""


def software() -> ET.Element:
    """Return the software used."""
    return element(
        'software',
        content('name', 'imu_calib'),
        # PTB's rules ask for a letter first.
        text_element('release', f'v{version()}'),
        text_element('type', 'application'),
    )


def measurement(certificate: Certificate) -> ET.Element:
    """Return all results, with their methods, references and conditions."""
    fields, calibration = certificate.fields, certificate.calibration
    method = element(
        'usedMethod',
        content('name', fields.procedure.name),
        content('description', _described(calibration)),
        text_element('reference', fields.procedure.reference),
    )
    results = [
        _result(title, [_quantity(r) for r in some]) for title, some in groups(certificate.results)
    ]
    return element(
        'measurementResult',
        content('name', 'Parameters of the inertial measurement unit'),
        element('usedMethods', method),
        element('usedSoftware', software()),
        element('measuringEquipments', *map(_equipment, fields.equipment)),
        element('influenceConditions', *_conditions(certificate)),
        element(
            'results',
            *results,
            _result('Nominal scale factors', _scales(calibration)),
            _budget(certificate),
            _file(calibration),
        ),
    )


def _described(calibration: Calibration) -> str:
    where = calibration.provenance
    return (
        f'Plan and estimator: {provenance.procedure(where)}. Recording '
        f'{where.get("recording") or "-"} (SHA-256 {where.get("sha256") or "-"}), begun '
        f'{provenance.date(where)}. input = (I + M)^-1 (output * scale factor - D), M with the '
        'scale-factor errors K on its diagonal and the misalignments E beside it. '
        f'IMU description: {provenance.file_words(calibration.imu.id, where, "imu")}. '
        f'Table: {provenance.file_words(where.get("table"), where, "table")}. '
        f'Assumed: {assumed_inputs(calibration) or "nothing"}.'
    )


def _equipment(equipment: Equipment) -> ET.Element:
    known = [
        identification(
            'manufacturer', equipment.serial_number, 'serial number', 'basic_serialNumber'
        ),
        identification(
            'other', equipment.certificate, f'certificate, issued by {equipment.issued_by}'
        ),
    ]
    until = equipment.valid_until
    words = [equipment.traceability] + [f'Valid until {until}.'] * (until is not None)
    manufacturer = None
    if equipment.manufacturer:
        manufacturer = element('manufacturer', content('name', equipment.manufacturer))
    return element(
        'measuringEquipment',
        content('name', equipment.name),
        content('description', *words),
        manufacturer,
        text_element('model', equipment.model),
        element('identifications', *known),
    )


def _conditions(certificate: Certificate) -> Iterable[ET.Element]:
    for key, (words, _, condition) in certificate.fields.environment.stated.items():
        uncertainty = expanded(condition.within, _UNIFORM, 1.0, 'uniform')
        unit, kind = _CONDITIONS[key]
        real = number_with_unit(condition.value, unit, uncertainty)
        data = element('data', element('quantity', content('name', words), real))
        yield element('influenceCondition', content('name', words), data, refType=kind)
    facts = certificate.calibration.provenance
    value, std = (provenance.number(facts, key) for key in ('gravity', 'gravity_std'))
    if value is not None and std is not None:
        spread = expanded(_TWO * std, _TWO, _OF_TWO, 'normal') if std else None
        real = number_with_unit(value, r'\metre\second\tothe{-2}', spread)
        words = f'gravity: {facts.get("gravity_source") or "source not stated"}'
        data = element('data', element('quantity', content('name', words), real))
        yield element('influenceCondition', content('name', 'gravity'), data)


def _result(title: str, quantities: Sequence[ET.Element]) -> ET.Element:
    inside = element('list', *quantities)
    return element('result', content('name', title), element('data', inside))


def _quantity(result: Stated) -> ET.Element:
    parameter, unit = result.parameter, digital(result.parameter)
    shape = 'student-t' if result.freedom < MANY else 'normal'
    uncertainty = expanded(result.expanded / unit.scale, result.factor, PROBABILITY, shape)
    metadata = []
    if result.freedom < MANY:
        real = number_with_unit(result.freedom, ONE.unit)
        data = element('data', element('quantity', real))
        words = 'Effective degrees of freedom.'
        metadata.append(statement(words, 'basic_degreesOfFreedom', 'metaData', data=data))
    if result.conformity is not None and result.limit is not None:
        limit = number_with_unit(result.limit / unit.scale, unit.unit)
        metadata.append(
            statement(
                f'Largest amount to either side of zero; {result.conformity.words}.',
                'basic_conformity',
                'metaData',
                conformity=_status(result.conformity),
                data=element('data', element('quantity', limit)),
            )
        )
    return element(
        'quantity',
        content('name', f'{parameter.name}, {parameter.kind.value.words}'),
        number_with_unit(result.value / unit.scale, unit.unit, uncertainty, parameter.name),
        element('measurementMetaData', *metadata) if metadata else None,
        refType='basic_measuredValue',
    )


def _scales(calibration: Calibration) -> list[ET.Element]:
    """Return the nominal scale factors, which are not results: numbers without uncertainty."""
    imu, found = calibration.imu, []
    units = (
        Digital(ARCSECOND + r'\second\tothe{-1}', ARCSEC),
        Digital(r'\metre\second\tothe{-2}', 1.0),
    )
    if imu.units.per_interval:
        units = (Digital(ARCSECOND, ARCSEC), Digital(r'\metre\second\tothe{-1}', 1.0))
    elif imu.units is Units.SI:
        units = (ONE, ONE)
    for spec, unit, name in zip(
        (imu.gyro, imu.accel), units, ('gyros', 'accelerometers'), strict=True
    ):
        words = f'Nominal scale factor of the {name}, per {OUTPUT[imu.units]}'
        real = number_with_unit(spec.scale_factor / unit.scale, unit.unit)
        found.append(element('quantity', content('name', words), real))
    return found


def _budget(certificate: Certificate) -> ET.Element:
    """Return the standard uncertainty that each source contributes to each parameter."""
    budget, calibration = certificate.budget, certificate.calibration
    lists = []
    for result in certificate.results:
        k = calibration.parameters.index(result.parameter)
        unit = digital(result.parameter)
        quantities = [
            element(
                'quantity',
                content('name', f'{line.source.words} (type {line.source.evaluation})'),
                number_with_unit(float(line.std[k]) / unit.scale, unit.unit),
            )
            for line in budget.lines
            if line.std[k] > 0
        ]
        name = content('name', f'{result.parameter.name}: standard uncertainties by source')
        if quantities:
            lists.append(element('list', name, *quantities))
    inside = element('data', element('list', *lists))
    return element('result', content('name', 'Uncertainty budget'), inside)


def _file(calibration: Calibration) -> ET.Element:
    """Return the complete calibration file, with the covariance and all digits."""
    data = base64.b64encode(calibration.to_yaml().encode()).decode()
    whole = element(
        'byteData',
        content('name', 'The calibration as imu_calib reads it'),
        text_element('fileName', 'calibration.yaml'),
        text_element('mimeType', 'application/yaml'),
        text_element('dataBase64', data),
    )
    return element('result', content('name', 'File'), element('data', whole))


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
        text_element('calibrationLaboratoryCode', fields.laboratory.accreditation),
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
        statement('Date of issue.', 'basic_dateOfIssue', date=text_element('date', fields.issued)),
        statement(
            f"Coverage probability {100 * PROBABILITY:g} %; coverage factors by Student's t for "
            'the effective degrees of freedom (Welch-Satterthwaite).',
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
    if fields.conformity.rule is not None and worst is not None:
        found.append(
            statement(
                f'{fields.conformity.requirement}. {certificate.rule} Statement: {worst.words}.',
                'basic_conformity',
                norm=text_element('norm', 'ILAC-G8:09/2019'),
                conformity=_status(worst),
            )
        )
    found += [statement(remark, 'basic_remark') for remark in certificate.remarks]
    return found
