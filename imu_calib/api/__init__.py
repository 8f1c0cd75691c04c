"""The suite from Python: what every command does, as a function. `imu_calib` exports them."""
