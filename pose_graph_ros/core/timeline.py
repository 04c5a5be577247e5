# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Raw odometry by stamp: what happened between any two instants, and how far that was."""

from collections.abc import Iterable
import math
from typing import cast, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import se2
from pose_graph_ros.core.arrays import GrowingArray
from pose_graph_ros.core.motion import Motion, NO_MOTION, Pose, wrap_one
from pose_graph_ros.core.se2 import FloatArray, IntArray

# Motion is counted when it exceeds one of these: odometry jitters at rest, and the sum of its
# jitter at 50 Hz would be a long way [m, rad].
JITTER_DISTANCE = 0.01
JITTER_HEADING = 0.01
# A robot that stays within the jitter for so long stands still: its odometry has no noise [ns].
STANDING_NS = 1_000_000_000

# Samples that are further apart do not tell what was in between, not even that it stood [ns].
LARGEST_GAP_NS = 1_000_000_000

# Between two samples motion is taken as uniform. An acceleration of this much would leave that by
# a t^2 / 2 at most, with t the time to the nearer one and the rest to the other [m/s^2, rad/s^2].
UNIFORM_WITHIN = (1.0, 0.5)

Variances = tuple[float, float, float]
NOTHING: Variances = (0.0, 0.0, 0.0)


class Row(NamedTuple):
    """A sample, with what has been counted up to it."""

    stamp_ns: int
    pose: Pose
    distance: float
    """Path length so far [m]."""
    turn: float
    """Sum of absolute turns so far [rad]."""
    variance: Variances
    """Sums of the variances of (x, y, theta) so far."""
    counted: Pose
    """Pose up to which path length and turns have been counted."""
    counted_ns: int
    """Its stamp."""
    held: Variances
    """Variances since, which count as soon as the robot turns out to move."""


def next_row(
    before: Row | None, stamp_ns: int, pose: Pose, variance: Variances = NOTHING,
    loose: Variances = NOTHING,
) -> Row:
    """
    Return the row of the next sample.

    Parameters
    ----------
    before : Row, optional
        None for the first sample.
    stamp_ns : int
    pose : tuple
        `T_odom_base` [m, m, rad].
    variance : tuple
        Of (x, y, theta) of the motion since the last sample, in the robot's frame; it counts only
        where the robot moves.
    loose : tuple
        The same, where it counts in any case.

    """
    if before is None:
        return Row(stamp_ns, pose, 0.0, 0.0, NOTHING, pose, stamp_ns, NOTHING)
    _, _, distance, turn, total, counted, counted_ns, held = before
    step = math.hypot(pose[0] - counted[0], pose[1] - counted[1])
    bend = abs(wrap_one(pose[2] - counted[2]))
    if variance is not NOTHING:
        held = held[0] + variance[0], held[1] + variance[1], held[2] + variance[2]
    if step >= JITTER_DISTANCE or bend >= JITTER_HEADING:
        distance, turn, counted, counted_ns = distance + step, turn + bend, pose, stamp_ns
        if held is not NOTHING:
            total = total[0] + held[0], total[1] + held[1], total[2] + held[2]
            held = NOTHING
    elif held is not NOTHING and stamp_ns - counted_ns > STANDING_NS:
        held, counted_ns = NOTHING, stamp_ns
    if loose is not NOTHING:
        total = total[0] + loose[0], total[1] + loose[1], total[2] + loose[2]
    return Row(stamp_ns, pose, distance, turn, total, counted, counted_ns, held)


class OdometryTimeline:
    """
    Odometry samples with increasing stamps.

    It takes 49 bytes a sample, 73 where variances were counted, and none for standing still.
    """

    def __init__(self) -> None:
        self._stamps = GrowingArray((), np.int64)
        # x, y, theta, path length, sum of absolute turns
        self._samples = GrowingArray((5,), np.float64)
        # sums of the variances of x, y, theta; empty while all are zero
        self._variances = GrowingArray((3,), np.float64)
        self._dense = GrowingArray((), np.bool_)
        """Whether there were samples, all of them the same, between the one before and this."""
        self._last: Row | None = None
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

    def append(self, stamp_ns: int, pose: Iterable[float]) -> None:
        """
        Add a sample.

        Parameters
        ----------
        stamp_ns : int
        pose : iterable of 3 numbers
            `T_odom_base` [m, m, rad].

        Raises
        ------
        ValueError
            If the stamp is not newer than the newest one.

        """
        x, y, theta = (float(number) for number in pose)
        self.append_row(next_row(self._last, stamp_ns, (x, y, theta)))

    def append_row(self, row: Row) -> None:
        """Add a sample as `next_row` makes it; raises as `append`."""
        last = self._last
        self._last = row
        if last is None:
            same = near = False
        else:
            if row.stamp_ns <= last.stamp_ns:
                self._last = last
                raise ValueError(
                    f'expected a stamp after {last.stamp_ns}, got {row.stamp_ns}')
            same = row[1:5] == last[1:5]
            near = row.stamp_ns - last.stamp_ns <= LARGEST_GAP_NS
        if same and near and self._resting:
            # where nothing changes the first sample and the last are enough
            self._stamps.values[-1] = row.stamp_ns
            self._dense.values[-1] = True
            return
        self._resting = same and near
        self._stamps.append_one(row.stamp_ns)
        if len(self._variances) == 0 and any(row.variance):
            self._variances.append(np.zeros((len(self._samples), 3)))
        if len(self._variances) == len(self._samples) > 0:
            self._variances.append_one(row.variance)
        self._samples.append_one((*row.pose, row.distance, row.turn))
        self._dense.append_one(False)

    def covers(self, stamp_ns: int, *, closely: bool = False) -> bool:
        """Tell whether there are samples on both sides of an instant (near to it), or at it."""
        stamps = cast('IntArray', self._stamps.values)
        if len(stamps) == 0 or not stamps[0] <= stamp_ns <= stamps[-1]:
            return False
        if not closely:
            return True
        after = int(np.searchsorted(stamps, stamp_ns))
        return (bool(stamps[after] == stamp_ns) or self.dense(after)
                or int(stamps[after] - stamps[after - 1]) <= LARGEST_GAP_NS)

    def dense(self, sample: int) -> bool:
        """Tell whether samples like it and the one before were left out between the two."""
        return bool(cast('npt.NDArray[np.bool_]', self._dense.values)[sample])

    def thinned(
        self, instants_ns: IntArray, since_ns: int,
    ) -> tuple[IntArray, FloatArray, npt.NDArray[np.bool_]]:
        """
        Return stamps (T,), rows (T, 8) and whether each is dense, of the samples that matter.

        Those are the first one, those at some instants or else on both sides of them, and all
        from another instant on. At these instants nothing changes by leaving out the others.
        """
        stamps = self.stamps_ns
        keep = np.zeros(len(stamps), dtype=bool)
        keep[:1] = True
        keep[np.searchsorted(stamps, since_ns):] = True
        after = np.searchsorted(stamps, instants_ns)
        inside = after < len(stamps)
        keep[after[inside]] = True
        inside[inside] = stamps[after[inside]] != instants_ns[inside]
        keep[after[inside] - 1] = True  # (the last sample, if it is before the first instant)
        dense = cast('npt.NDArray[np.bool_]', self._dense.values)
        return (stamps[keep], self._rows(keep),
                (dense & np.append(False, keep[:-1]))[keep])

    @property
    def resting(self) -> bool:
        """Whether the next sample takes the place of the last one if it is the same."""
        return self._resting

    def restore(
        self, stamps_ns: IntArray, rows: FloatArray, dense: npt.NDArray[np.bool_], last: Row, *,
        resting: bool,
    ) -> None:
        """Fill this empty timeline with what `thinned` has returned, and the newest row."""
        self._stamps.append(stamps_ns)
        self._samples.append(rows[:, :5])
        if np.any(rows[:, 5:]):
            self._variances.append(rows[:, 5:])
        self._dense.append(dense)
        self._last, self._resting = last, resting

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
        if start_ns == end_ns:
            return NO_MOTION
        end, bent_end = self._at(end_ns)
        return Motion(se2.between(start[:3], end[:3]), float(end[3] - start[3]),
                      float(end[4] - start[4]), end[5:] - start[5:] + bent_start + bent_end)

    def motion_to(self, start_ns: int, end: Row) -> Motion:
        """Return the motion from a covered instant to a later row that goes on from the last."""
        start, bent = self._at(start_ns)
        return Motion(se2.between(start[:3], np.array(end.pose)), float(end.distance - start[3]),
                      float(end.turn - start[4]), np.array(end.variance) - start[5:] + bent)

    def pose(self, stamp_ns: int) -> FloatArray:
        """Return the interpolated pose in the odometry frame at a covered instant."""
        return self._at(stamp_ns)[0][:3]

    def _rows(self, which: int | slice | npt.NDArray[np.bool_]) -> FloatArray:
        """Return some samples with their variances, shape (..., 8)."""
        samples = cast('FloatArray', self._samples.values)[which]
        rows = np.zeros((*samples.shape[:-1], 8))
        rows[..., :5] = samples
        if len(self._variances) > 0:
            rows[..., 5:] = self._variances.values[which]
        return rows

    def _at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return the row at an instant, interpolated, and what that may be wrong by, (3,)."""
        if not self.covers(stamp_ns):
            raise ValueError(f'no odometry at {stamp_ns}')
        stamps = cast('IntArray', self._stamps.values)
        after = int(np.searchsorted(stamps, stamp_ns))
        if stamps[after] == stamp_ns:
            return self._rows(after), np.zeros(3)
        before = after - 1
        start, end = int(stamps[before]), int(stamps[after])
        fraction = (stamp_ns - start) / (end - start)
        first, second = self._rows(slice(before, after + 1))
        row = first + fraction * (second - first)
        row[:3] = se2.interpolate(first[:3], second[:3], fraction)
        # no further off than the way between the samples
        way, turn = second[3:5] - first[3:5]
        bend = 0.5 * fraction * (1.0 - fraction) * ((end - start) * 1e-9)**2
        position = min(UNIFORM_WITHIN[0] * bend, float(way))
        heading = min(UNIFORM_WITHIN[1] * bend, float(turn))
        return row, np.array((position**2, position**2, heading**2))
