# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A node that sends back what it gets, as it is: what DDS and rclpy cost without any work.

With the parameter `events` by the executor that the node under test has.
"""

from nav_msgs.msg import Odometry
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, QoSReliabilityPolicy
from rclpy.task import Future

from pose_graph_ros.ros.spinning import EventsExecutor, LONGEST_WAIT

# As the node under test has them.
INPUT_QOS = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.RELIABLE)


def main() -> None:
    """Run until a signal."""
    rclpy.init()
    node = rclpy.create_node('echo')
    publisher = node.create_publisher(Odometry, 'odometry/filtered', OUTPUT_QOS)
    node.create_subscription(Odometry, 'odom', publisher.publish, INPUT_QOS, raw=True)
    try:
        if node.declare_parameter('events', value=False).value:
            executor = EventsExecutor()
            executor.add_node(node)
            executor.spin_until_future_complete(Future(), timeout_sec=LONGEST_WAIT)
        else:
            rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
