"""The sensor model: outputs of the channels of an IMU for rates and specific forces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.errors import NotObservable
from ..common.stream import Floats
from ..common.units import DEG, HOUR, STANDARD_GRAVITY
from .parameters import (
    AXES,
    MOST_SKEWED,
    PARAMETERS,
    Parameter,
    ParameterKind,
    Product,
    linear_product,
    skewed_parameters,
)
from .terms import DELAY, G_SENSITIVITIES, G_SENSITIVITY, SIZE_EFFECT, TERMS, Term, term

_ROUNDS = 30
"""Newton's steps double the digits: five suffice for terms of a percent. Where terms exceed the
linear part, the iteration does not converge."""

_CONVERGED = 1e-12
"""Relative to one SI unit and to the input itself: after a smaller step only rounding remains."""


class Nonlinear(Protocol):
    """Addition of a model to its linear part, as a function of (..., 6) inputs."""

    def extra(self, inputs: Floats) -> Floats:
        """Return the addition to the outputs, (..., 6)."""

    def extra_slopes(self, inputs: Floats) -> Floats:
        """Return its derivatives by the inputs, (..., 6, 6)."""


def inverted(model: Nonlinear, linear: Floats, gain: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the inputs x = linear - gain extra(x), by Newton's method.

    A sample gives the same bits alone as among others.

    Args:
        model: The addition to the outputs.
        linear: (n, 6) inputs by the linear model alone.
        gain: (6, 6) inputs of the linear model by its six outputs.

    Returns:
        (n, 6) inputs, NaN where the steps do not converge, and (n,) whether they did.

    Source: docs/mathematics.md, 'Terms'.
    """
    found = linear.copy()
    # NaN and infinite inputs are kept and not solved for.
    going: NDArray[np.bool_] = np.asarray(np.isfinite(linear).all(axis=1))
    done = ~going
    for _ in range(_ROUNDS):
        at = np.flatnonzero(going)
        if not len(at):
            break
        inputs = found[at]
        residuals = inputs - linear[at] + times_transpose(model.extra(inputs), gain)
        step = _solved_inputs(np.eye(6) + gain @ model.extra_slopes(inputs), residuals)
        found[at] = inputs - step
        small = np.abs(step).max(axis=1) <= _CONVERGED * (1 + np.abs(inputs).max(axis=1))
        done[at[small]] = True
        going[at] = ~small & np.isfinite(step).all(axis=1)
    found[~done] = np.nan
    return found, done


def times_transpose(columns: Floats, matrix: Floats) -> Floats:
    """Return (n, k) columns times the transpose of an (m, k) matrix, summed column by column.

    A BLAS product of many rows may round differently from that of one.
    """
    first, *others = np.ascontiguousarray(columns.T)
    found = matrix[:, :1] * first
    for k, column in enumerate(others, start=1):
        found += matrix[:, k, None] * column
    return np.ascontiguousarray(found.T)


def _solved_inputs(matrices: Floats, right: Floats) -> Floats:
    """Return the solutions (n, 6) of (n, 6, 6) systems; NaN for a singular one."""
    try:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full_like(right, np.nan)
        return np.vstack(
            [_solved_inputs(m[None], r[None]) for m, r in zip(matrices, right, strict=True)]
        )


_IDENTITY = np.eye(3)
_ENTRIES = np.array([0, 4, 8, 1, 2, 3, 5, 6, 7])
"""Indices of an error matrix row by row, in the order of `PARAMETERS`: first the diagonal."""
_BASE = len(PARAMETERS)
_G = slice(_BASE, _BASE + len(G_SENSITIVITIES))
_UNSKEWED = (*PARAMETERS, *(p for one in TERMS for p in one.parameters))
_ALL = (*_UNSKEWED, *skewed_parameters(MOST_SKEWED))
_PLACES = {parameter: k for k, parameter in enumerate(_ALL)}

PRODUCTS: Mapping[Parameter, Product] = {
    **{p: linear_product(p) for p in (*PARAMETERS, *skewed_parameters(MOST_SKEWED))},
    **{p: product for one in TERMS for p, product in one.products},
}
"""The factor of each parameter."""


def parameters_of(terms: Sequence[Term] = (), *, skewed: int = 0) -> tuple[Parameter, ...]:
    """Return the parameters of a model in the order of its vectors and covariance.

    They are the 24, those of its terms, in any order, and those of so many skewed gyros.
    """
    chosen = [p for one in TERMS if one in terms for p in one.parameters]
    return (*PARAMETERS, *chosen, *skewed_parameters(skewed))


def terms_of(parameters: Sequence[Parameter]) -> tuple[Term, ...]:
    """Return the terms to which some of the parameters belong."""
    kinds = {p.kind for p in parameters}
    return tuple(one for one in TERMS if one.kind in kinds)


def by_name(names: Sequence[str]) -> tuple[Parameter, ...]:
    """Return the parameters of these names."""
    return tuple(_NAMES[name] for name in names)


_NAMES = {parameter.name: parameter for parameter in _ALL}


@dataclass(frozen=True, eq=False)
class Regressors:
    """Parameters grouped by their factors."""

    channels: NDArray[np.intp]  #: (n,) output to which each adds, as in `Parameter.channel`.
    products: tuple[Product, ...]  #: The factors, each once.
    index: NDArray[np.intp]  #: (n,) index of each parameter's factor.

    def at(self, rate: Floats, force: Floats) -> Floats:
        """Return the products, (..., m), at (..., 3) rates and specific forces."""
        inputs = np.concatenate([rate, force], axis=-1)
        found = np.empty((*inputs.shape[:-1], len(self.products)))
        for k, product in enumerate(self.products):
            found[..., k] = product.value(inputs)
        return found


@lru_cache(maxsize=64)
def regressors(parameters: tuple[Parameter, ...]) -> Regressors:
    """Return the factors of parameters, in order of first occurrence."""
    mine = [PRODUCTS[parameter] for parameter in parameters]
    products = tuple(dict.fromkeys(mine))
    return Regressors(
        np.array([parameter.channel for parameter in parameters], dtype=np.intp),
        products,
        np.array([products.index(product) for product in mine], dtype=np.intp),
    )


@lru_cache(maxsize=64)
def _places(parameters: tuple[Parameter, ...]) -> NDArray[np.intp]:
    return np.array([_PLACES[parameter] for parameter in parameters], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Triad:
    """Three channels: n = (I + error_matrix) u + bias.

    Source: Cao 2022, eqs. (1)-(2).
    """

    #: (3, 3) scale-factor errors on the diagonal, misalignments (rad) off it.
    error_matrix: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    bias: Floats = field(default_factory=lambda: np.zeros(3))  #: (3,) rad/s or m/s^2.

    @property
    def response(self) -> Floats:
        """I + M, (3, 3)."""
        return _IDENTITY + self.error_matrix

    def vector(self) -> Floats:
        """Return the 12 parameters in the order of `PARAMETERS`."""
        return np.concatenate([self.error_matrix.ravel()[_ENTRIES], self.bias])

    @classmethod
    def from_vector(cls, vector: Floats) -> Triad:
        """Build a triad from 12 parameters in the order of `PARAMETERS`."""
        entries = np.zeros(9)
        entries[_ENTRIES] = vector[:9]
        return cls(entries.reshape(3, 3), np.array(vector[9:12], dtype=float))


@dataclass(frozen=True, eq=False)
class Skewed:
    """Gyros with input axes skewed to X, Y and Z: n_s = response w + bias.

    Scale factor and direction are not separated, so no small angle is needed (CN103697918A).
    """

    response: Floats  #: (k, 3) to rates about the body axes.
    bias: Floats  #: (k,) rad/s.

    def predict(self, rate: Floats) -> Floats:
        """Return the readings, (..., k) rad/s, for (..., 3) rates."""
        return np.asarray(rate @ self.response.T + self.bias)


@dataclass(frozen=True, eq=False)
class SensorModel:
    """Gyros and accelerometers of one unit, in SI after the nominal scale factor.

    n_g = (I + M_g) w + d_g + G f and n_a = (I + M_a) f + d_a, plus the terms. The effect of motion
    terms of the accelerometers is not included: see `MOTION`.

    Source: Cao 2022, eqs. (1)-(2); Luo 2018, section 6.2, for G; `terms` for the others.
    """

    gyro: Triad = field(default_factory=Triad)  #: The gyro triad.
    accel: Triad = field(default_factory=Triad)  #: The accelerometer triad.
    #: (3, 3) G, (rad/s)/(m/s^2); zero in the 24-parameter model.
    g_sensitivity: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    skewed: Skewed | None = None  #: Further gyros, or None.
    #: Coefficients of further terms by name, in the order of `Term.parameters`, SI.
    terms: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters: the 24, those of its terms, those of skewed gyros."""
        mine = [term(name) for name in self.terms]
        if self.g_sensitivity.any():
            mine.append(G_SENSITIVITY)
        return parameters_of(mine, skewed=0 if self.skewed is None else len(self.skewed.bias))

    def vector(self) -> Floats:
        """Return the 24 parameters in the order of `PARAMETERS`, SI units."""
        return np.concatenate([self.gyro.vector(), self.accel.vector()])

    @classmethod
    def from_vector(cls, vector: Floats) -> SensorModel:
        """Build the model from 24 parameters in the order of `PARAMETERS`, SI units."""
        return cls(Triad.from_vector(vector[:12]), Triad.from_vector(vector[12:24]))

    def values(self, parameters: Sequence[Parameter]) -> Floats:
        """Return the values of parameters, SI units.

        Those of an absent term are zero, those of an absent skewed gyro NaN.
        """
        return self._flat()[_places(tuple(parameters))]

    def with_values(self, parameters: Sequence[Parameter], values: Floats) -> SensorModel:
        """Return the model with other values of some parameters, (n,) SI units.

        A term or a skewed gyro is added to the model if one of its parameters is set.
        """
        chosen = tuple(parameters)
        flat = self._flat()
        flat[_places(chosen)] = values
        base = SensorModel.from_vector(flat)
        kinds = {p.kind for p in chosen}
        terms = {
            one.name: flat[_places(one.parameters)]
            for one in TERMS
            if one is not G_SENSITIVITY and (one.name in self.terms or one.kind in kinds)
        }
        channels = 0 if self.skewed is None else len(self.skewed.bias)
        channels = max([channels, *(p.row - 2 for p in chosen)])
        skewed = None
        if channels:
            four = flat[len(_UNSKEWED) :].reshape(-1, 4)[:channels]
            skewed = Skewed(four[:, :3], four[:, 3])
        return SensorModel(base.gyro, base.accel, flat[_G].reshape(3, 3), skewed, terms)

    def fingerprint(self) -> bytes:
        """Return a key equal for models with equal outputs: a term of zeros does not count."""
        return self._flat().tobytes()

    def gyros_fingerprint(self) -> bytes:
        """Return a key equal for models with equal gyro outputs at any specific force.

        With terms, both triads are inverted together: rounding of one may affect the other.
        """
        if self.linear and not self.gyros_sense_force:
            return self.gyro.vector().tobytes()
        return self.fingerprint()

    def _flat(self) -> Floats:
        """Return the values of all possible parameters, in the order of `_ALL`."""
        flat = np.zeros(len(_ALL))
        flat[len(_UNSKEWED) :] = np.nan
        flat[:_BASE] = self.vector()
        flat[_G] = self.g_sensitivity.ravel()
        for name, values in self.terms.items():
            flat[_places(term(name).parameters)] = values
        if self.skewed is not None:
            four = np.column_stack([self.skewed.response, self.skewed.bias]).ravel()
            flat[len(_UNSKEWED) : len(_UNSKEWED) + len(four)] = four
        return flat

    def predict(self, rate: Floats, force: Floats) -> tuple[Floats, Floats]:
        """Return the readings of gyros, (..., 3) rad/s, and accelerometers, (..., 3) m/s^2.

        Rates, (..., 3) rad/s, and specific forces, (..., 3) m/s^2, are along the body axes.
        """
        gyro = rate @ self.gyro.response.T + self.gyro.bias + force @ self.g_sensitivity.T
        accel = force @ self.accel.response.T + self.accel.bias
        if self.linear:
            return gyro, accel
        more = self.extra(np.concatenate(np.broadcast_arrays(rate, force), axis=-1))
        return gyro + more[..., :3], accel + more[..., 3:]

    def derivatives(self, rate: Floats, force: Floats, parameters: tuple[Parameter, ...]) -> Floats:
        """Return the derivatives of the six outputs by n parameters, (..., 6, n).

        The model is linear in the parameters: the derivatives do not depend on their values. Those
        by a skewed gyro's parameters are zero. Rates are (..., 3) rad/s, forces (..., 3) m/s^2.
        """
        by = regressors(parameters)
        result = np.zeros((*rate.shape[:-1], 6, len(parameters)))
        mine = np.flatnonzero(by.channels < 6)
        result[..., by.channels[mine], mine] = by.at(rate, force)[..., by.index[mine]]
        return result

    def slopes(self, rate: Floats, force: Floats) -> Floats:
        """Return the derivatives of the six outputs by the six inputs, (..., 6, 6)."""
        linear = np.zeros((6, 6))
        linear[:3, :3], linear[:3, 3:] = self.gyro.response, self.g_sensitivity
        linear[3:, 3:] = self.accel.response
        return linear + self.extra_slopes(np.concatenate([rate, force], axis=-1))

    @property
    def gyros_sense_force(self) -> bool:
        """Whether the gyros respond to specific force."""
        by_products = any(
            p.degree_in_force for channel, _, p in self._products if channel < len(AXES)
        )
        return by_products or bool(self.g_sensitivity.any())

    @property
    def linear(self) -> bool:
        """Whether the outputs are linear in the inputs."""
        return not self._products

    @cached_property
    def _products(self) -> tuple[tuple[int, float, Product], ...]:
        """Channel, coefficient and product of each nonlinear addition."""
        return tuple(
            (parameter.channel, float(value), product)
            for name, values in self.terms.items()
            for (parameter, product), value in zip(term(name).products, values, strict=True)
            if value and not product.is_zero
        )

    def extra(self, inputs: Floats) -> Floats:
        """Return the addition of the terms to the six outputs, (..., 6), at (..., 6) inputs."""
        result = np.zeros(inputs.shape)
        for channel, value, product in self._products:
            result[..., channel] += value * product.value(inputs)
        return result

    def extra_slopes(self, inputs: Floats) -> Floats:
        """Return the derivatives of `extra` by the inputs, (..., 6, 6)."""
        result = np.zeros((*inputs.shape, 6))
        for channel, value, product in self._products:
            result[..., channel, :] += value * product.slopes(inputs)
        return result

    def compensate(self, gyro: Floats, accel: Floats) -> tuple[Floats, Floats]:
        """Return rates and specific forces along the body axes for readings; shapes as `predict`.

        Raises:
            NotObservable: A response matrix is singular, or terms exceed the responses.

        Source: Luo 2018, eqs. (2-190) to (2-193); docs/mathematics.md, 'Terms', for the others.
        """
        try:
            force = _solved(self.accel.response, accel - self.accel.bias)
            free = gyro - self.gyro.bias - force @ self.g_sensitivity.T
            rate = _solved(self.gyro.response, free)
            if self.linear:
                return rate, force
            linear = replace(self, terms={}).slopes(np.zeros(3), np.zeros(3))
            gain = np.asarray(np.linalg.inv(linear))
        except np.linalg.LinAlgError:
            raise NotObservable('The model cannot be inverted: I + M is singular.') from None
        both = np.concatenate(np.broadcast_arrays(rate, force), axis=-1)
        found, done = inverted(self, both.reshape(-1, 6), gain)
        if not done.all():
            raise NotObservable(
                f'The model cannot be inverted: its terms ({", ".join(self.terms)}) outgrow the '
                'responses within the range of these outputs.'
            )
        found = found.reshape(both.shape)
        return found[..., :3], found[..., 3:]


def _solved(matrix: Floats, vectors: Floats) -> Floats:
    """Return a (3, 3) matrix times vectors (..., 3): each with the bits that it has alone."""
    inverse = np.asarray(np.linalg.inv(matrix))
    return times_transpose(vectors.reshape(-1, 3), inverse).reshape(vectors.shape)


def gravity_slope(model: SensorModel, parameters: Sequence[Parameter]) -> Floats:
    """Return the derivatives of parameters by the relative error of gravity, (n,).

    The outputs depend on gravity only as a factor of the accelerometers' responses and of terms
    that are products of forces: a session solved with g (1 + e) instead of g multiplies each by
    1 / (1 + e), to the power of the number of forces in the product.

    Source: docs/mathematics.md, 'Gravity'.
    """
    one = np.array([p.kind is ParameterKind.SCALE_FACTOR_ERROR for p in parameters])
    degree = np.array([PRODUCTS[p].degree_in_force for p in parameters])
    slope = -degree * (one + model.values(parameters))
    return np.asarray(np.where(degree > 0, slope, 0.0))


def gravity_covariance(
    model: SensorModel, parameters: Sequence[Parameter], relative_std: float
) -> Floats:
    """Return the share of gravity's relative uncertainty in a covariance, (n, n), of rank one."""
    deviation = gravity_slope(model, parameters) * relative_std
    return np.asarray(np.outer(deviation, deviation))


# Motion terms: the size effect (places of the accelerometers) and their delay.
#
# Accelerometer i is at r_i and measures, beyond the specific force f at the point where r_i is
# zero,
#
# a_i = ([dw/dt] + [w][w]) r_i,      n_i(t) = [(I + M) (f + a_i)]_i (t - T) + d_i
#
# A common shift of all three places is equivalent to another choice of that point. So the component
# of r_i along axis i is zero, and six remain.
#
# Source: Hung, Hunter, Stripling and White 1979, Size effect on navigation using a strapdown IMU,
# US Army T-79-73; IEEE Std 1559 (the words); docs/mathematics.md, 'Terms of motion'.


OF_MOTION = frozenset({ParameterKind.PLACE, ParameterKind.DELAY})
"""Kinds of parameters that neither static dwells nor whole turns determine."""


MOTION = (*SIZE_EFFECT.parameters, *DELAY.parameters)  #: The seven parameters.


def motion_parameters(parameters: Iterable[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters of motion terms."""
    return tuple(p for p in parameters if p.kind in OF_MOTION)


def has_motion_terms(terms: Iterable[Term]) -> bool:
    """Return whether any of the terms is a motion term."""
    return any(term.kind in OF_MOTION for term in terms)


def places(model: SensorModel) -> Floats:
    """Return the places of the accelerometers, (3, 3) m: row i is r_i."""
    found = np.zeros((3, 3))
    values = model.values(SIZE_EFFECT.parameters)
    for parameter, value in zip(SIZE_EFFECT.parameters, values, strict=True):
        found[parameter.row, parameter.column] = value
    return found


def delay(model: SensorModel) -> float:
    """Return the delay of the accelerometers after the gyros, s."""
    return float(model.values(DELAY.parameters)[0])


def slopes(model: SensorModel, rate: Floats, spin: Floats, change: Floats) -> Floats:
    """Return the derivatives of the measured specific force by places and delay.

    To first order in the delay. Every sum has a fixed order: a sample has the same bits alone as
    among others.

    Args:
        model: The sensors.
        rate: (n, 3) rad/s.
        spin: (n, 3) angular acceleration, rad/s^2.
        change: (n, 3) rate of change of the specific force, m/s^3.

    Returns:
        (n, 3, 7) m/s^2, in the order of the terms' parameters (`MOTION`).
    """
    x, y, z = spin.T
    nothing = np.zeros_like(x)
    lever = np.stack([nothing, -z, y, z, nothing, -x, -y, x, nothing], axis=-1).reshape(-1, 3, 3)
    lever += rate[:, :, None] * rate[:, None, :]
    lever[:, range(3), range(3)] -= (rate**2).sum(axis=1)[:, None]
    response = model.accel.response
    answer = np.linalg.inv(response)
    columns = []
    for parameter in SIZE_EFFECT.parameters:
        row = (lever[:, :, parameter.column] * response[parameter.row]).sum(axis=1)
        columns.append(row[:, None] * answer[:, parameter.row])
    return np.stack([*columns, -change], axis=-1)


TIMES = ' A wrong sample rate, or a wrong unit of time, has the same effect.'
"""For gyros: their rates times time are compared with turned angles."""
_RANGES = {
    2.0: 'Counts of half the range that the scale factor is for',
    0.5: 'Counts of twice the range that the scale factor is for',
}
_MISTAKES = {
    'gyros': {
        **_RANGES,
        1 / DEG: 'Rates in deg/s, stated as rad/s,',
        DEG: 'Rates in rad/s, stated as deg/s,',
        1e-3: 'Rates in deg/s, stated as mdps,',
        1e3: 'Rates in mdps, stated as deg/s,',
        1 / HOUR: 'Rates in deg/s, stated as deg/h,',
        HOUR: 'Rates in deg/h, stated as deg/s,',
    },
    'accelerometers': {
        **_RANGES,
        STANDARD_GRAVITY: 'Accelerations in m/s^2, stated as g,',
        1 / STANDARD_GRAVITY: 'Accelerations in g, stated as m/s^2,',
    },
}
"""Factor by which outputs are then too large."""
_NEAR = 0.1  #: Relative: scale factors of the cheapest units are 3 % off.


def wrong_scale_sentences(scale: float, name: str) -> str:
    """Return sentences on what gives sensors so many times the response; empty if unknown."""
    near = [m for factor, m in _MISTAKES[name].items() if abs(scale / factor - 1) < _NEAR]
    return ''.join(f' {mistake} have that effect.' for mistake in near) + (
        TIMES if name == 'gyros' else ''
    )


def wrong_turns_sentences(scale: float, meaning: str) -> str:
    """Return sentences on gyros that turn gravity `scale` times as far as it turns.

    `meaning` says what contradicts what, without a stop.
    """
    return (
        f'The gyros turn gravity {scale:.3g} times as far as the accelerometers do: {meaning}.'
        f'{wrong_scale_sentences(scale, "gyros")}'
    )
