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

The exact estimate of a drive knows all there is to know, and does without the engine: a Kalman
filter for the errors of the poses at all instants that matter, linear at the truth, with the
covariances by which the noise was drawn and each measurement at its own instant. Its NEES is one
in the mean over drives; over a few drives it is what their noise happens to make it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pose_graph_ros.core.config import ThinningConfig, WindowConfig, WindowPrior
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.measurements import (
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.offline.simulation.graph import composed
from pose_graph_ros.offline.simulation.motion import path_length
from pose_graph_ros.offline.simulation.sensors import model_variances

SECOND = 1_000_000_000
START_NS = 1_000 * SECOND
PIECE = 600.0
"""Length of what is made at once [s]."""
FIXES, CLOSURES = 'fix', 'loop_closure'
UNKNOWN = 1e4
"""Variance of a pose that nothing is known of [m^2, rad^2]."""
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


def exact_nees(course: Course, looks: IntArray) -> FloatArray:
    """
    Return the NEES of the newest pose, divided by 3, at some stamps, shape (L,).

    Without fixes the first pose is known, else nothing is known of it.

    Parameters
    ----------
    course : Course
    looks : ndarray of int64, shape (L,), ascending stamps of samples of odometry [ns]

    """
    pieces = list(course.pieces())
    time, measured = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 1))
    truth, others = course.truth(time), [each for piece in pieces for _, each in piece[2]]
    moves = se2.between(truth[:-1], truth[1:])
    noise = se2.between(moves, se2.between(measured[:-1], measured[1:]))
    variances = model_variances(moves)
    # a closure of these drives names its reference by stamp
    stamps = looks.tolist() + [each.reference_ns for each in others
                               if isinstance(each, LoopClosure)]
    at_sample: dict[int, list[LoopClosure | Position]] = {
        sample: [] for sample in _samples(course, stamps)}
    for each in others:
        assert isinstance(each, LoopClosure | Position)
        at_sample.setdefault(_samples(course, [each.stamp_ns])[0], []).append(each)
    wanted, found = {*_samples(course, looks.tolist())}, list[float]()
    # errors of all instants so far, each in the frame of its pose, and their covariance
    error, covariance = np.zeros(3), np.zeros((3, 3))
    if course.fix_period > 0.0:
        covariance += UNKNOWN * np.eye(3)
    columns, last = {0: slice(0, 3)}, 0
    for sample in sorted(at_sample):
        if sample >= len(time):
            break
        if sample > last:
            motion, offset, spread = np.eye(3), np.zeros(3), np.zeros((3, 3))
            for k in range(last, sample):
                step = se2.adjoint(se2.inverse(moves[k]))
                motion, offset = step @ motion, step @ offset + noise[k]
                spread = step @ spread @ step.T + np.diag(variances[k])
            across = motion @ covariance[-3:]
            covariance = np.block([[covariance, across.T],
                                   [across, across[:, -3:] @ motion.T + spread]])
            error = np.append(error, motion @ error[-3:] + offset)
            columns[sample], last = slice(len(error) - 3, len(error)), sample
        for each in at_sample[sample]:
            jacobian, residual, known = _linear(course, each, columns, len(error))
            gain = np.linalg.solve(
                jacobian @ covariance @ jacobian.T + known, jacobian @ covariance).T
            error = error + gain @ (residual - jacobian @ error)
            covariance = covariance - gain @ jacobian @ covariance
            covariance = 0.5 * (covariance + covariance.T)
        if sample in wanted:
            newest = error[-3:]
            found.append(float(newest @ np.linalg.solve(covariance[-3:, -3:], newest)) / 3.0)
    return np.array(found)


def _linear(
    course: Course, measurement: LoopClosure | Position, columns: dict[int, slice], size: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the Jacobian of a measurement by the errors of poses, its error and covariance."""
    new = _samples(course, [measurement.stamp_ns])[0]
    pose = _truth(course, measurement.stamp_ns)
    if isinstance(measurement, Position):
        jacobian = np.zeros((2, size))
        jacobian[:, columns[new]] = se2.rotation(pose[2]) @ np.eye(2, 3)
        return jacobian, measurement.position - pose[:2], measurement.covariance
    assert measurement.reference_ns is not None
    true = se2.between(_truth(course, measurement.reference_ns), pose)
    jacobian = np.zeros((3, size))
    jacobian[:, columns[new]] = np.eye(3)
    old = _samples(course, [measurement.reference_ns])[0]
    jacobian[:, columns[old]] = -se2.adjoint(se2.inverse(true))
    return jacobian, se2.between(true, measurement.pose), np.diag(np.square(course.closure_sigma))


def _truth(course: Course, stamp_ns: int) -> FloatArray:
    return course.truth(np.array([(stamp_ns - START_NS) / SECOND]))[0]


def _samples(course: Course, stamps_ns: list[int]) -> list[int]:
    """Return the numbers of the samples of odometry next to stamps [ns]."""
    return [round((stamp - START_NS) / SECOND * course.odometry_rate) for stamp in stamps_ns]
