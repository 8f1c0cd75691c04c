"""ROS 2 nodes: thin shells around the core, on either runtime of `imu_calib.middleware`."""
