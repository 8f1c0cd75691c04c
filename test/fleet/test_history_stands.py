"""Unit or stand, and the population: who is named, who is not, and what cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
from histories import SCALE, index, joined, of, sessions
from scipy import stats
from scipy.spatial.transform import Rotation

from imu_calib.fleet.evaluation import backtest
from imu_calib.fleet.results import Rules
from imu_calib.fleet.scatter import critical_deviate, lot_shifts, outliers
from imu_calib.fleet.stands import crossed, turned
from imu_calib.model.parameters import PARAMETER_NAMES

LIMITS = {'fog': 1e4 * SCALE}
THREE = ('east', 'south', 'west')

# Of a navigation-grade unit: repeatability of scale factors, ppm, and of alignment, arcmin.
PPM_ROUGH, ARCMIN_ROUGH = 5.0, 0.01
ROUGH = np.where(SCALE < 1e-5, PPM_ROUGH, 1.0)
for _name in PARAMETER_NAMES:
    if _name.startswith('E'):
        ROUGH[index(_name)] = ARCMIN_ROUGH


def laboratory(seed: int, shift: np.ndarray, stands=THREE, units: int = 30, count: int = 6):
    """Thirty units with the scatter of navigation grade; one stand shifts them, shown units."""

    def truth(unit: int, months: float, k: int, stand: str) -> np.ndarray:
        return shift / ROUGH * (stand == 'south')

    made = sessions(
        np.random.default_rng(seed),
        units,
        count,
        turn_on=0.9,
        stated=0.4,
        apart=40.0,
        stands=stands,
        truth=truth,
    )
    return replace(
        made,
        values=made.values * ROUGH,
        covariance=made.covariance * np.outer(ROUGH, ROUGH),
    )


def test_a_stand_that_shifts_accelerometers_by_5_ppm_is_named():
    found = backtest(laboratory(1, of(K_ax=5.0, K_ay=5.0, K_az=5.0)), LIMITS)
    (shift,) = found.stands.shifts
    assert (shift.stand, shift.what, shift.identified) == ('south', 'K_a', True)
    assert shift.others == ('east', 'west') and shift.units >= 25 and shift.unit == '1'
    assert shift.low < 5e-6 < shift.high and shift.chance < 0.01
    assert found.findings[0].startswith('Stand south is off: it adds +')
    assert 'ppm' in found.findings[0] and 'east and west agree' in found.findings[0]


@pytest.mark.parametrize('name', ['E_gxy', 'E_azx'])
def test_a_stand_that_shifts_a_misalignment_by_a_hundredth_of_an_arcminute_is_named(name):
    found = backtest(laboratory(2, of(**{name: 0.01})), LIMITS)
    (shift,) = found.stands.shifts
    assert (shift.stand, shift.what, shift.identified) == ('south', name, True)
    assert shift.low < 0.01 * SCALE[index(name)] < shift.high


def test_units_last_calibrated_on_a_stand_that_is_off_say_so():
    laid = laboratory(3, 0.30 * turned(2))
    found = backtest(laid, LIMITS)
    carrying = [unit.serial for unit in found.units if unit.stand[-1] == 'south']
    assert 5 < len(carrying) < 15 and [unit.serial for unit in found.off_stand] == carrying
    said = [u.serial for u in found.units if 'from stand south, which is off' in u.findings[0]]
    assert said == carrying
    # Of two stands nobody knows which is off: no unit is accused.
    pair = backtest(laboratory(6, 0.30 * turned(2), stands=('east', 'south')), LIMITS)
    assert pair.stands.shifts and pair.off_stand == ()


def test_a_stand_that_is_far_off_is_named_once():
    """Chances of large shifts are all zero in floating point."""
    found = backtest(laboratory(1, of(K_ax=5e4, K_ay=5e4, K_az=5e4)), LIMITS)
    assert [(s.stand, s.what, s.identified) for s in found.stands.shifts] == [
        ('south', 'K_a', True)
    ]


def test_a_fixture_that_is_turned_is_one_shift():
    found = backtest(laboratory(3, 0.01 * turned(1)), LIMITS)
    (shift,) = found.stands.shifts
    assert (shift.stand, shift.what) == ('south', 'E about Y')
    assert set(shift.parameters) == {'E_gxz', 'E_gzx', 'E_axz', 'E_azx'}


@pytest.mark.parametrize('remounted', [0.0, 0.02, 0.2])
@pytest.mark.parametrize('stands', [THREE, ('east', 'south')])
def test_a_fixture_that_is_turned_far_is_one_shift_of_its_size(remounted, stands):
    """However units turn in it from session to session: that scatter has the same pattern."""
    laid = laboratory(3, 0.30 * turned(2), stands=stands)
    rng = np.random.default_rng(21)
    scatter = remounted * rng.standard_normal(len(laid.values)) * SCALE[index('E_gxy')]
    laid = replace(laid, values=laid.values + np.outer(scatter, turned(2)))
    found = backtest(laid, LIMITS)
    (shift,) = found.stands.shifts
    assert (shift.what, shift.identified) == ('E about Z', len(stands) > 2)
    one = 1.0 if shift.stand == 'south' else -1.0
    arcmin = SCALE[index('E_gxy')]
    # 180 sessions, a third or half of them there: the deviation of a difference of means.
    assert 0.5 < shift.std / arcmin / np.hypot(remounted, 0.01 / 2) / np.sqrt(4.5 / 180) < 2
    assert one * shift.shift / arcmin == pytest.approx(0.30, abs=4 * shift.std / arcmin)
    # None of it is left in the corrected values: what they differ by is what the size is off by.
    at_south = np.array([name == 'south' for name in laid.stand])
    raw = np.concatenate([unit.values for unit in found.units])
    corrected = np.concatenate([unit.corrected for unit in found.units])
    removed = np.ptp((raw - corrected) @ turned(2) / 4)
    assert removed == pytest.approx(abs(shift.shift), rel=1e-9)
    assert at_south.any()


def test_a_turned_fixture_is_found_in_a_short_history_as_one_parameter_would_be():
    """Of three units: weights from correlations of so few sessions would leave no freedom."""
    laid = laboratory(3, 0.30 * turned(2), units=3, count=4)
    (shift,) = backtest(laid, LIMITS).stands.shifts
    assert (shift.stand, shift.what, shift.identified) == ('south', 'E about Z', True)
    units = np.unique(laid.serial, return_inverse=True)[1]
    stands = np.unique(laid.stand, return_inverse=True)[1]
    months = (laid.date - laid.date.min()).astype(float)[:, None] / 1e8
    alone = crossed(units, stands, months, laid.values @ turned(2) / 4, np.ones(12))
    # One stand that is off by g has an effect of 2 g / 3 of the mean of three.
    white = np.linalg.pinv(alone.covariance, rcond=1e-9, hermitian=True)
    column = np.eye(3)[1] - 1 / 3
    std = 1 / np.sqrt(column @ white @ column)
    assert shift.std == pytest.approx(std, rel=0.1)
    assert shift.shift == pytest.approx(std**2 * (column @ white @ alone.effect), abs=std)
    reach = stats.t.isf(0.025 / (29 * 3), alone.freedom)
    assert shift.high - shift.shift == pytest.approx(reach * shift.std)
    assert shift.low < 0.30 * SCALE[index('E_gxy')] < shift.high and shift.low > 0


def test_a_turned_unit_has_the_misalignments_of_the_turn():
    """Against rotations of the input itself: a unit turned by t measures R(t)' f."""
    for axis in range(3):
        angle = np.zeros(3)
        angle[axis] = 1e-6
        matrix = Rotation.from_rotvec(angle).as_matrix().T - np.eye(3)
        expected = {
            f'E_{t}{"xyz"[i]}{"xyz"[j]}': matrix[i, j] / 1e-6
            for t in 'ga'
            for i in range(3)
            for j in range(3)
            if i != j
        }
        got = dict(zip(PARAMETER_NAMES, turned(axis), strict=True))
        for name, value in expected.items():
            assert got[name] == pytest.approx(value, abs=1e-5)


def test_what_a_stand_adds_is_no_step_of_its_units():
    """Units that move to a stand that is off look as if they stepped; the stand is at fault."""
    shift = of(K_ax=40.0, K_ay=40.0, K_az=40.0)
    rng = np.random.default_rng(4)

    def truth(unit, months, k, stand):
        return shift / ROUGH * (stand == 'south')

    stays = sessions(rng, 10, 6, stands=('east', 'west'), truth=truth)
    moves = sessions(rng, 20, 6, stands=('south',), truth=lambda *_: of())
    stand = tuple('south' if k % 6 >= 3 else ('east', 'west')[k % 2] for k in range(120))
    values = moves.values + np.outer([s == 'south' for s in stand], shift / ROUGH * SCALE)
    # Some come back, or the stand's shift would be the drift of all.
    stand = tuple('east' if k % 6 == 5 else s for k, s in enumerate(stand))
    values[5::6] -= shift / ROUGH * SCALE
    moves = replace(moves, stand=stand, values=values, serial=tuple(f'M{s}' for s in moves.serial))
    found = backtest(joined(stays, moves), LIMITS)
    (one,) = found.stands.shifts
    assert (one.stand, one.what) == ('south', 'K_a')
    assert not any(unit.steps for unit in found.units)
    moved = next(u for u in found.units if u.serial.startswith('M'))
    p = index('K_ax')
    raw = moved.values[3, p] - moved.corrected[3, p]
    assert raw / SCALE[p] == pytest.approx(40.0 / ROUGH[p], abs=1.0)


def test_what_a_unit_does_is_not_blamed_on_a_stand():
    """One of thirty units is repaired at the stand where it goes then."""

    def truth(unit, months, k, stand):
        return of(K_gx=300.0) * (unit == 0 and k >= 3)

    made = sessions(np.random.default_rng(5), 30, 6, stands=THREE, truth=truth)
    stand = (*('east',) * 3, *('south',) * 3, *made.stand[6:])
    found = backtest(replace(made, stand=stand), LIMITS)
    assert found.stands.shifts == ()
    assert [s.parameters for s in found.units[0].steps] == [('K_gx',)]


def test_of_two_stands_none_is_blamed():
    found = backtest(laboratory(6, of(K_ax=9, K_ay=9, K_az=9), stands=('east', 'south')), LIMITS)
    (shift,) = found.stands.shifts
    assert not shift.identified and {shift.stand, *shift.others} == {'east', 'south'}
    assert 'Which of them is off needs a further stand' in found.findings[0]


def test_stands_that_no_unit_links_are_not_compared():
    """All units of one stand are shifted: nobody can tell it from the units, and nobody says so."""
    rng = np.random.default_rng(7)
    shift = of(K_ax=100.0, K_ay=100.0, K_az=100.0)
    one = sessions(rng, 15, 4, stands=('east',), apart=1.0)
    other = sessions(rng, 15, 4, stands=('south',), apart=1.0, truth=lambda *_: shift)
    other = replace(other, serial=tuple(f'S{s}' for s in other.serial))
    found = backtest(joined(one, other), LIMITS)
    assert found.stands.shifts == () and np.isnan(found.stands.effect).all()
    assert found.stands.groups == (('east',), ('south',))
    assert any('No unit links these stands: east; south' in s for s in found.findings)
    alone = backtest(one, LIMITS)
    assert any('All sessions were on one stand, east' in s for s in alone.findings)
    unknown = backtest(replace(one, stand=('',) * 60), LIMITS)
    assert any('No session says on which stand' in s for s in unknown.findings)


def test_one_unit_on_both_sides_links_groups():
    rng = np.random.default_rng(8)
    one = sessions(rng, 5, 4, stands=('a', 'b'))
    other = sessions(rng, 5, 4, stands=('c', 'd'))
    other = replace(other, serial=tuple(f'S{s}' for s in other.serial))
    apart = backtest(joined(one, other), LIMITS)
    assert apart.stands.groups == (('a', 'b'), ('c', 'd'))
    linked = replace(other, serial=(one.serial[0], *other.serial[1:]))
    together = backtest(joined(one, linked), LIMITS)
    assert together.stands.groups == (('a', 'b', 'c', 'd'),)


def test_stands_used_one_after_the_other_are_not_told_from_drift():
    """Every unit drifts alike, and all moved to another stand on the same day."""
    made = sessions(np.random.default_rng(9), 20, 2, stands=('old',), truth=lambda *_: of())
    date = np.where(np.arange(40) % 2, made.date[1], made.date[0])
    stand = tuple('new' if k % 2 else 'old' for k in range(40))
    values = made.values + np.outer(np.arange(40) % 2, 50 * SCALE)
    found = backtest(replace(made, date=date, stand=stand, values=values), LIMITS)
    assert found.stands.shifts == ()
    assert any('cannot be separated from the drift of the units' in s for s in found.findings)


def test_effects_of_a_balanced_design_are_differences_of_means():
    """Each unit on each stand: the effect is the mean of the differences, worked out by hand."""
    rng = np.random.default_rng(10)
    table = rng.standard_normal((40, 3)) + np.array([0.0, 1.0, -0.5])
    units, stands = np.repeat(np.arange(40), 3), np.tile(np.arange(3), 40)
    own = 100.0 * rng.standard_normal(40)[units]
    found = crossed(units, stands, np.zeros((120, 0)), table.ravel() + own, np.ones(120))
    expected = table.mean(axis=0) - table.mean()
    # Huber's weights take little off where all is normal.
    assert found.effect == pytest.approx(expected, abs=0.03)
    residuals = table - table.mean(axis=1, keepdims=True) - expected
    plain = np.sqrt(np.sum(residuals**2) / 78 / 40 * 2 / 3)
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.full(3, plain), rel=0.1)
    assert found.freedom == 78 and found.comparable


def test_stands_are_named_as_seldom_as_stated_where_none_is_off():
    """In effects alone, which is where it is decided: 24 parameters of small laboratories."""
    rng = np.random.default_rng(12)
    large, count = 0, 0
    for _ in range(100):
        units = np.repeat(np.arange(8), 4)
        stands = rng.integers(0, 3, 32)
        values = rng.standard_normal(32) + 50 * rng.standard_normal(8)[units]
        found = crossed(units, stands, np.zeros((32, 0)), values, np.ones(32))
        if found.comparable:
            t = found.effect / np.sqrt(np.diag(found.covariance))
            large += int(np.sum(np.abs(t) > 2.080))  # 5 % of Student's t, 21 to 22 degrees
            count += 3
    # Three effects of one laboratory hang together: as if half as many.
    assert large / count == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / (count / 2)))


def test_effects_in_short_histories_are_far_out_as_seldom_as_students_t():
    """Where stands are named, 1 % over 87 tests: three units, six degrees of freedom."""
    rng = np.random.default_rng(13)
    units, limit = np.repeat(np.arange(3), 4), 0.01 / 87
    large, count = 0, 0
    for _ in range(2000):
        stands = rng.integers(0, 3, 12)
        values, months = rng.standard_normal(12), rng.uniform(0, 1, (12, 1))
        found = crossed(units, stands, months, values, np.ones(12))
        if len(found.effect) == 3 and found.comparable:
            t = found.effect / np.sqrt(np.diag(found.covariance))
            large += int(np.sum(2 * stats.t.sf(np.abs(t), found.freedom) < limit))
            count += 3
    # Three effects of one laboratory hang together: as if half as many.
    assert count > 5000 and large / count < limit + 3 * np.sqrt(limit / (count / 2))


# Rosner 1983, as in the NIST/SEMATECH handbook, 1.3.5.17.3.
ROSNER = np.array(
    [
        -0.25,
        0.68,
        0.94,
        1.15,
        1.20,
        1.26,
        1.26,
        1.34,
        1.38,
        1.43,
        1.49,
        1.49,
        1.55,
        1.56,
        1.58,
        1.65,
        1.69,
        1.70,
        1.76,
        1.77,
        1.81,
        1.91,
        1.94,
        1.96,
        1.99,
        2.06,
        2.09,
        2.10,
        2.14,
        2.15,
        2.23,
        2.24,
        2.26,
        2.35,
        2.37,
        2.40,
        2.47,
        2.54,
        2.62,
        2.64,
        2.90,
        2.92,
        2.92,
        2.93,
        3.21,
        3.26,
        3.30,
        3.59,
        3.68,
        4.30,
        4.64,
        5.34,
        5.42,
        6.01,
    ]
)


def test_outliers_are_those_of_rosners_example(monkeypatch):
    monkeypatch.setattr('imu_calib.fleet.scatter._SHARE', 5)
    assert sorted(ROSNER[outliers(ROSNER, 0.05)]) == [5.34, 5.42, 6.01]
    critical = [critical_deviate(54, i, 0.05) for i in range(1, 6)]
    assert critical == pytest.approx([3.158, 3.151, 3.143, 3.136, 3.128], abs=1e-3)


def test_a_unit_and_a_lot_apart_are_found():
    def truth(unit, months, k, stand):
        return of(E_gxy=400.0) * (unit == 3) + of(D_az=150.0) * (unit >= 30)

    made = sessions(np.random.default_rng(13), 40, 2, truth=truth)
    lots = tuple('B' if int(s[1:]) >= 30 else 'A' for s in made.serial)
    population = backtest(replace(made, lot=lots), LIMITS).populations['fog']
    (outlier,) = population.outliers
    assert (outlier.serial, outlier.parameter) == ('F003', 'E_gxy') and abs(outlier.score) > 4
    assert {lot.parameter for lot in population.lots} == {'D_az'}
    (lot,) = (lot for lot in population.lots if lot.lot == 'B')
    assert lot.units == 10
    # Units are 50 apart: ten against thirty.
    assert lot.shift / SCALE[index('D_az')] == pytest.approx(150, abs=4 * 50 / np.sqrt(7.5))


def test_lots_are_compared_by_what_units_differ_within():
    values = np.array([1.0, 2.0, 3.0, 5.0, 6.0, 7.0, 9.0])
    (first, second) = lot_shifts(values, ['A', 'A', 'A', 'B', 'B', 'B', ''])
    # Means 2 and 6, variance within 1: sqrt(1/3 + 1/3).
    assert first[:4] == ('A', 3, -4.0, pytest.approx(np.sqrt(2 / 3)))
    assert second[2] == 4.0
    assert lot_shifts(values, ['A', 'A', 'A', 'B', '', '', '']) == []


def test_a_population_says_how_its_units_are_distributed():
    made = sessions(np.random.default_rng(14), 200, 1, apart=30.0)
    population = backtest(made, LIMITS, Rules()).populations['fog']
    expected = np.sqrt(30.0**2 + 1.0 + 0.25)
    # Of 200 units: 5 % by standard deviation, 8 % by median absolute deviation, 24 of each.
    assert population.std / SCALE == pytest.approx(np.full(24, expected), rel=0.2)
    assert population.robust_std / SCALE == pytest.approx(np.full(24, expected), rel=0.35)
    low, *_, high = population.quantiles / SCALE
    assert np.mean(high - low) == pytest.approx(2 * 1.645 * expected, rel=0.1)
    assert (population.count == 200).all() and population.units == 200
