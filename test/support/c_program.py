"""A program in C around the exported header: samples in, compensated ones out."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from loopback import completed

from imu_calib.common.stream import Floats

PROGRAM = """
#include <stdio.h>
#include "unit.h"

int main(void)
{
    double in[6];
    while (scanf("%lf %lf %lf %lf %lf %lf", in, in + 1, in + 2, in + 3, in + 4, in + 5) == 6) {
        imu_calib_real gyro[3], accel[3], rate[3], force[3];
        for (int i = 0; i < 3; ++i) {
            gyro[i] = (imu_calib_real)in[i];
            accel[i] = (imu_calib_real)in[i + 3];
        }
        imu_calib_compensate(gyro, accel, (imu_calib_real)0.01, rate, force);
        for (int i = 0; i < 3; ++i)
            printf("%.17g %.17g ", (double)rate[i], (double)force[i]);
        printf("\\n");
    }
    return 0;
}
"""
_STRICT = ['-std=c99', '-Wall', '-Wextra', '-Wconversion', '-Wdouble-promotion', '-Werror']


def compensated_in_c(folder: Path, header: str, read: Floats, define: str | None = None) -> Floats:
    """Compile the header into a program and run it, or skip the test without a compiler.

    Args:
        folder: Where it is compiled.
        header: Text of the exported header.
        read: (k, 6) outputs of gyros and accelerometers.
        define: Macro that is defined.

    Returns:
        (k, 6) rates and specific forces, by turns.
    """
    (folder / 'unit.h').write_text(header)
    (folder / 'main.c').write_text(PROGRAM)
    defined = [f'-D{define}'] if define else []
    try:
        subprocess.run(['cc', *_STRICT, *defined, 'main.c', '-o', 'main'], cwd=folder, check=True)
    except FileNotFoundError:
        pytest.skip('no C compiler')
    lines = '\n'.join(' '.join(map(repr, row)) for row in read.tolist())
    run = completed([folder / 'main'], input=lines, check=True)
    return np.array([line.split() for line in run.stdout.splitlines()], dtype=float)
