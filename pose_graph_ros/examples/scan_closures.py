# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A small front end: it sends a loop closure where a laser scan matches one of before.

    python3 -m pose_graph_ros.examples.scan_closures --ros-args -r scan:=/front/scan

`match` compares two scans; the rest is what any front end does for the node, see
docs/guides/loop_closures.md. Copy it, and put your own matching into its place.
"""

from collections.abc import Sequence
from contextlib import suppress
import math

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time
from scipy.spatial import cKDTree
from sensor_msgs.msg import LaserScan

PERIOD, LAP = 1.0, 20.0     # between scans that are kept; to one that may be the same place [s]
NEARBY, REACH = 3.0, 1.0    # between poses to compare; between points to match at the end [m]
OFF, SHARE = 0.1, 0.8       # how far points may be off their lines [m]; how many must not be
FLOOR = np.diag((0.03, 0.03, 0.005)) ** 2   # errors that all points share [m, m, rad]
WEAK, LOST = 0.1, 10.0      # below this share of what tells of x and y, one is unknown [m]


class ScanClosures(Node):
    """Keeps scans, and compares each with the nearest of earlier visits."""

    def __init__(self) -> None:
        super().__init__('scan_closures')
        self._mounting = self.declare_parameter('laser', [0.0, 0.0, 0.0]).value  # in base_link
        self._scans: list[tuple[int, np.ndarray]] = []  # stamps [ns], points in base_link [m]
        self._next = 0                                  # of these, which is compared next
        self._closures = self.create_publisher(PoseWithCovarianceStamped, 'loop_closure', 100)
        self.create_subscription(
            LaserScan, 'scan', self._keep, qos_profile_sensor_data,
            qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self.create_subscription(Path, 'path', self._compare, 1)

    def _keep(self, scan: LaserScan) -> None:
        stamp = Time.from_msg(scan.header.stamp).nanoseconds
        ranges = np.asarray(scan.ranges, dtype=float)
        angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
        hit = (ranges > scan.range_min) & (ranges < scan.range_max)
        if np.sum(hit) < 20 or (self._scans and stamp - self._scans[-1][0] < PERIOD * 1e9):
            return
        points = (ranges * (np.cos(angles), np.sin(angles))).T[hit]
        self._scans.append((stamp, move(self._mounting, points)))

    def _compare(self, path: Path) -> None:
        """Compare the scans that the path has come to, where it now says that they were taken."""
        if len(path.poses) == 0:
            return
        at = [Time.from_msg(item.header.stamp).nanoseconds for item in path.poses]
        poses = np.array([(item.pose.position.x, item.pose.position.y, 2.0 * math.atan2(
            item.pose.orientation.z, item.pose.orientation.w)) for item in path.poses])
        poses[:, 2] = np.unwrap(poses[:, 2])
        stamps = np.array([stamp for stamp, _ in self._scans])
        places = np.stack([np.interp(stamps, at, column) for column in poses.T], axis=1)
        while self._next < len(stamps) and stamps[self._next] <= at[-1]:
            new, self._next = self._next, self._next + 1
            apart = np.hypot(*(places[:new, :2] - places[new, :2]).T)
            apart[stamps[:new] > stamps[new] - LAP * 1e9] = math.inf
            if len(apart) > 0 and apart[old := int(np.argmin(apart))] < NEARBY:
                x, y, yaw = places[old]
                there = move((0.0, 0.0, -yaw), places[new, :2] - (x, y))
                if (found := match(self._scans[new][1], self._scans[old][1],
                                   np.append(there, places[new, 2] - yaw))) is not None:
                    self._send(int(stamps[new]), int(stamps[old]), *found)

    def _send(self, new: int, old: int, pose: np.ndarray, covariance: np.ndarray) -> None:
        """Say where the robot was at stamp `new`, in the frame of where it was at `old`."""
        message = PoseWithCovarianceStamped()
        message.header.stamp = Time(nanoseconds=new).to_msg()
        message.header.frame_id = f'@{old // 10**9}.{old % 10**9:09d}'
        message.pose.pose.position.x, message.pose.pose.position.y = pose[:2].tolist()
        message.pose.pose.orientation.z = math.sin(pose[2] / 2.0)
        message.pose.pose.orientation.w = math.cos(pose[2] / 2.0)
        full = np.zeros((6, 6))
        full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance     # x, y and yaw
        message.pose.covariance = full.ravel().tolist()
        self._closures.publish(message)


def move(pose: Sequence[float] | np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points that are given in the frame of a pose in the frame that this is given in."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return points @ np.array(((c, s), (-s, c))) + pose[:2]


def match(points: np.ndarray, target: np.ndarray, pose: np.ndarray) -> tuple | None:
    """Return the pose of one scan in another, with its covariance, by point-to-line ICP."""
    tree = cKDTree(target)
    around = target[tree.query(target, 10)[1]]
    normals = np.linalg.svd(around - around.mean(axis=1, keepdims=True))[2][:, 1]
    for iteration in range(30):
        moved = move(pose, points)
        apart, nearest = map(np.asarray, tree.query(moved))
        near = apart < max(REACH, 4.0 * 0.8 ** iteration)
        n, arm = normals[nearest[near]], moved[near] - pose[:2]
        error = np.sum(n * (moved[near] - target[nearest[near]]), axis=1)
        J = np.column_stack((n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]))
        H = J.T @ J + 1e-6 * np.eye(3)
        pose = pose - np.linalg.solve(H, J.T @ error)
    if np.sum(np.abs(error) < OFF) < SHARE * len(points):
        return None
    covariance = np.mean(error ** 2) * np.linalg.inv(H) + FLOOR
    # the noise of the normals seems to tell the place along a corridor
    known, axes = np.linalg.eigh(H[:2, :2])
    covariance[:2, :2] += axes @ np.diag((known < WEAK * known[1]) * LOST ** 2) @ axes.T
    return pose, covariance


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(ScanClosures())


if __name__ == '__main__':
    main()
