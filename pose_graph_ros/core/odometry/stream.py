# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One source of odometry: its samples in the order of their stamps, without jumps."""

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import math
import operator
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.config import Integrate, NoiseFrom, OdometrySource
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import between_one, compose_one, FloatArray, IntArray, Pose
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.odometry import motion as mo
from pose_graph_ros.core.odometry.timeline import next_row, NOTHING, OdometryTimeline, Row
from pose_graph_ros.core.quantities import StampNs, StampsNs
from pose_graph_ros.core.saved_columns import Flags, Integers, Rows8

NEVER = 1 << 63  # after all stamps [ns]
NO_TWIST: Pose = (0.0, 0.0, 0.0)
# A sample is dropped if its stamp is farther ahead, by this and the reorder window [ns], than the
# stamps of this number of consecutive samples that came after it.
FAR_AHEAD_NS = 10_000_000_000
MANY_BEHIND = 5
LARGEST_SPEED = 1e4  # of a twist [m/s, rad/s]; a larger one is a faulty number


class Received(NamedTuple):
    """An odometry sample as received."""

    stamp_ns: int
    pose: Pose
    speed: float  # by the twist; 0 if it is unknown
    variance: mo.Variances | None  # of the twist; 0 where it is unknown
    twist: Pose = NO_TWIST  # (v_x, v_y, yaw rate) [m/s, m/s, rad/s], if twists are integrated


Sample = TypeVar('Sample', Received, ms.YawRate)
stamp_of = operator.attrgetter('stamp_ns')


class ReorderBuffer(Generic[Sample]):
    """
    The samples that are not settled.

    A sample is settled when it is older than the newest one by the reorder window; older samples
    are rejected then.
    """

    def __init__(self, what: str) -> None:
        self.n_sorted = 0  # samples that were received after newer ones and sorted in before them
        self.n_dropped = 0  # accepted samples that were dropped later, as they were far ahead
        self.settled_ns = -1  # stamp of the newest settled sample; -1 before the first [ns]
        self._waiting: list[Sample] = []
        self._what, self._window_ns = what, 0  # [ns]
        self._n_behind = 0  # consecutive received samples that are far behind the newest one

    @property
    def newest_ns(self) -> StampNs:
        """Stamp of the newest sample, settled or not; -1 before the first."""
        return self._waiting[-1].stamp_ns if self._waiting else self.settled_ns

    def _was_settled(self, stamp_ns: StampNs) -> bool:
        """Tell whether there was a settled sample with a stamp."""
        raise NotImplementedError

    def _settle(self, until_ns: StampNs | None = None) -> Iterator[Sample]:
        """
        Settle samples one by one, and yield each.

        The newest stamp to settle is by default that of the newest sample minus the window.
        """
        if until_ns is None:
            until_ns = self.newest_ns - self._window_ns
        while self._waiting and self._waiting[0].stamp_ns <= until_ns:
            sample = self._waiting.pop(0)
            self.settled_ns = sample.stamp_ns
            yield sample

    def _follow(self, begin: int) -> None:
        """Do what is to be done after samples that wait have changed, from one on."""
        raise NotImplementedError

    def _insert(self, sample: Sample) -> ms.Answer:
        """Return the answer to a sample, which is sorted in if it is accepted."""
        samples, stamp_ns, at = self._waiting, sample.stamp_ns, len(self._waiting)
        if not 0 < stamp_ns <= ms.LARGEST_STAMP:
            return ms.rejected('zero_stamp' if stamp_ns <= 0 else 'no_stamp',
                            f'expected a stamp above 0, got {stamp_ns} ns')
        if stamp_ns <= self.settled_ns:
            return ms.rejected(
                'duplicate_stamp' if self._was_settled(stamp_ns) else 'out_of_order',
                f'{self._what} at {1e-9 * stamp_ns:.3f} s after {1e-9 * self.settled_ns:.3f} s')
        if at > 0 and stamp_ns <= samples[-1].stamp_ns:
            at = bisect.bisect_left(samples, stamp_ns, key=stamp_of)
            if samples[at].stamp_ns == stamp_ns:
                return ms.rejected('duplicate_stamp',
                                f'{self._what} at {1e-9 * stamp_ns:.3f} s came before')
            self.n_sorted += 1
        samples.insert(at, sample)
        latest_ns = stamp_ns + FAR_AHEAD_NS + self._window_ns
        self._n_behind = self._n_behind + 1 if samples[-1].stamp_ns > latest_ns else 0
        if self._n_behind >= MANY_BEHIND:
            kept = bisect.bisect_right(samples, latest_ns, key=stamp_of)
            self.n_dropped += len(samples) - kept
            del samples[kept:]
            self._n_behind = 0
        self._follow(at)
        return ms.ACCEPTED


class Instant(NamedTuple):
    """The state of a source at a sample."""

    raw: Pose  # pose as received [m, m, rad]
    row: Row  # the sample in a frame without jumps, with its sums
    # pose of the odometry frame in the frame without jumps; None before the first jump
    offset: Pose | None
    window: mo.SpeedWindow  # speeds of the robot by this odometry
    jumped: bool  # whether odometry jumped to this sample
    restarted: bool = False  # whether odometry restarted at this sample, after a graph was loaded
    twist: Pose = NO_TWIST  # as `Received.twist`


class SavedStream(NamedTuple):
    """Saved odometry source: its samples next to the hidden nodes, and its newest ones."""

    stamps_ns: Integers  # stamps of settled samples, shape (T,) [ns]
    samples: Rows8  # their rows, as returned by `OdometryTimeline.thinned`, shape (T, 8)
    dense: Flags  # as `OdometryTimeline.dense`, shape (T,)
    resting: bool  # as `OdometryTimeline.resting`
    last: Instant | None  # at the newest settled sample
    waiting: tuple[Received, ...]  # samples that are not settled
    restarted_ns: int  # as `OdometryStream.restarted_ns`
    # newest node that the samples cover, where the next secondary edge begins; -1 for none
    tied: int
    next_to_tie: int  # next node to check for a secondary edge


class OdometryStream(ReorderBuffer[Received]):
    """
    The samples of one source of odometry.

    Where odometry jumps farther than the robot can have moved, it was reset:
    the motion of that step is predicted from the speeds before, with a large covariance, and the
    later samples are appended to the predicted pose.
    """

    def __init__(self, source: OdometrySource) -> None:
        super().__init__('odometry')
        self.timeline = OdometryTimeline()  # settled samples, in a frame without jumps
        self.n_jumps = 0  # number of jumps among the settled samples
        self.jump = ''  # when and how far odometry jumped last, in words
        self._ahead: list[Instant] = []  # states at the samples that wait
        self._last: Instant | None = None  # state at the newest settled sample
        # stamp of the newest sample of a graph that was loaded; -1 if none was [ns]
        self.saved_ns = -1
        # stamp at which odometry restarted after a graph was loaded; -1 if it did not [ns]
        self.restarted_ns = -1
        # newest node that the samples cover, where the next secondary edge begins, or -1 for none;
        # and the next node to check
        self.tied, self.next_to_tie = -1, 0
        self.configure(source)

    def configure(self, source: OdometrySource) -> None:
        """
        Set the settings for samples that are not settled yet and for covariances from now on.

        `noise_from` must not change, as settled samples keep their variances from the twist.
        """
        self._source = source
        self._noise = source.noise
        if source.noise_from is NoiseFrom.TWIST:
            # the variances of the timeline contain all of the noise
            self._noise = replace(source.noise, sigma_distance=0.0, sigma_lateral=0.0,
                                  sigma_heading_distance=0.0, sigma_heading_turn=0.0)
        self._window_ns = round(source.reorder_window * 1e9)
        # samples not settled yet get the new settings, even if their states were computed before
        self._follow()

    @property
    def n_jumps_seen(self) -> int:
        """Number of jumps among all samples, settled or not."""
        return self.n_jumps + sum(instant.jumped for instant in self._ahead)

    def add(self, sample: ms.OdometrySample) -> ms.Answer:
        """Add a sample; return whether it is accepted, or the reason for its rejection."""
        x, y, theta = sample.pose.tolist()
        twist, variance = sample.twist or NO_TWIST, sample.twist_variance
        for what, numbers, largest in (('odometry pose', (x, y, theta), ms.LARGEST_COORDINATE),
                                       ('twist', twist, LARGEST_SPEED)):
            if not all(abs(number) <= largest for number in numbers):
                reason = 'too_large' if all(map(math.isfinite, numbers)) else 'not_finite'
                return ms.rejected(reason, f'{what} {numbers}')
        return self._insert(Received(
            sample.stamp_ns, (x, y, se2.wrap_one(theta)),
            sample.speed if math.isfinite(sample.speed) else 0.0,
            None if variance is None else tuple(
                np.nan_to_num(variance, posinf=0.0, neginf=0.0).tolist()), twist))

    def _was_settled(self, stamp_ns: int) -> bool:
        stamps = self.timeline.stamps_ns
        at = int(np.searchsorted(stamps, stamp_ns))
        return at < len(stamps) and bool(stamps[at] == stamp_ns or self.timeline.dense(at))

    def settle(self, until_ns: int | None = None) -> Iterator[tuple[int, Pose]]:
        """
        Settle samples one by one, and yield each after it was appended to the timeline.

        What is yielded are its stamp [ns] and its pose in a frame without jumps. The newest stamp
        to settle [ns] is by default that of the newest sample minus the reorder window.
        """
        for _ in self._settle(until_ns):
            before, self._last = self._last, self._ahead.pop(0)
            if self._last.jumped and before is not None:
                x, y, turn = between_one(before.raw, self._last.raw)
                begin_ns, end_ns = before.row.stamp_ns, self._last.row.stamp_ns
                self.jump = (
                    f'by {math.hypot(x, y):.2f} m and {math.degrees(turn):.1f} degrees within '
                    f'{(end_ns - begin_ns) * 1e-9:.3f} s at {end_ns * 1e-9:.3f} s')
            self.n_jumps += self._last.jumped
            if self._last.restarted:
                self.restarted_ns = self._last.row.stamp_ns
            self.timeline.append(self._last.row)
            yield self._last.row.stamp_ns, self._last.row.pose

    def forget(self, before_ns: int) -> None:
        """Drop settled samples that motions from an instant [ns] on do not depend on."""
        self.timeline.drop_before(min(before_ns, self.settled_ns - mo.SPEED_TIME_NS))

    def first_after(self, stamp_ns: int) -> int:
        """
        Return the stamp of the first sample after an instant [ns], settled or not, or `NEVER`.

        Between samples at rest, of which the timeline keeps two, it is `stamp_ns + 1`.
        """
        if self.settled_ns > stamp_ns:
            stamps = self.timeline.stamps_ns
            at = int(np.searchsorted(stamps, stamp_ns, side='right'))
            # samples at rest that the timeline left out lie in between
            return stamp_ns + 1 if self.timeline.dense(at) and at > 0 else int(stamps[at])
        at = bisect.bisect_right(self._waiting, stamp_ns, key=stamp_of)
        return self._waiting[at].stamp_ns if at < len(self._waiting) else NEVER

    def tie_from(self, node: int, *, reached: bool) -> None:
        """
        Let secondary edges continue at a node, by its number.

        They begin there if it is reached, or else at the first one from it on that the samples
        cover.
        """
        self.tied, self.next_to_tie = (node, node + 1) if reached else (-1, node)

    def secondary_edges(self, stamps_ns: StampsNs, ids: IntArray) -> Iterator[Factors]:
        """
        Make the edges between consecutive nodes up to the newest settled sample.

        The poses are interpolated at the stamps of the nodes. A node without samples close to its
        stamp is left out: the edge spans from the node before to the next.
        """
        end = int(np.searchsorted(stamps_ns, self.settled_ns, side='right'))
        for node in range(self.next_to_tie, end):
            node_ns = int(stamps_ns[node])
            if self.timeline.covers(node_ns, closely=True):
                # no edge spans a restart
                last_ns = int(stamps_ns[self.tied])
                if self.tied >= 0 and not last_ns < self.restarted_ns <= node_ns:
                    motion = self.timeline.motion(last_ns, node_ns)
                    yield Factors(
                        [ids[self.tied]], [ids[node]], [motion.increment],
                        [covariance.information(self.covariance(motion))], [FactorKind.ODOMETRY])
                self.tied = node
        self.next_to_tie = max(self.next_to_tie, end)

    def saved(self, nodes_ns: StampsNs) -> SavedStream:
        """Return the state, with the samples next to the hidden nodes and the newest ones."""
        stamps, rows, dense = self.timeline.thinned(
            # and those of the last minute, for measurements that come late
            nodes_ns, min(int(nodes_ns[-1]), self.settled_ns - 60_000_000_000))
        return SavedStream(stamps, rows, dense, self.timeline.resting, self._last,
                           tuple(self._waiting), self.restarted_ns, self.tied, self.next_to_tie)

    def restore(self, saved: SavedStream) -> None:
        """Set the state of this empty stream to a saved one."""
        if saved.last is not None:
            self._last, self.settled_ns = saved.last, saved.last.row.stamp_ns
            self.timeline.restore(
                saved.stamps_ns, saved.samples, saved.dense, saved.last.row, resting=saved.resting)
        self._waiting += saved.waiting
        self.restarted_ns = saved.restarted_ns
        self.tied, self.next_to_tie = saved.tied, saved.next_to_tie
        self.saved_ns = self.newest_ns
        self._follow()

    def covariance(self, motion: mo.Motion, *, floor: bool = True) -> FloatArray:
        """
        Return the covariance, shape (3, 3), of a motion by this odometry in the frame at its end.
        """
        return np.asarray(self._source.covariance_scale * mo.odometry_covariance(
            self._noise, motion, floor=floor))

    def newest(self, since_ns: int) -> tuple[mo.Motion, FloatArray]:
        """
        Return the motion from a settled instant [ns] to the newest sample, settled or not.

        With it comes the pose of that sample as received, shape (3,) [m, m, rad]. Raises
        ValueError if the samples do not cover the instant.
        """
        last = self._ahead[-1] if self._ahead else self._last
        assert last is not None, 'the primary source has samples'
        return self.timeline.motion_to(since_ns, last.row.numbers), np.array(last.raw)

    def motion_ahead(self, since_ns: int, stamp_ns: int) -> mo.Motion | None:
        """
        Return the motion from a settled instant to one after it that may not be settled [ns].

        None if samples do not cover that instant closely.
        """
        rows = [each.row for each in (*filter(None, [self._last]), *self._ahead)]
        after = bisect.bisect_left(rows, stamp_ns, key=lambda row: row.stamp_ns)
        if not 0 < after < len(rows):
            return None
        ends = OdometryTimeline(rows[after - 1:after + 1])
        if not ends.covers(stamp_ns, closely=True):
            return None
        return self.timeline.motion_to(since_ns, *ends.at(stamp_ns))

    def _follow(self, begin: int = 0) -> None:
        """Compute the states at the samples that are not settled, from one on."""
        del self._ahead[begin:]
        for sample in self._waiting[begin:]:
            self._ahead.append(self._next_instant(
                self._ahead[-1] if self._ahead else self._last, sample))

    def _next_instant(self, before: Instant | None, sample: Received) -> Instant:
        """Return the state at a sample from the state at the sample before."""
        stamp_ns, raw, twist = sample.stamp_ns, sample.pose, sample.twist
        if before is None:
            window = mo.SpeedWindow(mo.UNKNOWN, stamp_ns, raw)
            return Instant(
                raw, next_row(None, stamp_ns, raw), None, window, jumped=False, twist=twist)
        elapsed = (stamp_ns - before.row.stamp_ns) * 1e-9
        integrates = self._source.integrate is Integrate.TWIST
        motion = (mo.integrated(before.twist, twist, elapsed) if integrates
                  else between_one(before.raw, raw))
        step = math.hypot(motion[0], motion[1]), abs(motion[2])
        # twists are not integrated over a longer gap [s]
        jump = (integrates and elapsed > 1.0) or mo.is_jump(
            before.window.speeds, step, elapsed, sample.speed, self._source.maximum_speed)
        if before.row.stamp_ns <= self.saved_ns < stamp_ns and (
                jump or elapsed > mo.RESUMED_WITHIN):
            return _elsewhere(before, sample, before.row.pose, mo.RESTART_VARIANCE, restarted=True)
        if jump:
            time, speeds = min(elapsed, mo.MEMORY_TIME), before.window.speeds
            x, y, theta = speeds.velocity
            pose = compose_one(before.row.pose, (x * time, y * time, se2.wrap_one(theta * time)))
            position, heading = ((sigma + (0.0 if speeds == mo.UNKNOWN else rate * elapsed))**2
                                 for sigma, rate in zip(mo.JUMP_SIGMA, speeds.recent, strict=True))
            return _elsewhere(before, sample, pose, (position, position, heading), speeds)
        if integrates:
            pose = compose_one(before.row.pose, motion)
        else:
            pose = raw if before.offset is None else compose_one(before.offset, raw)
        variance = (mo.step_variance(self._source, sample.variance, step, elapsed)
                    if self._source.noise_from is NoiseFrom.TWIST else NOTHING)
        row = next_row(before.row, stamp_ns, pose, variance)
        return Instant(raw, row, before.offset, before.window.moved(stamp_ns, pose, step),
                       jumped=False, twist=twist)


def _elsewhere(before: Instant, sample: Received, pose: Pose, variance: mo.Variances,
               speeds: mo.Speeds = mo.UNKNOWN, *, restarted: bool = False) -> Instant:
    """Return the state at a sample from which on odometry has another origin."""
    row = next_row(before.row, sample.stamp_ns, pose, loose=variance)
    offset = compose_one(pose, between_one(sample.pose, (0.0, 0.0, 0.0)))
    return Instant(sample.pose, row, offset, mo.SpeedWindow(speeds, sample.stamp_ns, pose),
                   jumped=True, restarted=restarted, twist=sample.twist)


def find_silence(streams: Mapping[str, OdometryStream], names: Sequence[str], last_ns: int,
                 settled: tuple[str, int], patience_ns: int) -> tuple[int, int] | None:
    """
    Return the first silence of the primary source that is longer than the patience, if any.

    That is the stamp of the last sample before it, and of the sample of another source that proves
    it [ns]. `names` begin with the primary source; the search starts at its sample at `last_ns`.
    The samples before a settled one, given by source and stamp, are known.
    """
    primary, *others = names
    source, settled_ns = settled
    while True:
        # the next sample of the primary source ends its silence
        next_ns = settled_ns if source == primary else streams[primary].first_after(last_ns)
        known_ns = min((streams[name].first_after(last_ns + patience_ns) for name in others),
                       default=NEVER)
        if known_ns < min(next_ns, settled_ns + 1):
            return last_ns, known_ns
        if next_ns >= settled_ns:
            return None
        last_ns = next_ns
