# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What odometry says happened between two instants.

Here are also the few functions of `se2` for one pose at a time, as a tuple of plain numbers: every
sample of odometry goes through them, and they take a tenth of the time of those for arrays.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.se2 import FloatArray

Pose = tuple[float, float, float]
"""x, y, theta [m, m, rad], theta in [-pi, pi)."""

NO_VARIANCE: FloatArray = np.zeros(3)
NO_VARIANCE.flags.writeable = False


class Motion(NamedTuple):
    """Motion between two instants."""

    increment: FloatArray
    """Pose at the later instant seen from the earlier one, shape (3,) [m, m, rad]."""
    distance: float
    """Length of the path in between [m]."""
    turn: float
    """Sum of the absolute turns in between [rad]."""
    variance: FloatArray = NO_VARIANCE
    """Of (x, y, theta) beyond what path and turns tell, shape (3,): twist noise, jumps, gaps."""


NO_MOTION = Motion(np.zeros(3), 0.0, 0.0)


def wrap_one(angle: float) -> float:
    """Wrap an angle to [-pi, pi), to the bit as `se2.wrap` does."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return -math.pi if wrapped >= math.pi else wrapped


def compose_one(a: Pose, b: Pose) -> Pose:
    """Return `T_a_c` from `T_a_b` and `T_b_c`."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return (a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], wrap_one(a[2] + b[2]))


def between_one(a: Pose, b: Pose) -> Pose:
    """Return `T_a_b` from `T_w_a` and `T_w_b`."""
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, c * dy - s * dx, wrap_one(b[2] - a[2])
