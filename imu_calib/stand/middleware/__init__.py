"""rclpy where ROS 2 is, else the same subset of it over Cyclone DDS or within one process.

    from imu_calib.stand.middleware import Node, QoSProfile, messages
    from imu_calib.stand.nodes.programs import run

    class Talker(Node):
        def __init__(self):
            super().__init__('talker')
            self.publisher = self.create_publisher(messages.String, 'chatter', 10)

    run(Talker)

`RUNTIME` names the one in use; IMU_CALIB_MIDDLEWARE=rclpy|dds|embedded forces it. In addition to
rclpy's names there are `open_drain` and `drain` (all that has arrived as serialised bytes, in
bulk), `open_stream` (the same as soon as it arrives), `publish_all`, `acknowledged`, `GoalServer`
(an action whose goals the node ends), `ManagedNode` (a lifecycle node that can start by itself),
`run_beside` (work beside callbacks), `in_step` (whether a simulation in this process makes the
time) and `run`; `LEASE` is the time, s, for which a process that was killed is still listed.
`dds.node.Node` lists what the subset lacks; services over DDS do not reach peers on
rmw_fastrtps.
"""

from .chosen import *  # noqa: F403
from .chosen import NAMES, RUNTIME
from .node_life import Stoppable, run
from .running import GoalStatus

__all__ = [*NAMES, 'RUNTIME', 'GoalStatus', 'Stoppable', 'run']  # noqa: PLE0604
