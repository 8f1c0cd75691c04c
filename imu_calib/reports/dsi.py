r"""Units of parameters in D-SI, the notation of digital certificates.

D-SI has no unit for standard gravity, and no multiple of 1/(m/s^2): such numbers are converted.
`\per` is deprecated; negative exponents are written.

Source: D-SI (doi 10.5281/zenodo.3366901), BIPM SI brochure, 9th edition.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..common.units import ARCMIN, DEG_H, PPM
from ..model.parameters import Parameter


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
