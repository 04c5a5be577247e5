# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From messages to measurements.

Any object with the fields of the message will do (rclpy's or those of a bag reader), so this
module imports no ROS and the offline tools share it. What cannot be read comes back as an answer
with the reason; nothing raises for bad data. Covariances are handed on as they are: what becomes
of them is up to the policy of the source.
"""

import math
import re
from typing import Any

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    HeadingOnly,
    LARGEST_COORDINATE,
    LoopClosure,
    OdometrySample,
    rejected,
)
from pose_graph_ros.core.motion import wrap_one
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.ros.sources import NANOSECONDS

# rows and columns x, y and yaw of a 6x6 covariance
PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
# an Imu without an orientation says so in the first element of its covariance
NO_ORIENTATION = -1.0

_REFERENCE_NODE = re.compile(r'x(\d{1,18})')
_REFERENCE_TIME = re.compile(r'@(\d{1,10})(?:\.(\d{1,9}))?')

Message = Any
"""A message of any reader; its fields are checked where they are read."""


def stamp_ns(message: Message, offset_ns: int = 0) -> int:
    """Return the stamp of a message's header plus an offset [ns]; one that is not set stays so."""
    stamp = message.header.stamp
    whole = int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)
    return whole + offset_ns if whole > 0 else whole


def frame(name: str) -> str:
    """Return a frame id without the leading slash of old drivers."""
    return name.removeprefix('/')


def yaw_of(q: Message) -> float | None:
    """Return the yaw of a quaternion, which need not be normalised; None if it is none."""
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not (math.isfinite(norm) and norm > 1e-12):
        return None
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def planar_pose(pose: Message) -> FloatArray | None:
    """Return (x, y, yaw), shape (3,), of a Pose; None if it is not finite or not turned."""
    position, yaw = pose.position, yaw_of(pose.orientation)
    if yaw is None or not (math.isfinite(position.x) and math.isfinite(position.y)):
        return None
    return np.array((position.x, position.y, wrap_one(yaw)))


def odometry_sample(message: Message, offset_ns: int = 0) -> OdometrySample | Answer:
    """
    Read a nav_msgs/Odometry: its pose, whose increments make the edges, and its twist.

    The covariance of its pose is accumulated over the drive and not looked at.
    """
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    x, y, _ = pose.tolist()
    if max(abs(x), abs(y)) > LARGEST_COORDINATE:
        return rejected('too_large', f'odometry pose {pose.tolist()}')
    linear = message.twist.twist.linear
    speed = math.hypot(linear.x, linear.y)
    return OdometrySample(
        stamp_ns(message, offset_ns), pose, speed if math.isfinite(speed) else 0.0,
        _twist_variance(message))


def _twist_variance(message: Message) -> FloatArray | None:
    """Return the variances of v_x, v_y and yaw rate; None if they say nothing."""
    # element by element: arrays of three cost ten times as much, at each message
    values = message.twist.covariance
    variance = float(values[0]), float(values[7]), float(values[35])
    usable = all(0.0 <= value <= covariance.LARGEST_VARIANCE for value in variance)
    return np.array(variance) if usable and any(variance) else None


def global_pose(message: Message, map_frame: str, offset_ns: int = 0) -> GlobalPose | Answer:
    """Read a geometry_msgs/PoseWithCovarianceStamped that is expressed in the map."""
    named = frame(message.header.frame_id)
    if named not in ('', map_frame):
        return rejected('wrong_frame', f'expected frame {map_frame!r}, got {named!r}')
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    return GlobalPose(stamp_ns(message, offset_ns), pose, _planar(message.pose.covariance))


def heading(
    message: Message, map_yaw: float = 0.0, yaw_offset: float = 0.0, offset_ns: int = 0,
) -> HeadingOnly | Answer:
    """
    Read a sensor_msgs/Imu whose yaw is absolute, from east: the heading of the robot in the map.

    Parameters
    ----------
    message : sensor_msgs/Imu
    map_yaw : float
        Angle of the map's x axis from east [rad].
    yaw_offset : float
        Added to the yaw: declination, or how the sensor is mounted [rad].
    offset_ns : int
        Added to the stamp [ns].

    """
    if message.orientation_covariance[0] == NO_ORIENTATION:
        return rejected('no_orientation', 'the sensor says that it has no orientation')
    yaw = yaw_of(message.orientation)
    if yaw is None:
        q = message.orientation
        return rejected('not_finite', f'quaternion ({q.x}, {q.y}, {q.z}, {q.w})')
    return HeadingOnly(stamp_ns(message, offset_ns), float(se2.wrap(yaw + yaw_offset - map_yaw)),
                       float(message.orientation_covariance[8]))


def loop_closure(message: Message, offset_ns: int = 0) -> LoopClosure | Answer:
    """
    Read a geometry_msgs/PoseWithCovarianceStamped whose frame names another pose.

    `x42` is a hidden node, `@1695.250000000` an instant in seconds.
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
