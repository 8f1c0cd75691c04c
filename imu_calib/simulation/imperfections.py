"""Read the file of a stand's imperfections: table, stamps, samples, vibration, biases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..common.config import Section
from ..common.errors import InputError
from ..common.units import Dimension
from ..session.table import Table
from .options import (
    BiasStep,
    Channels,
    Shake,
    StandOptions,
    ThermalDrift,
    Vibration,
    Warming,
    WarmUp,
)
from .true_table import TableSizes, TrueTable


def load_imperfections(
    name: str | Path, options: StandOptions, table: Table | None, seed: int
) -> StandOptions:
    """Read a file of imperfections, shipped (by name) or the user's (by path).

    Args and errors as for `read_imperfections`.
    """
    section = Section.named('imperfections', name)
    return read_imperfections(section, options, table, seed)


def read_imperfections(
    section: Section, options: StandOptions, table: Table | None, seed: int
) -> StandOptions:
    """Read imperfections on top of options; omitted ones stay unchanged.

    Args:
        section: Their YAML mapping.
        options: Of the stand without them.
        table: Its description; None for a unit held by hand.
        seed: Of the table's constant errors: the same seed gives the same table.

    Raises:
        InputError: File, key, what was found and what was expected.
    """
    readers: dict[str, Callable[[Section, StandOptions], StandOptions]] = {
        'table': lambda part, o: _table(part, o, table, seed),
        'joint_states': _joint_states,
        'stamps': _stamps,
        'samples': _samples,
        'mounting': _mounting,
        'temperature': _temperature,
        'bias_step': _bias_step,
    }
    for key, read in readers.items():
        if not section.has(key):
            continue
        if table is None and key in {'table', 'joint_states', 'mounting'}:
            raise InputError(
                f'{section.key(key)}: found an imperfection of a table, '
                'expected none: the unit is held by hand.'
            )
        part = section.section(key)
        options = read(part, options)
        part.finish()
    section.finish()
    return options


def _table(part: Section, options: StandOptions, table: Table | None, seed: int) -> StandOptions:
    sizes = TableSizes(
        zeros=_size(part, 'zeros'),
        orthogonality=_size(part, 'orthogonality'),
        wobble=_harmonics(part, 'wobble'),
        encoder=_harmonics(part, 'encoder'),
    )
    options = replace(
        options,
        servo_error=_size(part, 'servo', options.servo_error),
        rate_error=_size(part, 'rate', options.rate_error, Dimension.RATIO),
        acceleration=part.quantity(
            'acceleration', Dimension.ANGULAR_ACCELERATION, options.acceleration, above=0
        ),
    )
    if part.has('tilt'):
        tilt = part.section('tilt')
        both = (
            tilt.quantity('east', Dimension.ANGLE, 0.0),
            tilt.quantity('north', Dimension.ANGLE, 0.0),
        )
        tilt.finish()
        options = replace(options, tilt=both)
    # Files of version 0.1.0 call them arrivals.
    key = 'positioning' if part.has('positioning') else 'arrivals'
    if part.has(key):
        positioning = part.section(key)
        options = replace(
            options,
            # The file replaces the positioning error of the table's description.
            positioning_error=0.0,
            stop_error=_size(positioning, 'joints'),
            stop_tilt=_size(positioning, 'tilt'),
            stop_heading=_size(positioning, 'heading'),
        )
        positioning.finish()
    if table is None or sizes == TableSizes():
        return options
    return replace(options, true=TrueTable.drawn(table, sizes, seed))


def _joint_states(part: Section, options: StandOptions) -> StandOptions:
    return replace(
        options,
        encoder_noise=_size(part, 'noise'),
        encoder_resolution=_size(part, 'resolution', options.encoder_resolution),
        joint_stamp_jitter=_size(part, 'jitter', 0.0, Dimension.TIME),
        joint_state_rate=part.quantity(
            'rate', Dimension.FREQUENCY, options.joint_state_rate, above=0
        ),
    )


def _stamps(part: Section, options: StandOptions) -> StandOptions:
    delivery = replace(
        options.delivery,
        bunch=part.whole('bunch', 1, default=1),
        late=_share(part, 'late'),
        delay=_size(part, 'delay', 0.0, Dimension.TIME),
    )
    return replace(
        options,
        imu_stamp_jitter=_size(part, 'jitter', 0.0, Dimension.TIME),
        clock_rate_error=part.quantity('clock_rate', Dimension.RATIO, options.clock_rate_error),
        clock_offset=part.quantity('clock_offset', Dimension.TIME, options.clock_offset),
        delivery=delivery,
    )


def _samples(part: Section, options: StandOptions) -> StandOptions:
    delivery = replace(options.delivery, lost=_share(part, 'lost'), twice=_share(part, 'twice'))
    if part.has('frozen'):
        frozen = part.section('frozen')
        delivery = replace(
            delivery,
            frozen_every=frozen.quantity('every', Dimension.TIME, above=0),
            frozen_for=_size(frozen, 'for', None, Dimension.TIME),
        )
        frozen.finish()
    return replace(options, delivery=delivery)


def _mounting(part: Section, options: StandOptions) -> StandOptions:
    if part.has('ringing'):
        s, usual = part.section('ringing'), Vibration()
        ringing = Vibration(
            _size(s, 'rate', 0.0, Dimension.RATE),
            _size(s, 'force', 0.0, Dimension.ACCELERATION),
            s.quantity('frequency', Dimension.FREQUENCY, usual.frequency, above=0),
            s.quantity('decay', Dimension.TIME, usual.decay, above=0),
        )
        s.finish()
        options = replace(options, vibration=ringing)
    if part.has('floor'):
        s, still = part.section('floor'), Shake()
        shake = Shake(
            _size(s, 'rate', 0.0, Dimension.RATE),
            _size(s, 'force', 0.0, Dimension.ACCELERATION),
            _size(s, 'lowest', still.lowest, Dimension.FREQUENCY),
            _size(s, 'highest', still.highest, Dimension.FREQUENCY),
        )
        if shake.lowest > shake.highest:
            raise InputError(
                f'{s.where}: found lowest {shake.lowest:g} Hz above highest {shake.highest:g} Hz.'
            )
        s.finish()
        options = replace(options, shake=shake)
    return options


def _temperature(part: Section, options: StandOptions) -> StandOptions:
    usual = options.warming
    warming = Warming(
        usual.reference,
        part.quantity('offset', Dimension.TEMPERATURE, usual.offset),
        part.quantity('rise', Dimension.TEMPERATURE, usual.rise),
        part.quantity('time_constant', Dimension.TIME, usual.time_constant, above=0),
        part.quantity('ramp', Dimension.TEMPERATURE_RATE, usual.ramp),
    )
    drift, fading = options.thermal_drift, options.warm_up
    if part.has('gyro') or part.has('accelerometer'):
        gyro, accel = (
            part.section(key) if part.has(key) else Section({}, part.key(key))
            for key in ('gyro', 'accelerometer')
        )
        drift = ThermalDrift(
            _channels(gyro, 'bias', Dimension.RATE_PER_KELVIN),
            _channels(gyro, 'scale_factor', Dimension.RATIO_PER_KELVIN),
            _channels(accel, 'bias', Dimension.ACCELERATION_PER_KELVIN),
            _channels(accel, 'scale_factor', Dimension.RATIO_PER_KELVIN),
        )
        gyro.finish()
        accel.finish()
    if part.has('warm_up'):
        s = part.section('warm_up')
        fading = WarmUp(
            _channels(s, 'gyro', Dimension.RATE),
            _channels(s, 'accelerometer', Dimension.ACCELERATION),
            s.quantity('time_constant', Dimension.TIME, fading.time_constant, above=0),
        )
        s.finish()
    return replace(options, warming=warming, thermal_drift=drift, warm_up=fading)


def _bias_step(part: Section, options: StandOptions) -> StandOptions:
    step = BiasStep(
        part.quantity('time', Dimension.TIME, least=0),
        _channels(part, 'gyro', Dimension.RATE),
        _channels(part, 'accelerometer', Dimension.ACCELERATION),
    )
    return replace(options, bias_step=step)


def _size(
    part: Section,
    key: str,
    default: float | None = 0.0,
    dimension: Dimension = Dimension.ANGLE,
) -> float:
    """Return a quantity that cannot be negative."""
    return part.quantity(key, dimension, default, least=0)


def _share(part: Section, key: str) -> float:
    share = _size(part, key, 0.0, Dimension.RATIO)
    if share > 1:
        raise InputError(f'{part.key(key)}: found {part.raw(key)}, expected 100 % or less.')
    return share


def _harmonics(part: Section, key: str) -> tuple[float, float]:
    if not part.has(key):
        return 0.0, 0.0
    s = part.section(key)
    pair = _size(s, 'once'), _size(s, 'twice')
    s.finish()
    return pair


def _channels(part: Section, key: str, dimension: Dimension) -> Channels:
    """Return one figure for all channels, or a list of three."""
    if not part.has(key) or not isinstance(part.raw(key), list):
        return part.quantity(key, dimension, 0.0)
    values = part.items(key)
    if len(values) != 3:
        raise InputError(f'{part.key(key)}: found {len(values)} figures, expected 3 or one.')
    three = [
        Section({'value': v}, f'{part.key(key)}[{i}]').quantity('value', dimension)
        for i, v in enumerate(values)
    ]
    return three[0], three[1], three[2]
