# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How fast the published transform may move; no rclpy."""

import math

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.se2 import FloatArray


class Slew:
    """
    Lets the robot's pose by the published transform follow the estimate at a limited speed.

    A correction that moves the odometry frame by little can move a robot far from its origin by
    much, so the limits hold where the robot is. The graph knows nothing of them.
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None
        self._stamp_ns = 0

    def forget(self) -> None:
        """Let the next transform be published as it is."""
        self._last = None

    def limited(
        self, stamp_ns: int, T_map_odom: FloatArray, T_odom_base: FloatArray, linear: float,
        angular: float,
    ) -> FloatArray:
        """
        Return the transform to publish.

        Parameters
        ----------
        stamp_ns : int
        T_map_odom : ndarray, shape (3,)
            As estimated.
        T_odom_base : ndarray, shape (3,)
            Odometry at the stamp.
        linear, angular : float
            Speeds [m/s, rad/s] at which the robot's pose may be corrected at the most; 0: at any.

        """
        if self._last is not None and (linear > 0.0 or angular > 0.0):
            elapsed = (stamp_ns - self._stamp_ns) * 1e-9
            shown = se2.compose(self._last, T_odom_base)
            wanted = se2.compose(T_map_odom, T_odom_base)
            step = wanted - shown
            step[2] = se2.wrap(step[2])
            distance, turn = math.hypot(step[0], step[1]), abs(float(step[2]))
            if 0.0 < linear * elapsed < distance:
                step[:2] *= linear * elapsed / distance
            if 0.0 < angular * elapsed < turn:
                step[2] *= angular * elapsed / turn
            T_map_odom = se2.compose(
                se2.wrapped(np.asarray(shown + step)), se2.inverse(T_odom_base))
        self._last, self._stamp_ns = T_map_odom, stamp_ns
        return T_map_odom
