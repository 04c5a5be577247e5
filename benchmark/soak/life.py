# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a robot in a yard hears from its sensors in a month of days, made piece by piece from a seed.

It works so many hours a day, round and round a course, and rests half of the time. Each morning
odometry begins somewhere else. Fixes fail now and then, some closures are wrong, and some lead to
a place that has left the window long ago.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmark.course import Course, SECOND
from pose_graph_ros.adapters.conversions import Datum
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import composed, FloatArray, IntArray
from pose_graph_ros.core.measurements import Fix, LoopClosure, Measurement, OdometrySample
from pose_graph_ros.offline.simulation.sensors import model_variances

START_NS, DAY_NS = 1_700_000_000 * SECOND, 24 * 3600 * SECOND
PIECE = 600     # length of what is made at once, of which a day has a whole number [s]
RATE = 20       # of odometry [Hz]
PERIOD, MOVES = 300, 150    # the robot drives in the first part of each period [s]
COURSE = Course(0.0, length=200.0)  # of which only the truth is used
FIX_SIGMA = 1.0     # of fixes at 1 Hz [m]
OUTAGE_EVERY, OUTAGE = 3600, 300    # how often fixes fail, and for how long [s]
CLOSURE_EVERY = 10  # between two closures while the robot moves [s]
CLOSURE_SIGMA = np.array((0.1, 0.1, 0.02))
# One closure of so many is wrong, by so much [m], and one leads so far back [m].
WRONG, WRONG_BY, OLD, OLD_BY = 50, 5.0, 20, 7200.0
# One fix of so many comes twice, and one sample is followed by one that is NaN.
TWICE, NO_NUMBER = 601, 9773
EXPECTED = {'odom not_finite', 'fix duplicate_stamp', 'loop_closure before_window'}
"""Sources and reasons of all that is to be refused."""
Event = tuple[str, OdometrySample | Measurement]
"""A source, and what it says."""


@dataclass(frozen=True, slots=True)
class Piece:
    """What comes in `PIECE` seconds."""

    begins: bool    # whether a day begins with it
    events: list[Event]


@dataclass(frozen=True, slots=True)
class Life:
    """A robot's life; times are those at work so far [s]."""

    days: int
    hours: float    # of work in a day
    datum: Datum
    seed: int = 0

    @property
    def pieces_of_a_day(self) -> int:
        """Number of pieces of a day."""
        return max(round(self.hours * 3600 / PIECE), 1)

    def truth_at(self, stamps_ns: IntArray) -> FloatArray:
        """Return the true poses at some stamps, shape (N, 3)."""
        days, rest = np.divmod(stamps_ns - START_NS, DAY_NS)
        work = PIECE * self.pieces_of_a_day
        return _truth(days * work + np.minimum(rest / SECOND, work))

    def pieces(self) -> Iterator[Piece]:
        """Yield the life piece by piece."""
        rng, n = np.random.default_rng(self.seed), self.pieces_of_a_day
        last, before = np.zeros(3), _truth(np.zeros(1))
        for k in range(self.days * n):
            if k % n == 0:
                last = np.array((*rng.uniform(-10.0, 10.0, 2), rng.uniform(-np.pi, np.pi)))
            times = k * PIECE + np.arange(PIECE * RATE) / RATE
            truth = _truth(times)
            moves = se2.between(np.concatenate((before, truth[:-1])), truth)
            noise = np.sqrt(model_variances(moves)) * rng.standard_normal(moves.shape)
            poses = composed(last, se2.compose(moves, noise))[1:]
            last, before = poses[-1], truth[-1:]
            events = self._odometry(times, poses) + self._fixes(rng, times[::RATE])
            events += self._closures(rng, times[::RATE * CLOSURE_EVERY])
            yield Piece(k % n == 0, sorted(events, key=lambda event: event[1].stamp_ns))

    def _stamps(self, times: FloatArray) -> IntArray:
        days, rest = np.divmod(times, PIECE * self.pieces_of_a_day)
        return START_NS + days.astype(np.int64) * DAY_NS + np.round(rest * SECOND).astype(np.int64)

    def _odometry(self, times: FloatArray, poses: FloatArray) -> list[Event]:
        speeds = np.where(times % PERIOD < MOVES, COURSE.speed, 0.0).tolist()
        stamps = self._stamps(times).tolist()
        nothing = np.full(3, np.nan)
        return [('odom', OdometrySample(stamp, pose, speed)) for stamp, pose, speed in zip(
            stamps, poses, speeds, strict=True)] + [
                ('odom', OdometrySample(stamp + 1, nothing))
                for stamp in stamps[NO_NUMBER::NO_NUMBER]]

    def _fixes(self, rng: np.random.Generator, times: FloatArray) -> list[Event]:
        times = times[times % OUTAGE_EVERY < OUTAGE_EVERY - OUTAGE]
        if len(times) == 0:
            return []
        places = _truth(times)[:, :2] + FIX_SIGMA * rng.standard_normal((len(times), 2))
        known, arm = FIX_SIGMA**2 * np.eye(2), np.zeros(2)
        latitudes, longitudes, altitudes = self.datum.geodetic(places).T.tolist()
        events: list[Event] = [('fix', Fix(stamp, where, self.datum.place, known, arm))
                               for stamp, *where in zip(
            self._stamps(times).tolist(), latitudes, longitudes, altitudes, strict=True)]
        return events + [event for event, time in zip(events, times.tolist(), strict=True)
                         if round(time) % TWICE == 0]

    def _closures(self, rng: np.random.Generator, times: FloatArray) -> list[Event]:
        numbers = np.round(times / CLOSURE_EVERY).astype(np.int64)
        back = np.where(numbers % OLD == 1, OLD_BY, COURSE.length)
        ways = _way(times) - back + rng.uniform(-1.0, 1.0, len(times))
        # only while the robot moves, and only to where it has been
        chosen = (times % PERIOD < MOVES) & (ways > 0.0)
        times, ways, numbers = times[chosen], ways[chosen], numbers[chosen]
        laps, rest = np.divmod(ways, MOVES * COURSE.speed)
        earlier = laps * PERIOD + rest / COURSE.speed
        true = se2.between(_truth(earlier), _truth(times))
        poses = se2.compose(true, CLOSURE_SIGMA * rng.standard_normal(true.shape))
        poses[numbers % WRONG == 2, 0] += WRONG_BY
        known = np.diag(np.square(CLOSURE_SIGMA))
        return [('loop_closure', LoopClosure(stamp, pose, known, reference_ns=old))
                for stamp, old, pose in zip(self._stamps(times).tolist(),
                                            self._stamps(earlier).tolist(), poses, strict=True)]


def _way(times: FloatArray) -> FloatArray:
    """Return how far the robot has driven [m]."""
    periods, rest = np.divmod(times, PERIOD)
    return COURSE.speed * (MOVES * periods + np.minimum(rest, MOVES))


def _truth(times: FloatArray) -> FloatArray:
    return COURSE.truth(_way(times) / COURSE.speed)
