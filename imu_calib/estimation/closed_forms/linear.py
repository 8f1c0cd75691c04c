"""Estimators that are linear in the mean outputs, and the covariance by their weights.

A published method of this kind is a matrix of weights on the outputs of dwells and turns. With the
covariance of the outputs (random walk, quantisation, positioning, encoder) that of the parameters
follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...common.budget import ErrorSource, Share
from ...common.errors import NotObservable
from ...common.stream import Floats
from ...model.parameters import PARAMETERS, Parameter, ParameterKind
from ...model.sensors import SensorModel, Triad, parameters_of
from ...model.terms import G_SENSITIVITY
from ..checks import no_turn_about
from ..conclusion import SAME_UP, conclude
from ..equations import Equations
from ..evidence import Evidence, vertical_axis
from ..solution import Solution
from ..table_effects import Accelerometers

# Per channel i the unknowns are its three responses delta_ij + M_ij and its bias. Each equation of
# a method reads `coefficients . unknowns = weights . outputs`, so that the estimate follows from
# one small matrix, and its covariance from that of the outputs (`Gains`).

UNKNOWNS = 4  #: Of a channel: three responses and a bias.
BIAS = 3  #: Its index among them.


@dataclass(frozen=True, eq=False)
class SolvedTriad:
    """Three channels by the weights on their outputs."""

    triad: Triad  #: The parameters.
    gain: Floats  #: (3, 4, size) weights of each channel's outputs for responses and bias.
    condition: float  #: Condition number of the coefficients, columns scaled to unit length.

    @classmethod
    def solve(cls, coefficients: Floats, weights: Floats, outputs: Floats) -> SolvedTriad:
        """Solve channels x, y and z, whose equations differ in the weights alone.

        (4, 4) coefficients of responses and bias in each equation, (3, 4, size) weights of each
        channel's outputs in it, (size, 3) mean outputs.
        """
        gain = np.asarray(np.linalg.solve(coefficients, weights))
        unknowns = np.einsum('ium,mi->iu', gain, outputs)
        triad = Triad(unknowns[:, :BIAS] - np.eye(3), unknowns[:, BIAS])
        scaled = coefficients / np.linalg.norm(coefficients, axis=0)
        return cls(triad, gain, float(np.linalg.cond(scaled)))


ILL_CONDITIONED = 100.0
"""Where two digits are lost, only errors of the attitudes separate the parameters."""
_SINGULAR = 1e-12  #: Of the largest singular value: a smaller one is zero but for rounding (1e-16).
_INVOLVED = 0.1
"""Of a unit vector: parameters with this share in undetermined directions are named."""


@dataclass(frozen=True, eq=False)
class Gains:
    """Weights of outputs that give the unknowns."""

    #: (u, s + t), or (3, u, s + t) where channels differ: three responses, the bias, and three
    #: g-sensitivities where u is 7, from the outputs of static dwells, then turns.
    gyro: Floats
    #: (4, s), or (3, 4, s), three responses and the bias; None where they are not estimated.
    accel: Floats | None
    condition: float  #: Condition number of what was inverted, columns scaled to unit length.

    @property
    def _gyro(self) -> Floats:
        return np.broadcast_to(self.gyro, (3, *self.gyro.shape[-2:]))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters that the weights give, those of accelerometers included."""
        return parameters_of([G_SENSITIVITY] if self.gyro.shape[-2] > BIAS + 1 else [])

    @property
    def _accel(self) -> Floats | None:
        if self.accel is None:
            return None
        return np.broadcast_to(self.accel, (3, *self.accel.shape[-2:]))

    def model(self, evidence: Evidence) -> SensorModel:
        """Return the sensors for the outputs of a session."""
        outputs = evidence.outputs()
        turned = np.array([t.statistics.mean[:3] for t in evidence.turns]).reshape(-1, 3)
        gyro = np.einsum('ium,mi->iu', self._gyro, np.vstack([outputs[:, :3], turned]))
        accel = Triad()
        if self._accel is not None:
            unknowns = np.einsum('ium,mi->iu', self._accel, outputs[:, 3:])
            accel = Triad(unknowns[:, :BIAS] - np.eye(3), unknowns[:, BIAS])
        model = SensorModel(Triad(gyro[:, :BIAS] - np.eye(3), gyro[:, BIAS]), accel)
        further = self.parameters[len(PARAMETERS) :]
        return model.with_values(further, gyro[:, BIAS + 1 :].ravel())

    def derivatives(self, evidence: Evidence) -> Floats:
        """Return the derivatives of the parameters by the outputs without moves, (n, m)."""
        s = len(evidence.segments)
        parameters = self.parameters
        where = replace(evidence, moves=()).layout
        rows = np.zeros((len(parameters), len(where)))
        for row, parameter in zip(rows, parameters, strict=True):
            column = BIAS if parameter.column is None else parameter.column
            if parameter.kind is ParameterKind.G_SENSITIVITY:
                column += BIAS + 1
            if parameter.triad == 'g':
                gain = self._gyro[parameter.row, column]
                row[where.dwell[:, parameter.row]] = gain[:s]
                row[where.turn[:, parameter.row]] = gain[s:]
            elif self._accel is not None:
                row[where.dwell[:, 3 + parameter.row]] = self._accel[parameter.row, column]
            else:
                row[:] = np.nan
        return rows

    def shares(self, evidence: Evidence, model: SensorModel) -> dict[ErrorSource, Share]:
        """Return the covariance (n, n) by source, NaN for parameters that are not estimated."""
        return shares_of(evidence, model, self.derivatives(evidence))

    def conclude(
        self,
        evidence: Evidence,
        *,
        model: SensorModel | None = None,
        accelerometers: Accelerometers | None = None,
        findings: Sequence[str] = (),
        north_known: bool,
    ) -> Solution:
        """Check the estimate against the data.

        The estimate and its accelerometers are those by these gains, if not given.
        """
        model = model or self.model(evidence)
        return conclude(
            evidence,
            model,
            self.shares(evidence, model),
            self.condition,
            gain=self.derivatives(evidence),
            parameters=self.parameters,
            findings=findings,
            north_known=north_known,
            accelerometers=accelerometers or (lambda other: self.model(other).accel),
        )


def shares_of(evidence: Evidence, model: SensorModel, rows: Floats) -> dict[ErrorSource, Share]:
    """Return by source the covariance of parameters that are linear in the outputs.

    `rows` (n, m) are their derivatives by the outputs without moves, NaN for those not estimated.
    """
    # A closed form does not use moves.
    equations = Equations(replace(evidence, moves=()))
    state = np.concatenate([model.vector(), np.zeros(equations.nuisances)])
    found = equations.shares(state, rows)
    clock = rows @ equations.jacobian(state)[:, equations.clock_index] * evidence.clock_rate()[1]
    found[ErrorSource.CLOCK] = Share.from_parts([(np.outer(clock, clock), evidence.clock_freedom)])
    return found


def inverse(design: Floats, names: Sequence[str], what: str) -> tuple[Floats, float]:
    """Return the least-squares inverse of a design and its condition number.

    Args:
        design: (m, u), its columns of comparable size.
        names: The parameters determined by each column.
        what: Source of the rows, for the message.
    """
    rows = np.vstack([design, np.zeros((max(0, design.shape[1] - len(design)), design.shape[1]))])
    left, values, vectors = np.linalg.svd(rows, full_matrices=False)
    weak = values * ILL_CONDITIONED < values[0] if values[0] > 0 else np.ones(len(values), bool)
    if weak.any():
        involved = np.linalg.norm(vectors[weak], axis=0) > _INVOLVED
        lost = ', '.join(n for n, k in zip(names, involved, strict=True) if k)
        ratio = values[0] / values[-1] if values[-1] > _SINGULAR * values[0] else np.inf
        number = 'infinite' if np.isinf(ratio) else f'{ratio:.2g}'
        raise NotObservable(
            f'{what} cannot tell apart {lost} (condition number {number}, at most '
            f'{ILL_CONDITIONED:g}): not observable.'
        )
    gain = (vectors.T / values) @ left[: len(design)].T
    return np.asarray(gain), float(values[0] / values[-1])


def rate_test_weights(evidence: Evidence) -> tuple[Floats, float]:
    """Return the weights (3, t) of turns for the responses, and the condition number.

    Least squares of the outputs on the rate about the axis that is up, with a separate offset for
    each attitude: bias, g-sensitivity and vertical Earth rate cancel in it.

    Source: Luo 2018, eqs. (2-175) to (2-183), as corrected in docs/mathematics.md, 'Rate test'.
    """
    ups = np.array([turn.up for turn in evidence.turns]).reshape(-1, 3)
    rates = np.array([turn.rate() for turn in evidence.turns])
    for axis in range(3):
        if not np.any(np.abs(ups[:, axis]) > SAME_UP):
            raise no_turn_about(axis)
    inputs = ups * (rates + evidence.site.up_rate)[:, None]
    attitudes = np.argmax(ups @ ups.T > SAME_UP, axis=1)
    offsets = (attitudes[:, None] == np.unique(attitudes)).astype(float)
    scale = np.abs(rates).max()
    names = [*(response_names('g', axis) for axis in range(3)), *['biases'] * offsets.shape[1]]
    gain, condition = inverse(np.hstack([inputs / scale, offsets]), names, 'The turns')
    return gain[:3] / scale, condition


def response_names(triad: str, axis: int) -> str:
    """Return the names of a triad's response parameters to one axis."""
    return ', '.join(p.name for p in PARAMETERS if p.triad == triad and p.column == axis)


def bias_names(triad: str) -> str:
    """Return the names of the biases of a triad."""
    return ', '.join(p.name for p in PARAMETERS if p.triad == triad and p.column is None)


def position_weights(evidence: Evidence) -> Floats:
    """Return the weight of each static dwell, (s,): a position measured twice counts as one."""
    names = [segment.position for segment in evidence.segments]
    return np.array([1 / names.count(name) for name in names])


# Sources: Cao 2022, section 3.1; Luo 2018, eqs. (2-175) to (2-183); off-axis 2019, section 1.1.1;
# with the corrections of docs/mathematics.md, 'Rate test'.

_ONE_RATE = 0.2  #: Of the largest rate: spread below which a line has no determined slope.


@dataclass(frozen=True, eq=False)
class RateTestEquations:
    """The turns of a session as equations for the gyros' responses."""

    outputs: Floats  #: (t, 3) mean gyro outputs, rad/s.
    inputs: Floats  #: (t,) rate about the vertical body axis, Earth included, rad/s.
    axes: Floats  #: (t,) which body axis was vertical.
    off_axis: Floats  #: (t, 3) rates of the other axes by the encoders, rad/s.

    @classmethod
    def from_turns(cls, evidence: Evidence) -> RateTestEquations:
        """Collect the turns of a session."""
        axes, inputs, off = [], [], []
        for turn in evidence.turns:
            axis, sign = vertical_axis(turn.up, turn.position)
            rate = turn.rate() + evidence.site.up_rate
            axes.append(axis)
            inputs.append(sign * rate)
            off.append(rate * (turn.up - sign * np.eye(3)[axis]))
        for axis in range(3):
            if axis not in axes:
                raise no_turn_about(axis)
        outputs = np.array([t.statistics.mean[:3] for t in evidence.turns])
        return cls(outputs, np.array(inputs), np.array(axes), np.array(off))

    def equation(self, axis: int) -> tuple[Floats, Floats]:
        """Return the equation for the response to one body axis: (4,) coefficients, (t,) weights.

        Turns at several rates or in both senses: the slope of the output on the input, independent
        of bias and vertical Earth rate. One sense at one rate (a turn by hand): output less bias
        over input, with the bias from elsewhere.
        """
        mine = np.flatnonzero(self.axes == axis)
        inputs = self.inputs[mine]
        centred = inputs - inputs.mean()
        coefficients = np.zeros(UNKNOWNS)
        weights = np.zeros(len(self.axes))
        spread = float(centred @ centred)
        if np.sqrt(spread / len(mine)) > _ONE_RATE * np.abs(inputs).max():
            coefficients[axis] = 1.0
            weights[mine] = centred / spread
        else:
            coefficients[axis], coefficients[BIAS] = inputs.mean(), 1.0
            weights[mine] = 1 / len(mine)
        return coefficients, weights
