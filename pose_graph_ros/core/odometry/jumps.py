# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Jumps of odometry, steps that are longer than the robot can have moved, and the motion in gaps.

Speeds are taken from the odometry itself. A step is a jump if it is longer than the recent speeds,
the greatest speed so far, or the speed limit of the source allow in its time. The engine and the
publisher of the newest pose use the same test.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import between_one, FloatArray, Pose
from pose_graph_ros.core.odometry.motion import Variances
from pose_graph_ros.core.odometry.timeline import OdometryTimeline
from pose_graph_ros.core.quantities import StampNs

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

    velocity: Pose  # in the robot's frame, with the yaw rate
    recent: tuple[float, float]  # greatest recent speed and yaw rate
    greatest: tuple[float, float]  # greatest speed and yaw rate so far


# Beyond all limits, but finite: a saved state contains it.
_ANY = (1e30, 1e30)
UNKNOWN = Speeds((0.0, 0.0, 0.0), _ANY, _ANY)


class SpeedWindow(NamedTuple):
    """The speeds, and the motion since they were last updated."""

    speeds: Speeds
    since_ns: int  # stamp of the last update [ns]
    since: Pose  # pose at that stamp, in a frame without jumps [m, m, rad]
    # path length [m] and sum of absolute turns [rad] since then
    path: tuple[float, float] = (0.0, 0.0)

    def moved(self, stamp_ns: int, pose: Pose, step: tuple[float, float]) -> 'SpeedWindow':
        """Return the window after a step (length, absolute turn) to a pose that is no jump."""
        path = self.path[0] + step[0], self.path[1] + step[1]
        time = (stamp_ns - self.since_ns) * 1e-9
        if time < LEAST_TIME:
            return self._replace(path=path)
        speed = path[0] / time, path[1] / time
        x, y, theta = between_one(self.since, pose)
        velocity = x / time, y / time, theta / time
        if self.speeds == UNKNOWN:
            speeds = Speeds(velocity, speed, speed)
        else:
            decay, (_, recent, greatest) = math.exp(-time / MEMORY_TIME), self.speeds
            speeds = Speeds(
                velocity, (max(speed[0], decay * recent[0]), max(speed[1], decay * recent[1])),
                (max(speed[0], greatest[0]), max(speed[1], greatest[1])))
        return SpeedWindow(speeds, stamp_ns, pose)


def is_jump(
    speeds: Speeds, step: tuple[float, float], elapsed: float, stated: float, limit: float,
) -> bool:
    """
    Tell whether a step (length, absolute turn) is longer than the robot can have moved.

    `speeds` are those before the step, `stated` that by the twist in the sample, not finite
    without one, and `limit` that of the source [m/s].
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


# Standard deviations of the motion across a jump or a gap for a robot at rest; the way at the
# previous speed is added [m, rad].
JUMP_SIGMA = (0.5, 0.1)
# Time before a gap over which the speed is averaged [ns].
SPEED_TIME_NS = 500_000_000
# Longest gap after which the odometry of a loaded graph is continued; beyond, it restarts [s].
RESUMED_WITHIN = 10.0
# Variances of the motion across a restart: the robot may have been moved by 1 m and 0.3 rad.
RESTART_VARIANCE: Variances = (1.0, 1.0, 0.09)


def gap_motion(
    timeline: OdometryTimeline, last_ns: StampNs, until_ns: StampNs, saved_ns: StampNs,
) -> tuple[FloatArray, FloatArray]:
    """
    Return the estimated motion during a gap in odometry, and its covariance at the end.

    The robot is assumed to keep its mean speed, for at most `MEMORY_TIME`. After a long gap at the
    end of a loaded graph it is assumed to stand where it was.
    """
    if last_ns <= saved_ns and until_ns - last_ns > RESUMED_WITHIN * 1e9:
        return np.zeros(3), np.diag(RESTART_VARIANCE)
    begin_ns = max(int(timeline.stamps_ns[0]), last_ns - SPEED_TIME_NS)
    motion, time = timeline.motion(begin_ns, last_ns), (last_ns - begin_ns) * 1e-9
    elapsed = (until_ns - last_ns) * 1e-9
    ratio = elapsed / time if time > 0.0 else 0.0
    position = JUMP_SIGMA[0] + motion.distance * ratio
    sigma = np.array((position, position, JUMP_SIGMA[1] + motion.turn * ratio))
    mean = motion.increment * min(ratio, MEMORY_TIME / time if time > 0.0 else 0.0)
    return se2.wrapped(mean), np.diag(sigma**2)
