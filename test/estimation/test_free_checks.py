"""What contradicts a session in the hand is refused by its name: units, axes, latitude."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hand_sessions import spread_holds
from mems_by_hand import calibrator, held, result, unit
from sessions import SITE

from imu_calib.common.errors import Contradiction, InputError
from imu_calib.common.stream import Floats
from imu_calib.common.units import DEG, DEG_H
from imu_calib.estimation.evidence import Evidence
from imu_calib.estimation.hand import in_frame_of_accelerometers, solve
from imu_calib.model.terms import G_SENSITIVITY
from imu_calib.session.plan import load_plan

UPS = np.array([p.up for p in load_plan('free_positions').positions])[::2]
MODEL = in_frame_of_accelerometers(unit(3))


def session() -> Evidence:
    return held(MODEL, UPS, np.random.default_rng(5))


def seen_by(evidence: Evidence, gyros: Floats, accelerometers: Floats) -> Evidence:
    """Return the session as a driver hands it on that mixes channels by these (3, 3)."""

    def of_rest(mean: Floats) -> Floats:
        return np.concatenate([gyros @ mean[:3], accelerometers @ mean[3:]])

    segments = tuple(
        replace(s, statistics=replace(s.statistics, mean=of_rest(s.statistics.mean)))
        for s in evidence.segments
    )
    moves = tuple(replace(m, turned=m.turned @ gyros.T) for m in evidence.moves)
    return replace(evidence, segments=segments, moves=moves)


def test_a_sound_session_is_solved() -> None:
    fit = solve(session())
    assert np.abs(fit.model.gyro.response - MODEL.gyro.response).max() < 1e-3


@pytest.mark.parametrize('scale', [180 / np.pi, np.pi / 180, 1e-3, 1e3, 1 / 3600])
def test_gyros_in_other_units_are_refused_with_the_factor(scale: float) -> None:
    wrong = seen_by(session(), scale * np.eye(3), np.eye(3))
    words = re.escape(f'The gyros turn gravity {scale:.3g} times as far')
    with pytest.raises(InputError, match=words):
        solve(wrong)


@pytest.mark.parametrize('scale', [2.0, 0.5])
def test_half_and_twice_the_rate_of_the_samples_are_refused(scale: float) -> None:
    wrong = seen_by(session(), scale * np.eye(3), np.eye(3))
    # By steps of 1.1 %.
    words = r'The gyros turn gravity (1\.9[89]|2(\.0[12])?|0\.(49\d|50\d|5)) times as far'
    with pytest.raises(InputError, match=f'{words}.* A wrong sample rate'):
        solve(wrong)


@pytest.mark.parametrize('scale', [0.6, 1.7])
def test_a_scale_that_no_mistake_explains_is_solved(scale: float) -> None:
    fit = solve(seen_by(session(), scale * np.eye(3), np.eye(3)))
    assert np.abs(fit.model.gyro.response - scale * MODEL.gyro.response).max() < 2e-3


@pytest.mark.parametrize('scale', [1 / 9.81, 9.81])
def test_accelerometers_in_other_units_are_refused_with_the_factor(scale: float) -> None:
    wrong = seen_by(session(), np.eye(3), scale * np.eye(3))
    with pytest.raises(InputError, match=r'The accelerometers read (0\.10|9\.8)\d* times'):
        solve(wrong)


EXCHANGED = [
    (np.diag([-1.0, 1, 1]), np.eye(3), 'from hold to hold gyro x answers to -X. '),
    (np.eye(3)[[1, 0, 2]], np.eye(3), 'gyro x answers to Y, gyro y answers to X. '),
    (np.eye(3)[[1, 2, 0]], np.eye(3), 'gyro x answers to Y, gyro y answers to Z, gyro z answers'),
    (
        np.eye(3),
        np.diag([1.0, -1, 1]),
        'gyro x answers to -X, gyro z answers to -Z (accelerometer y with a wrong sign looks the',
    ),
]


@pytest.mark.parametrize(('gyros', 'accelerometers', 'words'), EXCHANGED)
def test_exchanged_and_mirrored_channels_are_named(
    gyros: Floats, accelerometers: Floats, words: str
) -> None:
    wrong = seen_by(session(), gyros, accelerometers)
    with pytest.raises(Contradiction) as error:
        solve(wrong)
    assert words in str(error.value)


def on_the_earth(latitude: float) -> Evidence:
    """A session at SITE whose gyros see what turns about up, said to be at a latitude.

    The noise of a hold is 4 deg/h; turns take a second each, in which the Earth does not count.
    """
    evidence = held(MODEL, UPS, np.random.default_rng(8), replace(SITE, latitude=latitude))
    rate = 15.041 * DEG_H * np.sin(SITE.latitude)
    segments = []
    for segment, up in zip(evidence.segments, UPS, strict=True):
        mean = segment.statistics.mean.copy()
        mean[:3] += MODEL.gyro.response @ up * rate
        segments.append(replace(segment, statistics=replace(segment.statistics, mean=mean)))
    return replace(evidence, segments=tuple(segments))


def test_another_hemisphere_is_no_g_sensitivity() -> None:
    fit = solve(on_the_earth(SITE.latitude))
    assert len(fit.parameters) == 24
    with pytest.raises(Contradiction) as error:
        solve(on_the_earth(-SITE.latitude))
    assert f'fit a latitude of {SITE.latitude / DEG:.2f} deg' in str(error.value)
    assert 'or all accelerometers have: at rest' in str(error.value)


def test_accelerometers_of_the_opposite_sign_are_named() -> None:
    negated = seen_by(on_the_earth(SITE.latitude), np.eye(3), -np.eye(3))
    with pytest.raises(Contradiction, match='or all accelerometers have: at rest'):
        solve(negated)


def test_the_screen_names_the_terms_that_were_estimated() -> None:
    coefficients = np.full(9, 0.2 * DEG / 9.81)
    model = unit(4).with_values(G_SENSITIVITY.parameters, coefficients)
    found = calibrator(spread_holds(30, 4), model, 4).finish()
    assert found.terms[0] == 'terms: g_sensitivity'
    assert result(0).terms[0] == 'terms: none'
