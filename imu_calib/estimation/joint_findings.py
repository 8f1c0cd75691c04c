"""Findings on a joint estimate: outliers and scatter that the user must know."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.units import ARCSEC, DEG, DEG_H, MICRO_G, significant
from ..model.session_terms import names_of
from .checks import turns_scatter_finding
from .estimate import Estimate
from .evidence import Evidence
from .exact_table import SHOWN
from .outliers import Outlier, RejectedMove
from .session_model import Nuisance
from .temperature_change import temperature_finding

_SIGNIFICANT = 0.1
"""Of the stated values: positioning errors below it change no deviation by more than half a
percent, biases that drift by so much more by no more than a tenth."""
_OF_ATTITUDE = {'gyros': 'g_sensitivity', 'accelerometers': 'accel_cross'}
"""The largest of the terms that change with the attitude, for each triad."""
_NAMED = 3
"""Moves named in a sentence; users inspect the first ones."""


def estimate_findings(found: Estimate, confounded: Sequence[str]) -> list[str]:
    """Return the findings on an estimate, in sentences.

    `confounded` names errors of the table that positioning errors may be in fact.
    """
    notes = []
    if found.outliers:
        names = ', '.join(
            f'{o.name} ({np.sqrt(o.chi_square):.0f} sigma{_tilt_explanation(found, o)})'
            for o in found.outliers
        )
        plural = 's' * (len(found.outliers) > 1)
        notes.append(f'Outlier{plural}, given less weight: {names}.')
    notes += _rejected_moves_finding(found)
    if found.turns_scatter > 1:
        notes.append(turns_scatter_finding(found.turns_scatter))
    if found.equations.any_heading:
        azimuth, std = found.nuisance(Nuisance.AZIMUTH)
        notes.append(
            f'The gyros see north {azimuth / DEG:.1f} +- {std / DEG:.1f} deg off the azimuth '
            'given, which is therefore not used.'
        )
    if found.equations.levelled is not None:
        tilts = [found.nuisance(which)[0] for which in (Nuisance.TILT_X, Nuisance.TILT_Y)]
        tilt, level = float(np.linalg.norm(tilts)), found.equations.evidence.levelling
        notes.append(
            f'The table is tilted by {tilt / ARCSEC:.0f} arcsec, more than the '
            f'{significant(level / ARCSEC, 3)} arcsec to which it was taken to be level.'
        )
    notes += [_constant_finding(found)] if found.constant else []
    return [*notes, *temperature_finding(found), *_scatter_findings(found, confounded)]


def _tilt_explanation(found: Estimate, outlier: Outlier) -> str:
    """Return the attitude error of the table that explains this; empty where it explains little.

    The residual along gravity is then below a third of the 5.5 deviations from which on a dwell
    gets less weight: two, as by noise.
    """
    equations = found.equations
    if not any(np.array_equal(rows, outlier.rows) for rows in equations.layout.dwell[:, 3:]):
        return ''
    force = equations.predict(found.state)[outlier.rows]
    # Channels lie along their axes to milliradians, and so do their errors.
    off = (equations.outputs[outlier.rows] - force) / np.linalg.norm(force)
    along = float(off @ force) / float(np.linalg.norm(force))
    lean = float(np.linalg.norm(np.cross(off, force))) / float(np.linalg.norm(force))
    return (
        f', as an attitude error of the table of {significant(lean / ARCSEC)} arcsec makes it'
        if abs(along) < lean / 3
        else ''
    )


def _constant_finding(found: Estimate) -> str:
    """Report coefficients of changes during the session that it does not determine."""
    names = ', '.join(c.name for c in found.constant)
    return (
        f'The session does not determine how {names} change '
        f'({" and ".join(names_of(found.constant))}): taken as constant. Moves between dwells, or '
        'turns about each axis at the beginning and at the end, would determine it for gyros; '
        'dwells with each axis up and down there for accelerometers.'
    )


def _rejected_moves_finding(found: Estimate) -> list[str]:
    """Report the moves or velocities that were left out, their errors and possible causes."""
    notes = []
    turned = [move for move in found.rejected_moves if not move.velocity]
    pushed = [move for move in found.rejected_moves if move.velocity]
    used = found.equations.evidence.used_moves
    if turned:
        off = max(move.misclosure for move in turned)
        unit, words = (DEG, 'deg') if off >= DEG else (ARCSEC, 'arcsec')
        angle = f'{significant(off / unit, 3)} {words}'
        notes.append(
            f'By the gyros {len(turned)} of {len(turned) + len(used)} moves end elsewhere than by '
            f'the encoders ({_names_of_moves(turned)}; {angle} at most): they are left out. '
            'Possible causes: rates beyond the range of the gyros, nonlinear gyros, samples that '
            'freeze on the way, and a table whose axes are not where its description says.'
        )
    if pushed:
        speed = max(move.misclosure for move in pushed)
        notes.append(
            f'By the accelerometers {len(pushed)} of {len(pushed) + len(used.with_accels)} moves '
            f'do not end at rest ({_names_of_moves(pushed)}; {speed:.3g} m/s at most): their '
            'velocities are left out. Possible causes: nonlinear accelerometers, samples that '
            'freeze on the way, and a unit that vibrates in its mount.'
        )
    return notes


def _names_of_moves(moves: Sequence[RejectedMove]) -> str:
    """Return the names of the first of several moves."""
    names = ', '.join(' to '.join(move.positions) for move in moves[:_NAMED])
    more = '' if len(moves) <= _NAMED else f' and {len(moves) - _NAMED} more'
    return f'from position {names}{more}'


def _scatter_findings(found: Estimate, confounded: Sequence[str] = ()) -> list[str]:
    """Report scatter beyond the noise and beyond the files of table and IMU."""
    return [*_positioning_findings(found, confounded), *_drift_findings(found)]


def _positioning_findings(found: Estimate, confounded: Sequence[str]) -> list[str]:
    """Report positioning errors beyond those that the table's file states."""
    evidence, scatter = found.equations.evidence, found.scatter
    notes = []
    small = evidence.positioning / ARCSEC
    stated = f'{significant(small, 3)} arcsec' if small else 'none'
    known = f"the table's description states {stated}"
    if evidence.table is not None and 'positioning' in evidence.table.not_stated:
        known = f'{stated} are assumed of the table'
    joints, stops = scatter.positioning.joints, scatter.positioning.stops
    if scatter.positioning_probability < SHOWN:
        # The deviations allow for it by its probability; it is not what happened.
        joints = stops = 0.0
    if evidence.plan.by_hand and (lean := float(np.hypot(joints, stops))):
        notes.append(
            f'The holds lean by {lean / DEG:.2g} deg about each level axis against the plan: the '
            'standard deviations allow for it, and for as much in the turns. Hold the unit, or a '
            'box that it is fixed to, against something level; free positions need no level holds.'
        )
    elif joints > _SIGNIFICANT * evidence.positioning:
        notes.append(
            f'Positioning errors of {significant(joints / ARCSEC)} arcsec, which encoders do not '
            f'show, explain the scatter of the residuals ({known}): the standard deviations allow '
            f'for them.{_in_steps(joints, evidence)}'
        )
    if stops > _SIGNIFICANT * max(joints, evidence.positioning) and not evidence.plan.by_hand:
        notes.append(
            f'Attitude errors of the whole table, {significant(stops / ARCSEC)} arcsec about each '
            'axis and others at each stop, explain the scatter of the residuals: the standard '
            'deviations allow for it.'
        )
    if notes and confounded:
        notes[-1] += (
            f' In so few positions they cannot be distinguished from {" and ".join(confounded)}. A '
            'second session at the same positions would show which: the same residuals mean the '
            'axes and the encoders, others the stops. So would stops at more angles of each joint.'
        )
    return notes


def _drift_findings(found: Estimate) -> list[str]:
    """Report bias drift and fast scatter beyond the bias instability that the IMU's file states."""
    evidence, scatter = found.equations.evidence, found.scatter
    notes = []
    for name, first, unit, symbol in (
        ('gyros', 0, DEG_H, 'deg/h'),
        ('accelerometers', 3, MICRO_G, 'ug'),
    ):
        drift, stated_of = scatter.bias_drift[first], evidence.instability[first]
        if drift > (1 + _SIGNIFICANT) * stated_of:
            stated = f'{significant(stated_of / unit, 3)} {symbol}' if stated_of else 'none'
            if scatter.fast_drift[first // 3]:
                notes.append(
                    f'The {name} scatter from dwell to dwell by '
                    f'{significant(drift / unit)} {symbol}, more than their noise, and faster than '
                    f'biases drift (the description of the IMU states {stated} for those): the '
                    'standard deviations allow for it. Possible causes: a floor that shakes, and '
                    'errors that depend on the attitude and are too small to be identified '
                    f'({_OF_ATTITUDE[name]}). A second session shows which: the same residuals at '
                    'the same positions mean the attitude.'
                )
                continue
            notes.append(
                f'The biases of the {name} drift by {significant(drift / unit)} {symbol} (the '
                f'description of the IMU states {stated}): the standard deviations allow for it.'
            )
    return notes


def _in_steps(errors: float, evidence: Evidence) -> str:
    """Report that encoders do not show positioning errors (rad) that are within their steps."""
    step = evidence.encoder_step
    if errors > step:
        return ''
    return f' The angles of the encoders come in steps of {step / DEG:.2g} deg, which hide as much.'
