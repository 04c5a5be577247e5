# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the newest estimate to the newest odometry: one composition, no solver.

Each message of odometry is answered by one, at up to a thousand a second, so all of it is plain
numbers; `covariance.odometry_covariance` and `covariance.propagated` say the same with matrices.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.motion import between_one, compose_one
from pose_graph_ros.core.se2 import FloatArray


class Prediction(NamedTuple):
    """Where the robot is."""

    T_map_base: FloatArray
    """Shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """In map axes, shape (3, 3)."""


def predict(estimate: Estimate, T_odom_base: FloatArray) -> Prediction:
    """
    Carry the estimate to an odometry pose, shape (3,), a little later or earlier.

    The path in between is taken as straight; it is short, as each update makes a new estimate.
    """
    x, y, theta = between_one(estimate.T_odom_base.tolist(), T_odom_base.tolist())
    begin = estimate.T_map_base.tolist()
    end = compose_one(begin, (x, y, theta))
    # what the odometry in between adds, along (a) and across (b) the robot at its end
    noise, distance = estimate.noise, math.hypot(x, y)
    q = min(noise.sigma_heading_distance**2 * distance + noise.sigma_heading_turn**2 * abs(theta),
            UNKNOWN_HEADING_VARIANCE)
    c, s = math.cos(theta), math.sin(theta)
    sweep_a, sweep_b = s * x - c * y, c * x + s * y
    aa = q / 3.0 * sweep_a * sweep_a + noise.sigma_distance**2 * distance
    ab = q / 3.0 * sweep_a * sweep_b
    bb = q / 3.0 * sweep_b * sweep_b + noise.sigma_lateral**2 * distance
    # the same in the axes of the map
    c, s = math.cos(end[2]), math.sin(end[2])
    sweep_x, sweep_y = c * sweep_a - s * sweep_b, s * sweep_a + c * sweep_b
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = estimate.covariance.tolist()
    # an error of the heading before turns the increment
    dx, dy = begin[1] - end[1], end[0] - begin[0]
    xx += (2.0 * xt + dx * tt) * dx + c * c * aa - 2.0 * c * s * ab + s * s * bb
    xy += dx * yt + dy * xt + dx * dy * tt + c * s * (aa - bb) + (c * c - s * s) * ab
    yy += (2.0 * yt + dy * tt) * dy + s * s * aa + 2.0 * c * s * ab + c * c * bb
    xt += dx * tt + 0.5 * q * sweep_x
    yt += dy * tt + 0.5 * q * sweep_y
    tt += q
    return Prediction(np.array(end), np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))))
