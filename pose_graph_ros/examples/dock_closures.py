# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The smallest front end: a robot that begins to charge stands where it did the first time.

    python3 -m pose_graph_ros.examples.dock_closures --ros-args -r battery_state:=/battery
"""

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import BatteryState

ERRORS = np.array((0.02, 0.02, 0.0, 0.0, 0.0, 0.02))    # of standing in the dock [m, rad]


class DockClosures(Node):
    """Sends a loop closure to the first time in the dock, each time that charging begins."""

    def __init__(self) -> None:
        super().__init__('dock_closures')
        self._first, self._charges = '', False
        self._closures = self.create_publisher(PoseWithCovarianceStamped, 'loop_closure', 100)
        self.create_subscription(BatteryState, 'battery_state', self._receive, 10)

    def _receive(self, battery: BatteryState) -> None:
        charged, self._charges = self._charges, (
            battery.power_supply_status == BatteryState.POWER_SUPPLY_STATUS_CHARGING)
        stamp = battery.header.stamp
        if self._charges and not charged and self._first:
            closure = PoseWithCovarianceStamped()   # its pose is that of no motion
            closure.header.stamp, closure.header.frame_id = stamp, self._first
            closure.pose.covariance = np.diag(ERRORS ** 2).ravel().tolist()
            self._closures.publish(closure)
        elif self._charges and not self._first:
            self._first = f'@{stamp.sec}.{stamp.nanosec:09d}'


if __name__ == '__main__':
    rclpy.init()
    rclpy.spin(DockClosures())
