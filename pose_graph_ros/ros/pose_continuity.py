# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check whether the newest estimate can be propagated by odometry; imports no rclpy."""

import math

from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.scalar_se2 import between_one
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.jumps import is_jump, SpeedWindow, UNKNOWN

# A step in the stamps by more than this may be a mistake: it is treated as a jump [ns].
FAR_NS = 10_000_000_000


class PoseContinuity:
    """
    Watches the raw poses of the primary odometry for jumps, as the engine does.

    Its next estimate accounts for a jump; until then the old one must not be propagated over it.

    Parameters
    ----------
    maximum_speed : float, greatest possible speed of the robot [m/s]
    resumes : bool
        Whether there is an estimate from before the first sample: the engine then decides whether
        the odometry continues from there.

    """

    def __init__(self, maximum_speed: float, *, resumes: bool = False) -> None:
        self.maximum_speed = maximum_speed  # may be changed at any time
        self._resumes = resumes
        self._stamp_ns = 0
        self._pose = (0.0, 0.0, 0.0)
        self._window = SpeedWindow(UNKNOWN, 0, self._pose)
        self._jump_ns = 0

    def covers(self, estimate: Estimate | None, sample: OdometrySample) -> bool:
        """
        Tell whether an estimate can be propagated to the newest sample.

        Parameters
        ----------
        estimate : Estimate or None, the newest estimate, a little older than the sample
        sample : OdometrySample, newest sample of the primary odometry, in order of arrival

        """
        if sample.stamp_ns > self._stamp_ns:
            self._add(sample)
        elif sample.stamp_ns < self._stamp_ns - FAR_NS:
            # the stamp before was wrong: it lay in the future
            self._begin(sample)
            self._jump_ns = 0
        return estimate is not None and estimate.stamp_ns >= self._jump_ns

    def _begin(self, sample: OdometrySample) -> None:
        x, y, theta = sample.pose.tolist()
        self._stamp_ns, self._pose = sample.stamp_ns, (x, y, theta)
        self._window = SpeedWindow(self._window.speeds, sample.stamp_ns, self._pose)

    def _add(self, sample: OdometrySample) -> None:
        x, y, theta = sample.pose.tolist()
        elapsed_ns, pose = sample.stamp_ns - self._stamp_ns, (x, y, theta)
        motion = between_one(self._pose, pose)
        step = math.hypot(motion[0], motion[1]), abs(motion[2])
        if self._stamp_ns == 0:
            jumped = self._resumes
        else:
            jumped = elapsed_ns > FAR_NS or is_jump(
                self._window.speeds, step, elapsed_ns * 1e-9, sample.speed, self.maximum_speed)
        if jumped or self._stamp_ns == 0:
            self._begin(sample)
            self._jump_ns = sample.stamp_ns if jumped else 0
        else:
            self._stamp_ns, self._pose = sample.stamp_ns, pose
            self._window = self._window.moved(sample.stamp_ns, pose, step)
