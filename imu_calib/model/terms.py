"""Terms beyond the 24 parameters: additions to a channel's output besides I + M and bias.

Every parameter of a term is multiplied by a product of the instantaneous inputs (`Product`), from
which prediction, derivatives, inversion and code follow; two terms are observable in motion alone
(`sensors.MOTION`). `TERMS` is their order in vectors.

Rates are in units of 60 deg/s, so that the coefficients are ratios of the size of their effect.

Sources: IEEE Std 1293 (model equation of a linear accelerometer), IEEE Std 952 and 1431 (gyros),
IEEE Std 528 (the words); docs/mathematics.md, 'Terms'.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..common.errors import InputError
from ..common.units import DEG
from .parameters import AXES, NOTHING, Parameter, ParameterKind, Product
from .session_terms import SESSION_TERMS, Change, session_term

NO_TERMS = 'none'  #: Input that stands for the 24 parameters alone.

AUTO_TERMS = 'auto'
"""Input that stands for the terms that the session shows, alone or among names."""

REFERENCE_RATE = 60 * DEG  #: Rate at which the coefficients of gyros' terms are stated, rad/s.


@dataclass(frozen=True)
class Term:
    """A group of parameters that are added to the model together."""

    name: str  #: As in `--terms` and in files.
    kind: ParameterKind  #: Of all its parameters.
    #: Its parameters, in order, each with its factor.
    products: tuple[tuple[Parameter, Product], ...]
    needs: str  #: What a session must contain to determine it; ends 'it takes'.
    #: Its addition to channel i if it is a motion term, as text; empty for others.
    moving: str = ''

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters, in order."""
        return tuple(parameter for parameter, _ in self.products)

    @property
    def formula(self) -> str:
        """Its addition to channel i as text: the coefficients are those of files."""
        if self.moving:
            channel = '[i]' if len(self.products) > 1 else ''
            return f'{self.name}{channel} {self.moving}'
        if len(self.products) == len(AXES):
            return f'{self.name}[i] {self.products[0][1].words("i")}'
        each = [product.words() for _, product in self.products[: len(self.products) // 3]]
        return ' + '.join(f'{self.name}[i][{k}] {words}' for k, words in enumerate(each))

    @property
    def linear(self) -> bool:
        """Whether the outputs remain linear in the inputs with it."""
        return all(p.is_zero or (len(p.factors) == 1 and not p.absolute) for _, p in self.products)

    @property
    def triad(self) -> str:
        """The triad to whose outputs it adds: 'g' or 'a'."""
        return self.parameters[0].triad


def _own(
    kind: ParameterKind, triad: str, plain: int, absolute: int, needs: str, scale: float = 1.0
) -> Term:
    """Return a term of one coefficient for each channel, by its own input: u^plain |u|^absolute."""
    first = 0 if triad == 'g' else len(AXES)
    products = tuple(
        (
            Parameter(kind, triad, i, i),
            Product((first + i,) * plain, (first + i,) * absolute, scale),
        )
        for i in range(3)
    )
    return Term(kind.value.key, kind, products, needs)


G_SENSITIVITY = Term(
    'g_sensitivity',
    ParameterKind.G_SENSITIVITY,
    tuple(
        (Parameter(ParameterKind.G_SENSITIVITY, 'g', i, j), Product((len(AXES) + j,)))
        for i in range(3)
        for j in range(3)
    ),
    'static dwells with each axis up and down, and turns about each',
)
"""G_ij f_j to gyro i (Luo 2018, section 6.2), row by row of G."""

GYRO_ASYMMETRY = _own(
    ParameterKind.GYRO_ASYMMETRY, 'g', 0, 1, 'turns about each axis, in both senses at two rates'
)
"""A_i |w_i|: scale factors that differ by 2 A between the senses; K is their mean."""

GYRO_RATE_DEPENDENCE = _own(
    ParameterKind.GYRO_RATE_DEPENDENCE,
    'g',
    1,
    1,
    'turns about each axis at two rates or more, four to tell it from gyro_cubic',
    1 / REFERENCE_RATE,
)
"""N_i w_i |w_i| / w_ref: a scale factor that changes with the rate, alike in both senses."""

GYRO_CUBIC = _own(
    ParameterKind.GYRO_CUBIC,
    'g',
    3,
    0,
    'turns about each axis at two rates or more, four to tell it from gyro_rate_dependence',
    1 / REFERENCE_RATE**2,
)
"""C_i w_i^3 / w_ref^2: a scale factor that changes with the square of the rate."""

GYRO_QUADRATIC = _own(
    ParameterKind.GYRO_QUADRATIC,
    'g',
    2,
    0,
    'turns about each axis, in both senses at three rates to tell it from gyro_asymmetry',
    1 / REFERENCE_RATE,
)
"""Q_i w_i^2 / w_ref: scale factors of both senses whose difference grows with the rate."""

ACCEL_QUADRATIC = _own(
    ParameterKind.ACCEL_QUADRATIC,
    'a',
    2,
    0,
    'static dwells with each axis up, down and horizontal, and at 45 degrees between to tell it '
    'from accel_asymmetry',
)
"""K2_i f_i^2 (IEEE Std 1293, K_2)."""

ACCEL_ASYMMETRY = _own(
    ParameterKind.ACCEL_ASYMMETRY,
    'a',
    0,
    1,
    'static dwells with each axis up, down and horizontal, and at 45 degrees between to tell it '
    'from accel_quadratic',
)
"""A_i |f_i|: scale factors that differ by 2 A between the signs; K is their mean."""

ACCEL_CUBIC = _own(
    ParameterKind.ACCEL_CUBIC,
    'a',
    3,
    0,
    'static dwells with each axis some 45 degrees off the vertical',
)
"""K3_i f_i^3 (IEEE Std 1293, K_3). At 0 and 1 g it cannot be separated from the scale factor."""

ACCEL_CROSS = Term(
    'accel_cross',
    ParameterKind.ACCEL_CROSS,
    tuple(
        (
            Parameter(ParameterKind.ACCEL_CROSS, 'a', i, j, k),
            Product((len(AXES) + j, len(AXES) + k)),
        )
        for i in range(3)
        for j, k in ((0, 1), (0, 2), (1, 2))
    ),
    'static dwells with two axes at once some 45 degrees off the vertical, in all quadrants of '
    'each pair',
)
"""X_ijk f_j f_k to accelerometer i, j < k (IEEE Std 1293, K_ip, K_io, K_po)."""

GYRO_G2 = Term(
    'gyro_g2',
    ParameterKind.GYRO_G2,
    tuple(
        (Parameter(ParameterKind.GYRO_G2, 'g', i, i), Product((len(AXES) + i,) * 2))
        for i in range(3)
    ),
    'static dwells with each axis up, down and horizontal, and turns about each',
)
"""G2_i f_i^2 to gyro i: specific force along its axis, independent of its sign (IEEE Std 952)."""

_OF_MOVES = (
    'moves from rest to rest about each axis, of a table with joint states, and pulses of the '
    'accelerometers that are small beside what these make of'
)

SIZE_EFFECT = Term(
    'size_effect',
    ParameterKind.PLACE,
    tuple(
        (Parameter(ParameterKind.PLACE, 'a', i, j), NOTHING)
        for i in range(3)
        for j in range(3)
        if i != j
    ),
    f'{_OF_MOVES} a centimetre',
    '(m, along the two other axes) as its place r_i: row i of ([dw/dt] + [w][w]) r_i',
)
"""Accelerometer i is at r_i. The reference point is a free choice, so one component of each place
is
fixed: that along its own axis is zero. The specific force refers to the point whose x, y and z are
those of the accelerometers x, y and z."""

DELAY = Term(
    'delay',
    ParameterKind.DELAY,
    ((Parameter(ParameterKind.DELAY, 'a', 0, None), NOTHING),),
    f'{_OF_MOVES} a millisecond',
    '(s after the gyros): it reads what it should have read so much earlier',
)
"""Delay of the accelerometers after the gyros; common to all three, since moves by right angles do
not separate a delay of one from a displacement of it."""

TERMS: tuple[Term, ...] = (
    G_SENSITIVITY,
    GYRO_ASYMMETRY,
    GYRO_RATE_DEPENDENCE,
    GYRO_CUBIC,
    GYRO_QUADRATIC,
    ACCEL_QUADRATIC,
    ACCEL_ASYMMETRY,
    ACCEL_CUBIC,
    ACCEL_CROSS,
    GYRO_G2,
    SIZE_EFFECT,
    DELAY,
)
"""All terms, in the order of vectors and covariances: after the 24 parameters."""

G_SENSITIVITIES: tuple[Parameter, ...] = G_SENSITIVITY.parameters
"""The nine g-sensitivities, which make 33 parameters."""


def named_terms(text: str) -> tuple[Term, ...]:
    """Return the terms in a text: 'none', or names with commas between; 'auto' is left out."""
    if text == NO_TERMS:
        return ()
    names = [name.strip() for name in text.split(',')]
    return tuple(dict.fromkeys(term(name) for name in names if name != AUTO_TERMS))


def asks_for_search(text: str) -> bool:
    """Return whether the search for terms is asked for: 'auto' among the names."""
    return AUTO_TERMS in [name.strip() for name in text.split(',')]


def term(name: str) -> Term:
    """Return the term of a name."""
    for known in TERMS:
        if known.name == name:
            return known
    names = ', '.join([*(known.name for known in TERMS), *SESSION_TERMS])
    raise InputError(f'No term is called {name!r}; there are: {names}.')


def coefficients_of(name: str) -> tuple[Parameter | Change, ...]:
    """Return the coefficients of a term of the sensors or of a session; none for other names."""
    if name.partition(':')[0] in SESSION_TERMS:
        return session_term(name)
    return tuple(p for one in TERMS if one.name == name for p in one.parameters)
