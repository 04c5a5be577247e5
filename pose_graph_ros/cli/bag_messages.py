# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Create messages for a bag from arrays, as drivers and scan matchers would publish them."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.conversions import PLANAR
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation.sensors import velocities

Message = tuple[str, str, int, Any]
"""Topic, type, time of recording [ns] and message; recorded at its stamp, if made here."""
_TYPES = message_types()
_ODOMETRY = 'nav_msgs/msg/Odometry'
_FIX = 'sensor_msgs/msg/NavSatFix'
_IMU = 'sensor_msgs/msg/Imu'
_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


def write_bag(
    folder: str | Path, messages: Iterable[Message], *, overwrite: bool = False,
) -> None:
    """
    Write messages as a rosbag2, in the order of their stamps.

    Parameters
    ----------
    overwrite : bool, whether to replace an existing bag; otherwise one raises `BagError`

    """
    with BagWriter(folder, overwrite=overwrite) as bag:
        for topic, type_name, stamp, message in sorted(messages, key=lambda item: item[2]):
            bag.write(topic, type_name, stamp, message)


def odometry_messages(
    topic: str, frame: str, path: Trajectory, variances: Sequence[float],
    rates: FloatArray | None = None,
) -> Iterator[Message]:
    """
    Return nav_msgs/Odometry messages.

    Parameters
    ----------
    path : Trajectory, poses of base_link in the frame
    variances : sequence of float, length 6
        Of the pose and of the twist.
    rates : ndarray, shape (N, 3), optional
        Velocities in base_link [m/s, m/s, rad/s]; by default those between consecutive poses.

    """
    pose_with_covariance, twist_with_covariance, make_twist, vector = (
        _TYPES[f'geometry_msgs/msg/{key}']
        for key in ('PoseWithCovariance', 'TwistWithCovariance', 'Twist', 'Vector3'))
    covariance = np.diag(variances).ravel()
    stamps, poses = path.stamps_ns, path.poses
    rates = velocities(path) if rates is None else rates
    for stamp, pose, (vx, _, yaw_rate) in zip(
            stamps.tolist(), poses.tolist(), rates.tolist(), strict=True):
        twist = make_twist(vector(vx, 0.0, 0.0), vector(0.0, 0.0, yaw_rate))
        yield topic, _ODOMETRY, stamp, _TYPES[_ODOMETRY](
            _header(stamp, frame), 'base_link', pose_with_covariance(_pose(pose), covariance),
            twist_with_covariance(twist, covariance))


def fix_messages(
    topic: str, stamps_ns: IntArray, geodetic: FloatArray, sigma: float,
) -> Iterator[Message]:
    """
    Return sensor_msgs/NavSatFix messages.

    Parameters
    ----------
    stamps_ns : ndarray, shape (M,)
    geodetic : ndarray, shape (M, 3)
        Latitude, longitude and ellipsoidal height [deg, deg, m].
    sigma : float
        Standard deviation along each of east and north [m]; that of the height is twice as large.

    """
    status = _TYPES['sensor_msgs/msg/NavSatStatus']
    covariance = sigma**2 * np.diag([1.0, 1.0, 4.0]).ravel()
    for stamp, fix in zip(stamps_ns.tolist(), geodetic.tolist(), strict=True):
        yield topic, _FIX, stamp, _TYPES[_FIX](
            _header(stamp, 'gps'), status(status.STATUS_FIX, status.SERVICE_GPS), *fix,
            covariance, _TYPES[_FIX].COVARIANCE_TYPE_DIAGONAL_KNOWN)


def rate_messages(
    topic: str, stamps_ns: IntArray, rates: FloatArray, sigma: float,
) -> Iterator[Message]:
    """
    Return sensor_msgs/Imu messages of a gyroscope alone, in base_link.

    Parameters
    ----------
    stamps_ns : ndarray, shape (M,)
    rates : ndarray, shape (M,)
        Yaw rates [rad/s].
    sigma : float, standard deviation of each rate [rad/s]

    """
    vector, quaternion = (
        _TYPES[f'geometry_msgs/msg/{key}'] for key in ('Vector3', 'Quaternion'))
    none, covariance = np.append(-1.0, np.zeros(8)), sigma**2 * np.eye(3).ravel()
    for stamp, rate in zip(stamps_ns.tolist(), rates.tolist(), strict=True):
        yield topic, _IMU, stamp, _TYPES[_IMU](
            _header(stamp, 'base_link'), quaternion(0.0, 0.0, 0.0, 1.0), none,
            vector(0.0, 0.0, rate), covariance, vector(0.0, 0.0, 0.0), none)


def loop_closure_messages(
    topic: str, stamps_ns: IntArray, poses: FloatArray, covariance: FloatArray,
) -> Iterator[Message]:
    """
    Return loop closures as geometry_msgs/PoseWithCovarianceStamped messages.

    Parameters
    ----------
    stamps_ns : ndarray, shape (L, 2)
        Stamps of the earlier and of the later pose [ns].
    poses : ndarray, shape (L, 3)
        Later pose of the robot in the frame of the earlier one [m, m, rad].
    covariance : ndarray, shape (3, 3)
        Of each of the poses.

    """
    pose_with_covariance = _TYPES['geometry_msgs/msg/PoseWithCovariance']
    full = _spatial(covariance)
    for (old, new), pose in zip(stamps_ns.tolist(), poses.tolist(), strict=True):
        yield topic, _POSE, new, _TYPES[_POSE](
            _header(new, f'@{old // 10**9}.{old % 10**9:09d}'),
            pose_with_covariance(_pose(pose), full))


def pose_messages(
    topic: str, stamps_ns: IntArray, poses: FloatArray, covariance: FloatArray,
) -> Iterator[Message]:
    """
    Return poses in the map as geometry_msgs/PoseWithCovarianceStamped messages.

    Parameters
    ----------
    stamps_ns : ndarray, shape (M,)
    poses : ndarray, shape (M, 3) [m, m, rad]
    covariance : ndarray, shape (3, 3)
        Of each of the poses, in map axes.

    """
    pose_with_covariance = _TYPES['geometry_msgs/msg/PoseWithCovariance']
    full = _spatial(covariance)
    for stamp, pose in zip(stamps_ns.tolist(), poses.tolist(), strict=True):
        yield topic, _POSE, stamp, _TYPES[_POSE](
            _header(stamp, 'map'), pose_with_covariance(_pose(pose), full))


def _spatial(covariance: FloatArray) -> FloatArray:
    """Return a planar covariance, shape (3, 3), in the order of messages, shape (36,)."""
    full = np.diag([0.0, 0.0, 0.01, 3e-4, 3e-4, 0.0])
    full[PLANAR] = covariance
    return full.ravel()


def _header(stamp_ns: int, frame: str) -> Any:
    time = _TYPES['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
    return _TYPES['std_msgs/msg/Header'](time, frame)


def _pose(pose: list[float]) -> Any:
    x, y, theta = pose
    return _TYPES['geometry_msgs/msg/Pose'](
        _TYPES['geometry_msgs/msg/Point'](x, y, 0.0),
        _TYPES['geometry_msgs/msg/Quaternion'](
            0.0, 0.0, float(np.sin(0.5 * theta)), float(np.cos(0.5 * theta))))
