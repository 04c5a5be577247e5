# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""An immutable sequence of stamped poses, with interpolation."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Trajectory:
    """
    Poses of the robot at strictly increasing stamps; the arrays are read-only.

    Raises ValueError if the shapes do not match or the stamps do not increase.
    """

    stamps_ns: IntArray
    """Stamps [ns], shape (N,)."""
    poses: FloatArray
    """`T_map_base`, or poses in another frame of the owner's choice, shape (N, 3) [m, m, rad]."""

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
        """
        Return the trajectory with one pose more, unless that is not later than the last one.

        Parameters
        ----------
        stamp_ns : int, [ns]
        pose : ndarray, shape (3,) [m, m, rad]

        """
        if len(self) > 0 and stamp_ns <= self.stamps_ns[-1]:
            return self
        return Trajectory(np.append(self.stamps_ns, stamp_ns), np.vstack((self.poses, pose)))

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
