# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The motion between two instants by odometry, and its covariance."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import NoiseFrom, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import FloatArray

# Largest variance of a twist that is used; those beyond, and zero, stand for unknown
# [m^2/s^2, rad^2/s^2].
LARGEST_TWIST_VARIANCE = 1e4
Variances = tuple[float, float, float]
"""Of (x, y, theta) [m^2, m^2, rad^2], or of a twist."""
NO_VARIANCE: FloatArray = np.zeros(3)
NO_VARIANCE.flags.writeable = False


class Motion(NamedTuple):
    """Motion between two instants."""

    increment: FloatArray
    """Pose at the later instant seen from the earlier one, shape (3,) [m, m, rad]."""
    distance: float
    """Length of the path in between [m]."""
    turn: float
    """Sum of the absolute turns in between [rad]."""
    variance: FloatArray = NO_VARIANCE
    """
    Variance of (x, y, theta) in addition to the noise by path and turns, shape (3,): noise by the
    twist, jumps, interpolation [m^2, m^2, rad^2].
    """


NO_MOTION = Motion(np.zeros(3), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Attachment:
    """An instant, given by the last hidden node before it and the motion since."""

    node: int
    """Id of the node in the graph."""
    motion: FloatArray
    """`T_at`, pose at the instant in the frame of the node, shape (3,) [m, m, rad]."""
    noise: FloatArray
    """Covariance of the motion in the frame at the instant, shape (3, 3)."""


def step_variance(
    source: OdometrySource, twist: Variances | None, step: tuple[float, float], elapsed: float,
) -> Variances:
    """
    Return the variance of (x, y, theta) of a short motion in the robot's frame, but its scale.

    Parameters
    ----------
    twist : tuple, optional, variance of the twist in its message; None if it has none
    step : tuple, length and absolute turn of the motion [m, rad]
    elapsed : float, time of the motion [s]

    """
    noise = source.noise
    by_model = (noise.sigma_distance**2 * step[0], noise.sigma_lateral**2 * step[0],
                noise.sigma_heading_distance**2 * step[0] + noise.sigma_heading_turn**2 * step[1])
    if source.noise_from is not NoiseFrom.TWIST or twist is None:
        return by_model
    x, y, theta = (
        variance * elapsed if 0.0 < variance <= LARGEST_TWIST_VARIANCE else instead
        for variance, instead in zip(twist, by_model, strict=True))
    return x, y, theta


def odometry_covariance(
    noise: OdometryNoise, motion: Motion, *, floor: bool = True,
) -> FloatArray:
    """
    Return the covariance, shape (3, 3), of a motion by odometry in the frame at its end.

    The heading is a random walk along the path, and an error of the heading turns the rest of the
    path. With c the chord in the frame at the end, n = c turned by 90 degrees, and q the variance
    of the heading, this adds q n n^T / 3 to the covariance of the position and gives it the
    covariance q n / 2 with the heading.

    Parameters
    ----------
    noise : OdometryNoise, noise per path length and turn; it is added to `motion.variance`
    floor : bool, whether to add the floors of the noise, which every increment has once

    """
    increment, distance, turn, variance = motion
    # the variance of a heading is at most that of the uniform distribution
    q = min(noise.sigma_heading_distance**2 * distance + noise.sigma_heading_turn**2 * turn
            + float(variance[2]), UNKNOWN_HEADING_VARIANCE)
    c, s = np.cos(increment[2]), np.sin(increment[2])
    chord_x, chord_y = c * increment[0] + s * increment[1], c * increment[1] - s * increment[0]
    sweep = np.array([-chord_y, chord_x])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = q / 3.0 * np.outer(sweep, sweep)
    covariance[0, 0] += noise.sigma_distance**2 * distance + variance[0]
    covariance[1, 1] += noise.sigma_lateral**2 * distance + variance[1]
    covariance[:2, 2] = covariance[2, :2] = q / 2.0 * sweep
    covariance[2, 2] = q
    if floor:
        covariance[0, 0] += noise.sigma_floor_position**2
        covariance[1, 1] += noise.sigma_floor_position**2
        covariance[2, 2] += noise.sigma_floor_heading**2
    return covariance
