# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Prediction of the pose at the newest odometry from the newest estimate, without the solver.

It runs for each odometry message, up to a thousand times per second, and therefore uses plain
numbers. `odometry_covariance` and `covariance.propagated` compute the same with matrices.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.scalar_se2 import between_one, compose_one
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.motion import step_variance
from pose_graph_ros.core.odometry.timeline import JITTER_DISTANCE, JITTER_HEADING


class Prediction(NamedTuple):
    """Predicted pose and covariance of the robot."""

    T_map_base: FloatArray
    """Shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """In map axes, shape (3, 3)."""


def predict(estimate: Estimate, sample: OdometrySample) -> Prediction:
    """
    Return the estimate propagated to odometry shortly after or before it.

    The path in between is assumed to be straight, and the twist to be uncertain as in the sample;
    it is short because each update makes a new estimate.
    """
    x, y, theta = between_one(estimate.T_odom_base.tolist(), sample.pose.tolist())
    begin = estimate.T_map_base.tolist()
    # noise of the odometry in between, along (a) and across (b) the robot's final heading
    odometry, twist, errors = estimate.odometry, sample.twist_variance, estimate.odometry_errors
    since = (sample.stamp_ns - estimate.stamp_ns) * 1e-9
    step, elapsed = (math.hypot(x, y), abs(theta)), abs(since)
    if step[0] < JITTER_DISTANCE and step[1] < JITTER_HEADING:
        elapsed = 0.0   # at rest the twist adds nothing
    along, across, heading = step_variance(
        odometry, None if twist is None else tuple(twist.tolist()), step, elapsed)
    factor = odometry.covariance_scale
    claimed = factor * min(heading, UNKNOWN_HEADING_VARIANCE)
    c, s = math.cos(theta), math.sin(theta)
    sweep_a, sweep_b = s * x - c * y, c * x + s * y
    # of q / 3 the part q / 4 is what the heading at the end tells
    q, by_sweep = errors.turn * claimed, (errors.turn / 4.0 + errors.way / 12.0) * claimed
    aa = by_sweep * sweep_a * sweep_a + errors.way * factor * along
    ab = by_sweep * sweep_a * sweep_b
    bb = by_sweep * sweep_b * sweep_b + errors.way * factor * across
    if errors.rate != 0.0 or errors.scale != 0.0:
        c, s = math.cos(0.5 * errors.rate * since), math.sin(0.5 * errors.rate * since)
        x, y, theta = ((1.0 + errors.scale) * (c * x - s * y),
                       (1.0 + errors.scale) * (s * x + c * y), theta + errors.rate * since)
    end = compose_one(begin, (x, y, theta))
    # the same in map axes
    c, s = math.cos(end[2]), math.sin(end[2])
    sweep_x, sweep_y = c * sweep_a - s * sweep_b, s * sweep_a + c * sweep_b
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = estimate.covariance.tolist()
    # an error of the initial heading rotates the increment
    dx, dy = begin[1] - end[1], end[0] - begin[0]
    xx += (2.0 * xt + dx * tt) * dx + c * c * aa - 2.0 * c * s * ab + s * s * bb
    xy += dx * yt + dy * xt + dx * dy * tt + c * s * (aa - bb) + (c * c - s * s) * ab
    yy += (2.0 * yt + dy * tt) * dy + s * s * aa + 2.0 * c * s * ab + c * c * bb
    xt += dx * tt + 0.5 * q * sweep_x
    yt += dy * tt + 0.5 * q * sweep_y
    tt += q
    return Prediction(np.array(end), np.array(((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))))
