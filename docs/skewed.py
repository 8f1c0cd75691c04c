"""Write docs/skewed.md: what weights are worth where a gyro's noise grows with the rate.

Usage: python docs/skewed.py
"""

from pathlib import Path

import numpy as np

from imu_calib.calibration.calibration import Calibration
from imu_calib.common.files import named_file
from imu_calib.common.units import ARCSEC, DEG, DEG_H
from imu_calib.estimation.closed_forms.skewed import RatePoints
from imu_calib.model.earth import Site, normal_gravity

RUNS = 200
SITE = Site.at(34.65 * DEG, gravity=normal_gravity(34.65 * DEG))
RATES = np.array([5.0, 20, 50, 100, 150]) * DEG
GROWTHS = np.array([0.0, 0.2, 1.0, 5.0]) * 1e-6
FLOOR = 0.05 * DEG_H
TURNS = (1, 2, 4, 8)


def couplings() -> np.ndarray:
    """Return the unit's sixteen numbers: (4 channels, responses to X, Y, Z and bias)."""
    model = Calibration.load(named_file('truths', 'fog_skewed')).model
    plain = np.column_stack([model.gyro.response, model.gyro.bias])
    return np.vstack([plain, np.append(model.skewed.response[0], model.skewed.bias[0])])


def points(rng: np.random.Generator, turns: int, growth: float) -> tuple[RatePoints, np.ndarray]:
    """Return one session's rate points and the true variances (t, 4) of their outputs."""
    signed = np.concatenate([[r, -r] for r in RATES])
    rates = np.tile(signed, 3)
    inputs = np.repeat(np.eye(3), len(signed), axis=0) * (rates + SITE.up_rate)[:, None]
    numbers = couplings()
    sigma = np.hypot(FLOOR, growth * rates)[:, None]
    clean = inputs @ numbers[:, :3].T + numbers[:, 3]
    each = clean[:, None] + sigma[:, None] * rng.standard_normal((len(rates), turns, 4))
    spread = np.full(clean.shape, np.nan)
    if turns > 1:
        spread = each.var(axis=1, ddof=1) / turns
    true = np.repeat(sigma**2 / turns, 4, axis=1)
    groups = np.searchsorted(RATES, np.abs(rates) - 1e-9)
    error = np.zeros(len(rates))
    return RatePoints(inputs, each.mean(axis=1), true, groups, spread, rates, error), true


def ratios(turns: int, growth: float) -> np.ndarray:
    """Return the error of weighted over plain: (2 own and true weights, 2 responses and bias)."""
    square = np.zeros((3, 4, 4))
    for seed in range(RUNS):
        session, true = points(np.random.default_rng(seed), turns, growth)
        plain = np.einsum('cut,tc->cu', session.weights()[0], session.outputs)
        for k, variances in enumerate((None, session.pooled(plain), true)):
            found = np.einsum('cut,tc->cu', session.weights(variances)[0], session.outputs)
            square[k] += (found - couplings()) ** 2
    relative = np.sqrt(square[1:] / square[0])
    rms = [np.sqrt(np.mean(relative[:, :, c] ** 2, axis=(1, 2))) for c in (slice(3), slice(3, 4))]
    return np.array(rms).T


def main() -> None:
    """Run the study and write the page."""
    rows = []
    for growth in GROWTHS:
        for turns in TURNS:
            own, true = ratios(turns, growth)
            rows.append(
                f'| {growth * 1e6:.1f} ppm | {turns} | {own[0]:.2f} | {true[0]:.2f} '
                f'| {own[1]:.2f} | {true[1]:.2f} |'
            )
    listed = ', '.join(f'{r / DEG:.0f}' for r in RATES)
    floor, fastest = FLOOR / DEG_H, RATES[-1] / DEG
    spins = f'{np.hypot(FLOOR, 1e-6 * RATES[-1]) * 2 * np.pi / RATES[-1] / ARCSEC:.2f}'
    text = f"""# Weights for three orthogonal gyros and one skewed

Written by `docs/skewed.py`. CN103697918A fits the outputs at each rate by least squares and then
weights them by their spread. Here a turn's mean has a noise of {floor:.2f} deg/h and, on top, a
part that grows with the rate (1 ppm at {fastest:.0f} deg/s is {spins} arcsec in a turn). Rates of
+-{listed} deg/s about X, Y and Z up, {RUNS} runs; the root mean square error of the weighted
solution over that of the plain one, for the twelve responses and the four biases, with weights from
the spread and with true ones.

| growth | turns per point | responses | true weights | biases | true weights |
|---|---|---|---|---|---|
{chr(10).join(rows)}

- With one turn per point the weight comes from the residuals of the plain fit, pooled over the six
  points of one |rate|: a point's own single residual gives no spread. With several turns it is
  their scatter about the point, pooled in the same way.
- If the noise does not grow, weights gain nothing, and estimated weights increase the error by up
  to a sixth. The supplied plan makes three turns per point; four reduce this to below 5 %.
- True weights are the lower bound: they are known only in a simulation. {RUNS} runs determine a
  ratio to about 3 %.
- Biases gain most: the slow turns determine them, and in the plain solution the fast turns add
  noise.
"""
    Path(__file__).with_name('skewed.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
