# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motion model for gaps in odometry: at jumps, during silences, after a graph was loaded."""

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.jumps import MEMORY_TIME
from pose_graph_ros.core.odometry.motion import Variances
from pose_graph_ros.core.odometry.timeline import OdometryTimeline

# Standard deviations of the motion across a jump or a gap for a robot at rest; the way at the
# previous speed is added [m, rad].
JUMP_SIGMA = (0.5, 0.1)
# Time before a gap over which the speed is averaged [ns].
SPEED_TIME_NS = 500_000_000
# Longest gap after which the odometry of a loaded graph is continued; beyond, it restarts [s].
RESUMED_WITHIN = 10.0
# Standard deviations of the motion across a restart: the robot may have been moved [m, rad].
RESTARTED = (1.0, 0.3)
# The variances of (x, y, theta) by them [m^2, m^2, rad^2].
RESTART_VARIANCE: Variances = (RESTARTED[0]**2, RESTARTED[0]**2, RESTARTED[1]**2)


def gap_motion(
    timeline: OdometryTimeline, last_ns: int, until_ns: int, saved_ns: int,
) -> tuple[FloatArray, FloatArray]:
    """
    Return the estimated motion during a gap in odometry, and its covariance.

    The motion is the pose at the end of the gap in the frame at its begin, shape (3,) [m, m, rad];
    the covariance is in the frame at the end. The robot is assumed to keep its mean speed, for at
    most `MEMORY_TIME`. After a long gap at the end of a loaded graph it is assumed to stand where
    it was.

    Parameters
    ----------
    timeline : OdometryTimeline, samples before the gap
    last_ns, until_ns : int, stamps of the last sample before the gap, and of its end [ns]
    saved_ns : int, newest stamp of a graph that was loaded; -1 if none was [ns]

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
