"""What an IMU does: parameters, terms, sensors, changes in a session; gravity, Earth rate."""
