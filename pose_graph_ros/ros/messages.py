# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From estimates to messages."""

from collections.abc import Mapping
import math
import struct

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Pose, PoseWithCovariance, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import NavSatFix, NavSatStatus
from std_msgs.msg import Header

from pose_graph_ros.core import covariance as cov
from pose_graph_ros.core.prediction import Prediction
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.tangent_plane import TangentPlane
from pose_graph_ros.core.trajectory import Trajectory
from pose_graph_ros.ros.conversions import PLANAR
from pose_graph_ros.ros.sources import NANOSECONDS

# Height, roll and pitch are not estimated: their variance says so [m^2, rad^2].
UNKNOWN_VARIANCE = 1e6


def time_message(stamp_ns: int) -> Time:
    """Return a stamp [ns] as a message."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanoseconds)


def pose_message(pose: FloatArray) -> Pose:
    """Return a planar pose, shape (3,), as a message."""
    message = Pose()
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    message.orientation.z = math.sin(pose[2] / 2.0)
    message.orientation.w = math.cos(pose[2] / 2.0)
    return message


def pose_with_covariance(prediction: Prediction) -> PoseWithCovariance:
    """Return a prediction as a message; what is not planar has a large variance."""
    covariance = np.diag((0.0, 0.0, *(4 * [UNKNOWN_VARIANCE])))
    covariance[PLANAR] = prediction.covariance
    return PoseWithCovariance(
        pose=pose_message(prediction.T_map_base), covariance=covariance.ravel())


def odometry_message(
    stamp_ns: int, prediction: Prediction, source: Odometry, map_frame: str, base_frame: str,
) -> Odometry:
    """Return the pose in the map, with the twist that the odometry came with if it is finite."""
    message = Odometry(
        header=Header(stamp=time_message(stamp_ns), frame_id=map_frame),
        child_frame_id=base_frame, pose=pose_with_covariance(prediction))
    twist = source.twist
    linear, angular = twist.twist.linear, twist.twist.angular
    numbers = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if all(map(math.isfinite, numbers)) and np.all(np.isfinite(twist.covariance)):
        message.twist = twist
    else:
        message.twist.covariance = (UNKNOWN_VARIANCE * np.eye(6)).ravel()
    return message


def stamped_pose_message(
    stamp_ns: int, pose: PoseWithCovariance, map_frame: str,
) -> PoseWithCovarianceStamped:
    """Return the pose in the map alone."""
    return PoseWithCovarianceStamped(
        header=Header(stamp=time_message(stamp_ns), frame_id=map_frame), pose=pose)


def fix_message(
    stamp_ns: int, prediction: Prediction, plane: TangentPlane, altitude: float, base_frame: str,
) -> NavSatFix:
    """Return where the robot is on the Earth, its covariance turned to east and north."""
    latitude, longitude, _ = plane.to_geodetic(prediction.T_map_base[:2], altitude)
    covariance = np.diag((0.0, 0.0, UNKNOWN_VARIANCE))
    turned = cov.turned(prediction.covariance[:2, :2], -plane.yaw)
    covariance[:2, :2] = 0.5 * (turned + turned.T)
    return NavSatFix(
        header=Header(stamp=time_message(stamp_ns), frame_id=base_frame),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX), latitude=float(latitude),
        longitude=float(longitude), altitude=float(altitude),
        position_covariance=covariance.ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN)


def transform_message(
    stamp_ns: int, T_map_odom: FloatArray, map_frame: str, odom_frame: str,
) -> TransformStamped:
    """Return the transform from the map to the odometry frame."""
    message = TransformStamped(
        header=Header(stamp=time_message(stamp_ns), frame_id=map_frame), child_frame_id=odom_frame)
    pose = pose_message(T_map_odom)
    message.transform.translation.x = pose.position.x
    message.transform.translation.y = pose.position.y
    message.transform.rotation = pose.orientation
    return message


def path_cdr(path: Trajectory, stamp_ns: int, frame_id: str) -> bytes:
    """
    Serialise a nav_msgs/Path whose poses all lie in one frame, without a message a pose.

    The layout is CDR, little endian: every number lies at a multiple of its size, counted from
    behind the four bytes that open the stream. A PoseStamped ends at a multiple of 8, so all but
    the first have the same layout, and NumPy fills them at once.
    """
    name = frame_id.encode() + b'\0'
    stamps, poses = path.stamps_ns, path.poses
    body = struct.pack('<iII', *divmod(stamp_ns, NANOSECONDS), len(name)) + name
    body += bytes(-len(body) % 4) + struct.pack('<I', len(path))
    if len(path) > 0:
        record = np.dtype([
            ('sec', '<i4'), ('nanosec', '<u4'), ('length', '<u4'), ('name', f'S{len(name)}'),
            ('padding', f'V{-(12 + len(name)) % 8}'), ('pose', '<f8', (7,))])
        records = np.zeros(len(path), dtype=record)
        records['sec'], records['nanosec'] = np.divmod(stamps, NANOSECONDS)
        records['length'], records['name'] = len(name), name
        records['pose'][:, :2] = poses[:, :2]
        records['pose'][:, 5] = np.sin(poses[:, 2] / 2.0)
        records['pose'][:, 6] = np.cos(poses[:, 2] / 2.0)
        first = struct.pack('<iII', *records[0].item()[:3]) + name
        padding = -(len(body) + len(first)) % 8
        body += first + bytes(padding) + records['pose'][0].tobytes() + records[1:].tobytes()
    return b'\x00\x01\x00\x00' + body


def diagnostics_message(
    stamp: Time, name: str, level: bytes, text: str, values: Mapping[str, object],
) -> DiagnosticArray:
    """Return one status with its values."""
    status = DiagnosticStatus(
        level=level, name=name, message=text, hardware_id='pose_graph',
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])
