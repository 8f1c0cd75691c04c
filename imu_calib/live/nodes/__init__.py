"""ROS 2 nodes: thin shells around the core, on any runtime of `middleware`."""
