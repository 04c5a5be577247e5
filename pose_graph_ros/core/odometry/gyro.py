# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Yaw rates of a gyroscope by stamp, and their integral between two instants.

Between two samples the rate is taken to change uniformly, so the integral is that of a polygon. A
rate is w + b + n: w the true one, b the bias, which is estimated in the graph, n white noise.
"""

import bisect
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.gyro_config import GyroSource, RateNoise
from pose_graph_ros.core.measurements import (
    ACCEPTED,
    Answer,
    LARGEST_STAMP,
    rejected,
    YawRate,
)
from pose_graph_ros.core.odometry.stream import FAR_AHEAD_NS, MANY_BEHIND
from pose_graph_ros.core.saved_columns import Integers, Rows2

# A faster rotation is a faulty number [rad/s]; sensors of robots saturate at 35 rad/s.
LARGEST_RATE = 1000.0
# Samples that wait for odometry; beyond, the oldest are dropped.
MOST_SAMPLES = 100_000
# Change of the rate that the polygon must allow for [rad/s^2]: an acceleration that is not uniform
# during a step h leaves an error of h^2 / 12 times its change.
UNIFORM_WITHIN = 0.5


@dataclass(frozen=True, slots=True)
class SavedRates:
    """Saved samples of a gyroscope from the last node on that was reached."""

    stamps_ns: Integers
    """Shape (S,) [ns]."""
    rates: Rows2
    """Rate and its variance, shape (S, 2) [rad/s, rad^2/s^2]."""


class Rotation(NamedTuple):
    """What a gyroscope has measured during some time."""

    angle: float
    """Integral of the rate, with the bias, not wrapped [rad]."""
    variance: float
    """By the white noise and the error of the scale [rad^2]."""
    seconds: float
    """The time [s]."""

    def without(self, part: 'Rotation') -> 'Rotation':
        """Return the rotation during the rest of the time."""
        return Rotation(*(whole - less for whole, less in zip(self, part, strict=True)))


class GyroStream:
    """
    The samples of a gyroscope, sorted by stamp.

    A sample is settled when it is older than the newest one by the reorder window; older samples
    are rejected then.
    """

    def __init__(self, source: GyroSource) -> None:
        self.n_sorted = 0
        """Number of samples that were received after newer ones and sorted in before them."""
        self.n_dropped = 0
        """Number of accepted samples that were dropped later as their stamps were far ahead."""
        self._stamps: list[int] = []
        self._rates: list[tuple[float, float]] = []
        """Rate and its variance [rad/s, rad^2/s^2]."""
        self._n_settled = 0
        """Number of these samples that are settled, the oldest ones."""
        self._n_behind = 0
        """Number of consecutive received samples that are far behind the newest one."""
        self.configure(source)

    def configure(self, source: GyroSource) -> None:
        """Set the settings for samples that are not integrated yet."""
        self._source = source
        self._window_ns = round(source.reorder_window * 1e9)
        self._gap_ns = round(source.maximum_gap * 1e9)

    @property
    def first_ns(self) -> int:
        """Stamp of the oldest sample that is still here [ns]; -1 without."""
        return self._stamps[0] if self._stamps else -1

    @property
    def settled_ns(self) -> int:
        """Stamp of the newest settled sample [ns]; -1 before the first."""
        return self._stamps[self._n_settled - 1] if self._n_settled > 0 else -1

    def add(self, sample: YawRate) -> Answer:
        """Add a sample; return whether it is accepted, or the reason for its rejection."""
        stamp_ns, rate = sample.stamp_ns, sample.rate
        if not 0 < stamp_ns <= LARGEST_STAMP:
            return rejected('zero_stamp' if stamp_ns <= 0 else 'no_stamp',
                            f'expected a stamp above 0, got {stamp_ns} ns')
        if not abs(rate) <= LARGEST_RATE:
            return rejected('too_large' if abs(rate) > LARGEST_RATE else 'not_finite',
                            f'yaw rate {rate} rad/s')
        at, stamps = len(self._stamps), self._stamps
        if at > 0 and stamp_ns <= stamps[-1]:
            at = bisect.bisect_left(stamps, stamp_ns)
            if stamps[at] == stamp_ns:
                return rejected(
                    'duplicate_stamp', f'a rate at {1e-9 * stamp_ns:.3f} s came before')
            if at < self._n_settled:
                return rejected('out_of_order', f'a rate at {1e-9 * stamp_ns:.3f} s after '
                                                f'{1e-9 * self.settled_ns:.3f} s')
            self.n_sorted += 1
        known = 0.0 < sample.variance < LARGEST_RATE**2
        stamps.insert(at, stamp_ns)
        self._rates.insert(at, (rate, sample.variance if known else 0.0))
        behind = stamps[-1] - stamp_ns > FAR_AHEAD_NS + self._window_ns
        self._n_behind = self._n_behind + 1 if behind else 0
        if self._n_behind >= MANY_BEHIND:
            kept = bisect.bisect_right(stamps, stamp_ns + FAR_AHEAD_NS + self._window_ns)
            self.n_dropped += len(stamps) - kept
            del stamps[kept:], self._rates[kept:]
            self._n_behind = 0
        self.settle(stamps[-1] - self._window_ns)
        self._drop(len(stamps) - MOST_SAMPLES)
        return ACCEPTED

    def settle(self, until_ns: int | None = None) -> None:
        """Settle the samples up to a stamp [ns], by default all."""
        stamps, at = self._stamps, self._n_settled
        while at < len(stamps) and (until_ns is None or stamps[at] <= until_ns):
            at += 1
        self._n_settled = at

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the samples that rates from a stamp [ns] on do not need."""
        self._drop(bisect.bisect_right(self._stamps, stamp_ns) - 1)

    def _drop(self, n: int) -> None:
        if n > 0:
            del self._stamps[:n], self._rates[:n]
            self._n_settled = max(self._n_settled - n, 0)

    def integral(self, start_ns: int, end_ns: int) -> 'RateIntegral | None':
        """
        Return the integral of the rate; None if samples do not cover the time, or with a gap.

        Parameters
        ----------
        start_ns, end_ns : int, stamps [ns]

        """
        stamps = self._stamps
        begin = bisect.bisect_right(stamps, start_ns) - 1
        end = bisect.bisect_left(stamps, end_ns) + 1
        if begin < 0 or end > len(stamps):
            return None
        times_ns = np.array(stamps[begin:end], dtype=np.int64)
        if len(times_ns) < 2 or np.max(np.diff(times_ns)) > self._gap_ns:
            return None
        return RateIntegral(times_ns, np.array(self._rates[begin:end]), self._source)

    def newest(self, start_ns: int, end_ns: int) -> 'Rotation | None':
        """
        Return the rotation between two instants, by samples that need not be settled.

        The newest rate is taken to last until the end, if that is no gap. None as for `integral`.

        Parameters
        ----------
        start_ns, end_ns : int, stamps [ns]

        """
        stamps, rates = self._stamps, self._rates
        begin = bisect.bisect_right(stamps, start_ns) - 1
        if begin < 0 or end_ns - start_ns <= 0:
            return None
        end = bisect.bisect_left(stamps, end_ns) + 1
        times, values = stamps[begin:end], rates[begin:end]
        if end > len(stamps):
            times, values = [*times, end_ns], [*values, rates[-1]]
        times_ns = np.array(times, dtype=np.int64)
        if np.max(np.diff(times_ns)) > self._gap_ns:
            return None
        return RateIntegral(times_ns, np.array(values), self._source).between(start_ns, end_ns)

    def saved(self) -> SavedRates:
        """Return the samples that are still here."""
        return SavedRates(np.array(self._stamps, dtype=np.int64),
                          np.array(self._rates).reshape(-1, 2))

    def restore(self, saved: SavedRates) -> None:
        """Fill this empty stream with saved samples."""
        self._stamps = saved.stamps_ns.tolist()
        self._rates = [(rate, variance) for rate, variance in saved.rates.tolist()]
        if self._stamps:
            self.settle(self._stamps[-1] - self._window_ns)


class RateIntegral:
    """
    The integral of the polygon through some samples.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (S,), ascending, S >= 2 [ns]
    rates : ndarray, shape (S, 2), rates and their variances, 0 for unknown [rad/s, rad^2/s^2]

    """

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

    def between(self, start_ns: int, end_ns: int) -> Rotation:
        """
        Return the rotation between two instants that the samples cover.

        Parameters
        ----------
        start_ns, end_ns : int, stamps [ns]

        """
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
