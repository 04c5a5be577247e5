# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Poses between those of a corrected path, by the odometry that was measured there.

Between two poses of the path, the pose of the odometry frame in the map is interpolated in time.
It changes slowly, so the result moves as odometry does; a robot that stands between them stands.
"""

import bisect

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.scalar_se2 import between_one, compose_one, Pose, wrap_one
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory

LARGEST_CHANGE = 0.5
"""Where odometry alone differs by more from one pose to the next, it has jumped [m, rad]."""


class OdometryAtPath:
    """
    Collects the poses of odometry at the stamps of a path, from samples in the order of time.

    Parameters
    ----------
    path : Trajectory

    """

    def __init__(self, path: Trajectory) -> None:
        self._stamps = path.stamps_ns.tolist()
        self._poses = np.full((len(path), 3), np.nan)
        self._next, self._last = 0, (0, (0.0, 0.0, 0.0))

    def add(self, stamp_ns: int, pose: Pose) -> None:
        """
        Add a sample; one that is older than another is ignored.

        Parameters
        ----------
        stamp_ns : int, [ns]
        pose : tuple of float, `T_odom_base` [m, m, rad]

        """
        before_ns, before = self._last
        if stamp_ns <= before_ns:
            return
        while self._next < len(self._stamps) and self._stamps[self._next] <= stamp_ns:
            at_ns = self._stamps[self._next]
            if at_ns == stamp_ns:
                self._poses[self._next] = pose
            elif before_ns > 0:
                self._poses[self._next] = se2.interpolate(
                    np.array(before), np.array(pose), (at_ns - before_ns) / (stamp_ns - before_ns))
            self._next += 1
        self._last = stamp_ns, pose

    @property
    def poses(self) -> FloatArray:
        """Poses of odometry at the path, shape (N, 3) [m, m, rad]; NaN where there is none."""
        return self._poses


class PathCorrection:
    """
    Corrects poses of odometry.

    Parameters
    ----------
    path : Trajectory, `T_map_base`
    odometry : ndarray, shape (N, 3), `T_odom_base` at its stamps; NaN where unknown

    """

    def __init__(self, path: Trajectory, odometry: FloatArray) -> None:
        self._path, self._stamps = path, path.stamps_ns.tolist()
        self._poses = path.poses.tolist()
        self._odometry = odometry.tolist()
        moved = se2.between(odometry[:-1], odometry[1:])
        wanted = se2.between(path.poses[:-1], path.poses[1:])
        change = np.abs(se2.between(moved, wanted))
        self._follows = np.all(change <= LARGEST_CHANGE, axis=1).tolist()  # not if NaN

    def at(self, stamp_ns: int, odometry: Pose) -> Pose | None:
        """
        Return the corrected pose at a stamp inside the path; None outside.

        Where odometry has jumped, the path is interpolated instead.

        Parameters
        ----------
        stamp_ns : int, [ns]
        odometry : tuple of float, `T_odom_base` at the stamp [m, m, rad]

        """
        k = bisect.bisect_right(self._stamps, stamp_ns) - 1
        if k < 0 or stamp_ns > self._stamps[-1]:
            return None
        if self._stamps[k] == stamp_ns:
            x, y, theta = self._poses[k]
            return x, y, theta
        if not self._follows[k]:
            x, y, theta = self._path.at(stamp_ns).tolist()
            return x, y, theta
        part = (stamp_ns - self._stamps[k]) / (self._stamps[k + 1] - self._stamps[k])
        first = compose_one(self._poses[k], between_one(self._odometry[k], odometry))
        last = compose_one(self._poses[k + 1], between_one(self._odometry[k + 1], odometry))
        return (first[0] + part * (last[0] - first[0]), first[1] + part * (last[1] - first[1]),
                wrap_one(first[2] + part * wrap_one(last[2] - first[2])))
