"""The results of a Digital Calibration Certificate: methods, references, quantities, budget."""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np

from ..calibration.calibration import Calibration
from ..common.budget import PROBABILITY
from ..common.files import version
from ..common.stream import Units
from ..common.units import ARCSEC
from ..model.parameters import Parameter
from . import provenance
from .budget import MANY
from .certificate import OUTPUT, Certificate, Stated, groups
from .certificate_fields import CONDITIONS, Equipment
from .dcc_elements import (
    content,
    element,
    expanded,
    identification,
    number_with_unit,
    statement,
    text_element,
)
from .dsi import ARCSECOND, ONE, Digital, digital

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
        content('name', fields.procedure),
        content('description', _described(calibration)),
        text_element('reference', fields.procedure_reference),
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
        f'Plan {provenance.plan(where)}, estimator {where.get("method") or "-"}, recording '
        f'{where.get("recording") or "-"} (SHA-256 {where.get("sha256") or "-"}), begun '
        f'{provenance.date(where)}. input = (I + M)^-1 (output * scale factor - D), M with the '
        'scale-factor errors K on its diagonal and the misalignments E beside it.'
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
    for condition in certificate.fields.environment:
        uncertainty = expanded(condition.within, _UNIFORM, 1.0, 'uniform')
        real = number_with_unit(condition.value, _UNITS[condition.key], uncertainty)
        words = CONDITIONS[condition.key][0]
        data = element('data', element('quantity', content('name', words), real))
        kind = _REF_TYPES[condition.key]
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
    uncertainty = expanded(
        result.expanded / unit.scale, result.factor, PROBABILITY, _shape(result.freedom)
    )
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
                'Largest amount to either side of zero.',
                'basic_conformity',
                'metaData',
                conformity=text_element('conformity', result.conformity.value),
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


def _shape(freedom: float) -> str:
    return 'student-t' if freedom < MANY else 'normal'


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
        quantities = [
            _contribution(result.parameter, line.source.words, line.source.evaluation, line.std[k])
            for line in budget.lines
            if line.std[k] > 0
        ]
        name = content('name', f'{result.parameter.name}: standard uncertainties by source')
        if quantities:
            lists.append(element('list', name, *quantities))
    inside = element('data', element('list', *lists))
    return element('result', content('name', 'Uncertainty budget'), inside)


def _contribution(parameter: Parameter, words: str, kind: str, std: float) -> ET.Element:
    unit = digital(parameter)
    name = content('name', f'{words} (type {kind})')
    return element('quantity', name, number_with_unit(float(std) / unit.scale, unit.unit))


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
