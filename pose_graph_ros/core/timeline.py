# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw odometry by stamp: what happened between any two instants, and how far that was."""

import math
from typing import cast, NamedTuple

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.se2 import FloatArray, IntArray

# Motion is counted when it exceeds one of these: odometry jitters at rest, and the sum of its
# jitter at 50 Hz would be a long way [m, rad].
JITTER_DISTANCE = 0.01
JITTER_HEADING = 0.01


class Motion(NamedTuple):
    """Motion between two instants."""

    increment: FloatArray
    """Pose at the later instant seen from the earlier one, shape (3,) [m, m, rad]."""
    distance: float
    """Length of the path in between [m]."""
    turn: float
    """Sum of the absolute turns in between [rad]."""


class OdometryTimeline:
    """Odometry samples with increasing stamps; 48 bytes a sample."""

    def __init__(self) -> None:
        self._stamps = GrowingArray((), np.int64)
        # x, y, theta, path length, sum of absolute turns
        self._samples = GrowingArray((5,), np.float64)
        self._distance = self._turn = 0.0
        self._counted = np.zeros(3)
        """Pose up to which path length and turns have been counted."""

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

    def append(self, stamp_ns: int, pose: FloatArray) -> None:
        """
        Add a sample, `T_odom_base`, shape (3,).

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
            self._distance += step
            self._turn += turn
            self._counted = pose.copy()
        self._stamps.append_one(stamp_ns)
        self._samples.append_one((pose[0], pose[1], pose[2], self._distance, self._turn))

    def covers(self, stamp_ns: int) -> bool:
        """Tell whether odometry is known on both sides of an instant, or at it."""
        return len(self) > 0 and bool(self.stamps_ns[0] <= stamp_ns <= self.stamps_ns[-1])

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
        start, end = self._at(start_ns), self._at(end_ns)
        return Motion(se2.between(start[:3], end[:3]), float(end[3] - start[3]),
                      float(end[4] - start[4]))

    def pose(self, stamp_ns: int) -> FloatArray:
        """Return the interpolated pose in the odometry frame at a covered instant."""
        return self._at(stamp_ns)[:3]

    def _at(self, stamp_ns: int) -> FloatArray:
        """Return the row (x, y, theta, path length, turns) at an instant, interpolated."""
        if not self.covers(stamp_ns):
            raise ValueError(f'no odometry at {stamp_ns}')
        samples = cast('FloatArray', self._samples.values)
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if self.stamps_ns[after] == stamp_ns:
            return samples[after].copy()
        before = after - 1
        start, end = int(self.stamps_ns[before]), int(self.stamps_ns[after])
        fraction = (stamp_ns - start) / (end - start)
        row = samples[before] + fraction * (samples[after] - samples[before])
        row[:3] = se2.interpolate(samples[before, :3], samples[after, :3], fraction)
        return row
