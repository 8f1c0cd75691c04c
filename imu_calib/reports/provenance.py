"""The origin of a calibration as text, in engineering units; the calibration on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime

import numpy as np
from rich.table import Table

from ..calibration.calibration import Calibration
from ..common.finding import is_warning
from ..common.units import DEG, PPM, counted, rounded, significant
from ..model.earth import MEASURED, VAGUE, Site
from ..model.parameters import bias_units
from ..session.imu import TRIAD_NAMES, Coefficient
from .budget import budget_tables, errors_of_table
from .charts import tag
from .html import named_rows, table
from .plain_table import folded, plain_table
from .tables import (
    CHANGE_HEADINGS,
    FREE_OF_FRAME,
    TERM_HEADINGS,
    TERM_NOTE,
    angle_table,
    change_note,
    change_rows,
    parameter_table,
    term_rows,
    three_digits,
)

Facts = Mapping[str, object]

_APART = ' \u00b1 '
_ELSEWHERE = frozenset({'noise', 'tests_of_terms', 'marks'})
"""Entries that have separate sections, or tell a person nothing."""
_CHANNELS = ('gx', 'gy', 'gz', 'ax', 'ay', 'az')
_PER_CHANNEL = (
    ('random_walk', 'random walk used', ('deg/\u221ah', DEG / 60), ('(m/s)/\u221ah', 1 / 60)),
    (
        'sensor_random_walk',
        'random walk of the sensor',
        ('deg/\u221ah', DEG / 60),
        ('(m/s)/\u221ah', 1 / 60),
    ),
    ('residual_rms', 'RMS of the residuals'),
    ('bias_drift', 'bias drift allowed for'),
    ('bias_instability', 'bias instability stated'),
)
"""Key, text, and the units of gyros and accelerometers; without any, those of biases."""


def number(facts: Facts, key: str) -> float | None:
    """Return a finite number, else None."""
    value = facts.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        return None
    return float(value)


def count(value: object) -> str:
    """Return a whole number with thin spaces between the thousands."""
    return f'{value:,}'.replace(',', '\u2009') if isinstance(value, int) else '-'


def date(facts: Facts) -> str:
    """Return when the recording began, as text; other entries unchanged."""
    try:
        found = recorded(facts)
    except ValueError:
        return str(facts['recorded'])
    if found is None:
        return 'no date: the stamps do not count from 1970'
    return f'{found:%Y-%m-%d %H:%M:%S} UTC'


def recorded(facts: Facts) -> datetime | None:
    """Return when the recording began; None if it is not stated.

    Raises:
        ValueError: The entry is no date.
    """
    text = facts.get('recorded')
    return None if text is None else datetime.fromisoformat(str(text).replace('Z', '+00:00'))


def site(facts: Facts) -> str:
    """Return latitude and gravity."""
    latitude, gravity = number(facts, 'latitude_deg'), number(facts, 'gravity')
    if latitude is None or gravity is None:
        return '-'
    return f'latitude {latitude:.3f}\u00b0, gravity {gravity:.5f}\u00a0m/s\u00b2'


def plan(facts: Facts) -> str:
    """Return the plan's name."""
    return str(facts.get('plan') or 'none')


def procedure(facts: Facts) -> str:
    """Return plan and estimator, and which positions of the plan were not measured."""
    missing = _listed('missing_positions')(facts)
    incomplete = f'; not completed, without position {missing}' if missing else ''
    return f'{plan(facts)}, {facts.get("method") or "-"}{incomplete}'


def _text(key: str) -> Callable[[Facts], str]:
    return lambda facts: str(facts[key]) if facts.get(key) not in (None, '') else ''


def _count(key: str) -> Callable[[Facts], str]:
    return lambda facts: count(facts[key]) if key in facts else ''


def _listed(key: str) -> Callable[[Facts], str]:
    def words(facts: Facts) -> str:
        found = facts.get(key)
        return ', '.join(map(str, found)) if isinstance(found, (list, tuple)) else ''

    return words


def _terms(facts: Facts) -> str:
    if 'terms' not in facts:
        return ''
    found = _listed('terms')(facts) or 'none'
    return f'{found} (found by a search)' if facts.get('terms_looked_for') else found


def _closed_form(facts: Facts) -> str:
    found = facts.get('closed_form')
    if not isinstance(found, Mapping):
        return ''
    method = found.get('method')
    if found.get('refusal'):
        return f'{method}: refused. {found["refusal"]}'
    apart = found.get('difference_in_std')
    if not isinstance(apart, Mapping) or not apart:
        return str(method)
    name, off = max(apart.items(), key=lambda pair: abs(pair[1]))
    words = f'{method}: within {abs(off):.1f} standard deviations ({name}) of the joint estimate'
    ratio = number(found, 'joint_std_over_closed_form')
    if ratio is None:
        return words
    return f'{words}, whose standard deviations are {ratio:.2g} times those of {method}'


def _spread(value: float, std: float | None, places: int, unit: str) -> str:
    if not std:
        return f'{value:.{places}f}{unit}'
    # Its last digits in brackets: \u00b1 is for expanded uncertainties (JCGM 100:2008, 7.2.2).
    shown, known = rounded(value, std)
    return f'{shown}({known.lstrip("0.") or 0}){unit}'


def latitude(facts: Facts) -> str:
    """Return the latitude with its standard deviation, or that it was not stated."""
    value = number(facts, 'latitude_deg')
    std = number(facts, 'latitude_std_deg')
    # With a measured gravity it need not be: 0 stands for any.
    if std is not None and std > 0.99 * VAGUE / DEG:
        return 'not stated'
    return '' if value is None else _spread(value, std, 3, '\u00b0')


def gravity(facts: Facts) -> str:
    """Return gravity with its standard deviation and source; empty without it."""
    value, std = number(facts, 'gravity'), number(facts, 'gravity_std')
    if value is None:
        return ''
    source = facts.get('gravity_source') or 'source not stated'
    exact = '' if std else ', taken as exact'
    return f'{_spread(value, std, 6, chr(0xA0) + "m/s" + chr(0xB2))} ({source}{exact})'


def impossible_gravity(facts: Facts) -> bool:
    """Return whether gravity was stated as measured, and is beyond that of any such place."""
    names = ('latitude_deg', 'gravity', 'gravity_std', 'height', 'latitude_std_deg')
    latitude, gravity, std, height, latitude_std = (number(facts, name) for name in names)
    if facts.get('gravity_source') != MEASURED:
        return False
    if latitude is None or gravity is None or latitude_std is None:
        return False
    site = Site(latitude * DEG, gravity, MEASURED, std or 0.0, height, latitude_std * DEG)
    return any(map(is_warning, site.contradictions))


def _height(facts: Facts) -> str:
    value = number(facts, 'height')
    if value is None:
        return ''
    words = ' (assumed: not stated)' if facts.get('height_assumed') else ''
    if facts.get('gravity_source') == MEASURED and not words:
        words = ' (not used: gravity was measured)'
    return f'{value:g}\u00a0m above the ellipsoid{words}'


def _azimuth(facts: Facts) -> str:
    value = number(facts, 'azimuth_seen_deg')
    if value is None:
        return ''
    angle = _spread(value, number(facts, 'azimuth_seen_std_deg'), 1, '\u00b0')
    return f"{angle} from north to the table's zero, counter-clockwise"


def _table_clock(facts: Facts) -> str:
    std = number(facts, 'table_clock_std')
    if std is None:
        return ''
    return f'known to {std / PPM:g} ppm' if std else 'taken as exact'


def _clocks(facts: Facts) -> str:
    clock = facts.get('clock')
    if not isinstance(clock, Mapping):
        return ''
    offset, rate = number(clock, 'offset_s'), number(clock, 'rate_ppm')
    if offset is None or rate is None or not clock.get('motions'):
        return 'not compared'
    deviations = number(clock, 'offset_std_s'), number(clock, 'rate_std_ppm')
    behind = '' if deviations[0] is None else f'{_APART}{1e3 * deviations[0]:.3f}'
    faster = '' if deviations[1] is None else f'{_APART}{deviations[1]:.2f}'
    return (
        f'offset {1e3 * offset:+.3f}{behind}\u00a0ms, rate {rate:+.2f}{faster}\u00a0ppm, '
        f'from {clock.get("motions")} motions'
    )


def _rate(facts: Facts) -> str:
    value = number(facts, 'highest_rate')
    return '' if value is None else f'{value / DEG:.4g}\u00a0deg/s'


def _duration(facts: Facts) -> str:
    value = number(facts, 'duration')
    return '' if value is None else f'{value:.0f}\u00a0s'


def gravity_won(facts: Facts) -> str:
    """Return by how much the accelerometers miss gravity at the worst rest, raw and calibrated.

    Samples that are off by half of it have another unit or another zero: of these it means nothing.
    """
    before, after = (number(facts, f'gravity_off_{when}') for when in ('before', 'after'))
    if before is None:
        return ''
    least = 0.0 if facts.get('by_hand') else _IN_PERCENT
    raw = f'{_ratio(before, least)} off raw' if before < _ANOTHER else ''
    if after is None:
        return f'at worst {raw}' if raw else ''
    won = f'{_ratio(after, least)}{"" if raw else " off"} calibrated'
    return f'at worst {raw}, {won}' if raw else f'at worst {won}'


_ANOTHER = 0.5
"""Ratio from which raw samples are none of this scale: a scale factor off by more is implausible
(`calibration.provenance`), and an ADC counts from any zero."""
_IN_PERCENT = 1e-4
"""Ratio of a unit on a table from which on it is stated in percent, below in ppm. A choice."""


def _ratio(value: float, least: float) -> str:
    if value >= least:
        return f'{significant(100 * value)} %'
    return f'{significant(value / PPM)} ppm'


def _interpolated(facts: Facts) -> str:
    rate = number(facts, 'accel_interpolated_from_hz')
    if rate is None:
        return ''
    return f'interpolated from {rate:.4g}\u00a0Hz at the stamps of the gyros'


def temperature(facts: Facts) -> str:
    """Return the mean temperature of a session and its range; empty without one."""
    found = facts.get('temperature')
    if not isinstance(found, Mapping):
        return ''
    values = [number(found, key) for key in ('mean', 'lowest', 'highest')]
    if None in values:
        return ''
    mean, low, high = values
    return f'{mean:.2f}\u00a0\u00b0C, from {low:.2f} to {high:.2f}\u00a0\u00b0C'


def _versions(facts: Facts) -> str:
    found = facts.get('versions')
    return ', '.join(f'{k} {v}' for k, v in found.items()) if isinstance(found, Mapping) else ''


def _condition(facts: Facts) -> str:
    value = number(facts, 'condition_number')
    return '' if value is None else three_digits(value)


def _table(facts: Facts) -> str:
    return f'{_text("table")(facts)}{" (simulated)" if facts.get("table_simulated") else ""}'


def file_words(name: object, facts: Facts, kind: str) -> str:
    """Return a name of IMU or table (`kind`) with the SHA-256 of its file."""
    return f'{name or "-"} (SHA-256 of its file {facts.get(f"{kind}_sha256") or "-"})'


_GROUPS: tuple[tuple[str, tuple[tuple[str, Callable[[Facts], str], tuple[str, ...]], ...]], ...] = (
    (
        'Recording',
        (
            ('recording', _text('recording'), ('recording',)),
            ('begun', date, ('recorded',)),
            ('SHA-256', _text('sha256'), ('sha256',)),
            ("SHA-256 of the IMU's file", _text('imu_sha256'), ('imu_sha256',)),
            ('data', lambda facts: 'simulated' * bool(facts['simulated']), ('simulated',)),
            ('topics', _listed('topics'), ('topics',)),
            ('accelerometers', _interpolated, ('accel_interpolated_from_hz',)),
            ('temperature of the unit', temperature, ('temperature',)),
        ),
    ),
    (
        'Estimate',
        (
            ('method', _text('method'), ('method',)),
            ('plan', plan, ('plan', 'by_hand')),
            ('terms beyond the 24', _terms, ('terms', 'terms_looked_for')),
            ('static dwells', _count('segments'), ('segments',)),
            ('turns', _count('turns'), ('turns',)),
            ('samples used', _count('samples'), ('samples',)),
            ('duration', _duration, ('duration',)),
            ('gravity at rest', gravity_won, ('gravity_off_before', 'gravity_off_after')),
            ('highest rate', _rate, ('highest_rate',)),
            ('missing positions', _listed('missing_positions'), ('missing_positions',)),
            ('condition number', _condition, ('condition_number',)),
            ('closed form', _closed_form, ('closed_form',)),
        ),
    ),
    (
        'Site, table and clocks',
        (
            ('latitude', latitude, ('latitude_deg', 'latitude_std_deg')),
            ('gravity', gravity, ('gravity', 'gravity_source', 'gravity_std')),
            ('height', _height, ('height', 'height_assumed')),
            ('table', _table, ('table', 'table_simulated')),
            ('SHA-256 of its file', _text('table_sha256'), ('table_sha256',)),
            ("the table's errors", errors_of_table, ('table_errors', 'table_errors_assumed')),
            ('heading found', _azimuth, ('azimuth_seen_deg', 'azimuth_seen_std_deg')),
            ("the table's clock", _table_clock, ('table_clock_std',)),
            ('IMU against table', _clocks, ('clock',)),
        ),
    ),
)
"""Heading, and rows: name, text, and the keys that they cover."""
_SHOWN = {key for _, rows in _GROUPS for _, _, keys in rows for key in keys}


def origin_rows(calibration: Calibration) -> list[tuple[str, str]]:
    """Return the provenance for a terminal: names and texts, without those of the recording."""
    facts = calibration.provenance
    rows = [(name, words(facts)) for _, group in _GROUPS[1:] for name, words, _ in group]
    rows.append(('temperature of the unit', temperature(facts)))
    rows.append(('bias drift allowed for', _bias_drift(calibration)))
    return [(name, text.replace('\u00a0', ' ')) for name, text in rows if text]


def _bias_drift(calibration: Calibration) -> str:
    drift = calibration.provenance.get('bias_drift')
    if not isinstance(drift, Sequence) or len(drift) != len(_CHANNELS) or not any(drift):
        return ''
    units = zip(drift[::3], bias_units(by_hand=calibration.by_hand), strict=True)
    each = ' and '.join(f'{significant(value / unit.scale)} {unit.unit}' for value, unit in units)
    return f'{each} over some 1000 s, by the data sheet and the session'


def provenance(calibration: Calibration) -> str:
    """Return the complete provenance in a calibration."""
    facts = calibration.provenance
    if not facts:
        return ''
    parts = []
    for title, rows in _GROUPS:
        texts = [(name, words(facts)) for name, words, keys in rows if set(keys) & set(facts)]
        shown = named_rows([(name, text) for name, text in texts if text])
        parts.append(tag('div', tag('h3', title) + shown, class_='whole') if shown else '')
    per_channel = _per_channel(calibration)
    if per_channel:
        parts.append(tag('div', tag('h3', 'By channel') + per_channel, class_='whole across'))
    others = {k: v for k, v in facts.items() if k not in _SHOWN | _ELSEWHERE | {'versions'}}
    others = {k: v for k, v in others.items() if k not in {row[0] for row in _PER_CHANNEL}}
    further = [*_flat(others), ('software', _versions(facts))]
    shown = named_rows([(name, text) for name, text in further if text])
    parts.append(tag('div', tag('h3', 'Further') + shown, class_='whole') if shown else '')
    return tag('div', ''.join(parts), class_='provenance')


def _per_channel(calibration: Calibration) -> str:
    """Return a table of the entries for each channel."""
    rows, facts = [], calibration.provenance
    usual = [(unit.symbol, unit.scale) for unit in bias_units(by_hand=calibration.by_hand)]
    for key, words, *units in _PER_CHANNEL:
        values = facts.get(key)
        if not isinstance(values, Sequence) or len(values) != len(_CHANNELS):
            continue
        cells = [words]
        for k, (unit, scale) in enumerate(units or usual):
            cells += [_scaled(v, scale) for v in values[3 * k : 3 * k + 3]] + [unit]
        rows.append(cells)
    headings = ['', *_CHANNELS[:3], '', *_CHANNELS[3:], '']
    return table(headings, rows, 'plain', 'lrrrlrrrl') if rows else ''


def _scaled(value: object, scale: float) -> str:
    if not isinstance(value, (int, float)) or not np.isfinite(value):
        return '-'
    return three_digits(float(value) / scale)


def _flat(tree: Facts, above: str = '') -> list[tuple[str, str]]:
    """Return unknown entries as pairs: other software may add entries to a file."""
    pairs: list[tuple[str, str]] = []
    for key, value in tree.items():
        name = f'{above}{key}'.replace('_', ' ')
        if isinstance(value, Mapping):
            pairs += _flat(value, f'{name}: ')
        elif isinstance(value, (list, tuple)):
            pairs.append((name, ', '.join(map(_word, value))))
        else:
            pairs.append((name, _word(value)))
    return pairs


def _word(value: object) -> str:
    if isinstance(value, float):
        return f'{value:.6g}'
    return '-' if value is None else str(value)


def noise_table(calibration: Calibration) -> Table | None:
    """Return the measured noise by channel beside that of the IMU's file; None without any."""
    seen = calibration.noise
    rows = plain_table(('noise of', 'random walk', 'stated', 'bias instability', 'stated'), 'lrlrl')
    for units, spec in zip(TRIAD_NAMES, (calibration.imu.gyro, calibration.imu.accel), strict=True):
        for channel in units.channels:
            if channel in seen:
                rows.add_row(
                    channel,
                    written(seen[channel].random_walk, units.walk_scale),
                    _stated(spec.random_walk, units.walk_scale, units.walk),
                    written(seen[channel].bias_instability, units.rate_scale),
                    _stated(spec.bias_instability, units.rate_scale, units.rate),
                )
    return rows if rows.row_count else None


def _stated(value: float, scale: float, unit: str) -> str:
    return f'{value / scale:.3g} {unit}' if value > 0 else unit


def written(coefficient: Coefficient, scale: float) -> str:
    """Return a coefficient with its deviation, or its upper limit, in the unit of `scale`."""
    if coefficient.value is not None and coefficient.std is not None:
        if coefficient.std == 0:
            return f'{coefficient.value / scale:.3g}'
        return '+-'.join(rounded(coefficient.value / scale, coefficient.std / scale))
    return (
        f'<{three_digits(coefficient.below / scale)}' if coefficient.below < float('inf') else '-'
    )


# A calibration on a terminal: parameters, data, verdict; everything else on request.

_LETTERS = (
    'K: scale-factor error; D: what a channel reads at zero (bias); g: gyro, a: accelerometer.\n'
    'E_gxy: how far gyro x leans towards axis y. The saved file holds the same in SI units.'
)
"""Explanation of the symbols to people who calibrate a unit in the hand."""


def overview(
    calibration: Calibration, truth: Calibration | None = None, *, budget: bool = False
) -> Iterator[Table | str]:
    """Yield the parameters, what they mean in the hand, the data used and the verdict.

    The truth of a simulation adds the errors in standard deviations, `budget` the sources of them.
    """
    if not budget or calibration.budget is None:
        found = parameter_table(calibration, truth)
        # Two columns more, beside a truth, do not fit twice into a line.
        yield found if truth else folded(found)
    if budget:
        yield from budget_tables(calibration)
    if calibration.by_hand:
        yield _LETTERS
    if changes := change_rows(calibration):
        yield ''
        yield plain_table(CHANGE_HEADINGS, 'llrrl', changes)
        yield change_note(calibration)
    yield ''
    yield data_line(calibration)
    yield verdict_line(calibration)
    if won := gravity_won(calibration.provenance):
        yield f'Gravity {_gravity_used(calibration.provenance)}: {won}.'


def _gravity_used(facts: Facts) -> str:
    """Return gravity and what it follows from: data of one place cannot show that it is wrong."""
    used = f'{number(facts, "gravity") or 0.0:.4f} m/s^2'
    if facts.get('gravity_source') == MEASURED:
        return f'{used} (as stated)'
    height = f'height {number(facts, "height") or 0.0:g} m'
    if facts.get('height_assumed'):
        height += ' assumed'
    north = number(facts, 'latitude_deg') or 0.0
    return f'{used} ({abs(north):.4g} deg {"N" if north >= 0 else "S"}, {height})'


def data_line(calibration: Calibration) -> str:
    """Return the data that a calibration was made from, in a line."""
    facts = calibration.provenance
    seconds, samples = number(facts, 'duration'), facts.get('samples')
    rests = 'hold' if calibration.by_hand else 'static dwell'
    parts = [counted(facts.get('segments', 0), rests), counted(facts.get('turns', 0), 'turn')]
    of = '' if seconds is None else f' of {seconds:.0f} s'
    if samples is not None:
        parts.append(f'{samples} samples used{of}')
    return f'{calibration.unit_name}: {", ".join(parts)} ({facts.get("method", "no method")}).'


def verdict_line(*calibrations: Calibration) -> str:
    """Return in a line whether the sessions give reason to doubt the numbers."""
    findings = [finding for calibration in calibrations for finding in calibration.findings]
    warnings = sum(map(is_warning, findings))
    if not findings:
        return 'Verdict: sound. Nothing in the data contradicts the result.'
    if not warnings:
        incomplete = any(c.provenance.get('missing_positions') for c in calibrations)
        but = ', but positions of the plan are missing' if incomplete else ''
        return f'Verdict: no warnings{but}. The notes below say what limits the numbers.'
    return f'Verdict: {counted(warnings, "warning")}. Read below before you use the numbers.'


def details(calibration: Calibration, truth: Calibration | None = None) -> Iterator[Table | str]:
    """Yield all else that the file holds and people read: angles, terms, origin, noise."""
    yield ''
    yield angle_table(calibration, truth)
    yield FREE_OF_FRAME
    if rows := term_rows(calibration):
        yield ''
        yield plain_table(TERM_HEADINGS, 'llllll', rows)
        yield TERM_NOTE
    yield ''
    yield plain_table(('origin', ''), 'll', origin_rows(calibration))
    noise = noise_table(calibration)
    if noise is not None:
        yield ''
        yield noise
