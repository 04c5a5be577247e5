# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`initialpose` and `set_pose`: where the robot is, as somebody says; no rclpy."""

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.measurements import Answer, GlobalPose, rejected, value_defect
from pose_graph_ros.ros.conversions import frame, Message, PLANAR, planar_pose, stamp_ns

# Taken where no covariance is given: what RViz says [m, m, rad].
DEFAULT_SIGMA = (0.5, 0.5, 0.26)
# For a stamp that is not set: that of the newest odometry; for one before there was any: its first
# [ns].
NEWEST, FIRST = 2**62, 1


class PoseSetting:
    """
    Reads poses that are set, and keeps one until there is odometry to set it for.

    Parameters
    ----------
    map_frame, odom_frame, base_frame : str
        The frames in which a pose can be given.

    """

    def __init__(self, map_frame: str, odom_frame: str, base_frame: str) -> None:
        self._frames = (map_frame, odom_frame, base_frame)
        self._waiting: Message | None = None
        self._early = False

    def take(self, message: Message, *, early: bool = False) -> Answer | None:
        """
        Keep a message for `pop`.

        Parameters
        ----------
        message : geometry_msgs/PoseWithCovarianceStamped
        early : bool
            Whether there is no odometry yet: it is then for where that begins.

        Returns
        -------
        answer : Answer, optional
            Why it cannot be used.

        """
        named = frame(message.header.frame_id)
        if named not in ('', *self._frames):
            return rejected('wrong_frame', f'expected {", ".join(self._frames)}, got {named!r}')
        pose = planar_pose(message.pose.pose)
        if pose is None:
            return rejected('not_finite', 'a position or an orientation that is none')
        if (broken := value_defect(pose)) is not None:
            return rejected(broken, f'pose {pose.tolist()}')
        self._waiting, self._early = message, early
        return None

    def pop(self, estimate: Estimate) -> GlobalPose | None:
        """Return the pose that waits, in the map by an estimate; None if there is none."""
        message, self._waiting = self._waiting, None
        if message is None:
            return None
        pose = planar_pose(message.pose.pose)
        assert pose is not None
        cov = np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)[PLANAR]
        variance = np.diagonal(cov)
        if not (np.all(np.isfinite(cov)) and np.all(variance > 0.0)
                and np.all(variance <= covariance.LARGEST_VARIANCE)):
            cov = np.diag(DEFAULT_SIGMA) ** 2
        _, odom_frame, base_frame = self._frames
        T_map_frame = {odom_frame: estimate.T_map_odom, base_frame: estimate.T_map_base}.get(
            frame(message.header.frame_id))
        if T_map_frame is not None:
            pose = se2.compose(T_map_frame, pose)
            turn = np.eye(3)
            turn[:2, :2] = se2.rotation(float(T_map_frame[2]))
            cov = turn @ cov @ turn.T
        stamp = FIRST if self._early else stamp_ns(message)
        return GlobalPose(stamp if stamp > 0 else NEWEST, pose, cov)

    def forget(self) -> None:
        """Keep nothing."""
        self._waiting = None
