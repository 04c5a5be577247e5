# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Convert ROS messages to measurements.

The functions accept any object with the fields of the message, from rclpy or from a bag reader.
Invalid data never raises: they return an `Answer` with the reason. Covariances are passed on
unchanged; `core.sources.validation` applies the covariance policy of the source.
"""

from collections.abc import Sequence
import math
import re
from typing import Any

import numpy as np

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, Pose, wrap_one
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    HeadingOnly,
    LARGEST_COORDINATE,
    LoopClosure,
    OdometrySample,
    rejected,
)
from pose_graph_ros.core.quantities import NANOSECONDS, Radians

PLANAR = np.ix_((0, 1, 5), (0, 1, 5))  # rows and columns of x, y and yaw in a 6x6 covariance

_REFERENCE_NODE = re.compile(r'x(\d{1,18})')
_REFERENCE_TIME = re.compile(r'@(\d{1,10})(?:\.(\d{1,9}))?')

Message = Any
"""A ROS message of any reader."""


def stamp_ns(message: Message, offset_ns: int = 0) -> int:
    """Return the stamp of a message's header plus an offset [ns]; a stamp of 0 stays 0."""
    stamp = message.header.stamp
    whole = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    return whole + offset_ns if whole > 0 else whole


def frame(name: str) -> str:
    """Return a frame id without a leading slash, which drivers from ROS 1 may still send."""
    return name.removeprefix('/')


def yaw_of(q: Message) -> float | None:
    """Return the yaw of a quaternion of any norm [rad]; None if the norm is zero or not finite."""
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not (math.isfinite(norm) and norm > 1e-12):
        return None
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def planar_pose(pose: Message) -> FloatArray | None:
    """Return (x, y, yaw) of a Pose, shape (3,); None if it is not finite or has no rotation."""
    position, yaw = pose.position, yaw_of(pose.orientation)
    if yaw is None or not (math.isfinite(position.x) and math.isfinite(position.y)):
        return None
    return np.array((position.x, position.y, wrap_one(yaw)))


def odometry_sample(
    message: Message, offset_ns: int = 0, *, with_twist: bool = False,
) -> OdometrySample | Answer:
    """
    Return the sample in a nav_msgs/Odometry, or the reason for rejecting it.

    The covariance of its pose is accumulated over the drive, so it is not used.
    """
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    x, y, _ = pose.tolist()
    if max(abs(x), abs(y)) > LARGEST_COORDINATE:
        return rejected('too_large', f'odometry pose {pose.tolist()}')
    linear = message.twist.twist.linear
    speed = math.hypot(linear.x, linear.y)
    twist = planar_twist(message.twist.twist) if with_twist else None
    if isinstance(twist, Answer):
        return twist
    return OdometrySample(
        stamp_ns(message, offset_ns), pose, speed if math.isfinite(speed) else 0.0,
        twist_variance(message.twist.covariance), twist)


def planar_twist(twist: Message) -> Pose | Answer:
    """Return (v_x, v_y, yaw rate) of a Twist, or the reason for rejecting it."""
    x, y, rate = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(rate)):
        return rejected('not_finite', f'twist ({x}, {y}), yaw rate {rate}')
    return x, y, rate


def twist_variance(values: Sequence[float]) -> FloatArray | None:
    """Return the variances of v_x, v_y and yaw rate, shape (3,); None if they are unknown."""
    # element by element: NumPy operations on three elements take ten times as long
    variance = float(values[0]), float(values[7]), float(values[35])
    usable = all(0.0 <= value <= covariance.LARGEST_VARIANCE for value in variance)
    return np.array(variance) if usable and any(variance) else None


def global_pose(
    message: Message, frames: Sequence[str], offset_ns: int = 0,
) -> GlobalPose | Answer:
    """
    Return the pose in a PoseWithCovarianceStamped, or the reason for rejecting it.

    It is in one of some frames, or in the first of them if it names none.
    """
    named = frame(message.header.frame_id)
    if named not in ('', *frames):
        return rejected('wrong_frame', f'expected frame {" or ".join(map(repr, frames))}, got '
                                       f'{named!r}')
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    return GlobalPose(stamp_ns(message, offset_ns), pose, _planar(message.pose.covariance))


def heading(
    message: Message, map_yaw: Radians = 0.0, yaw_offset: Radians = 0.0, offset_ns: int = 0,
) -> HeadingOnly | Answer:
    """
    Return the heading in a sensor_msgs/Imu with an absolute yaw, or the reason for rejecting it.
    """
    if message.orientation_covariance[0] == -1.0:   # by the definition of the message
        return rejected('no_orientation', 'the sensor reports no orientation')
    yaw = yaw_of(message.orientation)
    if yaw is None:
        q = message.orientation
        return rejected('not_finite', f'quaternion ({q.x}, {q.y}, {q.z}, {q.w})')
    return HeadingOnly(stamp_ns(message, offset_ns), float(se2.wrap(yaw + yaw_offset - map_yaw)),
                       float(message.orientation_covariance[8]))


def loop_closure(message: Message, offset_ns: int = 0) -> LoopClosure | Answer:
    """
    Return the loop closure in a PoseWithCovarianceStamped, or the reason for rejecting it.

    The frame of the header names the other pose: a hidden node, such as `x42`, or the pose at a
    stamp [s], such as `@1695.250000000`.
    """
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    named, stamp = message.header.frame_id, stamp_ns(message, offset_ns)
    cov = _planar(message.pose.covariance)
    if (node := _REFERENCE_NODE.fullmatch(named)) is not None:
        return LoopClosure(stamp, pose, cov, reference_node=int(node[1]))
    if (time := _REFERENCE_TIME.fullmatch(named)) is not None:
        nanoseconds = int((time[2] or '').ljust(9, '0'))
        return LoopClosure(stamp, pose, cov, reference_ns=(
            int(time[1]) * NANOSECONDS + nanoseconds + offset_ns))
    return rejected('wrong_frame', f'expected a hidden node such as x42 or a time such as '
                                   f'@1695.250000000, got {named!r}')


def _planar(covariance_6x6: Message) -> FloatArray:
    return np.asarray(covariance_6x6, dtype=float).reshape(6, 6)[PLANAR]


def _bad_pose(pose: Message) -> Answer:
    p, q = pose.position, pose.orientation
    return rejected('not_finite', f'position ({p.x}, {p.y}), quaternion ({q.x}, {q.y}, {q.z}, '
                                  f'{q.w})')
