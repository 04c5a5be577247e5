# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive whose errors are just what their covariances claim, unless it is told otherwise."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import LoopClosure, Measurement, OdometrySample, Position

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
SPEED, PERIOD = 2.0, 0.1
CLOSURE_SIGMAS = np.array((0.1, 0.1, 0.02))


@dataclass
class HonestDrive:
    """
    Laps of a figure of eight with odometry at 10 Hz, positions at 1 Hz and loop closures.

    Numbers `times` are ratios of true to claimed sigmas.
    """

    seed: int
    seconds: float = 400.0
    sigma: float = 0.5
    """Claimed by the fixes [m]."""
    times: float = 1.0
    odometry_times: float = 1.0
    closure_times: float = 1.0
    tau: float = 0.0
    """Correlation time of the errors of fixes [s]."""
    outage: tuple[float, float] = (0.0, 0.0)
    closures: int = 30
    false_closures: int = 0
    fixes: bool = True
    fix_period: float = 1.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        n = round(self.seconds / PERIOD) + 1
        t = np.arange(n) * PERIOD
        rate = 0.15 * np.sign(np.sin(2.0 * np.pi * t / (4.0 * np.pi / 0.15)))
        steps = np.column_stack((np.full(n - 1, SPEED * PERIOD), np.zeros(n - 1),
                                 rate[1:] * PERIOD))
        self.truth = Trajectory(START_NS + np.round(t * SECOND).astype(np.int64),
                                _composed(np.array((3.0, -2.0, 0.7)), steps))
        noise, distance = OdometryNoise(), SPEED * PERIOD
        sigmas = self.odometry_times * np.array((
            noise.sigma_distance * np.sqrt(distance), noise.sigma_lateral * np.sqrt(distance),
            np.sqrt(noise.sigma_heading_distance**2 * distance
                    + noise.sigma_heading_turn**2 * 0.15 * PERIOD)))
        self.odometry = Trajectory(
            self.truth.stamps_ns, _composed(np.zeros(3), steps + sigmas * rng.normal(
                size=steps.shape)))
        self.fix_at = np.arange(5, n, round(self.fix_period / PERIOD))
        self.fix_at = self.fix_at[(t[self.fix_at] < self.outage[0])
                                  | (t[self.fix_at] > self.outage[1])]
        errors = rng.normal(size=(len(self.fix_at), 2))
        if self.tau > 0.0:
            phi = np.exp(-np.diff(t[self.fix_at]) / self.tau)
            for k in range(1, len(errors)):
                errors[k] = phi[k - 1] * errors[k - 1] + np.sqrt(1.0 - phi[k - 1]**2) * errors[k]
        self.positions = (self.truth.poses[self.fix_at, :2] + self.times * self.sigma * errors)
        later = np.sort(rng.choice(np.arange(n // 2, n), self.closures, replace=False))
        lap = round(2.0 * (2.0 * np.pi / 0.15) / PERIOD)
        self.closure_at = np.column_stack((np.maximum(later - lap, 3), later))
        exact = se2.between(*(self.truth.poses[self.closure_at[:, k]] for k in (0, 1)))
        # errors are in the axes of the reference
        self.relative = exact + self.closure_times * CLOSURE_SIGMAS * rng.normal(size=exact.shape)
        self.is_false = np.zeros(self.closures, dtype=bool)
        self.is_false[rng.permutation(self.closures)[:self.false_closures]] = True
        self.relative[self.is_false, :2] += rng.choice((-1.0, 1.0), (self.false_closures, 2)) * (
            rng.uniform(8.0, 20.0, (self.false_closures, 2)))

    def measurements(self) -> Iterator[tuple[str, OdometrySample | Measurement]]:
        """Yield sources and measurements in the order of their stamps."""
        every: list[tuple[int, int, str, OdometrySample | Measurement]] = []
        for stamp, pose in zip(self.odometry.stamps_ns.tolist(), self.odometry.poses, strict=True):
            every.append((stamp, 0, 'odom', OdometrySample(stamp, pose)))
        stamps = self.truth.stamps_ns
        for at, position in zip(self.fix_at, self.positions, strict=True):
            if self.fixes:
                every.append((int(stamps[at]), 1, 'global_pose', Position(
                    int(stamps[at]), position, self.sigma**2 * np.eye(2), np.zeros(2))))
        for (i, j), pose in zip(self.closure_at, self.relative, strict=True):
            every.append((int(stamps[j]), 2, 'loop_closure', LoopClosure(
                int(stamps[j]), pose, np.diag(CLOSURE_SIGMAS**2), int(stamps[i]))))
        every.sort(key=lambda each: each[:2])
        for _, _, source, measurement in every:
            yield source, measurement


def _composed(first: np.ndarray, steps: np.ndarray) -> np.ndarray:
    poses = [first]
    for step in steps:
        poses.append(se2.compose(poses[-1], step))
    return np.array(poses)
