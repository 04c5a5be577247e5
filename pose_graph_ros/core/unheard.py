# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is taken for the motion that no odometry tells of: at jumps, in silence, after a load."""

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.timeline import OdometryTimeline, Variances

# The fastest motion of late is forgotten within about this time [s].
MEMORY_TIME = 2.0
# Standard deviations of the motion at a jump: at least, and of the speed before [m, rad].
LOOSE = (0.5, 0.1)
# The speed of a robot is looked at over so long [ns].
SPEED_TIME_NS = 500_000_000
# Odometry that comes after a graph was loaded goes on from where it was if it comes within ... [s]
RESUMED_WITHIN = 10.0
# Otherwise the robot is about where it was: standard deviations [m, rad]. It may have been moved.
RESTARTED = (1.0, 0.3)


def restart_variance() -> Variances:
    """Return the variances of (x, y, theta) of a robot that is about where it was."""
    return RESTARTED[0]**2, RESTARTED[0]**2, RESTARTED[1]**2


def unheard_motion(
    timeline: OdometryTimeline, last_ns: int, until_ns: int, saved_ns: int,
) -> tuple[FloatArray, FloatArray]:
    """
    Guess the motion after the last sample before a silence, and its covariance.

    Parameters
    ----------
    timeline : OdometryTimeline
    last_ns, until_ns : int
        Of the silence.
    saved_ns : int
        Newest stamp of a graph that was loaded: if the silence began there, and is long, the
        robot was switched off.

    """
    if last_ns <= saved_ns and until_ns - last_ns > RESUMED_WITHIN * 1e9:
        return np.zeros(3), np.diag(restart_variance())
    begin_ns = max(int(timeline.stamps_ns[0]), last_ns - SPEED_TIME_NS)
    motion, time = timeline.motion(begin_ns, last_ns), (last_ns - begin_ns) * 1e-9
    elapsed = (until_ns - last_ns) * 1e-9
    share = elapsed / time if time > 0.0 else 0.0
    sigma = np.array((LOOSE[0] + motion.distance * share, LOOSE[0] + motion.distance * share,
                      LOOSE[1] + motion.turn * share))
    mean = motion.increment * min(share, MEMORY_TIME / time if time > 0.0 else 0.0)
    return se2.wrapped(mean), np.diag(sigma**2)
