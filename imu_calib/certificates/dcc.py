"""A certificate as PTB's Digital Calibration Certificate, version 3.1.2, with units of D-SI.

Source: PTB, dcc.xsd 3.1.2 and SI_Format.xsd 2.1.0; refTypes: DCC good practice, basic_*.
"""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from datetime import date

import numpy as np

from ..calibration import Calibration
from ..model import Parameter
from ..reports import provenance
from ..stream import Units
from ..version import version
from .dsi import ARCSECOND, ONE, Digital, digital
from .fields import CONDITIONS, Contact, Equipment, Fields
from .statement import PROBABILITY, Certificate, Stated, groups

DCC, SI = 'https://ptb.de/dcc', 'https://ptb.de/si'
_XSI = 'http://www.w3.org/2001/XMLSchema-instance'
_LOCATION = 'https://ptb.de/dcc https://ptb.de/dcc/v3.1.2/dcc.xsd'
_UNITS = {
    'temperature': r'\degreecelsius',
    'relative_humidity': r'\percent',
    'air_pressure': r'\hecto\pascal',
}
_REF_TYPES = {
    'temperature': 'basic_temperature',
    'relative_humidity': 'basic_humidityRelative',
    'air_pressure': 'basic_pressure',
}
_UNIFORM = float(np.sqrt(3.0))
"""Half the width of a uniform distribution over its standard deviation (GUM 4.3.7)."""


def dcc(certificate: Certificate) -> str:
    """Return a certificate as XML.

    The calibration's own file is in it whole, with the covariance of all parameters.
    """
    for prefix, name in (('dcc', DCC), ('si', SI), ('xsi', _XSI)):
        ET.register_namespace(prefix, name)
    root = ET.Element(
        _d('digitalCalibrationCertificate'),
        {'schemaVersion': '3.1.2', f'{{{_XSI}}}schemaLocation': _LOCATION},
    )
    root.append(_administration(certificate))
    root.append(_element('measurementResults', _measurement(certificate)))
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding='unicode') + '\n'


def _d(name: str) -> str:
    return f'{{{DCC}}}{name}'


def _element(name: str, *parts: ET.Element | None, text: str = '', **attributes: str) -> ET.Element:
    element = ET.Element(_d(name), {k.rstrip('_'): v for k, v in attributes.items()})
    element.text = text or None
    element.extend([part for part in parts if part is not None])
    return element


def _si(name: str, text: str, *parts: ET.Element) -> ET.Element:
    element = ET.Element(f'{{{SI}}}{name}')
    element.text = text or None
    element.extend(parts)
    return element


def _leaf(name: str, text: object) -> ET.Element | None:
    """Return an element with a text; None where there is no text."""
    return _element(name, text=str(text)) if text not in (None, '') else None


def _content(name: str, *texts: str, **attributes: str) -> ET.Element:
    """Return an element of texts in English."""
    contents = [_element('content', text=text, lang='en') for text in texts]
    return _element(name, *contents, **attributes)


def _administration(certificate: Certificate) -> ET.Element:
    fields = certificate.fields
    laboratory = _element(
        'calibrationLaboratory',
        _leaf('calibrationLaboratoryCode', fields.accreditation),
        _contact('contact', fields.laboratory),
    )
    return _element(
        'administrativeData',
        _element('dccSoftware', _software()),
        _core(fields),
        _element('items', _item(certificate)),
        laboratory,
        _element('respPersons', *_persons(fields)),
        _contact('customer', fields.customer),
        _element('statements', *_statements(certificate)),
    )


def _software() -> ET.Element:
    return _element(
        'software',
        _content('name', 'imu_calib'),
        _leaf('release', version()),
        _leaf('type', 'application'),
    )


def _core(fields: Fields) -> ET.Element:
    assert fields.calibrated is not None
    first, last = fields.calibrated
    identifications = None
    if fields.replaces:
        identifications = _element(
            'identifications',
            _identification('calibrationLaboratory', fields.replaces, 'replaces certificate'),
        )
    return _element(
        'coreData',
        _leaf('countryCodeISO3166_1', fields.laboratory.country),
        _leaf('usedLangCodeISO639_1', 'en'),
        _leaf('mandatoryLangCodeISO639_1', 'en'),
        _leaf('uniqueIdentifier', fields.number),
        identifications,
        _leaf('receiptDate', fields.received),
        _leaf('beginPerformanceDate', first),
        _leaf('endPerformanceDate', last),
        _leaf('performanceLocation', fields.location),
    )


def _identification(issuer: str, value: str, name: str, kind: str = '') -> ET.Element:
    attributes = {'refType': kind} if kind else {}
    return _element(
        'identification',
        _leaf('issuer', issuer),
        _leaf('value', value),
        _content('name', name),
        **attributes,
    )


def _item(certificate: Certificate) -> ET.Element:
    item = certificate.fields.item
    known = [
        _identification('manufacturer', item.serial_number, 'serial number', 'basic_serialNumber')
    ]
    if item.customer_id:
        known.append(_identification('customer', item.customer_id, 'identification'))
    return _element(
        'item',
        _content('name', item.description),
        _content('description', f'Condition: {item.condition}', f'Adjustment: {item.adjustment}'),
        _element('manufacturer', _content('name', item.manufacturer)),
        _leaf('model', item.model),
        _element('identifications', *known),
    )


def _contact(name: str, contact: Contact) -> ET.Element:
    location = _element(
        'location',
        _leaf('city', contact.city),
        _leaf('countryCode', contact.country),
        _leaf('postCode', contact.postcode),
        _leaf('street', contact.street),
    )
    return _element(
        name,
        _content('name', contact.name),
        _leaf('eMail', contact.email),
        _leaf('phone', contact.phone),
        location,
    )


def _persons(fields: Fields) -> Iterable[ET.Element]:
    for k, signature in enumerate(fields.signatures):
        yield _element(
            'respPerson',
            _element('person', _content('name', signature.name)),
            _leaf('role', signature.role),
            _leaf('mainSigner', 'true' if k == 0 else 'false'),
        )


def _statement(
    words: str, kind: str, name: str = 'statement', **more: ET.Element | None
) -> ET.Element:
    """Return a statement; elements in the order of the schema."""
    return _element(
        name,
        more.get('traceable'),
        more.get('norm'),
        _content('declaration', words),
        more.get('date'),
        more.get('conformity'),
        more.get('data'),
        refType=kind,
    )


def _statements(certificate: Certificate) -> list[ET.Element]:
    fields, worst = certificate.fields, certificate.conformity
    found = [
        _statement('Date of issue.', 'basic_dateOfIssue', date=_leaf('date', _day(fields.issued))),
        _statement(
            f"Coverage probability {PROBABILITY:.0%}; coverage factors by Student's t for the "
            'effective degrees of freedom (Welch-Satterthwaite).',
            'basic_measurementUncertainty',
            norm=_leaf('norm', 'JCGM 100:2008'),
        ),
        *(
            _statement(
                f'{e.name}: {e.traceability}',
                'basic_traceability',
                traceable=_leaf('traceable', 'true'),
            )
            for e in fields.equipment
        ),
    ]
    if fields.rule is not None and worst is not None:
        found.append(
            _statement(
                f'{fields.requirement}. {fields.rule.words}',
                'basic_conformity',
                norm=_leaf('norm', 'ILAC-G8:09/2019'),
                conformity=_leaf('conformity', worst.value),
            )
        )
    found += [_statement(remark, 'basic_remark') for remark in fields.remarks]
    return found


def _day(day: date | None) -> str:
    return '' if day is None else day.isoformat()


def _measurement(certificate: Certificate) -> ET.Element:
    fields, calibration = certificate.fields, certificate.calibration
    method = _element(
        'usedMethod',
        _content('name', fields.procedure),
        _content('description', _described(calibration)),
        _leaf('reference', fields.procedure_reference),
    )
    results = [
        _result(title, [_quantity(r) for r in some]) for title, some in groups(certificate.results)
    ]
    return _element(
        'measurementResult',
        _content('name', 'Parameters of the inertial measurement unit'),
        _element('usedMethods', method),
        _element('usedSoftware', _software()),
        _element('measuringEquipments', *map(_equipment, fields.equipment)),
        _element('influenceConditions', *_conditions(certificate)),
        _element(
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
        f'Plan {provenance.plan(where)}, estimator {where.get("method") or "-"}, recording '
        f'{where.get("recording") or "-"} (SHA-256 {where.get("sha256") or "-"}), begun '
        f'{provenance.date(where)}. input = (I + M)^-1 (output * scale factor - D), M with the '
        'scale-factor errors K on its diagonal and the misalignments E beside it.'
    )


def _equipment(equipment: Equipment) -> ET.Element:
    known = [
        _identification(
            'manufacturer', equipment.serial_number, 'serial number', 'basic_serialNumber'
        ),
        _identification(
            'other', equipment.certificate, f'certificate, issued by {equipment.issued_by}'
        ),
    ]
    until = equipment.valid_until
    words = [equipment.traceability] + [f'Valid until {until}.'] * (until is not None)
    manufacturer = None
    if equipment.manufacturer:
        manufacturer = _element('manufacturer', _content('name', equipment.manufacturer))
    return _element(
        'measuringEquipment',
        _content('name', equipment.name),
        _content('description', *words),
        manufacturer,
        _leaf('model', equipment.model),
        _element('identifications', *known),
    )


def _conditions(certificate: Certificate) -> Iterable[ET.Element]:
    for condition in certificate.fields.environment:
        uncertainty = _expanded(condition.within, _UNIFORM, 1.0, 'uniform')
        real = _real(condition.value, _UNITS[condition.key], uncertainty)
        words = CONDITIONS[condition.key][0]
        data = _element('data', _element('quantity', _content('name', words), real))
        kind = _REF_TYPES[condition.key]
        yield _element('influenceCondition', _content('name', words), data, refType=kind)


def _result(title: str, quantities: Sequence[ET.Element]) -> ET.Element:
    inside = _element('list', *quantities)
    return _element('result', _content('name', title), _element('data', inside))


def _real(
    value: float, unit: str, uncertainty: ET.Element | None = None, label: str = ''
) -> ET.Element:
    parts = [_si('label', label)] if label else []
    parts += [_si('value', _number(value)), _si('unit', unit)]
    parts += [] if uncertainty is None else [uncertainty]
    return _si('real', '', *parts)


def _number(value: float) -> str:
    return f'{value:.12g}'


def _expanded(uncertainty: float, factor: float, probability: float, shape: str) -> ET.Element:
    return _si(
        'expandedUnc',
        '',
        _si('uncertainty', _number(uncertainty)),
        _si('coverageFactor', f'{factor:.6f}'),
        _si('coverageProbability', f'{probability:.4g}'),
        _si('distribution', shape),
    )


def _quantity(result: Stated) -> ET.Element:
    parameter, unit = result.parameter, digital(result.parameter)
    uncertainty = _expanded(
        result.expanded / unit.scale, result.factor, PROBABILITY, _shape(result.freedom)
    )
    metadata = []
    if np.isfinite(result.freedom):
        real = _real(result.freedom, ONE.unit)
        data = _element('data', _element('quantity', real))
        words = 'Effective degrees of freedom.'
        metadata.append(_statement(words, 'basic_degreesOfFreedom', 'metaData', data=data))
    if result.conformity is not None and result.limit is not None:
        limit = _real(result.limit / unit.scale, unit.unit)
        metadata.append(
            _statement(
                'Largest amount to either side of zero.',
                'basic_conformity',
                'metaData',
                conformity=_leaf('conformity', result.conformity.value),
                data=_element('data', _element('quantity', limit)),
            )
        )
    return _element(
        'quantity',
        _content('name', f'{parameter.name}, {parameter.kind.value.words}'),
        _real(result.value / unit.scale, unit.unit, uncertainty, parameter.name),
        _element('measurementMetaData', *metadata) if metadata else None,
    )


def _shape(freedom: float) -> str:
    return 'student-t' if np.isfinite(freedom) else 'normal'


def _scales(calibration: Calibration) -> list[ET.Element]:
    """Return the nominal scale factors, which are no results: numbers without uncertainty."""
    imu, found = calibration.imu, []
    units = {
        Units.PULSES: (
            Digital(ARCSECOND, np.pi / 648000),
            Digital(r'\metre\second\tothe{-1}', 1.0),
        ),
        Units.SI: (ONE, ONE),
    }.get(
        imu.units,
        (
            Digital(ARCSECOND + r'\second\tothe{-1}', np.pi / 648000),
            Digital(r'\metre\second\tothe{-2}', 1.0),
        ),
    )
    for spec, unit, name in zip(
        (imu.gyro, imu.accel), units, ('gyros', 'accelerometers'), strict=True
    ):
        words = f'Nominal scale factor of the {name}, per {_output(imu.units)}'
        real = _real(spec.scale_factor / unit.scale, unit.unit)
        found.append(_element('quantity', _content('name', words), real))
    return found


def _output(units: Units) -> str:
    return {Units.PULSES: 'pulse', Units.SI: 'unit of the output'}.get(units, 'count')


def _budget(certificate: Certificate) -> ET.Element:
    """Return the standard uncertainty that each source contributes to each parameter."""
    budget, calibration = certificate.budget, certificate.calibration
    lists = []
    for result in certificate.results:
        k = calibration.parameters.index(result.parameter)
        quantities = [
            _contribution(result.parameter, line.source.words, line.source.evaluation, line.std[k])
            for line in budget.lines
            if line.std[k] > 0
        ]
        name = _content('name', f'{result.parameter.name}: standard uncertainties by source')
        if quantities:
            lists.append(_element('list', name, *quantities))
    inside = _element('data', _element('list', *lists))
    return _element('result', _content('name', 'Uncertainty budget'), inside)


def _contribution(parameter: Parameter, words: str, kind: str, std: float) -> ET.Element:
    unit = digital(parameter)
    name = _content('name', f'{words} (type {kind})')
    return _element('quantity', name, _real(float(std) / unit.scale, unit.unit))


def _file(calibration: Calibration) -> ET.Element:
    """Return the calibration's own file, which holds the covariance and all digits."""
    data = base64.b64encode(calibration.to_yaml().encode()).decode()
    whole = _element(
        'byteData',
        _content('name', 'The calibration as imu_calib reads it'),
        _leaf('fileName', 'calibration.yaml'),
        _leaf('mimeType', 'application/yaml'),
        _leaf('dataBase64', data),
    )
    return _element('result', _content('name', 'File'), _element('data', whole))
