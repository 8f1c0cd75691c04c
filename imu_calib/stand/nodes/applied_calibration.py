"""The calibration that a compensator applies: from a file that may change, or from a topic."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ...calibration.compensator import Compensator
from ...calibration.thermal import (
    AnyCalibration,
    ThermalCalibration,
    by_temperature,
    check_same_unit,
    first_of,
    load_calibration,
)
from ...common.errors import ImuCalibError, InputError
from ..middleware import messages
from .convert import calibration_of
from .diagnostics import Diagnostics, Level


class AppliedCalibration:
    """Receives calibrations, refuses those of other units, and reports which one is applied.

    Args:
        file: Loaded again when it changes; None where calibrations come from the topic alone.
        topic: Topic that publishes calibrations.
        follows: Whether calibrations of the topic are applied. A file that the user names must not
            be replaced by a message.
        serial_number: Of the unit; empty if it is not stated.
        diagnostics: Receives reports on the applied and the refused calibrations.

    Attributes:
        compensator: None until there is a calibration.
        follows: As above.
    """

    def __init__(
        self,
        file: Path | None,
        topic: str,
        diagnostics: Diagnostics,
        *,
        follows: bool,
        serial_number: str,
    ) -> None:
        self.compensator: Compensator | None = None
        self._file = file
        self._topic = topic
        self.follows = follows
        self._serial = serial_number
        self._diagnostics = diagnostics
        self._version: tuple[int, int] | None = None
        self._offered: Any = None
        self._source = ''
        self._made_at = 0.0

    def begin(self) -> None:
        """Apply the calibration that is available now, whatever was applied before."""
        self._version, self.compensator, self._source = None, None, ''
        self.read_file()
        if self._offered is not None:
            self.take(self._offered)
        self.report()

    def renew(self) -> None:
        """Restart the compensator."""
        if self.compensator is not None:
            self.compensator = Compensator(self.compensator.calibration)

    def take(self, message: Any) -> None:
        """Apply a calibration of the topic if it is valid."""
        self._offered = message
        if message.status == messages.ImuCalibration.INCOMPLETE:
            text = (
                f'The calibration on {self._topic} is incomplete and is not used. '
                f'{message.status_text}'
            )
            self._diagnostics.report('calibration offered', Level.WARN, text)
        if message.status != messages.ImuCalibration.VALID:
            return
        stamp = message.header.stamp
        try:
            calibration = by_temperature(calibration_of(message), self._topic)
            # The message must state the serial number of this node or of the applied calibration.
            self._check_serial(calibration, self._topic, stated=True)
            self._check_same(calibration, self._topic)
            self._use(calibration, self._topic, stamp.sec + stamp.nanosec * 1e-9)
        except ImuCalibError as error:
            self._diagnostics.report('calibration offered', Level.WARN, str(error))

    def read_file(self) -> None:
        """Read the file if it is new or has changed."""
        if self._file is None:
            return
        try:
            found = self._file.stat()
        except OSError:
            # Another process may still be writing it.
            if self._version is not None:
                self._refuse(Level.WARN, f'{self._file} is not there any more.')
            self._version = None
            return
        version = found.st_mtime_ns, found.st_size
        if version == self._version:
            return
        self._version = version
        try:
            calibration = load_calibration(self._file)
            self._check_serial(calibration, str(self._file), stated=False)
            self._check_same(calibration, str(self._file))
            self._use(calibration, str(self._file), found.st_mtime)
        except ImuCalibError as error:
            self._refuse(Level.ERROR, str(error))

    def _refuse(self, level: Level, reason: str) -> None:
        """Report why the file is not applied, and what is."""
        stays = '' if self.compensator is None else ' What was read before stays applied.'
        self._diagnostics.report('calibration offered', level, reason + stays)

    def report(self) -> None:
        """Report which calibration is applied, or from where one is expected."""
        if self.compensator is None:
            sources = [str(self._file)] if self._file is not None else []
            where = ' or '.join([*sources, self._topic] if self.follows else sources)
            self._diagnostics.report(
                'calibration',
                Level.WARN,
                f'No calibration: nothing is published until there is one in {where}.',
            )
            return
        calibration = self.compensator.calibration
        single = first_of(calibration)
        age = time.time() - self._made_at
        self._diagnostics.report(
            'calibration',
            Level.OK,
            ' '.join([f'{self._source} is applied.', *single.unknown_noise]),
            imu=single.imu.id,
            serial_number=single.serial_number or 'not stated',
            source=self._source,
            age=f'{age / 3600:.1f} h',
            temperatures=_degrees(calibration),
            method=str(single.provenance.get('method', 'not stated')),
        )

    def _check_same(self, calibration: AnyCalibration, name: str) -> None:
        """Refuse the calibration of another type of IMU, or of other units."""
        if self.compensator is not None:
            used = f'the calibration in use ({self._source})'
            check_same_unit(calibration, name, self.compensator.calibration, used)

    def _check_serial(self, calibration: AnyCalibration, name: str, *, stated: bool) -> None:
        """Refuse the calibration of another unit."""
        expected, who = self._serial, 'the parameter serial_number says'
        remedy = 'Give the calibration of this unit'
        if not expected and self.compensator is not None:
            expected = first_of(self.compensator.calibration).serial_number
            who = f'the calibration in use ({self._source}) says'
            remedy += '; if it was replaced, start the node again'
        found = first_of(calibration).serial_number
        if expected and found != expected and (found or stated):
            raise InputError(
                f'{name}: serial_number: found {found or "none"}, expected {expected} as {who}: '
                f'it is not applied. {remedy}.'
            )

    def _use(self, calibration: AnyCalibration, source: str, made_at: float) -> None:
        """Apply a calibration, and report its source and unit."""
        if self.compensator is None:
            self.compensator = Compensator(calibration)
        else:
            self.compensator.replace(calibration)
        self._source, self._made_at = source, made_at
        unit = first_of(calibration)
        self._diagnostics.hardware_id = f'{unit.imu.id} {unit.serial_number}'.strip()
        self._diagnostics.report('calibration offered', Level.OK, f'{source} is used.')
        self.report()


def _degrees(calibration: AnyCalibration) -> str:
    if isinstance(calibration, ThermalCalibration):
        return ', '.join(f'{celsius:.2f}' for celsius in calibration.temperatures) + ' degC'
    seen = calibration.provenance.get('temperature')
    return 'not measured' if seen is None else f'{float(seen["mean"]):.2f} degC'
