# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Create messages for a bag from arrays, as drivers and scan matchers would publish them."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.conversions import PLANAR
from pose_graph_ros.core.geometry.se2 import Covariance, FloatArray, IntArray, Poses
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.quantities import Metres, StampsNs
from pose_graph_ros.offline.simulation.sensors import velocities

Message = tuple[str, str, int, Any]
"""Topic, type, time of recording [ns] and message; recorded at its stamp, if made here."""
_TYPES = message_types()
_ODOMETRY = 'nav_msgs/msg/Odometry'
_FIX = 'sensor_msgs/msg/NavSatFix'
_IMU = 'sensor_msgs/msg/Imu'
_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def write_bag(folder: str | Path, messages: Iterable[Message]) -> None:
    """Write messages as a rosbag2, in the order of their stamps."""
    with BagWriter(folder) as bag:
        for topic, type_name, stamp, message in sorted(messages, key=lambda item: item[2]):
            bag.write(topic, type_name, stamp, message)


def odometry_messages(
    topic: str, frame: str, path: Trajectory, variances: Sequence[float],
    rates: FloatArray | None = None,
) -> Iterator[Message]:
    """
    Return nav_msgs/Odometry messages of poses of base_link in a frame.

    The six variances are those of the pose and of the twist. Rates are velocities in base_link,
    shape (N, 3) [m/s, m/s, rad/s]; by default those between consecutive poses.
    """
    covariance = np.diag(variances).ravel()
    rates = velocities(path) if rates is None else rates
    for stamp, pose, (vx, _, yaw_rate) in zip(
            path.stamps_ns.tolist(), path.poses.tolist(), rates.tolist(), strict=True):
        twist = _of('Twist', _of('Vector3', vx, 0.0, 0.0), _of('Vector3', 0.0, 0.0, yaw_rate))
        yield topic, _ODOMETRY, stamp, _TYPES[_ODOMETRY](
            _header(stamp, frame), 'base_link',
            _of('PoseWithCovariance', _pose(pose), covariance),
            _of('TwistWithCovariance', twist, covariance))


def fix_messages(
    topic: str, stamps_ns: StampsNs, geodetic: FloatArray, sigma: Metres,
) -> Iterator[Message]:
    """
    Return sensor_msgs/NavSatFix messages, of rows of latitude, longitude [deg] and height [m].

    Sigma is that of east and of north; that of the height is twice as large.
    """
    status = _TYPES['sensor_msgs/msg/NavSatStatus']
    covariance = sigma**2 * np.diag([1.0, 1.0, 4.0]).ravel()
    for stamp, fix in zip(stamps_ns.tolist(), geodetic.tolist(), strict=True):
        yield topic, _FIX, stamp, _TYPES[_FIX](
            _header(stamp, 'gps'), status(status.STATUS_FIX, status.SERVICE_GPS), *fix,
            covariance, _TYPES[_FIX].COVARIANCE_TYPE_DIAGONAL_KNOWN)


def rate_messages(
    topic: str, stamps_ns: StampsNs, rates: FloatArray, sigma: float,
) -> Iterator[Message]:
    """Return sensor_msgs/Imu messages of yaw rates in base_link [rad/s], and nothing else."""
    none, covariance = np.append(-1.0, np.zeros(8)), sigma**2 * np.eye(3).ravel()
    for stamp, rate in zip(stamps_ns.tolist(), rates.tolist(), strict=True):
        yield topic, _IMU, stamp, _TYPES[_IMU](
            _header(stamp, 'base_link'), _of('Quaternion', 0.0, 0.0, 0.0, 1.0), none,
            _of('Vector3', 0.0, 0.0, rate), covariance, _of('Vector3', 0.0, 0.0, 0.0), none)


def loop_closure_messages(
    topic: str, stamps_ns: IntArray, poses: Poses, covariance: Covariance,
) -> Iterator[Message]:
    """
    Return loop closures as geometry_msgs/PoseWithCovarianceStamped messages.

    Rows of stamps are those of the earlier and of the later pose; poses are the later ones in the
    frames of the earlier, each with the same covariance.
    """
    frames = [f'@{old // 10**9}.{old % 10**9:09d}' for old in stamps_ns[:, 0].tolist()]
    return _poses(topic, stamps_ns[:, 1], frames, poses, covariance)


def pose_messages(
    topic: str, stamps_ns: StampsNs, poses: Poses, covariance: Covariance,
) -> Iterator[Message]:
    """Return poses in the map with one covariance, as PoseWithCovarianceStamped messages."""
    return _poses(topic, stamps_ns, ['map'] * len(poses), poses, covariance)


def _poses(
    topic: str, stamps_ns: StampsNs, frames: Sequence[str], poses: Poses, covariance: Covariance,
) -> Iterator[Message]:
    spatial = np.diag([0.0, 0.0, 0.01, 3e-4, 3e-4, 0.0])
    spatial[PLANAR] = covariance
    for stamp, frame, pose in zip(stamps_ns.tolist(), frames, poses.tolist(), strict=True):
        yield topic, _POSE, stamp, _TYPES[_POSE](
            _header(stamp, frame), _of('PoseWithCovariance', _pose(pose), spatial.ravel()))


def _header(stamp_ns: int, frame: str) -> Any:
    time = _TYPES['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return _TYPES['std_msgs/msg/Header'](time, frame)


def _of(kind: str, *fields: Any) -> Any:
    """Return a message of geometry_msgs."""
    return _TYPES[f'geometry_msgs/msg/{kind}'](*fields)


def _pose(pose: list[float]) -> Any:
    x, y, theta = pose
    return _of('Pose', _of('Point', x, y, 0.0), _of(
        'Quaternion', 0.0, 0.0, float(np.sin(0.5 * theta)), float(np.cos(0.5 * theta))))
