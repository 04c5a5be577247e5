# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether the newest estimate can be carried on by odometry that has come since; no rclpy."""

import math

import numpy as np

from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.se2 import FloatArray

# A step of less is no jump [m] ...
SLACK = 0.25
# ... nor one at a speed of less than twice that of late and this [m/s].
MORE_SPEED = 3.0
# Stamps lie unevenly: a step is not judged over less time [s].
LEAST_TIME = 0.1
# A stamp so far ahead of the one before may be a mistake: those after it tell [ns].
FAR_NS = 10_000_000_000


class Continuity:
    """
    Watches the raw poses of the odometry that leads for jumps.

    The engine judges jumps more carefully, but only the next estimate tells; until then nothing
    is to be carried over one. Who is careful without need loses the pose at one message.

    Parameters
    ----------
    maximum_speed : float
        No robot is faster [m/s].
    goes_on : bool
        Whether there is an estimate of a time before: only the engine can tell whether the first
        sample goes on from there.

    """

    def __init__(self, maximum_speed: float, *, goes_on: bool = False) -> None:
        self.maximum_speed = maximum_speed
        """No robot is faster [m/s]; can be changed, for steps from then on."""
        self._goes_on = goes_on
        self._stamp_ns = 0
        self._pose: FloatArray = np.zeros(3)
        self._speed = math.inf
        self._jump_ns = 0

    def carries(self, estimate: Estimate | None, sample: OdometrySample) -> bool:
        """Tell whether an estimate, a little older, can be carried to the newest sample."""
        if sample.stamp_ns > self._stamp_ns:
            self._take(sample)
        elif sample.stamp_ns < self._stamp_ns - FAR_NS:
            # a stamp from the future had come before
            self._stamp_ns, self._pose, self._jump_ns = sample.stamp_ns, sample.pose, 0
        return estimate is not None and estimate.stamp_ns >= self._jump_ns

    def _take(self, sample: OdometrySample) -> None:
        elapsed_ns, first = sample.stamp_ns - self._stamp_ns, self._stamp_ns == 0
        moved = math.hypot(*(sample.pose - self._pose)[:2])
        time = max(elapsed_ns * 1e-9, LEAST_TIME)
        allowed = min(2.0 * max(self._speed, abs(sample.speed)) + MORE_SPEED, self.maximum_speed)
        jumped = moved > SLACK + allowed * time or elapsed_ns > FAR_NS
        if self._goes_on if first else jumped:
            self._jump_ns = sample.stamp_ns
        elif not first:
            self._speed = moved / time
        self._stamp_ns, self._pose = sample.stamp_ns, sample.pose
