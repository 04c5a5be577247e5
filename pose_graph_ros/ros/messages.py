# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The classes of messages, and messages that are made as objects of these.

What is sent with each odometry message is written by `adapters.output_cdr`, which is faster.
"""

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_msgs.msg import Header

from pose_graph_ros.adapters.output_cdr import UNKNOWN_VARIANCE
from pose_graph_ros.adapters.sources import Kind, NANOSECONDS
from pose_graph_ros.core.geometry import covariance as cov
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.prediction import Prediction

CLASSES = {Kind.ODOMETRY: Odometry, Kind.FIX: NavSatFix, Kind.IMU: Imu,
           Kind.GLOBAL_POSE: PoseWithCovarianceStamped,
           Kind.LOOP_CLOSURE: PoseWithCovarianceStamped,
           Kind.TWIST: TwistWithCovarianceStamped, Kind.GYRO: Imu}
"""Class of the messages by kind of source."""


def time_message(stamp_ns: int) -> Time:
    """Return a stamp [ns] as a message."""
    seconds, nanoseconds = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanoseconds)


def fix_message(
    stamp_ns: int, prediction: Prediction, plane: TangentPlane, altitude: float, base_frame: str,
) -> NavSatFix:
    """
    Return the robot's position on the Earth, its covariance in east and north.

    Parameters
    ----------
    altitude : float, above the ellipsoid [m]; NaN if unknown

    """
    latitude, longitude, _ = plane.to_geodetic(
        prediction.T_map_base[:2], altitude if math.isfinite(altitude) else plane.altitude)
    covariance = np.diag((0.0, 0.0, UNKNOWN_VARIANCE))
    turned = cov.turned(prediction.covariance[:2, :2], -plane.yaw)
    covariance[:2, :2] = 0.5 * (turned + turned.T)
    return NavSatFix(
        header=Header(stamp=time_message(stamp_ns), frame_id=base_frame),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX), latitude=float(latitude),
        longitude=float(longitude), altitude=float(altitude),
        position_covariance=covariance.ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN)
