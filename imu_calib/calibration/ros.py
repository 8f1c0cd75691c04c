"""A parameter file for compensator_node: `ros2 run imu_calib compensator_node --ros-args ...`."""

from __future__ import annotations

import yaml

from ..common.errors import InputError
from .exported import Exported, ExportSource, left_out


def export_ros(source: ExportSource) -> Exported:
    """Return parameters that name the calibration file for the node.

    The file is not copied: the node reads it again when it changes.

    Raises:
        InputError: The calibration has no file.
    """
    if source.path is None:
        raise InputError(
            "The format ros names the calibration's file: give its path, or `output`, beside which "
            'one is written.'
        )
    document = {'/**': {'compensator_node': {'ros__parameters': {'calibration': str(source.path)}}}}
    head = (
        f'# Calibration of {source.calibration.imu.id} for compensator_node:\n'
        '# ros2 run imu_calib compensator_node --ros-args --params-file THIS_FILE\n'
    )
    return Exported(
        head + yaml.safe_dump(document, sort_keys=False, width=10**6),
        (
            *left_out(source.calibration, 'ros'),
            'The file names the calibration by its path: it has to be there on the robot.',
        ),
    )
