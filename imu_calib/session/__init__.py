"""What a person states of a session: IMU, plan, table, units, metadata of a recording."""
