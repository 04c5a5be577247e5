# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Drives of any length round and round a course, made piece by piece from a seed.

A day at 50 Hz is too long for `pose_graph_ros.offline.simulation`, which makes a drive at once.

The noise is what the engine is told: odometry has that of its default model, fixes and closures
have white errors with the covariances that come with them. But the engine sums up the turns that
odometry shows, whose noise lengthens the sum the more the shorter the steps are: at 1 m/s on a
course of 60 m or 120 m its variance of the heading is 2 % too small or 4 % too large at 10 Hz,
14 % or 29 % too large at 50 Hz. The truth goes along a closed course, each lap a little to one
side of the last.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pose_graph_ros.core.config import ThinningConfig, WindowConfig, WindowPrior
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import composed, FloatArray, IntArray
from pose_graph_ros.core.measurements import (
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.offline.simulation.sensors import model_variances
from pose_graph_ros.offline.simulation.worlds import path_length

SECOND = 1_000_000_000
START_NS = 1_000 * SECOND
PIECE = 600.0
"""Length of what is made at once [s]."""
FIXES, CLOSURES = 'fix', 'loop_closure'
FINE = 20_000
"""Points of the course between which is interpolated."""


@dataclass(frozen=True, slots=True)
class Course:
    """What is driven, and what the sensors say."""

    duration: float
    """[s]"""
    seed: int = 0
    speed: float = 1.0
    """[m/s]"""
    length: float = 120.0
    """Of the course [m]."""
    odometry_rate: float = 50.0
    """[Hz]"""
    fix_period: float = 0.2
    """[s]; 0: there are none."""
    fix_sigma: float = 1.0
    """Of a coordinate [m]."""
    closure_period: float = 10.0
    """[s]; 0: there are none."""
    closure_sigma: tuple[float, float, float] = (0.1, 0.1, 0.02)
    """[m, m, rad]"""
    laps_back: tuple[int, ...] = (1,)
    """Number of laps between the ends of a closure: one of these each, in turn."""
    aside: float = 0.3
    """Amplitude of the offset from the course [m]."""

    @property
    def lap(self) -> float:
        """Time of a lap [s]."""
        return self.length / self.speed

    def truth(self, time: FloatArray) -> FloatArray:
        """Return the true poses `T_map_base` at some times since the start [s], shape (N, 3)."""
        along, points = _course(self.length)
        lap, rest = np.divmod(self.speed * time, self.length)
        x, y = (np.interp(rest, along, points[:, axis]) for axis in (0, 1))
        heading = np.interp(rest, along, points[:, 2])
        turn = heading + 2.0 * np.pi * lap
        # slow, so that the robot still points along its path
        side = self.aside * np.sin(0.017 * time)
        return np.column_stack((x - side * np.sin(turn), y + side * np.cos(turn), se2.wrap(turn)))

    def truth_at(self, stamp_ns: int) -> FloatArray:
        """Return the true pose at a stamp, shape (3,)."""
        return self.truth(np.array([(stamp_ns - START_NS) / SECOND]))[0]

    def stamps(self, time: FloatArray) -> IntArray:
        """Return the stamps of times since the start [s], shape (N,) [ns]."""
        return START_NS + np.round(time * SECOND).astype(np.int64)

    def events(self) -> Iterator[tuple[str, OdometrySample | Measurement]]:
        """Yield the sources and what they say, by stamp; a closure comes before its odometry."""
        for times, poses, others in self.pieces():
            done = 0
            for stamp, pose in zip(self.stamps(times).tolist(), poses, strict=True):
                while done < len(others) and others[done][1].stamp_ns <= stamp:
                    yield others[done]
                    done += 1
                yield 'odom', OdometrySample(stamp, pose, self.speed)
            yield from others[done:]

    def pieces(self) -> Iterator[tuple[FloatArray, FloatArray, list[tuple[str, Measurement]]]]:
        """
        Yield the drive piece by piece.

        Each time the times of the samples of odometry since the start [s], shape (N,), their poses
        `T_odom_base`, shape (N, 3), and the other measurements with their sources, by stamp.
        """
        rng = np.random.default_rng(self.seed)
        step = 1.0 / self.odometry_rate
        last = np.array((5.0, -3.0, rng.uniform(-np.pi, np.pi)))
        n, count = round(self.duration / step), round(PIECE / step)
        before = self.truth(np.zeros(1))
        for begin in range(0, n, count):
            times = step * np.arange(begin, min(begin + count, n))
            truth = self.truth(times)
            moves = se2.between(np.concatenate((before, truth[:-1])), truth)
            noise = np.sqrt(model_variances(moves)) * rng.standard_normal(moves.shape)
            poses = composed(last, se2.compose(moves, noise))[1:]
            before, last = truth[-1:], poses[-1]
            yield times, poses, self._others(float(times[0]), float(times[-1]), rng)

    def _others(
        self, begin: float, end: float, rng: np.random.Generator,
    ) -> list[tuple[str, Measurement]]:
        """Return fixes and closures between two times."""
        found: list[tuple[str, Measurement]] = []
        if self.fix_period > 0.0:
            times = _every(self.fix_period, begin, end)
            places = self.truth(times)[:, :2] + self.fix_sigma * rng.standard_normal(
                (len(times), 2))
            known, arm = self.fix_sigma**2 * np.eye(2), np.zeros(2)
            found += [(FIXES, Position(stamp, place, known, arm)) for stamp, place in zip(
                self.stamps(times).tolist(), places, strict=True)]
        if self.closure_period > 0.0:
            times = _every(self.closure_period, begin, end)
            numbers = np.round(times / self.closure_period).astype(np.int64)
            # where it was so many laps before, within a second
            back = self.lap * np.array(self.laps_back)[numbers % len(self.laps_back)]
            earlier = times - back + rng.uniform(-1.0, 1.0, len(times))
            times, earlier = times[earlier > 0.0], earlier[earlier > 0.0]
            true = se2.between(self.truth(earlier), self.truth(times))
            poses = se2.compose(true, self.closure_sigma * rng.standard_normal(true.shape))
            # as the noise is drawn in the axes of the robot, its covariance is turned
            turns = se2.rotation(true[:, 2])
            for old, new, pose, turn in zip(self.stamps(earlier).tolist(),
                                            self.stamps(times).tolist(), poses, turns,
                                            strict=True):
                covariance = np.diag(np.square(self.closure_sigma))
                covariance[:2, :2] = turn @ covariance[:2, :2] @ turn.T
                found.append((CLOSURES, LoopClosure(new, pose, covariance, reference_ns=old)))
        return sorted(found, key=lambda item: item[1].stamp_ns)


def _every(period: float, begin: float, end: float) -> FloatArray:
    """Return the multiples of a period between two times."""
    first = max(int(np.ceil(begin / period)), 1)
    return period * np.arange(first, int(np.floor(end / period)) + 1)


@cache
def _course(length: float) -> tuple[FloatArray, FloatArray]:
    """Return path length along a closed course, shape (M,), and its poses, shape (M, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, FINE + 1)
    radius = 1.0 + 0.25 * np.cos(3.0 * angle) + 0.1 * np.sin(2.0 * angle)
    points = radius[:, None] * np.column_stack((1.4 * np.cos(angle), np.sin(angle)))
    along = path_length(points)
    points, along = points * (length / along[-1]), along * (length / along[-1])
    slope = np.gradient(points, along, axis=0)
    slope[0] = slope[-1] = 0.5 * (slope[0] + slope[-1])
    return along, np.column_stack((points, np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))))


WINDOWS: dict[str, dict[str, Any]] = {
    'unlimited': {},
    '90 s': {'window': WindowConfig(seconds=90)},
    '90 s sparse': {'window': WindowConfig(seconds=90, prior=WindowPrior.SPARSE)},
    '600 s': {'window': WindowConfig(seconds=600)},
    'thinning 2 m': {'thinning': ThinningConfig(cell=2.0)}}
"""Arguments of `BackendConfig` for a window, by name."""
