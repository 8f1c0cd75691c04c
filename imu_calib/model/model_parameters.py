"""The parameters of the sensor model, and their factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.stream import Floats
from .parameters import ParameterKind, Unit

AXES = 'xyz'
_SKEWED = 'stuv'
MOST_SKEWED = len(_SKEWED)
"""Most skewed gyros: there are no names for more."""


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

    Attributes:
        factors: Indices of the inputs in the product; none for a bias.
        absolute: Indices of those that enter by their absolute value.
        scale: Constant factor, SI.
    """

    factors: tuple[int, ...] = ()
    absolute: tuple[int, ...] = ()
    scale: float = 1.0

    @property
    def is_zero(self) -> bool:
        """Whether it is zero for all inputs."""
        return self.scale == 0

    @property
    def degree_in_force(self) -> int:
        """Number of specific forces among the factors."""
        return sum(k >= len(AXES) for k in (*self.factors, *self.absolute))

    def words(self, axis: str = '') -> str:
        """Return it as text, with its constant factor as a number.

        Args:
            axis: Replaces the axis of every input; empty to keep them.
        """
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
"""Of parameters of motion terms (`motion`): at rest they add nothing."""


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
    """Return the factor of a parameter of the linear model: an input of its triad, or one.

    Args:
        parameter: One of `PARAMETERS` or of a skewed gyro.
    """
    if parameter.column is None:
        return Product()
    return Product((parameter.column + (len(AXES) if parameter.triad == 'a' else 0),))


def indices_of(wanted: Sequence[Parameter], among: Sequence[Parameter]) -> list[int]:
    """Return the indices of parameters in a longer list.

    Raises:
        KeyError: One is not in it.
    """
    places = {parameter: k for k, parameter in enumerate(among)}
    return [places[parameter] for parameter in wanted]
