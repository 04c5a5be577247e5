# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw odometry by stamp: what happened between any two instants, and how far that was."""

import math
from typing import cast

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.motion import Motion
from pose_graph_ros.core.se2 import FloatArray, IntArray

# Motion is counted when it exceeds one of these: odometry jitters at rest, and the sum of its
# jitter at 50 Hz would be a long way [m, rad].
JITTER_DISTANCE = 0.01
JITTER_HEADING = 0.01

# Between two samples motion is taken as uniform. An acceleration of this much would leave that by
# a t^2 / 2 at most, with t the time to the nearer one and the rest to the other [m/s^2, rad/s^2].
UNIFORM_WITHIN = (1.0, 0.5)


class OdometryTimeline:
    """Odometry samples with increasing stamps; 72 bytes a sample, none for standing still."""

    def __init__(self) -> None:
        self._stamps = GrowingArray((), np.int64)
        # x, y, theta, path length, sum of absolute turns, sums of the variances of x, y, theta
        self._samples = GrowingArray((8,), np.float64)
        self._sums = np.zeros(5)
        """Path length, turns and variances so far."""
        self._counted = np.zeros(3)
        """Pose up to which path length and turns have been counted."""
        self._resting = False

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> IntArray:
        """Stamps of all samples [ns], a read-only view."""
        return cast('IntArray', self._stamps.read_only)

    @property
    def poses(self) -> FloatArray:
        """Poses of all samples in the odometry frame, shape (N, 3), a read-only view."""
        return cast('FloatArray', self._samples.read_only)[:, :3]

    def append(
        self, stamp_ns: int, pose: FloatArray, variance: FloatArray | None = None,
    ) -> None:
        """
        Add a sample.

        Parameters
        ----------
        stamp_ns : int
        pose : ndarray, shape (3,)
            `T_odom_base` [m, m, rad].
        variance : ndarray, shape (3,), optional
            Of (x, y, theta) of the motion since the last sample, in the robot's frame.

        Raises
        ------
        ValueError
            If the stamp is not newer than the newest one.

        """
        if len(self) == 0:
            self._counted = pose.copy()
        elif stamp_ns <= self.stamps_ns[-1]:
            raise ValueError(f'expected a stamp after {self.stamps_ns[-1]}, got {stamp_ns}')
        step = math.hypot(pose[0] - self._counted[0], pose[1] - self._counted[1])
        turn = abs(float(se2.wrap(pose[2] - self._counted[2])))
        if step >= JITTER_DISTANCE or turn >= JITTER_HEADING:
            self._sums[:2] += step, turn
            self._counted = pose.copy()
        if variance is not None:
            self._sums[2:] += variance
        row = np.concatenate((pose, self._sums))
        samples = cast('FloatArray', self._samples.values)
        same = len(self) > 0 and bool(np.array_equal(samples[-1], row))
        if same and self._resting:
            # where nothing changes the first sample and the last are enough
            self._stamps.values[-1] = stamp_ns
            return
        self._resting = same
        self._stamps.append_one(stamp_ns)
        self._samples.append_one(row)

    def covers(self, stamp_ns: int, gap_ns: int | None = None) -> bool:
        """Tell whether there are samples on both sides of an instant, so near, or at it."""
        if len(self) == 0 or not self.stamps_ns[0] <= stamp_ns <= self.stamps_ns[-1]:
            return False
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        return (gap_ns is None or bool(self.stamps_ns[after] == stamp_ns)
                or bool(self.stamps_ns[after] - self.stamps_ns[after - 1] <= gap_ns))

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """
        Return the motion between two instants that are covered, start not after end.

        Raises
        ------
        ValueError
            If an instant is not covered, or they are in the wrong order.

        """
        if start_ns > end_ns:
            raise ValueError(f'expected start <= end, got {start_ns} and {end_ns}')
        start, bent_start = self._at(start_ns)
        end, bent_end = self._at(end_ns)
        return Motion(se2.between(start[:3], end[:3]), float(end[3] - start[3]),
                      float(end[4] - start[4]), end[5:] - start[5:] + bent_start + bent_end)

    def pose(self, stamp_ns: int) -> FloatArray:
        """Return the interpolated pose in the odometry frame at a covered instant."""
        return self._at(stamp_ns)[0][:3]

    def _at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the row at an instant, interpolated, and what that may be wrong by, (3,)."""
        if not self.covers(stamp_ns):
            raise ValueError(f'no odometry at {stamp_ns}')
        samples = cast('FloatArray', self._samples.values)
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if self.stamps_ns[after] == stamp_ns:
            return samples[after].copy(), np.zeros(3)
        before = after - 1
        start, end = int(self.stamps_ns[before]), int(self.stamps_ns[after])
        fraction = (stamp_ns - start) / (end - start)
        row = samples[before] + fraction * (samples[after] - samples[before])
        row[:3] = se2.interpolate(samples[before, :3], samples[after, :3], fraction)
        # no further off than the way between the samples
        way, turn = samples[after, 3:5] - samples[before, 3:5]
        bend = 0.5 * fraction * (1.0 - fraction) * ((end - start) * 1e-9)**2
        position = min(UNIFORM_WITHIN[0] * bend, float(way))
        heading = min(UNIFORM_WITHIN[1] * bend, float(turn))
        return row, np.array((position**2, position**2, heading**2))
