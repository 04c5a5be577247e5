# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Speed limit of the published transform; imports no rclpy."""

import math

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray


class Slew:
    """
    Limits the speed at which corrections move the robot in the published transform.

    A small turn of the odometry frame moves a robot far from its origin by much, so the limits
    hold at the robot. They do not affect the graph.
    """

    def __init__(self) -> None:
        self._last: FloatArray | None = None
        self._stamp_ns = 0

    def forget(self) -> None:
        """Let the next transform be published without limits."""
        self._last = None

    def limited(
        self, stamp_ns: int, T_map_odom: FloatArray, T_odom_base: FloatArray, linear: float,
        angular: float,
    ) -> FloatArray:
        """
        Return the transform from map to odom to publish, shape (3,).

        Parameters
        ----------
        stamp_ns : int, newer than in the call before [ns]
        T_map_odom : ndarray, shape (3,)
            The estimate.
        T_odom_base : ndarray, shape (3,)
            Odometry at the stamp.
        linear, angular : float
            Greatest speeds of corrections at the robot [m/s, rad/s]; 0: no limit.

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
