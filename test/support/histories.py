"""Made-up sessions of units for the tests of histories: plain loops over a model of scatter."""

from collections.abc import Callable, Sequence

import numpy as np

from imu_calib.fleet.results import Sessions
from imu_calib.model.parameters import PARAMETER_NAMES, PARAMETERS

SCALE = np.array([p.unit.scale for p in PARAMETERS])
"""SI value of ppm, arcmin, deg/h or ug, by parameter."""
START = np.datetime64('2020-01-01T00:00:00', 's')
MONTH = 30.4375 * 86400

Truth = Callable[[int, float, int, str], np.ndarray]
"""What a unit has beyond its scatter: (unit, months, session, stand) to (24,) in shown units."""


def index(name: str) -> int:
    return PARAMETER_NAMES.index(name)


def of(**sizes: float) -> np.ndarray:
    """Sizes in shown units, by parameter, as a vector of 24."""
    found = np.zeros(24)
    for name, size in sizes.items():
        found[index(name)] = size
    return found


def sessions(
    rng: np.random.Generator,
    units: int,
    count: int,
    *,
    turn_on: float = 1.0,
    stated: float = 0.5,
    apart: float = 50.0,
    interval: float = 6.0,
    stands: Sequence[str] = ('east',),
    truth: Truth | None = None,
    imu: str = 'fog',
) -> Sessions:
    """Units with sessions every six months or so, on stands by chance, in shown units.

    Args:
        rng: Of all chance.
        units: How many.
        count: Sessions of each.
        turn_on: Scatter between sessions, every parameter.
        stated: Within, as stated.
        apart: Of units from each other.
        interval: Months between sessions, give or take a month.
        stands: Names.
        truth: What is added.
        imu: Type.
    """
    serial, stand, date, values = [], [], [], []
    for unit in range(units):
        own = apart * rng.standard_normal(24)
        for k in range(count):
            months = interval * k + rng.uniform(0.0, 1.0)
            where = stands[int(rng.integers(len(stands)))]
            value = own + turn_on * rng.standard_normal(24) + stated * rng.standard_normal(24)
            if truth is not None:
                value = value + truth(unit, months, k, where)
            serial.append(f'{imu[0].upper()}{unit:03d}')
            stand.append(where)
            date.append(START + np.timedelta64(int(months * MONTH), 's'))
            values.append(value * SCALE)
    whole = len(serial)
    return Sessions(
        key=tuple(str(k) for k in range(whole)),
        serial=tuple(serial),
        imu=(imu,) * whole,
        lot=('',) * whole,
        stand=tuple(stand),
        date=np.array(date),
        values=np.array(values),
        covariance=np.tile(np.diag((stated * SCALE) ** 2), (whole, 1, 1)),
    )


def joined(*parts: Sessions) -> Sessions:
    """Sessions of several as those of one."""
    names = ('key', 'serial', 'imu', 'lot', 'stand')
    texts = {name: sum((getattr(p, name) for p in parts), ()) for name in names}
    arrays = {
        name: np.concatenate([getattr(p, name) for p in parts])
        for name in ('date', 'values', 'covariance')
    }
    return Sessions(**texts, **arrays)
