"""The sensor model: what the channels of an IMU answer to rates and specific forces."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from .errors import NotObservable
from .stream import Floats

AXES = 'xyz'
_SKEWED = 'stuv'
MOST_SKEWED = len(_SKEWED)
"""More skewed gyros than that have no names."""


class ParameterKind(Enum):
    """What a parameter is; decides its unit."""

    SCALE_FACTOR_ERROR = 'K'
    MISALIGNMENT = 'E'
    BIAS = 'D'
    G_SENSITIVITY = 'G'
    RESPONSE = 'R'
    """Of a skewed gyro to the rate about a body axis: scale and direction in one."""


@dataclass(frozen=True)
class Parameter:
    """One parameter: its name, its kind, its triad ('g' or 'a') and its place.

    `row` is the channel, skewed gyros from 3 on; `column` the input axis, or None for a bias.
    """

    kind: ParameterKind
    triad: str
    row: int
    column: int | None

    @property
    def name(self) -> str:
        """Name after Cao 2022, subscripts as in eqs. (1)-(2): E_gxy is row x, column y."""
        axes = (AXES + _SKEWED)[self.row]
        if self.kind is not ParameterKind.SCALE_FACTOR_ERROR and self.column is not None:
            axes += AXES[self.column]
        return f'{self.kind.value}_{self.triad}{axes}'


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

PARAMETER_NAMES: tuple[str, ...] = tuple(p.name for p in PARAMETERS)

G_SENSITIVITIES: tuple[Parameter, ...] = tuple(
    Parameter(ParameterKind.G_SENSITIVITY, 'g', i, j) for i in range(3) for j in range(3)
)
"""The nine that make 33 (Luo 2018, section 6.2), row by row of G."""


def skewed_parameters(channels: int) -> tuple[Parameter, ...]:
    """Return the four parameters of each skewed gyro: three responses and a bias."""
    rows = range(3, 3 + channels)
    return tuple(
        Parameter(ParameterKind.BIAS if j is None else ParameterKind.RESPONSE, 'g', i, j)
        for i in rows
        for j in (0, 1, 2, None)
    )


def extended_parameters(*, with_g: bool, skewed: int = 0) -> tuple[Parameter, ...]:
    """Return the parameters of a model in the order of its vectors and covariance.

    Args:
        with_g: Whether the nine g-sensitivities are among them.
        skewed: Number of skewed gyros.

    """
    extra = G_SENSITIVITIES if with_g else ()
    return (*PARAMETERS, *extra, *skewed_parameters(skewed))


@dataclass(frozen=True, eq=False)
class Triad:
    """Three channels: n = (I + error_matrix) u + bias.

    Attributes:
        error_matrix: (3, 3) scale-factor errors on the diagonal, misalignments (rad) off it.
        bias: (3,) rad/s or m/s^2.

    Source: Cao 2022, eqs. (1)-(2).

    """

    error_matrix: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    bias: Floats = field(default_factory=lambda: np.zeros(3))

    @property
    def response(self) -> Floats:
        """I + M, (3, 3)."""
        return np.eye(3) + self.error_matrix

    def vector(self) -> Floats:
        """Return the 12 parameters in the order of `PARAMETERS`."""
        off = self.error_matrix[~np.eye(3, dtype=bool)]
        return np.concatenate([np.diag(self.error_matrix), off, self.bias])

    @classmethod
    def from_vector(cls, vector: Floats) -> Triad:
        """Build a triad from 12 parameters in the order of `PARAMETERS`."""
        matrix = np.zeros((3, 3))
        matrix[~np.eye(3, dtype=bool)] = vector[3:9]
        matrix[np.diag_indices(3)] = vector[:3]
        return cls(matrix, np.array(vector[9:12], dtype=float))


@dataclass(frozen=True, eq=False)
class Skewed:
    """Gyros whose input axes lie askew to X, Y and Z: n_s = response w + bias.

    Scale factor and direction are not told apart, so no small angle is needed (CN103697918A).

    Attributes:
        response: (k, 3) to rates about the body axes.
        bias: (k,) rad/s.

    """

    response: Floats
    bias: Floats

    def predict(self, rate: Floats) -> Floats:
        """Return what the channels read, (..., k) rad/s, for (..., 3) rates."""
        return np.asarray(rate @ self.response.T + self.bias)


@dataclass(frozen=True, eq=False)
class SensorModel:
    """Gyros and accelerometers of one unit, in SI after the nominal scale factor.

    n_g = (I + M_g) w + d_g + G f and n_a = (I + M_a) f + d_a.

    Attributes:
        gyro: The gyro triad.
        accel: The accelerometer triad.
        g_sensitivity: (3, 3) G, (rad/s)/(m/s^2); zero in the 24-parameter model.
        skewed: Further gyros, or None.

    Source: Cao 2022, eqs. (1)-(2); Luo 2018, section 6.2, for G.

    """

    gyro: Triad = field(default_factory=Triad)
    accel: Triad = field(default_factory=Triad)
    g_sensitivity: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    skewed: Skewed | None = None

    def vector(self) -> Floats:
        """Return the 24 parameters in the order of `PARAMETERS`, SI units."""
        return np.concatenate([self.gyro.vector(), self.accel.vector()])

    def values(self, parameters: tuple[Parameter, ...]) -> Floats:
        """Return the values of `extended_parameters`, SI units."""
        extra = [self._further(p) for p in parameters[len(PARAMETERS) :]]
        return np.concatenate([self.vector(), np.array(extra, dtype=float)])

    def _further(self, parameter: Parameter) -> float:
        if parameter.kind is ParameterKind.G_SENSITIVITY:
            return float(self.g_sensitivity[parameter.row, parameter.column])
        if self.skewed is None or parameter.row - 3 >= len(self.skewed.bias):
            return float('nan')
        if parameter.column is None:
            return float(self.skewed.bias[parameter.row - 3])
        return float(self.skewed.response[parameter.row - 3, parameter.column])

    @classmethod
    def from_vector(cls, vector: Floats) -> SensorModel:
        """Build the model from 24 parameters in the order of `PARAMETERS`, SI units."""
        return cls(Triad.from_vector(vector[:12]), Triad.from_vector(vector[12:24]))

    def predict(self, rate: Floats, force: Floats) -> tuple[Floats, Floats]:
        """Return what the channels read.

        Args:
            rate: (..., 3) angular rate along the body axes, rad/s.
            force: (..., 3) specific force along the body axes, m/s^2.

        Returns:
            Gyro (..., 3) in rad/s and accelerometer (..., 3) in m/s^2 channels.

        """
        gyro = rate @ self.gyro.response.T + self.gyro.bias + force @ self.g_sensitivity.T
        return gyro, force @ self.accel.response.T + self.accel.bias

    def compensate(self, gyro: Floats, accel: Floats) -> tuple[Floats, Floats]:
        """Return the rate and the specific force that the channels' readings mean.

        Args:
            gyro: (..., 3) gyro channels, rad/s.
            accel: (..., 3) accelerometer channels, m/s^2.

        Returns:
            Angular rate (..., 3) in rad/s and specific force (..., 3) in m/s^2, body axes.

        Raises:
            NotObservable: A response matrix is singular.

        Source: Luo 2018, eqs. (2-190) to (2-193).

        """
        try:
            force = np.linalg.solve(self.accel.response, (accel - self.accel.bias)[..., None])[
                ..., 0
            ]
            free = gyro - self.gyro.bias - force @ self.g_sensitivity.T
            rate = np.linalg.solve(self.gyro.response, free[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise NotObservable('The model cannot be inverted: I + M is singular.') from None
        return np.asarray(rate), np.asarray(force)
