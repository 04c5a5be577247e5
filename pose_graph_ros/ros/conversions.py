# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From messages to measurements.

Any object with the fields of the message will do (rclpy's or those of a bag reader), so this
module imports no ROS and the offline tools share it. What cannot be used comes back as an answer
with the reason; nothing raises for bad data.
"""

from collections.abc import Sequence
import math
import re
from typing import Any

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
    rejected,
    value_defect,
)
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.tangent_plane import TangentPlane

# rows and columns x, y and yaw of a 6x6 covariance
PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
STATUS_NO_FIX = -1
COVARIANCE_TYPE_UNKNOWN = 0
NANOSECONDS = 1_000_000_000

_REFERENCE_NODE = re.compile(r'x(\d{1,18})')
_REFERENCE_TIME = re.compile(r'@(\d{1,10})(?:\.(\d{1,9}))?')

Message = Any
"""A message of any reader; its fields are checked where they are read."""


def stamp_ns(message: Message) -> int:
    """Return the stamp of a message's header [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def frame(name: str) -> str:
    """Return a frame id without the leading slash of old drivers."""
    return name.removeprefix('/')


def planar_pose(pose: Message) -> FloatArray | None:
    """
    Return (x, y, yaw), shape (3,), of a Pose; None if it is not finite or has no orientation.

    The quaternion need not be normalised.
    """
    position, q = pose.position, pose.orientation
    norm = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    if not (math.isfinite(norm) and norm > 1e-12
            and math.isfinite(position.x) and math.isfinite(position.y)):
        return None
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    return se2.wrapped(np.array([position.x, position.y, yaw]))


def odometry_sample(message: Message) -> OdometrySample | Answer:
    """Read a nav_msgs/Odometry: its pose alone, whose increments make the edges."""
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    broken = value_defect(pose)
    if broken is not None:
        return rejected(broken, f'odometry pose {pose.tolist()}')
    return OdometrySample(stamp_ns(message), pose)


def global_pose(message: Message, map_frame: str) -> GlobalPose | Answer:
    """Read a geometry_msgs/PoseWithCovarianceStamped that is expressed in the map."""
    named = frame(message.header.frame_id)
    if named not in ('', map_frame):
        return rejected('wrong_frame', f'expected frame {map_frame!r}, got {named!r}')
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    return GlobalPose(stamp_ns(message), pose, _planar_covariance(message))


def loop_closure(message: Message) -> LoopClosure | Answer:
    """
    Read a geometry_msgs/PoseWithCovarianceStamped whose frame names an earlier pose.

    `x42` is a hidden node, `@1695.250000000` an instant in seconds.
    """
    pose = planar_pose(message.pose.pose)
    if pose is None:
        return _bad_pose(message.pose.pose)
    named = message.header.frame_id
    cov = _planar_covariance(message)
    if (node := _REFERENCE_NODE.fullmatch(named)) is not None:
        return LoopClosure(stamp_ns(message), pose, cov, reference_node=int(node[1]))
    if (time := _REFERENCE_TIME.fullmatch(named)) is not None:
        nanoseconds = int((time[2] or '').ljust(9, '0'))
        return LoopClosure(stamp_ns(message), pose, cov,
                           reference_ns=int(time[1]) * NANOSECONDS + nanoseconds)
    return rejected('wrong_frame', f'expected a hidden node such as x42 or a time such as '
                                   f'@1695.250000000, got {named!r}')


class FixReader:
    """
    Reads NavSatFix messages into the map; the first good fix is the datum unless one is given.

    Parameters
    ----------
    datum : sequence of float
        Latitude and longitude [degrees] and, if there are three numbers, the angle of the map's x
        axis from east [rad]; empty for the first fix.
    lever_arm : sequence of float
        Position of the antenna in the robot's frame [m].

    Raises
    ------
    ValueError
        If one of them does not have the form above.

    """

    def __init__(
        self, datum: Sequence[float] = (), lever_arm: Sequence[float] = (0.0, 0.0),
    ) -> None:
        if len(datum) not in (0, 2, 3):
            raise ValueError(f'datum: expected [latitude, longitude] or [latitude, longitude, '
                             f'yaw], got {list(datum)}')
        if len(lever_arm) != 2 or not np.all(np.isfinite(lever_arm)):
            raise ValueError(f'lever arm: expected [x, y] in metres, got {list(lever_arm)}')
        if len(datum) > 0:
            TangentPlane(datum[0], datum[1], yaw=datum[2] if len(datum) == 3 else 0.0)
        self._datum = tuple(datum)
        self._lever_arm = np.array(lever_arm, dtype=np.float64)
        self.plane: TangentPlane | None = None
        """The map's plane; None before the first good fix, whose altitude it takes."""

    def position(self, message: Message) -> Position | Answer:
        """Read a sensor_msgs/NavSatFix; an unknown covariance comes back as zeros."""
        if message.status.status == STATUS_NO_FIX:
            return rejected('no_fix', 'the receiver says that it has no fix')
        latitude, longitude, altitude = message.latitude, message.longitude, message.altitude
        if not (math.isfinite(latitude) and math.isfinite(longitude)):
            return rejected('not_finite', f'latitude {latitude}, longitude {longitude}')
        if abs(latitude) > 90.0 or abs(longitude) > 360.0:
            return rejected('out_of_range', f'latitude {latitude}, longitude {longitude}')
        stamp = stamp_ns(message)
        if stamp <= 0:
            return rejected('zero_stamp', 'a fix without a stamp')
        cov = np.zeros((2, 2))
        if message.position_covariance_type != COVARIANCE_TYPE_UNKNOWN:
            cov = np.asarray(message.position_covariance, dtype=float).reshape(3, 3)[:2, :2]
        defect = covariance.defect(cov) if np.any(cov) else None
        if defect is not None:
            return rejected(f'covariance_{defect}', f'fix: {cov.tolist()}')
        if self.plane is None:
            self.plane = self._make_plane(latitude, longitude, altitude)
        if not math.isfinite(altitude):
            altitude = self.plane.altitude
        cov = covariance.turned(cov, self.plane.yaw)
        return Position(stamp, self.plane.to_map(latitude, longitude, altitude), cov,
                        self._lever_arm)

    def _make_plane(self, latitude: float, longitude: float, altitude: float) -> TangentPlane:
        height = altitude if math.isfinite(altitude) else 0.0
        if len(self._datum) == 0:
            return TangentPlane(latitude, longitude, height)
        yaw = self._datum[2] if len(self._datum) == 3 else 0.0
        return TangentPlane(self._datum[0], self._datum[1], height, yaw)


class MessageReader:
    """Turns the message of each input into the measurement that the engine takes."""

    def __init__(self, map_frame: str, fixes: FixReader) -> None:
        self._map_frame = map_frame
        self.fixes = fixes

    def read(self, source: str, message: Message) -> OdometrySample | Measurement | Answer:
        """Read a message of the input `odom`, `global_pose`, `fix` or `loop_closure`."""
        match source:
            case 'odom':
                return odometry_sample(message)
            case 'global_pose':
                return global_pose(message, self._map_frame)
            case 'fix':
                return self.fixes.position(message)
            case 'loop_closure':
                return loop_closure(message)
        raise ValueError(f'expected odom, global_pose, fix or loop_closure, got {source!r}')


def _planar_covariance(message: Message) -> FloatArray:
    return np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)[PLANAR]


def _bad_pose(pose: Message) -> Answer:
    p, q = pose.position, pose.orientation
    return rejected('not_finite', f'position ({p.x}, {p.y}), quaternion ({q.x}, {q.y}, {q.z}, '
                                  f'{q.w})')
