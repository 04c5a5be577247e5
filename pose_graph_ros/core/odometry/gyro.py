# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Yaw rates of a gyroscope by stamp, and their integral between two instants.

Between two samples the rate is taken to change uniformly, so the integral is that of a polygon. A
rate is w + b + n: w the true one, b the bias, which is estimated in the graph, n white noise.
"""

import bisect
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import GyroSource, RateNoise
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.measurements import ACCEPTED, Answer, rejected, YawRate
from pose_graph_ros.core.odometry.reorder_buffer import ReorderBuffer, stamp_of
from pose_graph_ros.core.quantities import StampNs

# A faster rotation is a faulty number [rad/s]; sensors of robots saturate at 35 rad/s.
LARGEST_RATE = 1000.0
# Change of the rate that the polygon must allow for [rad/s^2]: an acceleration that is not uniform
# during a step h leaves an error of h^2 / 12 times its change.
UNIFORM_WITHIN = 0.5


class Rotation(NamedTuple):
    """What a gyroscope has measured during some time."""

    angle: float  # integral of the rate, with the bias, not wrapped [rad]
    variance: float  # by the white noise and the error of the scale [rad^2]
    seconds: float

    def without(self, part: 'Rotation') -> 'Rotation':
        """Return the rotation during the rest of the time."""
        return Rotation(*(whole - less for whole, less in zip(self, part, strict=True)))


class GyroStream(ReorderBuffer[YawRate]):
    """The samples of a gyroscope, sorted by stamp."""

    def __init__(self, source: GyroSource) -> None:
        super().__init__('a rate')
        self._settled: list[YawRate] = []
        self.configure(source)

    def configure(self, source: GyroSource) -> None:
        """Set the settings for samples that are not integrated yet."""
        self._source = source
        self._window_ns = round(source.reorder_window * 1e9)
        self._gap_ns = round(source.maximum_gap * 1e9)

    @property
    def first_ns(self) -> int:
        """Stamp of the oldest settled sample that is still here [ns]; -1 without."""
        return self._settled[0].stamp_ns if self._settled else -1

    @property
    def settled_ns(self) -> int:
        """Stamp of the newest settled sample [ns]; -1 before the first."""
        return self._settled[-1].stamp_ns if self._settled else -1

    def _was_settled(self, stamp_ns: int) -> bool:
        at = bisect.bisect_left(self._settled, stamp_ns, key=stamp_of)
        return at < len(self._settled) and self._settled[at].stamp_ns == stamp_ns

    def add(self, sample: YawRate) -> Answer:
        """Add a sample; return whether it is accepted, or the reason for its rejection."""
        if not abs(sample.rate) <= LARGEST_RATE:
            return rejected('too_large' if abs(sample.rate) > LARGEST_RATE else 'not_finite',
                            f'yaw rate {sample.rate} rad/s')
        if not 0.0 < sample.variance < LARGEST_RATE**2:
            sample = replace(sample, variance=0.0)
        at = self._insert(sample)
        if isinstance(at, Answer):
            return at
        self.settle(self._waiting[-1].stamp_ns - self._window_ns)
        return ACCEPTED

    def settle(self, until_ns: int | None = None) -> None:
        """Settle the samples up to a stamp [ns], by default all."""
        n = len(self._waiting) if until_ns is None else bisect.bisect_right(
            self._waiting, until_ns, key=stamp_of)
        self._settled += self._waiting[:n]
        # without odometry the oldest are dropped
        del self._waiting[:n], self._settled[:-100_000]

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the samples that rates from a stamp [ns] on do not need."""
        n = bisect.bisect_right(self._settled, stamp_ns, key=stamp_of) - 1
        del self._settled[:max(n, 0)]

    def integral(
        self, start_ns: StampNs, end_ns: StampNs, *, to_come: bool = False,
    ) -> 'RateIntegral | None':
        """
        Return the integral of the rate; None if samples do not cover the time without a gap.

        Where samples are still to come, the newest rate is taken to last until the end.
        """
        every = self._settled + self._waiting
        begin = bisect.bisect_right(every, start_ns, key=stamp_of) - 1
        if begin < 0:
            return None
        samples = every[begin:bisect.bisect_left(every, end_ns, key=stamp_of) + 1]
        if to_come and samples[-1].stamp_ns < end_ns:
            samples.append(replace(samples[-1], stamp_ns=end_ns))
        stamps_ns = np.array([each.stamp_ns for each in samples], dtype=np.int64)
        if (len(stamps_ns) < 2 or stamps_ns[-1] < end_ns
                or np.max(np.diff(stamps_ns)) > self._gap_ns):
            return None
        rates = np.array([(each.rate, each.variance) for each in samples])
        return RateIntegral(stamps_ns, rates, self._source)

    def saved(self) -> tuple[YawRate, ...]:
        """Return the samples that are still here."""
        return (*self._settled, *self._waiting)

    def restore(self, saved: Sequence[YawRate]) -> None:
        """Fill this empty stream with saved samples."""
        self._waiting = [*saved]
        if len(saved) > 0:
            self.settle(self._waiting[-1].stamp_ns - self._window_ns)


class RateIntegral:
    """The integral of the polygon through at least two samples, given by rates and variances."""

    def __init__(self, stamps_ns: IntArray, rates: FloatArray, source: GyroSource) -> None:
        self._begin_ns, self.scale = int(stamps_ns[0]), source.covariance_scale
        self._times = (stamps_ns - stamps_ns[0]) * 1e-9
        self.rates, steps = rates[:, 0], np.diff(self._times)
        means = 0.5 * (self.rates[1:] + self.rates[:-1])
        change = np.diff(self.rates)
        self._slopes = change / steps
        self._angles = np.append(0.0, np.cumsum(means * steps))
        # n independent errors of variance v during a time t: that of the angle grows by v t / n
        density = np.full(len(steps), source.sigma_rate**2)
        if source.noise_from is RateNoise.MESSAGE:
            known = np.minimum(rates[1:, 1], rates[:-1, 1]) > 0.0
            density[known] = (0.5 * (rates[1:, 1] + rates[:-1, 1]) * steps)[known]
        bend = np.minimum(UNIFORM_WITHIN * steps**2 / 12.0, 0.25 * np.abs(change) * steps)
        self._densities = density + source.sigma_turn**2 * np.abs(means) + bend**2 / steps
        self._variances = np.append(0.0, np.cumsum(self._densities * steps))

    def rate(self, stamp_ns: int) -> float:
        """Return the rate at an instant [rad/s]."""
        return float(np.interp((stamp_ns - self._begin_ns) * 1e-9, self._times, self.rates))

    def between(self, start_ns: StampNs, end_ns: StampNs) -> Rotation:
        """Return the rotation between two instants that the samples cover."""
        (begin, begin_variance), (end, end_variance) = self._at(start_ns), self._at(end_ns)
        return Rotation(end - begin, self.scale * (end_variance - begin_variance),
                        (end_ns - start_ns) * 1e-9)

    def _at(self, stamp_ns: int) -> tuple[float, float]:
        """Return the integral and its variance at an instant."""
        time = (stamp_ns - self._begin_ns) * 1e-9
        k = min(int(np.searchsorted(self._times, time, side='right')), len(self._slopes)) - 1
        step = time - self._times[k]
        angle = self._angles[k] + (self.rates[k] + 0.5 * self._slopes[k] * step) * step
        return float(angle), float(self._variances[k] + self._densities[k] * step)
