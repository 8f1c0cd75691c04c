#!/usr/bin/env bash
# Commonly expected: set_accelerometer_low_pass(mode=5) and set_gyro_low_pass(mode=5), which the
# driver calls itself at start, choose setting 5 of the low-pass filter, about 11.5 Hz (data sheet of
# the ICM-20948: bits 5 to 3 of ACCEL_CONFIG and GYRO_CONFIG_1 are the setting, 2 and 1 the range).
#
# What happens: the setting is written one bit too high. 5 becomes 2, a cutoff of 111 and 120 Hz with
# samples at 125 and 100 Hz: vibration above half those rates is folded into the data as motion. 7,
# the widest, gives 5.7 Hz, and no odd setting can be had.
#
# Seen with icm20948 1.0.0, its bus replaced by registers in memory, Python 3.11, on 28 November
# 2026.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check icm20948==1.0.0 smbus2==0.6.1
"$folder/venv/bin/python" - <<'PROGRAM'
import sys

from icm20948 import ICM20948


class Bus:
    """An ICM-20948 after a reset: four banks of registers, its magnetometer always ready."""

    def __init__(self):
        self.bank = 0
        self.registers = {(0, 0x00): 0xEA, (0, 0x3B): 0x09, (2, 0x01): 1, (2, 0x14): 1}

    def write_byte_data(self, address, register, value):
        if register == 0x7F:
            self.bank = value >> 4
        else:
            self.registers[self.bank, register] = value

    def read_byte_data(self, address, register):
        return self.registers.get((self.bank, register), 0)


# Cutoffs by the setting (data sheet, ACCEL_CONFIG and GYRO_CONFIG_1), in Hz.
ACCELEROMETER = [246.0, 246.0, 111.4, 50.4, 23.9, 11.5, 5.7, 473.0]
GYROSCOPE = [196.6, 151.8, 119.5, 51.2, 23.9, 11.6, 5.7, 361.4]
bus = Bus()
chip = ICM20948(i2c_bus=bus)


def setting(register):
    return bus.registers[2, register] >> 3 & 7


start = ACCELEROMETER[setting(0x14)], GYROSCOPE[setting(0x01)]
print('cutoffs of accelerometer and gyroscope after the start:', start, 'Hz')
settings = []
for mode in range(8):
    chip.set_accelerometer_low_pass(mode=mode)
    settings.append(setting(0x14))
    print(f'mode {mode}: asked for {ACCELEROMETER[mode]} Hz, set {ACCELEROMETER[settings[-1]]} Hz')
sys.exit(not (start == (111.4, 119.5) and settings == [0, 2, 4, 6, 0, 2, 4, 6]))
PROGRAM
