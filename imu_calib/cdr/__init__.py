"""Convert serialised messages (CDR) to columns and back, in bulk; recorded or live."""

from .decode import (
    ImuDecoder,
    decode_imu,
    decode_joints,
    decode_setpoints,
    decode_skew,
    decode_temperatures,
    part,
)
from .encode import (
    PULSES,
    RATES,
    encode_imu,
    encode_joints,
    encode_rates,
    encode_setpoints,
    encode_temperatures,
    rates_payloads,
)
from .kinds import Kind
from .messages import CdrError, Malformed, Messages

__all__ = [
    'PULSES',
    'RATES',
    'CdrError',
    'ImuDecoder',
    'Kind',
    'Malformed',
    'Messages',
    'decode_imu',
    'decode_joints',
    'decode_setpoints',
    'decode_skew',
    'decode_temperatures',
    'encode_imu',
    'encode_joints',
    'encode_rates',
    'encode_setpoints',
    'encode_temperatures',
    'part',
    'rates_payloads',
]
