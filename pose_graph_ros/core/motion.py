# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What odometry says happened between two instants."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.se2 import FloatArray

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
