# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
One source of odometry: its samples in the order of their stamps, without its jumps.

A sample counts once nothing older can be expected any more (the reorder window). Where odometry
jumps farther than the robot can have moved, it was reset: the motion of that instant is unknown,
about what it was before, and what follows goes on from there.
"""

import bisect
from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance
from pose_graph_ros.core.measurements import (
    ACCEPTED,
    Answer,
    LARGEST_COORDINATE,
    LARGEST_STAMP,
    OdometrySample,
    rejected,
    value_defect,
)
from pose_graph_ros.core.motion import between_one, compose_one, Motion, Pose, wrap_one
from pose_graph_ros.core.saved_columns import Flags, Integers, Rows7, Rows8
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import NoiseFrom, OdometrySource
from pose_graph_ros.core.timeline import next_row, NOTHING, OdometryTimeline, Row, Variances
from pose_graph_ros.core.unheard import LOOSE, MEMORY_TIME, restart_variance, RESUMED_WITHIN

# A motion within the first of these is no jump, whatever the time [m, rad].
SLACK = (0.25, 0.5)
# How much faster than before odometry may say the robot is, in a time [m/s^2, rad/s^2] ...
ACCELERATION = (10.0, 20.0)
# ... and however long that was, faster than it ever was by this and a factor of 2 [m/s, rad/s].
MORE_SPEED = (3.0, 2.0)
# Stamps lie unevenly, by so much: a speed is not taken over less than this [s].
LEAST_TIME = 0.05
# A variance of a twist beyond this, or one of zero, says nothing [m^2/s^2, rad^2/s^2].
LARGEST_TWIST_VARIANCE = 1e4
# A sample whose stamp lies so far ahead of this many that come after it is a mistake [ns].
FAR_AHEAD_NS = 10_000_000_000
MANY_BEHIND = 5
# All samples of so long are saved with a graph: measurements may come late by that [ns].
RECENT_NS = 60_000_000_000


@dataclass(frozen=True, slots=True)
class SavedInstant:
    """The state of a source of odometry at its newest settled sample."""

    raw: Pose
    """The sample as it came."""
    offset: Pose | None
    counted: Pose
    counted_ns: int
    held: Pose
    rate: tuple[float, float, float, float, float, float, float] | None
    """Velocity, recent and greatest speeds; None before they are known."""
    since_ns: int
    since: Pose
    way: tuple[float, float]
    jumped: bool


@dataclass(frozen=True, slots=True)
class SavedStream:
    """A source of odometry: its samples near the hidden nodes and its newest ones."""

    stamps_ns: Integers
    """Of samples that are settled, shape (T,)."""
    samples: Rows8
    """In a frame without jumps; with path lengths, turns and variances so far, shape (T, 8)."""
    dense: Flags
    resting: bool
    last: SavedInstant | None
    waiting_ns: Integers
    """Of samples that are not settled yet, shape (W,)."""
    waiting: Rows7
    """As they came: pose, speed, variances of the twist (zero where unknown), shape (W, 7)."""
    restarted_ns: int
    """The newest stamp at which it began anew after a graph was loaded, or -1."""
    tied: int
    """Newest node that it ties to another, or -1 ..."""
    next_to_tie: int
    """... and the next to look at."""


class _Sample(NamedTuple):
    """An odometry sample as it came."""

    stamp_ns: int
    pose: Pose
    speed: float
    variance: Variances | None


class _Rate(NamedTuple):
    """How fast the robot moves by odometry: [m/s] and [rad/s]."""

    velocity: Pose
    """In the robot's frame, and turn rate."""
    recent: tuple[float, float]
    """Greatest speed and turn rate of late; infinite before the first are known."""
    ever: tuple[float, float]
    """Greatest speed and turn rate so far; likewise."""


_UNKNOWN = _Rate((0.0, 0.0, 0.0), (math.inf, math.inf), (math.inf, math.inf))


class _Instant(NamedTuple):
    """The state of a source at a sample."""

    raw: Pose
    """As it came."""
    row: Row
    """In a frame without jumps, with what has been counted."""
    offset: Pose | None
    """Pose of the odometry's own frame in that one; None before the first jump."""
    rate: _Rate
    since_ns: int
    """The rate is taken anew over the time from here on ..."""
    since: Pose
    """... the pose there ..."""
    way: tuple[float, float]
    """... and the path length and turns since."""
    jumped: bool
    """Whether odometry jumped to here."""
    restarted: bool = False
    """Whether it began anew here, after a graph was loaded."""


class OdometryStream:
    """
    The samples of one source of odometry.

    Parameters
    ----------
    source : OdometrySource

    """

    def __init__(self, source: OdometrySource) -> None:
        self.timeline = OdometryTimeline()
        """Samples that are settled, in a frame without jumps."""
        self.n_jumps = 0
        """Jumps among the settled samples."""
        self.n_sorted = 0
        """Samples that came after newer ones and were sorted in."""
        self.n_dropped = 0
        """Samples that were taken, but whose stamps turned out to be far ahead of their time."""
        self._waiting: list[_Sample] = []
        """By stamp, all newer than what is settled."""
        self._ahead: list[_Instant] = []
        """The states at the first of them, as far as they have been worked out."""
        self._last: _Instant | None = None
        self._n_behind = 0
        """How many have come since that are far behind the newest."""
        self.saved_ns = -1
        """Stamp of the newest sample of a graph that was loaded [ns]."""
        self.restarted_ns = -1
        """Stamp of the settled sample with which it began anew after that [ns]: no tie across."""
        self.configure(source)

    def configure(self, source: OdometrySource) -> None:
        """
        Take settings, for samples that are not settled yet and for covariances from now on.

        Where the noise comes from stays the same: settled samples have theirs with them.
        """
        self._source = source
        self._noise = source.noise
        if source.noise_from is NoiseFrom.TWIST:
            # the timeline brings all of it
            self._noise = replace(source.noise, sigma_distance=0.0, sigma_lateral=0.0,
                                  sigma_heading_distance=0.0, sigma_heading_turn=0.0)
        self._window_ns = round(source.reorder_window * 1e9)
        # how far ahead somebody has looked must not decide which settings a sample meets
        self._ahead.clear()

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample [ns], settled or not; -1 before the first."""
        return self._waiting[-1].stamp_ns if self._waiting else self.settled_ns

    @property
    def settled_ns(self) -> int:
        """Stamp of the newest settled sample [ns]; -1 before the first."""
        return -1 if self._last is None else self._last.row.stamp_ns

    @property
    def n_jumps_seen(self) -> int:
        """Jumps among all samples, settled or not."""
        self._look_ahead()
        return self.n_jumps + sum(instant.jumped for instant in self._ahead)

    def add(self, sample: OdometrySample) -> Answer:
        """Take a sample, or say why it cannot be used."""
        if not 0 < sample.stamp_ns <= LARGEST_STAMP:
            return rejected('zero_stamp' if sample.stamp_ns <= 0 else 'no_stamp',
                            f'odometry at {sample.stamp_ns}')
        x, y, theta = sample.pose.tolist()
        if not (abs(x) <= LARGEST_COORDINATE and abs(y) <= LARGEST_COORDINATE
                and abs(theta) <= LARGEST_COORDINATE):
            return rejected(value_defect(sample.pose) or '', f'odometry pose {[x, y, theta]}')
        if sample.stamp_ns <= self.settled_ns:
            return rejected(*self._late(sample.stamp_ns))
        at = len(self._waiting)
        if at > 0 and sample.stamp_ns <= self._waiting[-1].stamp_ns:
            at = bisect.bisect_left(self._waiting, sample.stamp_ns, key=_stamp)
            if self._waiting[at].stamp_ns == sample.stamp_ns:
                return rejected('duplicate_stamp', f'odometry at {sample.stamp_ns} came before')
            del self._ahead[at:]
            self.n_sorted += 1
        variance = sample.twist_variance
        self._waiting.insert(at, _Sample(
            sample.stamp_ns, (x, y, wrap_one(theta)), sample.speed,
            None if variance is None else tuple(variance.tolist())))
        behind = self._waiting[-1].stamp_ns - sample.stamp_ns > FAR_AHEAD_NS + self._window_ns
        self._n_behind = self._n_behind + 1 if behind else 0
        if self._n_behind >= MANY_BEHIND:
            self._drop_far_ahead(sample.stamp_ns)
        return ACCEPTED

    def _drop_far_ahead(self, now_ns: int) -> None:
        """Forget the samples that are far ahead of the others."""
        kept = bisect.bisect_right(
            self._waiting, now_ns + FAR_AHEAD_NS + self._window_ns, key=_stamp)
        self.n_dropped += len(self._waiting) - kept
        del self._waiting[kept:], self._ahead[kept:]
        self._n_behind = 0

    def _late(self, stamp_ns: int) -> tuple[str, str]:
        stamps = self.timeline.stamps_ns
        at = int(np.searchsorted(stamps, stamp_ns))
        came = at < len(stamps) and (stamps[at] == stamp_ns or self.timeline.dense(at))
        return ('duplicate_stamp' if came else 'out_of_order',
                f'odometry at {stamp_ns} after {self.settled_ns}')

    def settle(self, until_ns: int | None = None) -> Iterator[tuple[int, Pose]]:
        """
        Settle samples up to a stamp, or what nothing older can be expected for.

        Yields
        ------
        stamp_ns : int
        pose : tuple
            In a frame without jumps. The sample is in the timeline by then, the next one is not.

        """
        if until_ns is None:
            until_ns = self.newest_ns - self._window_ns
        while self._waiting and self._waiting[0].stamp_ns <= until_ns:
            if not self._ahead:
                self._ahead.append(self._carried(self._last, self._waiting[0]))
            del self._waiting[0]
            self._last = self._ahead.pop(0)
            self.n_jumps += self._last.jumped
            if self._last.restarted:
                self.restarted_ns = self._last.row.stamp_ns
            self.timeline.append_row(self._last.row)
            yield self._last.row.stamp_ns, self._last.row.pose

    def first_after(self, stamp_ns: int) -> int | None:
        """Return the stamp of the first sample after an instant [ns], settled or not."""
        if self.settled_ns > stamp_ns:
            stamps = self.timeline.stamps_ns
            at = int(np.searchsorted(stamps, stamp_ns, side='right'))
            # one that was left out lies somewhere in between
            return stamp_ns + 1 if self.timeline.dense(at) and at > 0 else int(stamps[at])
        at = bisect.bisect_right(self._waiting, stamp_ns, key=_stamp)
        return self._waiting[at].stamp_ns if at < len(self._waiting) else None

    def saved(self, nodes_ns: IntArray, tied: tuple[int, int]) -> SavedStream:
        """Return all but the samples away from the hidden nodes, by the stamps of the nodes."""
        stamps, rows, dense = self.timeline.thinned(
            nodes_ns, min(int(nodes_ns[-1]), self.settled_ns - RECENT_NS))
        waiting = np.array([(*sample.pose, sample.speed, *(sample.variance or NOTHING))
                            for sample in self._waiting]).reshape(-1, 7)
        waiting[~np.isfinite(waiting)] = 0.0    # which says as little
        return SavedStream(
            stamps, rows, dense, self.timeline.resting,
            None if self._last is None else _saved_instant(self._last),
            np.array([sample.stamp_ns for sample in self._waiting], dtype=np.int64), waiting,
            self.restarted_ns, *tied)

    def restore(self, saved: SavedStream) -> None:
        """Go on, as an empty stream, from where a saved one was."""
        if saved.last is not None:
            self._last = _restored_instant(saved, saved.last)
            self.timeline.restore(
                saved.stamps_ns, saved.samples, saved.dense, self._last.row,
                resting=saved.resting)
        for stamp_ns, (x, y, theta, speed, *variance) in zip(
                saved.waiting_ns.tolist(), saved.waiting.tolist(), strict=True):
            self._waiting.append(_Sample(stamp_ns, (x, y, theta), speed, tuple(variance)))
        self.restarted_ns = saved.restarted_ns
        self.saved_ns = self.newest_ns

    def covariance(self, motion: Motion, *, floor: bool = True) -> FloatArray:
        """Return the covariance, shape (3, 3), of a motion by this odometry, at its end."""
        return np.asarray(self._source.covariance_scale * covariance.odometry_covariance(
            self._noise, motion, floor=floor))

    def newest(self, since_ns: int) -> tuple[Motion, FloatArray]:
        """Return the motion from a settled instant to the newest sample, and that, as it came."""
        self._look_ahead()
        last = self._ahead[-1] if self._ahead else self._last
        if last is None:
            raise ValueError('there is no odometry')
        return self.timeline.motion_to(since_ns, last.row), np.array(last.raw)

    def _look_ahead(self) -> None:
        """Work out the states at all samples that wait."""
        for sample in self._waiting[len(self._ahead):]:
            self._ahead.append(self._carried(
                self._ahead[-1] if self._ahead else self._last, sample))

    def _carried(self, before: _Instant | None, sample: _Sample) -> _Instant:
        """Return the state at a sample."""
        stamp_ns, raw = sample.stamp_ns, sample.pose
        if before is None:
            return _Instant(raw, next_row(None, stamp_ns, raw), None, _UNKNOWN, stamp_ns,
                            raw, (0.0, 0.0), jumped=False)
        step = between_one(before.raw, raw)
        elapsed = (stamp_ns - before.row.stamp_ns) * 1e-9
        moved = math.hypot(step[0], step[1]), abs(step[2])
        jump = self._is_jump(before.rate, moved, elapsed, sample.speed)
        if before.row.stamp_ns <= self.saved_ns < stamp_ns and (jump or elapsed > RESUMED_WITHIN):
            return _after_restart(before, stamp_ns, raw)
        if jump:
            return _after_jump(before, stamp_ns, raw, elapsed)
        offset, rate = before.offset, before.rate
        pose = raw if offset is None else compose_one(offset, raw)
        row = next_row(before.row, stamp_ns, pose, self._step_variance(sample, moved, elapsed))
        way = before.way[0] + moved[0], before.way[1] + moved[1]
        time = (stamp_ns - before.since_ns) * 1e-9
        if time < LEAST_TIME:
            return _Instant(
                raw, row, offset, rate, before.since_ns, before.since, way, jumped=False)
        speed = way[0] / time, way[1] / time
        x, y, theta = between_one(before.since, pose)
        velocity = x / time, y / time, theta / time
        if rate is _UNKNOWN:
            rate = _Rate(velocity, speed, speed)
        else:
            decay = math.exp(-time / MEMORY_TIME)
            rate = _Rate(
                velocity,
                (max(speed[0], decay * rate.recent[0]), max(speed[1], decay * rate.recent[1])),
                (max(speed[0], rate.ever[0]), max(speed[1], rate.ever[1])))
        return _Instant(raw, row, offset, rate, stamp_ns, pose, (0.0, 0.0), jumped=False)

    def _is_jump(
        self, rate: _Rate, moved: tuple[float, float], elapsed: float, speed: float,
    ) -> bool:
        """Tell whether a step is farther than the robot can have moved in the time."""
        if moved[0] <= SLACK[0] and moved[1] <= SLACK[1]:
            return False
        time = elapsed + LEAST_TIME
        stated = abs(speed) if math.isfinite(speed) else 0.0
        for k, stated_k, most in ((0, stated, self._source.maximum_speed), (1, 0.0, math.inf)):
            recent, ever = max(rate.recent[k], stated_k), max(rate.ever[k], stated_k)
            allowed = min(2.0 * recent + ACCELERATION[k] * max(time, 0.1),
                          2.0 * ever + MORE_SPEED[k], most)
            if moved[k] > SLACK[k] + allowed * time:
                return True
        return False

    def _step_variance(
        self, sample: _Sample, moved: tuple[float, float], elapsed: float,
    ) -> Variances:
        """Return the variance of (x, y, theta) of a step, where it is taken from the twist."""
        if self._source.noise_from is not NoiseFrom.TWIST:
            return NOTHING
        noise = self._source.noise
        by_model = (
            noise.sigma_distance**2 * moved[0], noise.sigma_lateral**2 * moved[0],
            noise.sigma_heading_distance**2 * moved[0] + noise.sigma_heading_turn**2 * moved[1])
        if sample.variance is None:
            return by_model
        x, y, theta = (
            variance * elapsed if 0.0 < variance <= LARGEST_TWIST_VARIANCE else instead
            for variance, instead in zip(sample.variance, by_model, strict=True))
        return x, y, theta


def _after_jump(before: _Instant, stamp_ns: int, raw: Pose, elapsed: float) -> _Instant:
    """Return the state at a sample to which odometry has jumped."""
    time = min(elapsed, MEMORY_TIME)
    x, y, theta = before.rate.velocity
    pose = compose_one(before.row.pose, (x * time, y * time, wrap_one(theta * time)))
    way, turn = (rate * elapsed if math.isfinite(rate) else 0.0 for rate in before.rate.recent)
    position, heading = (LOOSE[0] + way)**2, (LOOSE[1] + turn)**2
    row = next_row(before.row, stamp_ns, pose, loose=(position, position, heading))
    offset = compose_one(pose, between_one(raw, (0.0, 0.0, 0.0)))
    return before._replace(raw=raw, row=row, offset=offset, since_ns=stamp_ns, since=pose,
                           way=(0.0, 0.0), jumped=True, restarted=False)


def _after_restart(before: _Instant, stamp_ns: int, raw: Pose) -> _Instant:
    """Return the state at a sample with which odometry begins anew, after a graph was loaded."""
    pose = before.row.pose
    row = next_row(before.row, stamp_ns, pose, loose=restart_variance())
    offset = compose_one(pose, between_one(raw, (0.0, 0.0, 0.0)))
    return _Instant(raw, row, offset, _UNKNOWN, stamp_ns, pose, (0.0, 0.0), jumped=True,
                    restarted=True)


def _saved_instant(last: _Instant) -> SavedInstant:
    rate = None if last.rate is _UNKNOWN else (
        *last.rate.velocity, *last.rate.recent, *last.rate.ever)
    return SavedInstant(
        last.raw, last.offset, last.row.counted, last.row.counted_ns, last.row.held, rate,
        last.since_ns, last.since, last.way, last.jumped)


def _restored_instant(saved: SavedStream, last: SavedInstant) -> _Instant:
    x, y, theta, distance, turn, *variance = saved.samples[-1].tolist()
    row = Row(int(saved.stamps_ns[-1]), (x, y, theta), distance, turn, _nothing(tuple(variance)),
              last.counted, last.counted_ns, _nothing(last.held))
    rate = _UNKNOWN if last.rate is None else _Rate(
        last.rate[:3], last.rate[3:5], last.rate[5:])
    return _Instant(last.raw, row, last.offset, rate, last.since_ns, last.since, last.way,
                    last.jumped)


def _nothing(variance: Variances) -> Variances:
    """Return the one object that stands for no variance where there is none."""
    return variance if any(variance) else NOTHING


def _stamp(sample: _Sample) -> int:
    return sample.stamp_ns
