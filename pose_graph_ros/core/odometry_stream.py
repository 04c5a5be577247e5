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
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.measurements import (
    ACCEPTED,
    Answer,
    OdometrySample,
    rejected,
    value_defect,
)
from pose_graph_ros.core.motion import Motion
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import NoiseFrom, OdometrySource
from pose_graph_ros.core.timeline import OdometryTimeline

# A motion within the first of these is no jump, whatever the time [m, rad].
SLACK = (0.25, 0.5)
# How much faster than before odometry may say the robot is, in a time [m/s^2, rad/s^2] ...
ACCELERATION = (10.0, 20.0)
# ... and however long that was, faster than it ever was by this and a factor of 2 [m/s, rad/s].
MORE_SPEED = (3.0, 2.0)
# Stamps lie unevenly; a speed is not judged over less than this [s].
LEAST_TIME = 0.05
# The fastest motion of late is forgotten within about this time [s].
MEMORY_TIME = 2.0
# Standard deviations of the motion at a jump: at least, and of the speed before [m, rad].
LOOSE = (0.5, 0.1)
# A motion of less than this between two samples is none [m or rad].
NO_STEP = 1e-6


class _Instant(NamedTuple):
    """The state of a source at a sample."""

    stamp_ns: int
    raw: FloatArray
    """As it came."""
    pose: FloatArray
    """In a frame without jumps."""
    velocity: FloatArray
    """In the robot's frame, shape (3,)."""
    recent: FloatArray
    """Greatest speed and turn rate of late, shape (2,); infinite at the first sample."""
    ever: FloatArray
    """Greatest speed and turn rate so far, shape (2,); likewise."""


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
        self._source = source
        self._noise = source.noise
        if source.noise_from is NoiseFrom.TWIST:
            # the timeline brings all of it
            self._noise = replace(source.noise, sigma_distance=0.0, sigma_lateral=0.0,
                                  sigma_heading_distance=0.0, sigma_heading_turn=0.0)
        self._window_ns = round(source.reorder_window * 1e9)
        self._waiting: list[OdometrySample] = []
        """By stamp, all newer than what is settled."""
        self._last: _Instant | None = None

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample [ns], settled or not; -1 before the first."""
        return self._waiting[-1].stamp_ns if self._waiting else self.settled_ns

    @property
    def settled_ns(self) -> int:
        """Stamp of the newest settled sample [ns]; -1 before the first."""
        return -1 if self._last is None else self._last.stamp_ns

    def add(self, sample: OdometrySample) -> Answer:
        """Take a sample, or say why it cannot be used."""
        if sample.stamp_ns <= 0:
            return rejected('zero_stamp', 'odometry without a stamp')
        broken = value_defect(sample.pose)
        if broken is not None:
            return rejected(broken, f'odometry pose {sample.pose.tolist()}')
        if sample.stamp_ns <= self.settled_ns:
            return rejected(*self._late(sample.stamp_ns))
        at = bisect.bisect_left(self._waiting, sample.stamp_ns, key=_stamp)
        if at < len(self._waiting) and self._waiting[at].stamp_ns == sample.stamp_ns:
            return rejected('duplicate_stamp', f'odometry at {sample.stamp_ns} came before')
        self._waiting.insert(at, replace(sample, pose=se2.wrapped(sample.pose)))
        return ACCEPTED

    def _late(self, stamp_ns: int) -> tuple[str, str]:
        stamps = self.timeline.stamps_ns
        at = int(np.searchsorted(stamps, stamp_ns))
        came = at < len(stamps) and stamps[at] == stamp_ns
        return ('duplicate_stamp' if came else 'out_of_order',
                f'odometry at {stamp_ns} after {self.settled_ns}')

    def settle(self, *, everything: bool = False) -> Iterator[int]:
        """Settle what nothing older can be expected for; yield the stamps [ns], one by one."""
        until = self.newest_ns - (0 if everything else self._window_ns)
        while self._waiting and self._waiting[0].stamp_ns <= until:
            sample = self._waiting.pop(0)
            before = self._last
            self._last, variance, jumped = self._carried(before, sample)
            self.n_jumps += jumped
            self.timeline.append(sample.stamp_ns, self._last.pose, variance)
            yield sample.stamp_ns

    def covariance(self, motion: Motion, *, floor: bool = True) -> FloatArray:
        """Return the covariance, shape (3, 3), of a motion by this odometry, at its end."""
        return np.asarray(self._source.covariance_scale * covariance.odometry_covariance(
            self._noise, motion, floor=floor))

    def newest(self, since_ns: int) -> tuple[Motion, FloatArray]:
        """Return the motion from a settled instant to the newest sample, and that, as it came."""
        last = self._last
        if last is None:
            raise ValueError('there is no settled odometry')
        motion = self.timeline.motion(since_ns, last.stamp_ns)
        distance, turn, variance = motion.distance, motion.turn, motion.variance.copy()
        start = last.pose
        for sample in self._waiting:
            before = last
            last, more, _ = self._carried(before, sample)
            distance += math.hypot(*(last.pose - before.pose)[:2])
            turn += abs(float(se2.wrap(last.pose[2] - before.pose[2])))
            variance += more
        increment = se2.compose(motion.increment, se2.between(start, last.pose))
        return Motion(increment, distance, turn, variance), last.raw

    def _carried(
        self, before: _Instant | None, sample: OdometrySample,
    ) -> tuple[_Instant, FloatArray, bool]:
        """Return the state at a sample, the variance of the motion to it, if it was a jump."""
        if before is None:
            unknown = np.full(2, np.inf)
            return (_Instant(sample.stamp_ns, sample.pose, sample.pose, np.zeros(3), unknown,
                             unknown), np.zeros(3), False)
        step = se2.between(before.raw, sample.pose)
        elapsed = (sample.stamp_ns - before.stamp_ns) * 1e-9
        if self._is_jump(before, sample.stamp_ns, step, sample.speed):
            guessed = se2.compose(before.pose, before.velocity * min(elapsed, MEMORY_TIME))
            speed = np.where(np.isfinite(before.recent), before.recent, 0.0) * elapsed
            loose = np.array((LOOSE[0] + speed[0], LOOSE[0] + speed[0], LOOSE[1] + speed[1]))
            return before._replace(
                stamp_ns=sample.stamp_ns, raw=sample.pose, pose=guessed), loose**2, True
        time = max(elapsed, LEAST_TIME)
        measure = np.array((math.hypot(step[0], step[1]), abs(step[2])))
        rate = measure / time
        recent = ever = rate
        if math.isfinite(before.ever[0]):
            recent = np.maximum(rate, math.exp(-elapsed / MEMORY_TIME) * before.recent)
            ever = np.maximum(rate, before.ever)
        after = _Instant(sample.stamp_ns, sample.pose, se2.compose(before.pose, step),
                         step / time, recent, ever)
        return after, self._step_variance(sample, measure, elapsed), False

    def _is_jump(
        self, before: _Instant, stamp_ns: int, step: FloatArray, speed: float = 0.0,
    ) -> bool:
        """Tell whether a step is farther than the robot can have moved in the time."""
        time = max((stamp_ns - before.stamp_ns) * 1e-9, LEAST_TIME)
        moved = math.hypot(step[0], step[1]), abs(float(step[2]))
        recent = max(float(before.recent[0]), abs(speed)), float(before.recent[1])
        for k, most in ((0, self._source.maximum_speed), (1, math.inf)):
            ever = max(float(before.ever[k]), recent[k])
            allowed = min(2.0 * recent[k] + ACCELERATION[k] * max(time, 0.1),
                          2.0 * ever + MORE_SPEED[k], most)
            if moved[k] > SLACK[k] + allowed * time:
                return True
        return False

    def _step_variance(
        self, sample: OdometrySample, measure: FloatArray, elapsed: float,
    ) -> FloatArray:
        """Return the variance of (x, y, theta) of a step, where it is taken from the twist."""
        if self._source.noise_from is not NoiseFrom.TWIST or np.max(measure) < NO_STEP:
            return np.zeros(3)  # at rest nothing is measured that could be wrong
        if sample.twist_variance is not None:
            return np.asarray(sample.twist_variance * elapsed)
        noise = self._source.noise
        return np.array((
            noise.sigma_distance**2 * measure[0], noise.sigma_lateral**2 * measure[0],
            noise.sigma_heading_distance**2 * measure[0]
            + noise.sigma_heading_turn**2 * measure[1]))


def _stamp(sample: OdometrySample) -> int:
    return sample.stamp_ns
