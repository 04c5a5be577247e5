# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What sensors say, as frozen values with their stamps, and the answers that they get.

Covariances have the axes in which ROS messages carry them: those of the frame in which the pose
is expressed (docs/conventions.md, section "Covariances").
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pose_graph_ros.core.se2 import FloatArray

# No coordinate of a map or of odometry is larger [m, rad]; numbers beyond are broken ones, and
# their squares would not fit.
LARGEST_COORDINATE = 1e9
# No stamp is later than the year 2116 [ns].
LARGEST_STAMP = 2**62


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Where the robot is by odometry."""

    stamp_ns: int
    pose: FloatArray
    """`T_odom_base`, shape (3,) [m, m, rad]."""
    speed: float = 0.0
    """By the twist that came with it, if one did [m/s]."""
    twist_variance: FloatArray | None = None
    """Of the twist (v_x, v_y, yaw rate) in the robot's frame, shape (3,); None if unknown."""


@dataclass(frozen=True, slots=True)
class GlobalPose:
    """Where the robot is in the map, with its heading."""

    stamp_ns: int
    pose: FloatArray
    """`T_map_base`, shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """Of (x, y, theta) in map axes, shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class Position:
    """Where a point of the robot, such as an antenna, is in the map."""

    stamp_ns: int
    position: FloatArray
    """Shape (2,) [m] in the map."""
    covariance: FloatArray
    """In map axes, shape (2, 2)."""
    lever_arm: FloatArray
    """The point in the robot's frame, shape (2,) [m]."""


@dataclass(frozen=True, slots=True)
class HeadingOnly:
    """Which way the robot points in the map."""

    stamp_ns: int
    heading: float
    """[rad]"""
    variance: float
    """[rad^2]"""


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """Where the robot is, seen from where it was at another instant (or at a hidden node)."""

    stamp_ns: int
    pose: FloatArray
    """`T_reference_base`, shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """
    Of (x, y, theta) in the axes of the reference pose, shape (3, 3); infinite variances of x and
    y make it a statement on the two headings alone, such as that two walls are perpendicular.
    """
    reference_ns: int | None = None
    """Instant of the reference pose ..."""
    reference_node: int | None = None
    """... or its hidden node; exactly one of the two is given."""


Absolute = GlobalPose | Position | HeadingOnly
"""What tells of the robot in the map."""
Measurement = Absolute | LoopClosure


class Verdict(Enum):
    """What becomes of a measurement."""

    ACCEPTED = 'accepted'
    PENDING = 'pending'
    REJECTED = 'rejected'


@dataclass(frozen=True, slots=True)
class Answer:
    """What becomes of a measurement, and why."""

    verdict: Verdict
    reason: str = ''
    """One word for counting, such as `not_finite`; empty when accepted."""
    detail: str = ''
    """A sentence with the numbers, for people."""


ACCEPTED = Answer(Verdict.ACCEPTED)


def value_defect(value: FloatArray) -> str | None:
    """Say in one word what keeps numbers from being a pose or a position; None if nothing."""
    if not np.all(np.isfinite(value)):
        return 'not_finite'
    if np.any(np.abs(value) > LARGEST_COORDINATE):
        return 'too_large'
    return None


def rejected(reason: str, detail: str = '') -> Answer:
    """Return the answer to what cannot be used."""
    return Answer(Verdict.REJECTED, reason, detail)
