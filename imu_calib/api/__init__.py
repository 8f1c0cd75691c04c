"""The Python interface: one function per command. `imu_calib` exports them."""
