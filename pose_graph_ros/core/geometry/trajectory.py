# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sequences of stamped poses: interpolation, alignment, and the odometry in between.
"""

from array import array
import bisect
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Points, Pose, Poses


@dataclass(frozen=True, slots=True)
class Trajectory:
    """
    Poses of the robot at strictly increasing stamps; the arrays are read-only.

    Raises ValueError if the shapes do not match or the stamps do not increase.
    """

    stamps_ns: IntArray  # stamps [ns], shape (N,)
    # `T_map_base`, or poses in another frame of the owner's choice, shape (N, 3) [m, m, rad]
    poses: FloatArray

    def __post_init__(self) -> None:
        stamps = np.array(self.stamps_ns, dtype=np.int64)
        poses = np.array(self.poses, dtype=np.float64)
        if stamps.ndim != 1 or poses.shape != (len(stamps), 3):
            raise ValueError(
                f'expected stamps (N,) and poses (N, 3), got {stamps.shape} and {poses.shape}')
        if np.any(np.diff(stamps) <= 0):
            at = int(np.argmax(np.diff(stamps) <= 0))
            raise ValueError(
                f'stamps must increase, got {stamps[at]} then {stamps[at + 1]} at index {at}')
        stamps.flags.writeable = False
        poses.flags.writeable = False
        object.__setattr__(self, 'stamps_ns', stamps)
        object.__setattr__(self, 'poses', poses)

    def continued(self, stamp_ns: int, pose: FloatArray) -> 'Trajectory':
        """Return the trajectory with one pose more, unless that is not later than the last one."""
        if len(self) > 0 and stamp_ns <= self.stamps_ns[-1]:
            return self
        return Trajectory(np.append(self.stamps_ns, stamp_ns), np.vstack((self.poses, pose)))

    def filled(self, correction: 'PathCorrection',
               samples: Iterable[tuple[int, Pose]]) -> 'Trajectory':
        """Return the path with the corrected poses of odometry at further stamps [ns] inside."""
        stamps = array('q', self.stamps_ns.tolist())
        poses = array('d', self.poses.ravel().tolist())
        for stamp_ns, odometry in samples:
            if (pose := correction.at(stamp_ns, odometry)) is not None:
                stamps.append(stamp_ns)
                poses.extend(pose)
        every, first = np.unique(np.array(stamps), return_index=True)
        return Trajectory(every, np.array(poses).reshape(-1, 3)[first])

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def covers(self, stamps_ns: npt.ArrayLike) -> BoolArray:
        """Return which stamps [ns] lie between the first and the last one of the trajectory."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        if len(self) == 0:
            return np.zeros(stamps.shape, dtype=bool)
        return (stamps >= self.stamps_ns[0]) & (stamps <= self.stamps_ns[-1])

    def at(self, stamps_ns: npt.ArrayLike) -> FloatArray:
        """
        Return the interpolated poses, shape (..., 3), at stamps [ns], shape (...).

        Raises ValueError if a stamp lies outside the trajectory: poses are not extrapolated.
        """
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        inside = self.covers(stamps)
        if not np.all(inside):
            span = f'[{self.stamps_ns[0]}, {self.stamps_ns[-1]}]' if len(self) else 'nothing'
            raise ValueError(
                f'{int(np.sum(~inside))} of {stamps.size} stamps lie outside the trajectory, '
                f'which covers {span}')
        if len(self) == 1:
            return np.broadcast_to(self.poses[0], (*stamps.shape, 3)).copy()
        after = np.clip(np.searchsorted(self.stamps_ns, stamps, side='right'), 1, len(self) - 1)
        start, end = self.stamps_ns[after - 1], self.stamps_ns[after]
        fraction = (stamps - start) / (end - start)
        return se2.interpolate(self.poses[after - 1], self.poses[after], fraction)


def interpolated(path: Trajectory, samples: Iterable[tuple[int, Pose]]) -> Poses:
    """
    Return the poses at the stamps of a path, by samples with stamps [ns]; NaN outside of these.

    A sample that is older than one before it is ignored.
    """
    stamps, poses = [0], [(0.0, 0.0, 0.0)]
    for stamp_ns, pose in samples:
        if stamp_ns > stamps[-1]:
            stamps.append(stamp_ns)
            poses.append(pose)
    odometry = Trajectory(np.array(stamps[1:]), np.array(poses[1:]).reshape(-1, 3))
    found = np.full((len(path), 3), np.nan)
    inside = odometry.covers(path.stamps_ns)
    found[inside] = odometry.at(path.stamps_ns[inside])
    return found


class PathCorrection:
    """Corrects poses of odometry by a path and the poses of odometry at it, NaN where unknown."""

    def __init__(self, path: Trajectory, odometry: FloatArray) -> None:
        self._path, self._stamps = path, path.stamps_ns.tolist()
        self._poses = path.poses.tolist()
        self._odometry = odometry.tolist()
        moved = se2.between(odometry[:-1], odometry[1:])
        wanted = se2.between(path.poses[:-1], path.poses[1:])
        change = np.abs(se2.between(moved, wanted))
        # where odometry alone differs by more, or is unknown, it does not follow [m, rad]
        self._follows = np.all(change <= 0.5, axis=1).tolist()

    def at(self, stamp_ns: int, odometry: Pose) -> Pose | None:
        """
        Return the corrected pose at a stamp inside the path; None outside.

        Where odometry has jumped, the path is interpolated instead.
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
        first, last = (se2.compose_one(
            self._poses[at], se2.between_one(self._odometry[at], odometry)) for at in (k, k + 1))
        return (first[0] + part * (last[0] - first[0]), first[1] + part * (last[1] - first[1]),
                se2.wrap_one(first[2] + part * se2.wrap_one(last[2] - first[2])))


def fit_motion(source: Points, target: Points) -> se2.PoseVector:
    """
    Return the rigid motion `T_target_source` that aligns points with others by least squares.

    This is the solution of Umeyama (1991), which in the plane needs no decomposition: the sums of
    the dot and the cross products of the centred points are cosine and sine of the angle times one
    number. If the points do not determine the angle, it is 0.
    """
    if source.shape != target.shape or source.ndim != 2 or len(source) == 0:
        raise ValueError(
            f'expected equally many points (N, 2), N > 0, got {source.shape} and {target.shape}')
    source_mean, target_mean = np.mean(source, axis=0), np.mean(target, axis=0)
    p, q = source - source_mean, target - target_mean
    theta = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    return se2.wrapped(np.append(target_mean - se2.rotation(theta) @ source_mean, theta))
