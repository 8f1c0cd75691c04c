"""The parameters of the sensor model, and their kinds: one row for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from ..common.stream import Floats
from ..common.units import (
    ARCMIN,
    DEG,
    DEG_H,
    MICRO_G,
    PPM,
    STANDARD_GRAVITY,
    Dimension,
    typeset,
)


class Carried(Enum):
    """How an export to another format treats a kind of parameter."""

    YES = 'yes'
    LEFT_OUT = 'left out'
    """The file is valid without it, and states that it is omitted."""
    REFUSED = 'refused'
    """The other parameters are wrong without it: no file is written."""


@dataclass(frozen=True)
class Unit:
    """The units of a kind of parameter."""

    si: str  #: In files and messages.
    shown: str  #: In displays for engineers.
    scale: float  #: SI value of the unit shown.
    dimension: Dimension  #: Dimension of the units accepted as input.
    #: Largest plausible amount for a strapdown IMU, SI; None if judged otherwise.
    limit: float | None = None

    def engineering(self, *, by_hand: bool = False) -> Shown:
        """Return what engineers use, on a table or of a unit in the hand."""
        own = Shown(self.shown, self.scale)
        return _BY_HAND.get(self.shown, own) if by_hand else own


@dataclass(frozen=True)
class Kind:
    """Common properties of all parameters of a kind."""

    symbol: str  #: Prefix of their names.
    words: str  #: Name in sentences.
    key: str  #: In calibration.yaml, and in the specification of an IMU's YAML.
    #: Number of input axes in their names after the channel; None if a triad has one parameter,
    #: without a channel.
    axes: int | None
    units: Mapping[str, Unit]  #: By triad.
    exports: Mapping[str, Carried]  #: Treatment by each export.


_EVERYWHERE = dict.fromkeys(('ros', 'c', 'kalibr', 'imucal'), Carried.YES)
_AS_PRODUCTS = {
    'ros': Carried.YES,
    'c': Carried.YES,
    'kalibr': Carried.REFUSED,
    'imucal': Carried.REFUSED,
}
_BY_THE_NODE = {
    'ros': Carried.YES,
    'c': Carried.LEFT_OUT,
    'kalibr': Carried.LEFT_OUT,
    'imucal': Carried.LEFT_OUT,
}

_NONLINEAR = 0.05
"""Ten times the nonlinearity that data sheets of cheap units state (MPU-9150: 0.5 % of full scale
of the accelerometers, 0.2 % of the gyros)."""

_BY_FORCE = 10 * DEG / STANDARD_GRAVITY  #: s/m: 10 deg/s per g, far beyond any data sheet.
_GYRO_BIAS = 100 * DEG  #: rad/s: far beyond any data sheet.
_ACCEL_BIAS = STANDARD_GRAVITY
"""At least five times the data sheets of the cheapest units (MPU-9150: zero-rate output 20 deg/s,
zero-g output 0.15 g; gyros respond to acceleration by some 0.1 deg/s per g)."""

_LARGE = 0.3  #: m: ten times the usual distance between the accelerometers of a unit.

_LATE = 0.1
"""Five times the longest delay of the low-pass filters of MEMS units, s (MPU-6050, register map,
DLPF_CFG: 2 to 19 ms)."""

_RATIO = Unit('1', 'ppm', PPM, Dimension.RATIO)
_NONLINEARITY = Unit('1', 'ppm', PPM, Dimension.RATIO, _NONLINEAR)
_SQUARE = Unit(
    '1/(m/s^2)',
    'ug/g^2',
    MICRO_G / STANDARD_GRAVITY**2,
    Dimension.PER_ACCELERATION,
    _NONLINEAR / STANDARD_GRAVITY,
)


class ParameterKind(Enum):
    """The kind of a parameter; its row holds all that depends on the kind."""

    def __repr__(self) -> str:
        """Return the name alone, without the row."""
        return self.name

    # Each exists once: parameters are looked up so often that the hash of a name matters.
    __hash__ = object.__hash__

    SCALE_FACTOR_ERROR = Kind(
        'K', 'scale-factor error', 'scale_factor_error', 0, {'g': _RATIO, 'a': _RATIO}, _EVERYWHERE
    )
    MISALIGNMENT = Kind(
        'E',
        'misalignment',
        'misalignment',
        1,
        dict.fromkeys('ga', Unit('rad', 'arcmin', ARCMIN, Dimension.ANGLE)),
        _EVERYWHERE,
    )
    BIAS = Kind(
        'D',
        'bias',
        'bias',
        0,
        {
            'g': Unit('rad/s', 'deg/h', DEG_H, Dimension.RATE, _GYRO_BIAS),
            'a': Unit('m/s^2', 'ug', MICRO_G, Dimension.ACCELERATION, _ACCEL_BIAS),
        },
        _EVERYWHERE,
    )
    RESPONSE = Kind(
        'R',
        'response of a skewed gyro',
        'response',
        1,
        {'g': Unit('1', '', 1.0, Dimension.RATIO)},
        _BY_THE_NODE,
    )
    """Response of a skewed gyro to the rate about a body axis: scale and direction in one."""
    G_SENSITIVITY = Kind(
        'G',
        'g-sensitivity',
        'g_sensitivity',
        1,
        {
            'g': Unit(
                '(rad/s)/(m/s^2)',
                '(deg/h)/g',
                DEG_H / STANDARD_GRAVITY,
                Dimension.G_SENSITIVITY,
                _BY_FORCE,
            )
        },
        _EVERYWHERE,
    )
    GYRO_ASYMMETRY = Kind(
        'A', 'gyro asymmetry', 'gyro_asymmetry', 0, {'g': _NONLINEARITY}, _AS_PRODUCTS
    )
    GYRO_RATE_DEPENDENCE = Kind(
        'N', 'gyro rate dependence', 'gyro_rate_dependence', 0, {'g': _NONLINEARITY}, _AS_PRODUCTS
    )
    GYRO_CUBIC = Kind('C', 'gyro cubic term', 'gyro_cubic', 0, {'g': _NONLINEARITY}, _AS_PRODUCTS)
    GYRO_QUADRATIC = Kind(
        'Q', 'gyro quadratic term', 'gyro_quadratic', 0, {'g': _NONLINEARITY}, _AS_PRODUCTS
    )
    ACCEL_QUADRATIC = Kind(
        'K2', 'accelerometer quadratic term', 'accel_quadratic', 0, {'a': _SQUARE}, _AS_PRODUCTS
    )
    ACCEL_ASYMMETRY = Kind(
        'A', 'accelerometer asymmetry', 'accel_asymmetry', 0, {'a': _NONLINEARITY}, _AS_PRODUCTS
    )
    ACCEL_CUBIC = Kind(
        'K3',
        'accelerometer cubic term',
        'accel_cubic',
        0,
        {
            'a': Unit(
                '1/(m/s^2)^2',
                'ug/g^3',
                MICRO_G / STANDARD_GRAVITY**3,
                Dimension.PER_ACCELERATION_SQUARED,
                _NONLINEAR / STANDARD_GRAVITY**2,
            )
        },
        _AS_PRODUCTS,
    )
    ACCEL_CROSS = Kind(
        'X', 'accelerometer cross term', 'accel_cross', 2, {'a': _SQUARE}, _AS_PRODUCTS
    )
    GYRO_G2 = Kind(
        'G2',
        'gyro g-squared sensitivity',
        'gyro_g2',
        0,
        {
            'g': Unit(
                '(rad/s)/(m/s^2)^2',
                '(deg/h)/g^2',
                DEG_H / STANDARD_GRAVITY**2,
                Dimension.RATE_PER_ACCELERATION_SQUARED,
                _BY_FORCE / STANDARD_GRAVITY,
            )
        },
        _AS_PRODUCTS,
    )
    PLACE = Kind(
        'P',
        'place of an accelerometer',
        'size_effect',
        1,
        {'a': Unit('m', 'mm', 1e-3, Dimension.LENGTH, _LARGE)},
        _BY_THE_NODE,
    )
    DELAY = Kind(
        'T',
        'delay of the accelerometers',
        'delay',
        None,
        {'a': Unit('s', 'ms', 1e-3, Dimension.TIME, _LATE)},
        _BY_THE_NODE,
    )


TRIADS = {'g': 'gyro', 'a': 'accelerometer'}
"""Section in files and word for a triad, by the letter in its parameters' names."""


AXES = 'xyz'
_SKEWED = 'stuv'
MOST_SKEWED = len(_SKEWED)  #: Most skewed gyros: there are no names for more.


@dataclass(frozen=True)
class Parameter:
    """One parameter: its name, its kind, its triad ('g' or 'a') and its place.

    `row` is the channel, skewed gyros from 3 on, and 0 for a parameter common to a triad; `column`
    the input axis, or None for a bias; `second` the other input axis of a product of two.
    """

    kind: ParameterKind
    triad: str
    row: int
    column: int | None
    second: int | None = None

    def __str__(self) -> str:
        return self.name

    @property
    def name(self) -> str:
        """Name after Cao 2022, subscripts as in eqs. (1)-(2): E_gxy is row x, column y."""
        if self.kind.value.axes is None:
            return f'{self.kind.value.symbol}_{self.triad}'
        places = [c for c in (self.column, self.second) if c is not None]
        axes = ''.join(AXES[c] for c in places[: self.kind.value.axes])
        return f'{self.kind.value.symbol}_{self.triad}{(AXES + _SKEWED)[self.row]}{axes}'

    @property
    def unit(self) -> Unit:
        """Its units."""
        return self.kind.value.units[self.triad]

    @property
    def channel(self) -> int:
        """Its output among [gyros x y z, accelerometers x y z, skewed gyros]."""
        if self.triad == 'a':
            return 3 + self.row
        return self.row if self.row < len(AXES) else 3 + self.row


@dataclass(frozen=True)
class Product:
    """The factor of a parameter: scale * u_i u_j ... abs(u_k) ...

    u = [w_x, w_y, w_z, f_x, f_y, f_z], rad/s and m/s^2.
    """

    factors: tuple[int, ...] = ()  #: Indices of the inputs in the product; none for a bias.
    absolute: tuple[int, ...] = ()  #: Indices of those that enter by their absolute value.
    scale: float = 1.0  #: Constant factor, SI.

    @property
    def is_zero(self) -> bool:
        """Whether it is zero for all inputs."""
        return self.scale == 0

    @property
    def degree_in_force(self) -> int:
        """Number of specific forces among the factors."""
        return sum(k >= len(AXES) for k in (*self.factors, *self.absolute))

    def words(self, axis: str = '') -> str:
        """Return it as text, with its constant factor; `axis` replaces those of inputs."""
        names = [f'{"wf"[k // len(AXES)]}_{axis or AXES[k % len(AXES)]}' for k in range(6)]
        factors = [*(names[k] for k in self.factors), *(f'|{names[k]}|' for k in self.absolute)]
        if self.scale != 1:
            factors.insert(0, f'{self.scale:.9g}')
        return ' '.join(factors)

    @property
    def degree_in_rate(self) -> int:
        """Number of angular rates among the factors."""
        return len(self.factors) + len(self.absolute) - self.degree_in_force

    def value(self, inputs: Floats) -> Floats:
        """Return the product, (...), at (..., 6) inputs."""
        if not self.factors and not self.absolute:
            return np.full(inputs.shape[:-1], self.scale)
        result = np.asarray(self.scale)
        for k in self.factors:
            result = result * inputs[..., k]
        for k in self.absolute:
            result = result * np.abs(inputs[..., k])
        return np.asarray(result)

    def slopes(self, inputs: Floats) -> Floats:
        """Return the derivatives of the product by the inputs, (..., 6); that of |0| is 0."""
        result = np.zeros(inputs.shape)
        for k, others, signed in self._others:
            slope = others.value(inputs)
            result[..., k] += slope * np.sign(inputs[..., k]) if signed else slope
        return result

    @cached_property
    def _others(self) -> tuple[tuple[int, Product, bool], ...]:
        """For each factor: its input, the product of the others, and whether its sign enters."""
        plain, absolute = self.factors, self.absolute
        found = [
            (k, Product(plain[:n] + plain[n + 1 :], absolute, self.scale), False)
            for n, k in enumerate(plain)
        ]
        found += [
            (k, Product(plain, absolute[:n] + absolute[n + 1 :], self.scale), True)
            for n, k in enumerate(absolute)
        ]
        return tuple(found)


NOTHING = Product(scale=0.0)
"""Of parameters of motion terms (`sensors.MOTION`): at rest they add nothing."""


def _triad_parameters(triad: str) -> list[Parameter]:
    scale = [Parameter(ParameterKind.SCALE_FACTOR_ERROR, triad, i, i) for i in range(3)]
    cross = [
        Parameter(ParameterKind.MISALIGNMENT, triad, i, j)
        for i in range(3)
        for j in range(3)
        if i != j
    ]
    bias = [Parameter(ParameterKind.BIAS, triad, i, None) for i in range(3)]
    return scale + cross + bias


PARAMETERS: tuple[Parameter, ...] = (*_triad_parameters('g'), *_triad_parameters('a'))
"""The 24 parameters, in the order of every vector and covariance."""

BIASES: tuple[Parameter, ...] = tuple(p for p in PARAMETERS if p.kind is ParameterKind.BIAS)
"""The six biases, gyros first."""

RESPONSES: tuple[Parameter, ...] = tuple(p for p in PARAMETERS if p not in BIASES)
"""Scale-factor errors and misalignments, the nine of the gyros first."""

PARAMETER_NAMES: tuple[str, ...] = tuple(p.name for p in PARAMETERS)


def skewed_parameters(channels: int) -> tuple[Parameter, ...]:
    """Return the four parameters of each skewed gyro: three responses and a bias."""
    rows = range(3, 3 + channels)
    return tuple(
        Parameter(ParameterKind.BIAS if j is None else ParameterKind.RESPONSE, 'g', i, j)
        for i in rows
        for j in (0, 1, 2, None)
    )


def linear_product(parameter: Parameter) -> Product:
    """Return the factor of a parameter of the linear model: an input of its triad, or one."""
    if parameter.column is None:
        return Product()
    return Product((parameter.column + (len(AXES) if parameter.triad == 'a' else 0),))


def indices_of(wanted: Sequence[Parameter], among: Sequence[Parameter]) -> list[int]:
    """Return the indices of parameters in a longer list."""
    places = {parameter: k for k, parameter in enumerate(among)}
    return [places[parameter] for parameter in wanted]


@dataclass(frozen=True)
class Shown:
    """Display of a parameter: its unit as text, and the unit's SI value."""

    unit: str
    scale: float

    @property
    def symbol(self) -> str:
        """The unit on a page."""
        return typeset(self.unit)


_MILLI_G = 1e3 * MICRO_G  #: m/s^2.
_BY_HAND = {
    'ppm': Shown('%', 0.01),
    'arcmin': Shown('deg', DEG),
    'deg/h': Shown('deg/s', DEG),
    'ug': Shown('mg', _MILLI_G),
    '(deg/h)/g': Shown('(deg/s)/g', DEG / STANDARD_GRAVITY),
    '(deg/h)/g^2': Shown('(deg/s)/g^2', DEG / STANDARD_GRAVITY**2),
    'ug/g^2': Shown('mg/g^2', _MILLI_G / STANDARD_GRAVITY**2),
    'ug/g^3': Shown('mg/g^3', _MILLI_G / STANDARD_GRAVITY**3),
}
"""Units of the grade of the units that are calibrated in the hand, by those of the others."""


def engineering(parameter: Parameter, *, by_hand: bool = False) -> Shown:
    """Return the unit that engineers use for a parameter, on a table or of a unit in the hand."""
    return parameter.unit.engineering(by_hand=by_hand)


def bias_units(*, by_hand: bool) -> tuple[Shown, Shown]:
    """Return the units of rates and accelerations as small as a bias."""
    of = ParameterKind.BIAS.value.units
    return of['g'].engineering(by_hand=by_hand), of['a'].engineering(by_hand=by_hand)
