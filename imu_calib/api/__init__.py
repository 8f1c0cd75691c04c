"""The Python interface: one function per command, exported by `imu_calib`."""
