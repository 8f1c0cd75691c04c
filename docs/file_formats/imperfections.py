"""The keys of a file of imperfections."""

from __future__ import annotations

from imu_calib.common.units import Dimension
from imu_calib.simulation.options import (
    BiasStep,
    Delivery,
    Shake,
    StandOptions,
    ThermalDrift,
    Tilt,
    Vibration,
    WarmUp,
    read_channels,
    read_shake,
    read_share,
    read_tilt,
)
from imu_calib.simulation.true_table import HarmonicSizes, TableSizes, read_harmonics

from .keys import (
    VALUES,
    Key,
    Tables,
    Value,
    array,
    either,
    keys_of,
    limited,
    mapping,
    mapping_of,
    quantity,
)


def _channels(dimension: Dimension) -> Value:
    one = quantity(dimension)
    return either(one, array(one, 3, 3), words=f'{one.words}, or a list of three')


VALUES.update(
    {
        read_channels: _channels,
        read_shake: lambda: mapping_of(Shake),
        read_share: lambda: limited(quantity(Dimension.RATIO, '0 or more'), '100 %'),
        read_tilt: lambda: mapping_of(Tilt, words='`east` and `north`, angles'),
        read_harmonics: lambda: mapping_of(HarmonicSizes, words='`once` and `twice`, angles'),
    }
)
_TABLE = [
    *keys_of(TableSizes),
    *keys_of(StandOptions, 'table'),
    Key(
        'positioning',
        mapping_of(StandOptions, 'positioning'),
        "errors of joints and table at each stop; replaces `positioning` of the table's file",
        None,
        "`positioning` of the table's file",
    ),
]
_SAMPLES = [
    *keys_of(StandOptions, 'samples'),
    Key(
        'frozen',
        mapping_of(Delivery, 'frozen', '`every` and `for`, times'),
        'every so long in the mean the device repeats its last sample for so long, and what its '
        'sensors counted is lost',
    ),
]
_TEMPERATURE = [
    *keys_of(StandOptions, 'temperature'),
    Key('gyro', mapping_of(ThermalDrift, 'gyro'), 'its effect'),
    Key(
        'accelerometer',
        mapping_of(ThermalDrift, 'accelerometer'),
        'its effect; the keys of `gyro`, per kelvin and in units of acceleration',
    ),
]
_BELOW = 'keys, below'
KEYS = [
    Key('table', mapping(_TABLE, words=_BELOW), 'the turntable'),
    Key('joint_states', mapping_of(StandOptions, 'joint_states'), 'readings of its encoders'),
    Key('stamps', mapping_of(StandOptions, 'stamps'), "of the IMU's samples"),
    Key('samples', mapping(_SAMPLES, words=_BELOW), 'on their way'),
    Key('mounting', mapping_of(StandOptions, 'mounting'), 'of the unit on the table'),
    Key('temperature', mapping(_TEMPERATURE, words=_BELOW), 'of the unit'),
    Key('bias_step', mapping_of(BiasStep), 'of a unit that is switched off and on'),
]

TABLES: Tables = {
    'imperfections': KEYS,
    'table': _TABLE,
    'positioning': keys_of(StandOptions, 'positioning'),
    'joint_states': keys_of(StandOptions, 'joint_states'),
    'stamps': keys_of(StandOptions, 'stamps'),
    'samples': _SAMPLES,
    'ringing': keys_of(Vibration),
    'floor': keys_of(Shake),
    'temperature': _TEMPERATURE,
    'gyro': keys_of(ThermalDrift, 'gyro'),
    'warm_up': keys_of(WarmUp),
    'bias_step': keys_of(BiasStep),
}
VALUE = mapping(KEYS)
TITLE = 'Imperfections of a simulated stand'
