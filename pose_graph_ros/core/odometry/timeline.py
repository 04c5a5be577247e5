# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry samples by stamp, and the motion between any two instants that they cover."""

from collections.abc import Iterable
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Pose, wrap_one
from pose_graph_ros.core.odometry import motion as mo
from pose_graph_ros.core.odometry.motion import Motion, NO_MOTION, NO_VARIANCE, Span, Variances
from pose_graph_ros.core.quantities import StampNs, StampsNs

# Motions below both of these are not added to path length and turns: odometry jitters at rest,
# and the sum of its jitter at 50 Hz would be a long path [m, rad].
JITTER_DISTANCE = 0.01
JITTER_HEADING = 0.01
# A robot that stays within the jitter for longer stands still: its odometry has no noise [ns].
STANDING_NS = 1_000_000_000

# Largest time between two samples that cover the instants in between closely, and between equal
# samples at rest of which some are left out [ns].
LARGEST_GAP_NS = 1_000_000_000

NOTHING: Variances = (0.0, 0.0, 0.0)


class Row(NamedTuple):
    """A sample, with the sums of path length, turns and variances up to it."""

    stamp_ns: int
    pose: Pose  # `T_odom_base` in a frame without jumps [m, m, rad]
    distance: float  # path length so far [m]
    turn: float  # sum of absolute turns so far [rad]
    variance: Variances  # sums of the variances of (x, y, theta) so far [m^2, m^2, rad^2]
    counted: Pose  # pose up to which path length and turns have been added
    counted_ns: int  # stamp of `counted`, or a later one up to which the robot stood still [ns]
    # sums of the variances since then; they are added to `variance` once the robot moves
    held: Variances

    @property
    def numbers(self) -> FloatArray:
        """Pose and sums, shape (8,)."""
        return np.array((*self.pose, self.distance, self.turn, *self.variance))


def next_row(before: Row | None, stamp_ns: int, pose: Pose, variance: Variances = NOTHING,
             loose: Variances = NOTHING) -> Row:
    """
    Return the row of the next sample.

    `variance` is that of the motion since the sample before, in the robot's frame, and is added
    only if the robot moves; `loose` is added in any case.
    """
    if before is None:
        return Row(stamp_ns, pose, 0.0, 0.0, NOTHING, pose, stamp_ns, NOTHING)
    _, _, distance, turn, total, counted, counted_ns, held = before
    step = math.hypot(pose[0] - counted[0], pose[1] - counted[1])
    bend = abs(wrap_one(pose[2] - counted[2]))
    held = held[0] + variance[0], held[1] + variance[1], held[2] + variance[2]
    if step >= JITTER_DISTANCE or bend >= JITTER_HEADING:
        distance, turn, counted, counted_ns = distance + step, turn + bend, pose, stamp_ns
        total = total[0] + held[0], total[1] + held[1], total[2] + held[2]
        held = NOTHING
    elif any(held) and stamp_ns - counted_ns > STANDING_NS:
        held, counted_ns = NOTHING, stamp_ns
    total = total[0] + loose[0], total[1] + loose[1], total[2] + loose[2]
    return Row(stamp_ns, pose, distance, turn, total, counted, counted_ns, held)


class OdometryTimeline:
    """
    Odometry samples with increasing stamps.

    A sample takes 49 bytes, 73 with variances. Of consecutive equal samples only the first and
    the last are kept.
    """

    def __init__(self, rows: Iterable[Row] = ()) -> None:
        self._stamps = GrowingArray((), np.int64)
        # x, y, theta, path length, sum of absolute turns
        self._samples = GrowingArray((5,), np.float64)
        # sums of the variances of x, y, theta; empty while all are zero
        self._variances = GrowingArray((3,), np.float64)
        # whether equal samples between the one before and this one were left out
        self._dense = GrowingArray((), np.bool_)
        self._last: Row | None = None
        # whether the newest two samples are equal: an equal one would replace the newest
        self.resting = False
        for row in rows:
            self.append(row)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> IntArray:
        """Stamps of all samples [ns], a read-only view."""
        return self._stamps.read_only

    @property
    def poses(self) -> FloatArray:
        """Poses of all samples in the odometry frame, shape (N, 3), a read-only view."""
        return self._samples.read_only[:, :3]

    def append(self, row: Row) -> None:
        """Append a row of `next_row`; raise ValueError if its stamp is not after the newest."""
        last, same = self._last, False
        if last is not None:
            if row.stamp_ns <= last.stamp_ns:
                raise ValueError(f'expected a stamp after {last.stamp_ns}, got {row.stamp_ns}')
            same = row[1:5] == last[1:5] and row.stamp_ns - last.stamp_ns <= LARGEST_GAP_NS
        self._last = row
        if same and self.resting:
            # the newest of the equal samples replaces the one before
            self._stamps.values[-1] = row.stamp_ns
            self._dense.values[-1] = True
            return
        self.resting = same
        self._stamps.append_one(row.stamp_ns)
        if len(self._variances) > 0 or any(row.variance):
            if len(self._variances) == 0:
                self._variances.append(np.zeros((len(self._samples), 3)))
            self._variances.append_one(row.variance)
        self._samples.append_one((*row.pose, row.distance, row.turn))
        self._dense.append_one(False)

    def covers(self, stamp_ns: int, *, closely: bool = False) -> bool:
        """
        Tell whether there is a sample at an instant, or one before and one after it.

        Parameters
        ----------
        closely : bool
            Whether the two samples must be at most `LARGEST_GAP_NS` apart, or equal samples
            between them must have been left out.

        """
        stamps = self._stamps.values
        if len(stamps) == 0 or not stamps[0] <= stamp_ns <= stamps[-1]:
            return False
        if not closely:
            return True
        after = int(np.searchsorted(stamps, stamp_ns))
        return (bool(stamps[after] == stamp_ns) or self.dense(after)
                or int(stamps[after] - stamps[after - 1]) <= LARGEST_GAP_NS)

    def dense(self, sample: int) -> bool:
        """Tell whether equal samples between the one before and this one were left out."""
        return bool(self._dense.values[sample])

    def drop_before(self, stamp_ns: int) -> None:
        """Drop the samples older than the last one up to an instant [ns]; one is always kept."""
        n_old = int(np.searchsorted(self._stamps.values, stamp_ns, side='right')) - 1
        if n_old > 0:
            for column in (self._stamps, self._samples, self._variances, self._dense):
                if len(column) > 0:
                    column.drop_first(n_old)

    def thinned(self, instants_ns: StampsNs,
                since_ns: StampNs) -> tuple[IntArray, FloatArray, BoolArray]:
        """
        Return stamps, rows and `dense` of the samples for the motions between some instants.

        These are the first sample, those at the instants or else on both sides of them, and all
        from a later instant on. Motions between these instants do not depend on other samples. The
        rows, shape (T, 8), are pose, path length, sum of absolute turns, and sums of variances.
        """
        stamps = self.stamps_ns
        keep = np.zeros(len(stamps), dtype=bool)
        keep[:1] = True
        keep[np.searchsorted(stamps, since_ns):] = True
        after = np.searchsorted(stamps, instants_ns)
        inside = after < len(stamps)
        keep[after[inside]] = True
        inside[inside] = stamps[after[inside]] != instants_ns[inside]
        keep[after[inside] - 1] = True  # (-1, the last sample, for an instant before the first)
        return (stamps[keep], self._rows(keep),
                (self._dense.values & np.append(False, keep[:-1]))[keep])

    def restore(self, stamps_ns: IntArray, rows: FloatArray, dense: BoolArray, last: Row, *,
                resting: bool) -> None:
        """Fill this empty timeline with the result of `thinned`."""
        self._stamps, self._samples, self._dense = map(
            GrowingArray.of, (stamps_ns, rows[:, :5], dense))
        if np.any(rows[:, 5:]):
            self._variances.append(rows[:, 5:])
        self._last, self.resting = last, resting

    def motion(self, start_ns: StampNs, end_ns: StampNs) -> Motion:
        """Return the motion between two instants; raise ValueError if one is not covered."""
        if start_ns > end_ns:
            raise ValueError(f'expected start <= end, got {start_ns} and {end_ns}')
        motion = self.motion_to(start_ns, *self.at(end_ns))
        return NO_MOTION if start_ns == end_ns else motion

    def motion_to(self, start_ns: int, end: FloatArray, more: FloatArray = NO_VARIANCE) -> Motion:
        """Return the motion from an instant to `Row.numbers` that may not be in the timeline."""
        start, start_variance = self.at(start_ns)
        return Motion(se2.between(start[:3], end[:3]), float(end[3] - start[3]),
                      float(end[4] - start[4]), end[5:] - start[5:] + start_variance + more)

    def gap_motion(self, last_ns: StampNs, until_ns: StampNs, saved_ns: StampNs) -> Span:
        """
        Return the estimated motion during a gap in odometry.

        The robot is assumed to keep its mean speed, for at most `MEMORY_TIME`. After a long gap at
        the end of a loaded graph it is assumed to stand where it was.
        """
        if last_ns <= saved_ns and until_ns - last_ns > mo.RESUMED_WITHIN * 1e9:
            return Span(np.zeros(3), np.diag(mo.RESTART_VARIANCE))
        begin_ns = max(int(self.stamps_ns[0]), last_ns - mo.SPEED_TIME_NS)
        motion, time = self.motion(begin_ns, last_ns), (last_ns - begin_ns) * 1e-9
        elapsed = (until_ns - last_ns) * 1e-9
        ratio = elapsed / time if time > 0.0 else 0.0
        position, heading = mo.JUMP_SIGMA
        position += motion.distance * ratio
        sigma = np.array((position, position, heading + motion.turn * ratio))
        mean = motion.increment * min(ratio, mo.MEMORY_TIME / time if time > 0.0 else 0.0)
        return Span(se2.wrapped(mean), np.diag(sigma**2))

    def rests(self, start_ns: StampNs, end_ns: StampNs) -> list[tuple[int, int]]:
        """
        Return the stretches of some time during which the robot does not leave the jitter.

        Each begins and ends at a sample; returned are their stamps [ns]. In the first of them the
        robot may have begun to stand just then, at the last it may have begun to move.
        """
        stamps = self._stamps.values
        rows = slice(int(np.searchsorted(stamps, start_ns)),
                     int(np.searchsorted(stamps, end_ns, side='right')))
        times, path = stamps[rows], self._samples.values[rows, 3:5]
        if len(times) < 2:
            return []
        still = np.all(path[1:] == path[:-1], axis=1) & (
            self._dense.values[rows][1:] | (np.diff(times) <= LARGEST_GAP_NS))
        ends = np.flatnonzero(np.diff(np.concatenate(([False], still, [False]))))
        return [(int(times[begin]), int(times[end])) for begin, end in ends.reshape(-1, 2)]

    def moving(self, start_ns: StampNs, end_ns: StampNs) -> float:
        """Return for how long the robot did not stand between two stamps [s]."""
        rests = (last_ns - first_ns for first_ns, last_ns in self.rests(start_ns, end_ns))
        return (end_ns - start_ns - sum(rest for rest in rests if rest >= STANDING_NS)) * 1e-9

    def pose(self, stamp_ns: int) -> FloatArray:
        """
        Return the interpolated pose in the odometry frame at an instant, shape (3,) [m, m, rad].

        Raises ValueError if the instant is not covered.
        """
        return self.at(stamp_ns)[0][:3]

    def _rows(self, which: int | slice | BoolArray) -> FloatArray:
        """Return some samples with their sums, shape (..., 8)."""
        samples = self._samples.values[which]
        rows = np.zeros((*samples.shape[:-1], 8))
        rows[..., :5] = samples
        if len(self._variances) > 0:
            rows[..., 5:] = self._variances.values[which]
        return rows

    def at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return interpolated `Row.numbers`, and the variance of the interpolation, shape (3,)."""
        if not self.covers(stamp_ns):
            raise ValueError(f'no odometry at {stamp_ns}')
        stamps = self._stamps.values
        after = int(np.searchsorted(stamps, stamp_ns))
        if stamps[after] == stamp_ns:
            return self._rows(after), NO_VARIANCE
        before = after - 1
        start, end = int(stamps[before]), int(stamps[after])
        fraction = (stamp_ns - start) / (end - start)
        first, second = self._rows(slice(before, after + 1))
        row = first + fraction * (second - first)
        row[:3] = se2.interpolate(first[:3], second[:3], fraction)
        # An acceleration a moves the pose away from uniform motion by a t1 t2 / 2, with t1 and t2
        # the times to the two samples: here by 1 m/s^2 and 0.5 rad/s^2, but at most by the path.
        way, turn = second[3:5] - first[3:5]
        bend = 0.5 * fraction * (1.0 - fraction) * ((end - start) * 1e-9)**2
        position = min(bend, float(way))
        heading = min(0.5 * bend, float(turn))
        return row, np.array((position**2, position**2, heading**2))
