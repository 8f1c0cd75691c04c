"""A recording's own entries, by which it can be calibrated without any other file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..common.errors import InputError, NotStated
from ..common.files import named_file, read_bytes, read_text
from ..common.stream import Floats
from ..common.units import DEG
from ..model.earth import MEASURED, NORMAL_GRAVITY, Site
from .imu import ImuSpec, imu_text
from .table import Table

if TYPE_CHECKING:
    from .plan import Plan

PREFIX = 'imu_calib.'  #: Of the keys of a recording's own entries.
SERIAL_NUMBER = f'{PREFIX}serial_number'  #: The unit's serial number.
LEFT_OUT = f'{PREFIX}left_out'
"""The units that were left out of a session of several: their names, with commas."""
SIMULATED = f'{PREFIX}simulated'  #: There if the data were simulated.
COMPENSATED = f'{PREFIX}compensated'  #: The calibration file by which a recording was compensated.
PLAN, IMU = f'{PREFIX}plan', f'{PREFIX}imu'  #: The texts of the files of plan and IMU.
TABLE = f'{PREFIX}table'  #: The text of the table's file; empty if there is none.
_INTERPOLATED = f'{PREFIX}accel_interpolated_from_hz'
_LATITUDE, _LATITUDE_STD = f'{PREFIX}latitude_deg', f'{PREFIX}latitude_std_deg'
_HEIGHT = f'{PREFIX}height'
_GRAVITY, _GRAVITY_STD = f'{PREFIX}gravity', f'{PREFIX}gravity_std'
_GRAVITY_SOURCE = f'{PREFIX}gravity_source'


def describe(
    plan: str | Path | Plan,
    imu: str | Path | ImuSpec,
    table: str | Path | Table | None,
    site: Site,
    serial_number: str = '',
) -> dict[str, str]:
    """Return a recording's own entries: full texts of the files, and the site.

    A value has no text, and whoever reads the recording must be given it.

    Args:
        plan: Name or file of the plan, or a value.
        imu: Likewise.
        table: Likewise; None if the unit is held by hand.
        site: Site of the recording.
        serial_number: Of the unit; empty if not stated.
    """
    texts = {
        key: read_text(named_file(f'{key.removeprefix(PREFIX)}s', name))
        for key, name in ((PLAN, plan), (IMU, imu), (TABLE, table))
        if isinstance(name, str | Path)
    }
    if isinstance(table, Table):
        # Otherwise the usual table would be assumed.
        texts[TABLE] = ''
    unit = {SERIAL_NUMBER: serial_number} if serial_number else {}
    described = {
        **unit,
        **texts,
        _LATITUDE: repr(site.latitude / DEG),
        _LATITUDE_STD: repr(site.latitude_std / DEG),
        _GRAVITY: repr(site.gravity),
        _GRAVITY_SOURCE: site.gravity_source,
        _GRAVITY_STD: repr(site.gravity_std),
    }
    if site.height is not None:
        described[_HEIGHT] = repr(site.height)
    return described


def shared_description(description: Mapping[str, str]) -> dict[str, str]:
    """Return the own entries that are common to several units."""
    return {k: v for k, v in description.items() if k not in {IMU, SERIAL_NUMBER}}


def unit_description(topic: str, imu: str, serial_number: str) -> dict[str, str]:
    """Return a recording's own entries on one of several units."""
    text = read_text(named_file('imus', imu))
    return {imu_key(topic): text, serial_key(topic): serial_number}


def described_imu(data: Mapping[str, str], topic: str) -> str | None:
    """Return the YAML text of the IMU of a topic; None if the recording has none.

    A stream computed from another has a separate description.
    """
    return data.get(imu_key(topic), data.get(IMU))


def imu_key(topic: str) -> str:
    """Return the key of the own entry that describes the numbers of one topic."""
    return f'{IMU}:{topic}'


def serial_key(topic: str) -> str:
    """Return the key of the own entry with the serial number of one topic's unit."""
    return f'{SERIAL_NUMBER}:{topic}'


def interpolation_description(topic: str, rate: float) -> dict[str, str]:
    """Return the own entry for accelerometers of a topic interpolated from another rate, Hz."""
    return {f'{_INTERPOLATED}:{topic}': f'{rate:.6g}'}


def interpolated_from(data: Mapping[str, str], topic: str) -> float | None:
    """Return the original rate of interpolated accelerometers, Hz; None if not interpolated."""
    try:
        rate = float(data.get(f'{_INTERPOLATED}:{topic}', 'nan'))
    except ValueError:
        return None
    return rate if 0 < rate < np.inf else None


def mount_description(topic: str, mount: Floats) -> dict[str, str]:
    """Return the own entry for a mount (3, 3): the body axes in those that the table mounts."""
    return {_mount_key(topic): json.dumps(mount.tolist())}


def described_mount(data: Mapping[str, str], topic: str, where: str) -> Floats:
    """Return the rotation of a topic's unit, (3, 3); that of the table if not stated."""
    if (text := data.get(_mount_key(topic))) is None:
        return np.eye(3)
    try:
        mount = np.array(json.loads(text), dtype=np.float64)
    except (ValueError, TypeError):
        mount = np.zeros(0)
    if mount.shape != (3, 3) or not np.allclose(mount.T @ mount, np.eye(3), atol=1e-9):
        raise InputError(
            f'{where}: the mounting of {topic} that it states is no rotation, so that its entries '
            'were changed since it was written: take the original.'
        )
    return mount


def _mount_key(topic: str) -> str:
    return f'{PREFIX}mount:{topic}'


def stream_description(
    data: Mapping[str, str], topic: str, imu: ImuSpec, *, raw_is_kept: bool
) -> dict[str, str]:
    """Return own entries with those of a computed Imu stream; the raw one may be kept."""
    kept = {key: text for key, text in data.items() if raw_is_kept or not key.startswith(IMU)}
    return {**kept, imu_key(topic): imu_text(imu)}


def compensated_key(topic: str) -> str:
    """Return the key of the own entry with the calibration by which a topic was computed."""
    return f'{COMPENSATED}:{topic}'


def compensated_already(data: Mapping[str, str], topic: str) -> list[str]:
    """Return a sentence on a topic's samples that are no raw ones; none on others."""
    if (by := data.get(compensated_key(topic))) is None:
        return []
    return [
        f'The samples of {topic} are compensated already (by {by}). A calibration of the raw '
        'samples does not apply to them, nor does one of these to the raw samples.'
    ]


def described_origin(data: Mapping[str, str]) -> dict[str, Any]:
    """Return the entry `simulated` of a calibration's provenance; none of measured data."""
    return {'simulated': True} if SIMULATED in data else {}


def file_hashes(
    data: Mapping[str, str], topic: str, stated: Mapping[str, object] | None = None
) -> dict[str, str]:
    """Return the SHA-256 of the files of IMU and table by key of the provenance.

    Args:
        data: A recording's own entries: texts of the files.
        topic: Of the IMU.
        stated: What is used in their place, by 'imu' and 'table': a name or file, or a value, which
            has no file; None where it is that of the recording.
    """
    import hashlib  # Only what is written needs it.

    hashes = {}
    for kind, text in (('imu', described_imu(data, topic)), ('table', data.get(TABLE))):
        given = None if stated is None else stated.get(kind)
        content = (text or '').encode()
        if given is not None:
            content = b''
            if isinstance(given, str | Path):
                content = read_bytes(named_file(f'{kind}s', given))
        if content:
            hashes[f'{kind}_sha256'] = hashlib.sha256(content).hexdigest()
    return hashes


def states_site(data: Mapping[str, str]) -> bool:
    """Return whether a recording states its site."""
    return _LATITUDE in data


def described_site(data: Mapping[str, str], where: str) -> Site:
    """Return the site stated in a recording's entries; `where` names it in messages."""
    if not states_site(data):
        raise NotStated(
            f'{where} does not say where it was taken: give `latitude` in degrees, negative in the '
            'south. Gravity follows from it, which scales the accelerometers, and the Earth rate.',
            'For a unit in the hand a tenth of a degree is enough, or `gravity` with the measured '
            'value in m/s^2 instead.',
        )
    try:
        latitude = float(data[_LATITUDE]) * DEG
        gravity = float(data[_GRAVITY])
        stated = data.get(_GRAVITY_STD)
        std = None if stated is None else float(stated)
        height = float(data[_HEIGHT]) if _HEIGHT in data else None
        doubt = data.get(_LATITUDE_STD)
        latitude_std = None if doubt is None else float(doubt) * DEG
    except (KeyError, ValueError):
        raise InputError(
            f'{where}: the site that it states cannot be read: give `latitude`.'
        ) from None
    source = data.get(_GRAVITY_SOURCE, MEASURED)
    if std is None and source == NORMAL_GRAVITY:
        # Recordings from before heights were recorded: as normal gravity without a height.
        std = Site.at(latitude, height).gravity_std
    site = Site.at(latitude, height, gravity, gravity_std=std, latitude_std=latitude_std)
    return replace(site, gravity_source=source)
