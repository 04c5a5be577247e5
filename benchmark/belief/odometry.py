# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives with clean fixes: simulated ones with four kinds of odometry, and recorded ones."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from benchmark.belief.engine import at_end, config
from benchmark.drives import Drive, plaza, SECOND, stamped, with_fixes
from pose_graph_ros.core.config import MeasurementSource, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import composed
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation.recording import course
from pose_graph_ros.offline.simulation.sensors import model_variances
from pose_graph_ros.offline.simulation.worlds import WORLDS

DURATION_S = 600
RATE = 10
"""Of simulated odometry [Hz]. Its noise is drawn once in a second, see `sensors.CELL_S`."""
FLOORS = 1e-4, 1e-5
"""Of true noise, in every increment [m, rad]: simulated odometry has none."""
HUSKY = 'robot/husky_test1_csv'


@dataclass(frozen=True, slots=True)
class Kind:
    """True errors of a simulated odometry."""

    noise: OdometryNoise
    yaw_rate: float = 0.0
    """Constant error of the yaw rate [rad/s]."""
    scale: float = 0.0
    """Constant error of the distance, as a part of it."""

    def settings(self) -> OdometrySource:
        """Return the settings of an engine that knows how large these errors are."""
        return OdometrySource(
            noise=self.noise, sigma_scale=1.0, calibrate=self.yaw_rate > 0.0,
            calibration_sigma=(self.yaw_rate or 1.0, self.scale or 1.0),
            calibration_walk=(1e-6, 1e-6))

    def drive(self, seed: int) -> Drive:
        """Simulate a drive through a grid of streets, from an unknown heading."""
        motion = course(WORLDS['grid'], seed, float(DURATION_S)).motion.truth
        stamps = motion.stamps_ns[0] + SECOND // RATE * np.arange(
            1 + RATE * int((motion.stamps_ns[-1] - motion.stamps_ns[0]) // SECOND))
        true = motion.at(stamps)
        steps = se2.between(true[:-1], true[1:])
        rng = np.random.default_rng((seed, 1))
        variances = model_variances(steps, self.noise).reshape(-1, RATE, 3)
        of_second = np.maximum(variances.sum(axis=1, keepdims=True), 1e-18)
        drawn = rng.standard_normal(of_second.shape) / np.sqrt(of_second)
        steps[:, :2] *= 1.0 + self.scale
        steps[:, 2] += self.yaw_rate / RATE
        steps += (variances * drawn).reshape(-1, 3)
        start = np.array((5.0, -3.0, rng.uniform(-np.pi, np.pi)))
        return with_fixes(Trajectory(stamps, composed(start, steps)), motion, seed)


def _noise(*sigmas: float) -> OdometryNoise:
    return OdometryNoise(*sigmas, *FLOORS)


KINDS = {
    'good': Kind(_noise(0.01, 0.003, 0.0005, 0.002)),
    'normal': Kind(_noise(0.05, 0.015, 0.003, 0.02)),
    'bad': Kind(_noise(0.15, 0.045, 0.012, 0.06)),
    'constant': Kind(_noise(0.04, 0.012, 0.003, 0.02), yaw_rate=0.004, scale=0.015),
}
"""
Visual or laser odometry, wheels of a cart, poor ones, and wheels with constant errors.

The sigmas are along and across the way in 1 m, of the heading in 1 m and in a turn of 1 rad.
"""
RECORDED = {'plaza1': 'robot/plaza1', 'plaza2': 'robot/plaza2', 'husky': HUSKY}
"""Folders of recorded odometry."""


def drive(name: str, seed: int, data: Path) -> Drive:
    """Return a drive of a kind of odometry, or of a recorded one."""
    if name in KINDS:
        return KINDS[name].drive(seed)
    if name == 'husky':
        return with_fixes(*_husky(data), seed)
    return plaza(data, seed, RECORDED[name])


@cache
def _husky(data: Path) -> tuple[Trajectory, Trajectory]:
    """Return odometry, and in place of a truth the path by all recorded fixes."""
    (stamps, poses), (fix_stamps, fixes) = (
        stamped(data / HUSKY / name) for name in ('odom.csv', 'gps.csv'))
    odometry = Trajectory(stamps, poses[:, :3])
    recorded = Drive(odometry, odometry, fix_stamps, fixes[:, :2], sigma=float(fixes[0, 2]))
    return odometry, at_end(recorded, config(MeasurementSource()))
