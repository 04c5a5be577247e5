# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Detection of jumps: steps of odometry that are longer than the robot can have moved.

Speeds are taken from the odometry itself. A step is a jump if it is longer than the recent speeds,
the greatest speed so far, or the speed limit of the source allow in its time. The engine and the
publisher of the newest pose use the same test.
"""

import math
from typing import NamedTuple

from pose_graph_ros.core.geometry.scalar_se2 import between_one, Pose

# A step within these is never a jump, whatever its time [m, rad].
SLACK = (0.25, 0.5)
# Acceleration by which the recent speed may be exceeded [m/s^2, rad/s^2].
ACCELERATION = (10.0, 20.0)
# Excess over twice the greatest speed so far [m/s, rad/s].
MORE_SPEED = (3.0, 2.0)
# Shortest time over which a speed is computed, as stamps are not evenly spaced [s].
LEAST_TIME = 0.05
# Time constant with which the recent greatest speed decays [s].
MEMORY_TIME = 2.0


class Speeds(NamedTuple):
    """How fast the robot moves by odometry, in [m/s] and [rad/s]."""

    velocity: Pose
    """In the robot's frame, with the yaw rate."""
    recent: tuple[float, float]
    """Greatest recent speed and yaw rate; infinite before the first are known."""
    greatest: tuple[float, float]
    """Greatest speed and yaw rate so far; infinite before the first are known."""


UNKNOWN = Speeds((0.0, 0.0, 0.0), (math.inf, math.inf), (math.inf, math.inf))


class SpeedWindow(NamedTuple):
    """The speeds, and the motion since they were last updated."""

    speeds: Speeds
    since_ns: int
    """Stamp of the last update [ns]."""
    since: Pose
    """Pose at that stamp, in a frame without jumps [m, m, rad]."""
    path: tuple[float, float] = (0.0, 0.0)
    """Path length [m] and sum of absolute turns [rad] since then."""

    def moved(self, stamp_ns: int, pose: Pose, step: tuple[float, float]) -> 'SpeedWindow':
        """
        Return the window after a step that is no jump.

        Parameters
        ----------
        stamp_ns : int, stamp of the sample at the end of the step [ns]
        pose : tuple, pose of that sample, in a frame without jumps [m, m, rad]
        step : tuple of float, length [m] and absolute turn [rad] of the step

        """
        path = self.path[0] + step[0], self.path[1] + step[1]
        time = (stamp_ns - self.since_ns) * 1e-9
        if time < LEAST_TIME:
            return self._replace(path=path)
        speed = path[0] / time, path[1] / time
        x, y, theta = between_one(self.since, pose)
        velocity = x / time, y / time, theta / time
        if self.speeds is UNKNOWN:
            speeds = Speeds(velocity, speed, speed)
        else:
            decay, (_, recent, greatest) = math.exp(-time / MEMORY_TIME), self.speeds
            speeds = Speeds(
                velocity,
                (max(speed[0], decay * recent[0]), max(speed[1], decay * recent[1])),
                (max(speed[0], greatest[0]), max(speed[1], greatest[1])))
        return SpeedWindow(speeds, stamp_ns, pose)


def is_jump(
    speeds: Speeds, step: tuple[float, float], elapsed: float, stated: float, limit: float,
) -> bool:
    """
    Tell whether a step is longer than the robot can have moved.

    Parameters
    ----------
    speeds : Speeds, speeds before the step
    step : tuple of float, length [m] and absolute turn [rad] of the step
    elapsed : float, duration of the step [s]
    stated : float, speed by the twist that came with the sample [m/s]; not finite if there is none
    limit : float, speed limit of the source [m/s]

    """
    if step[0] <= SLACK[0] and step[1] <= SLACK[1]:
        return False
    time = elapsed + LEAST_TIME
    stated = abs(stated) if math.isfinite(stated) else 0.0
    for k, stated_k, limit_k in ((0, stated, limit), (1, 0.0, math.inf)):
        recent, greatest = max(speeds.recent[k], stated_k), max(speeds.greatest[k], stated_k)
        allowed = min(2.0 * recent + ACCELERATION[k] * max(time, 0.1),
                      2.0 * greatest + MORE_SPEED[k], limit_k)
        if step[k] > SLACK[k] + allowed * time:
            return True
    return False
