# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From yaw rates of gyroscopes to rotations between consecutive hidden nodes.

Between two samples the rate is taken to change uniformly, so its integral is that of a polygon. A
rate is w + b + n: w the true one, b the bias, which is estimated in the graph, n white noise. At
rest the mean rate measures the bias.

How well rotations agree with those of odometry is told to people, and has no part in the estimate.
A rotation by the gyroscope minus that by odometry is, over the time t between two hidden nodes,

    d = b t + tau (w_1 - w_0) + k a

with b the bias, tau how much its stamps are early, w the rates at both nodes, a the rotation by
odometry and 1 + k how much the gyroscope turns for each turn of odometry: 0 if it is dead, -1 if
it is upside down. These three are fitted to the newest rotations by least squares, with the noise
that both claim.
"""

import bisect
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import BackendConfig, GyroSource, RateNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.measurements import Answer, rejected, YawRate
from pose_graph_ros.core.odometry import hidden_nodes, timeline
from pose_graph_ros.core.odometry.stream import ReorderBuffer, stamp_of
from pose_graph_ros.core.sources.queued import Queued

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


class RateIntegral:
    """The integral of the polygon through at least two samples, given by rates and variances."""

    def __init__(self, stamps_ns: IntArray, rates: FloatArray, source: GyroSource) -> None:
        self._begin_ns, self.scale = int(stamps_ns[0]), source.covariance_scale
        self._times = (stamps_ns - stamps_ns[0]) * 1e-9
        self.rates, steps = rates[:, 0], np.diff(self._times)
        # n independent errors of variance v during a time t: that of the angle grows by v t / n
        density = np.full(len(steps), source.sigma_rate**2)
        if source.noise_from is RateNoise.MESSAGE:
            known = np.minimum(rates[1:, 1], rates[:-1, 1]) > 0.0
            density[known] = (0.5 * (rates[1:, 1] + rates[:-1, 1]) * steps)[known]
        bend = np.minimum(UNIFORM_WITHIN * steps**2 / 12.0,
                          0.25 * np.abs(np.diff(self.rates)) * steps)
        means = 0.5 * (self.rates[1:] + self.rates[:-1])
        self._densities = density + source.sigma_turn**2 * np.abs(means) + bend**2 / steps

    def rate(self, stamp_ns: int) -> float:
        """Return the rate at an instant [rad/s]."""
        return float(np.interp((stamp_ns - self._begin_ns) * 1e-9, self._times, self.rates))

    def between(self, start_ns: int, end_ns: int) -> Rotation:
        """Return the rotation between two instants that the samples cover."""
        begin, end = ((stamp_ns - self._begin_ns) * 1e-9 for stamp_ns in (start_ns, end_ns))
        times = np.clip(self._times, begin, end)
        steps, rates = np.diff(times), np.interp(times, self._times, self.rates)
        return Rotation(float(0.5 * (rates[1:] + rates[:-1]) @ steps),
                        self.scale * float(self._densities @ steps), (end_ns - start_ns) * 1e-9)


# Rotations of independent sensors that differ by more contradict each other [sigma].
CONTRADICTORY = 1.5
LEAST = 30  # rotations for a verdict
# A robot whose gyroscope shows more than this many sigmas of its bias at rest is turned by others.
MOST_BIAS = 5.0


class Difference(NamedTuple):
    """How much rotations differ from those of odometry."""

    sigmas: float  # root mean square of what the bias does not explain, in units of its sigma
    # what is probably wrong, as a sentence without capital and full stop; '' for nothing
    reason: str


class Agreement:
    """The sums over the newest rotations of one gyroscope."""

    def __init__(self) -> None:
        # of seconds, change of the rate, angle by odometry, and difference
        self._products = np.zeros((4, 4))
        self._n = self._turned = 0.0

    def add(self, difference: float, seconds: float, change: float, angle: float,
            variance: float) -> None:
        """
        Add a rotation, `angle` by the gyroscope and that less a difference by odometry.

        `variance` is that of the difference, `change` how much the rate changes meanwhile [rad/s].
        """
        by_odometry, fade = angle - difference, 1.0 - 1.0 / 1000.0  # the fit forgets
        row = np.array((seconds, change, by_odometry, difference))
        left = difference - (float(row[:3] @ self._fit()[0]) if self._n >= LEAST else 0.0)
        # differences beyond 5 sigma do not count, as those of wheels that slip
        weight = min(25.0 / (left * left + 1e-300), 1.0 / variance)
        self._products = fade * self._products + weight * np.outer(row, row)
        self._n = fade * self._n + 1.0
        self._turned = fade * self._turned + max(abs(angle), abs(by_odometry))

    def _fit(self) -> tuple[FloatArray, FloatArray]:
        """Return bias, time and scale, and their covariance."""
        # weak priors: 0.1 rad/s, 10 s, 10
        covariance = np.linalg.inv(self._products[:3, :3] + np.diag((1e2, 1e-2, 1e-2)))
        return np.asarray(covariance @ self._products[:3, 3]), np.asarray(covariance)

    def difference(self) -> Difference | None:
        """Return the difference by now; None as long as too little is known."""
        if self._n < LEAST or self._turned < 2.0 * math.pi:
            return None
        squares, right = self._products[3, 3], self._products[:3, 3]
        explained = right[0]**2 / self._products[0, 0]
        sigmas = math.sqrt(max(squares - explained, 0.0) / self._n)
        found, covariance = self._fit()
        rest = max((squares - float(found @ right)) / self._n, 1.0)
        shown = np.abs(found) > 5.0 * np.sqrt(rest * np.diagonal(covariance))
        early, turns, reason = float(found[1]), 1.0 + float(found[2]), ''
        if sigmas < 0.1:
            reason = 'odometry seems to contain it already, so that it counts twice'
        elif sigmas < CONTRADICTORY:
            pass
        elif turns < -0.3:
            reason = 'it turns the other way: check its mounting'
        elif turns < 0.3:
            reason = ('it does not turn with odometry: its z axis is not up (see mounting and '
                      '/tf_static), or it is dead')
        elif shown[1] and abs(early) > 0.05:
            reason = (f'its stamps seem to be {abs(early):.2f} s '
                      f'{"early" if early > 0.0 else "late"}: see time_offset')
        elif shown[2] and abs(1.0 / turns - 1.0) > 0.05:
            reason = f'odometry turns {1.0 / turns:.2f} times as much'
        return Difference(sigmas, reason)


# Parts of a standstill by the wheels in which the robot may still, or already, turn [ns].
STOPPING_NS, STARTING_NS = timeline.STANDING_NS, timeline.STANDING_NS // 3


def turn(source: str, ends: Sequence[int], stamp_ns: int, rotation: Sequence[float],
         rest: Sequence[float]) -> list[Queued]:
    """
    Return the constraints of a rotation from one hidden node to the next.

    These are an edge with three ends, two nodes, given by their ids, and the bias, and, of rates
    at rest, an observation of the bias. The rotation is that of the time for which the robot was
    not at rest; `rest` has the mean rate at rest and its variance, 0 if it was not at rest. The
    stamp is the middle of the time in between [ns].
    """
    (i, j), (angle, variance, seconds), (rate, rate_variance) = ends, rotation, rest
    queued = [Queued(source, Factors(
        [i], [j], [(0.0, 0.0, angle)], [np.diag((0.0, 0.0, 1.0 / variance))], [FactorKind.TURN],
        constants=[(0.0, 0.0, 0.0, seconds)]), stamp_ns)]
    if rate_variance > 0.0:
        queued.append(Queued(source, Factors.on(
            [-1], None, [(rate, 0.0, 0.0)], [np.diag((1.0 / rate_variance, 0.0, 0.0))],
            [FactorKind.GLOBAL_POSE]), stamp_ns))
    return queued


class SavedGyro(NamedTuple):
    """Saved state of a gyroscope."""

    rates: tuple[YawRate, ...]  # from the last node on that was reached
    next_node: int  # number of the hidden node that the next rotation leads to


class GyroStream(ReorderBuffer[YawRate]):
    """The samples of a gyroscope, sorted by stamp, and what was made of them."""

    def __init__(self, source: GyroSource) -> None:
        super().__init__('a rate')
        self._settled: list[YawRate] = []
        self.next_node = 1  # number of the hidden node that the next rotation leads to
        self.agreement = Agreement()
        self.configure(source)

    def configure(self, source: GyroSource) -> None:
        """Set the settings for samples that are not integrated yet."""
        self._source = source
        self._window_ns = round(source.reorder_window * 1e9)

    @property
    def first_ns(self) -> int:
        """Stamp of the oldest settled sample that is still here [ns]; -1 without."""
        return self._settled[0].stamp_ns if self._settled else -1

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
        return self._insert(sample)

    def _follow(self, begin: int) -> None:
        self.settle()

    def settle(self, until_ns: int | None = None) -> None:
        """Settle samples, by default those that no older ones can come before any more."""
        self._settled += self._settle(until_ns)
        del self._settled[:-100_000]    # without odometry the oldest are dropped

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the samples that rates from a stamp [ns] on do not need."""
        n = bisect.bisect_right(self._settled, stamp_ns, key=stamp_of) - 1
        del self._settled[:max(n, 0)]

    def integral(self, start_ns: int, end_ns: int, *, ahead: bool = False) -> RateIntegral | None:
        """
        Return the integral of the rate; None if samples do not cover the time without a gap.

        Where samples are still to come, the newest rate is taken to last until the end.
        """
        every = self._settled + self._waiting
        begin = bisect.bisect_right(every, start_ns, key=stamp_of) - 1
        if begin < 0:
            return None
        samples = every[begin:bisect.bisect_left(every, end_ns, key=stamp_of) + 1]
        if ahead and samples[-1].stamp_ns < end_ns:
            samples.append(replace(samples[-1], stamp_ns=end_ns))
        stamps_ns = np.array([each.stamp_ns for each in samples], dtype=np.int64)
        if (len(stamps_ns) < 2 or stamps_ns[-1] < end_ns
                or np.max(np.diff(stamps_ns)) > round(self._source.maximum_gap * 1e9)):
            return None
        rates = np.array([(each.rate, each.variance) for each in samples])
        return RateIntegral(stamps_ns, rates, self._source)

    def saved(self) -> SavedGyro:
        """Return the state."""
        return SavedGyro((*self._settled, *self._waiting), self.next_node)

    def restore(self, saved: SavedGyro) -> None:
        """Fill this empty stream with what was saved."""
        self._waiting, self.next_node = [*saved.rates], saved.next_node
        self.settle()


class Gyros:
    """
    Makes a rotation per gyroscope between each two consecutive hidden nodes that it covers.

    Rates are integrated over gaps no longer than a limit; a longer one leaves the rotation out.
    While the wheels stand, the robot does not turn but for what the wheels say: the rotation has
    no part of that, and the mean rate measures the bias instead.
    """

    def __init__(self, nodes: hidden_nodes.HiddenNodes, config: BackendConfig,
                 counts: Counter[tuple[str, str]]) -> None:
        self._nodes, self._config = nodes, config
        self.streams: dict[str, GyroStream] = {}  # by the name of the source
        # among them numbers of rotations by source: 'rotations' that were made, those that a 'gap'
        # in the rates has left out, and those 'before_window', whose nodes have left the graph
        self._counts = counts

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for rotations that are made from now on."""
        self._config = config
        for name, stream in self.streams.items():
            stream.configure(config.gyro(name))

    def finish(self) -> None:
        """Settle all samples."""
        for stream in self.streams.values():
            stream.settle(stream.newest_ns)

    def extend(self) -> list[Queued]:
        """Return the rotations up to the newest node that settled rates have reached."""
        made: list[Queued] = []
        for source, stream in self.streams.items():
            stamps_ns = self._nodes.stamps_ns
            end = int(np.searchsorted(stamps_ns, stream.settled_ns, side='right'))
            if stream.next_node >= end:
                continue
            # before the first sample there is nothing to integrate
            begin = max(stream.next_node, int(np.searchsorted(stamps_ns, stream.first_ns)))
            for node in range(begin, end):
                made += self._extend(source, stream, node)
            stream.next_node = max(begin, end)
            stream.forget_before(int(stamps_ns[stream.next_node - 1]))
        return made

    def _extend(self, source: str, stream: GyroStream, node: int) -> list[Queued]:
        """Return the rotation to a node, given by its number."""
        nodes = self._nodes
        start_ns, end_ns = nodes.stamps_ns[node - 1:node + 1].tolist()
        # closer nodes have no rotation between them: a robot was put elsewhere
        if end_ns - start_ns < 1_000_000 or node in nodes.relocated:
            return []
        integral = stream.integral(start_ns, end_ns)
        if integral is None:
            if stream.first_ns <= start_ns:
                self._counts[source, 'gap'] += 1
            return []
        if nodes.has_left(node - 1) or nodes.has_left(node):
            self._counts[source, 'before_window'] += 1
            return []
        self._counts[source, 'rotations'] += 1
        angle, variance, seconds = integral.between(start_ns, end_ns)
        primary = nodes.primary_at(end_ns)
        odometry = nodes.streams[primary]
        if odometry.timeline.covers(start_ns) and odometry.timeline.covers(end_ns):
            motion = odometry.timeline.motion(start_ns, end_ns)
            stream.agreement.add(float(se2.wrap(angle - motion.increment[2])),
                                 seconds, integral.rate(end_ns) - integral.rate(start_ns), angle,
                                 variance + float(odometry.covariance(motion)[2, 2]))
        # by rates at rest, and by the wheels meanwhile
        rest, creep = np.zeros(3), np.zeros(2)
        most = MOST_BIAS * self._config.gyro(source).sigma_bias
        floor = self._config.odometry_source(primary).noise.sigma_floor_heading
        for first_ns, last_ns in odometry.timeline.rests(start_ns, end_ns):
            begin_ns, until_ns = first_ns + STOPPING_NS, last_ns - STARTING_NS
            if until_ns - begin_ns < timeline.STANDING_NS:
                continue
            part = integral.between(begin_ns, until_ns)
            if abs(part.angle) <= most * part.seconds:
                wheels = odometry.timeline.motion(begin_ns, until_ns).increment[2]
                rest, creep = rest + part, creep + np.array((wheels, floor**2))
        at_rest = float(rest[2])
        return turn(
            source, nodes.ids[node - 1:node + 1].tolist(), (start_ns + end_ns) // 2,
            (angle - rest[0] + creep[0], variance - rest[1] + creep[1], seconds - at_rest),
            (0.0, 0.0) if at_rest == 0.0 else (
                (rest[0] - creep[0]) / at_rest, (rest[1] + creep[1]) / at_rest**2))

    def stream(self, source: str) -> GyroStream:
        """Return the stream of a gyroscope, a new one if there was none."""
        if source not in self.streams:
            self.streams[source] = GyroStream(self._config.gyro(source))
        return self.streams[source]

    def differences(self) -> dict[str, Difference]:
        """Return how much each gyroscope differs from odometry, where enough is known."""
        found = {source: each.agreement.difference() for source, each in self.streams.items()}
        return {source: each for source, each in found.items() if each is not None}

    def newest(self, start_ns: int, end_ns: int,
               biases: Mapping[str, float]) -> tuple[float, float] | None:
        """
        Return the rotation of the robot between two recent stamps, and its variance.

        It is that of the first source that has one, among those with a bias [rad/s].
        """
        for source, bias in biases.items() if start_ns < end_ns else ():
            stream = self.streams.get(source)
            integral = None if stream is None else stream.integral(start_ns, end_ns, ahead=True)
            if integral is not None:
                angle, variance, seconds = integral.between(start_ns, end_ns)
                return angle - bias * seconds, variance
        return None
