# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Inputs of the engine, as immutable values with stamps [ns], and the answers to them.

The axes of covariances are those of ROS messages, the frame in which the pose is expressed; see
docs/conventions.md, section "Covariances".
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, Pose

# Largest valid coordinate in a map or in odometry [m, rad]; a larger one is a faulty number.
LARGEST_COORDINATE = 1e9
# Largest valid stamp [ns]: in the year 2116.
LARGEST_STAMP = 2**62


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Pose of the robot in the odometry frame."""

    stamp_ns: int
    pose: FloatArray  # `T_odom_base`, shape (3,) [m, m, rad]
    speed: float = 0.0  # of the twist in the same message [m/s]; 0 if it has none
    # of (v_x, v_y, yaw rate) in the robot's frame, shape (3,); None if unknown
    twist_variance: FloatArray | None = None
    # (v_x, v_y, yaw rate) in the robot's frame [m/s, m/s, rad/s]; used, and then needed, if the
    # motion of the source is integrated from twists
    twist: Pose | None = None


@dataclass(frozen=True, slots=True)
class YawRate:
    """Yaw rate of the robot by a gyroscope, with its bias."""

    stamp_ns: int
    rate: float  # about the vertical axis of the robot, counterclockwise [rad/s]
    variance: float = 0.0  # of the rate [rad^2/s^2]; 0 if unknown


@dataclass(frozen=True, slots=True)
class GlobalPose:
    """Pose of the robot in the map."""

    stamp_ns: int
    pose: FloatArray  # `T_map_base`, shape (3,) [m, m, rad]
    covariance: FloatArray  # of (x, y, theta) in map axes, shape (3, 3)


@dataclass(frozen=True, slots=True)
class Position:
    """Position in the map of a point of the robot, such as an antenna."""

    stamp_ns: int
    position: FloatArray  # in the map, shape (2,) [m]
    covariance: FloatArray  # in map axes, shape (2, 2)
    lever_arm: FloatArray  # the point in the robot's frame, shape (2,) [m]


@dataclass(frozen=True, slots=True)
class Fix:
    """
    Position on the Earth of a point of the robot; see `Position`.

    The first fix that the engine attaches to the graph makes the map's origin. So the position in
    the map is computed then, and not for a fix that is rejected.
    """

    stamp_ns: int
    coordinates: tuple[float, float, float]  # latitude, longitude [deg], altitude [m] or NaN
    # returns their position in the map, shape (2,) [m]
    place: Callable[[float, float, float], FloatArray]
    covariance: FloatArray  # in map axes, shape (2, 2)
    lever_arm: FloatArray  # the point in the robot's frame, shape (2,) [m]

    def placed(self) -> Position:
        """Return the position in the map."""
        return Position(
            self.stamp_ns, self.place(*self.coordinates), self.covariance, self.lever_arm)


@dataclass(frozen=True, slots=True)
class HeadingOnly:
    """Heading of the robot in the map."""

    stamp_ns: int
    heading: float  # [rad]
    variance: float  # [rad^2]


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """Pose of the robot relative to its pose at another stamp, or to a hidden node."""

    stamp_ns: int
    pose: FloatArray  # `T_reference_base`, shape (3,) [m, m, rad]
    # Of (x, y, theta) in the axes of the reference pose, shape (3, 3). With infinite variances of
    # x and y only the difference of the headings is used.
    covariance: FloatArray
    # stamp of the reference pose [ns]; None if `reference_node` is given
    reference_ns: int | None = None
    # index of the reference's hidden node; None if `reference_ns` is given
    reference_node: int | None = None


@dataclass(frozen=True, slots=True)
class Range:
    """Distance of a point of the robot, such as an antenna, from a beacon."""

    stamp_ns: int
    beacon: str  # name of the beacon
    distance: float  # [m]
    variance: float  # [m^2]; 0 if unknown
    lever_arm: FloatArray  # the point in the robot's frame, shape (2,) [m]
    place: FloatArray | None = None  # of the beacon in the map, shape (2,) [m]; None if unknown


Absolute = GlobalPose | Position | HeadingOnly  # measurements relative to the map
# measurements that are attached to hidden nodes by their stamps
PoseMeasurement = Absolute | LoopClosure | Fix | Range
Measurement = PoseMeasurement | YawRate


class AnswerStatus(Enum):
    """Whether an input is used."""

    ACCEPTED = 'accepted'
    PENDING = 'pending'
    REJECTED = 'rejected'


@dataclass(frozen=True, slots=True)
class Answer:
    """Whether an input is used, and why it is not."""

    status: AnswerStatus
    reason: str = ''  # key for counting, such as `not_finite`; empty if accepted
    detail: str = ''  # explanation with numbers, for users


ACCEPTED = Answer(AnswerStatus.ACCEPTED)


def value_defect(value: FloatArray) -> str | None:
    """Return why numbers are not a valid pose or position; None if they are."""
    if not np.all(np.isfinite(value)):
        return 'not_finite'
    if np.any(np.abs(value) > LARGEST_COORDINATE):
        return 'too_large'
    return None


def rejected(reason: str, detail: str = '') -> Answer:
    """Return the answer that rejects an input; its detail, which may quote that, is one line."""
    return Answer(AnswerStatus.REJECTED, reason, ' '.join(detail.split()))
