"""IMU devices: bytes of a line to columns of samples with the host's stamps."""
