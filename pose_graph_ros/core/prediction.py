# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the newest estimate to the newest odometry: one composition, no solver."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance, se2
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.motion import Motion
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
    increment = se2.between(estimate.T_odom_base, T_odom_base)
    motion = Motion(
        increment, float(np.hypot(increment[0], increment[1])), abs(float(increment[2])))
    added = covariance.odometry_covariance(estimate.noise, motion, floor=False)
    return Prediction(
        se2.compose(estimate.T_map_base, increment),
        covariance.propagated(estimate.T_map_base, estimate.covariance, increment, added))
