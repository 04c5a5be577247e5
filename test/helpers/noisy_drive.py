# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive whose odometry and fixes have exactly the noise of the models of the engine."""

import math
from pathlib import Path

from bag_of_messages import write_bag
import numpy as np

from pose_graph_ros.cli.simulate import fix_messages, odometry_messages
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import OdometrySample, Position

HERTZ, SPEED = 5, 2.0


def made(
    seed: int, seconds: int, sigmas: tuple[float, ...] = (0.05, 0.03, 0.01, 0.05), *,
    white: float = 1.0, slow: float = 0.0, tau: float = 20.0, claimed: float = 1.0,
) -> tuple[list[OdometrySample], list[Position]]:
    """Return odometry with the noise of the model, and fixes once a second."""
    generator, n = np.random.default_rng(seed), seconds * HERTZ
    time, d = np.arange(n) / HERTZ, SPEED / HERTZ
    rate = 0.25 * np.sin(time / 6.0) + 0.2 * np.sign(np.sin(time / 15.0))
    normal = generator.normal(size=(n, 3))
    truth, odometry = [np.array([0.0, 0.0, 0.4])], [np.array([3.0, -2.0, 1.0])]
    for turn, error in zip(rate[1:] / HERTZ, normal[1:], strict=True):
        step = np.array([d, 0.0, turn])
        noise = error * np.sqrt([sigmas[0]**2 * d, sigmas[1]**2 * d,
                                 sigmas[2]**2 * d + sigmas[3]**2 * abs(turn)])
        truth.append(se2.compose(truth[-1], step))
        odometry.append(se2.compose(odometry[-1], step + noise))
    stamps = (10**15 + np.round(time * 1e9)).astype(np.int64)
    fade, errors = math.exp(-1.0 / tau), [generator.normal(size=2)]
    for _ in range(seconds - 1):
        errors.append(fade * errors[-1] + math.sqrt(1.0 - fade**2) * generator.normal(size=2))
    fixes = [Position(int(stamps[k]), truth[k][:2] + slow * error + white * generator.normal(
        size=2), claimed**2 * np.eye(2), np.zeros(2))
        for k, error in zip(range(2, n, HERTZ), errors, strict=True)]
    return [OdometrySample(int(stamp), pose)
            for stamp, pose in zip(stamps, odometry, strict=True)], fixes


def write(
    folder: Path, odometry: list[OdometrySample], fixes: list[Position], claimed: float,
) -> Path:
    """Return a bag with `/odom` and `/fix`, which claims a sigma for these [m]."""
    path = Trajectory(np.array([each.stamp_ns for each in odometry]),
                      np.array([each.pose for each in odometry]))
    geodetic = TangentPlane(50.7, 7.1, 60.0).to_geodetic(
        np.array([each.position for each in fixes]), 60.0)
    write_bag(folder, (
        *odometry_messages('/odom', 'odom', path, (0.0,) * 6),
        *fix_messages('/fix', np.array([each.stamp_ns for each in fixes]), geodetic, claimed)))
    return folder
