# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The pose of the odometry frame in the map, in closed form from positions.

Positions p_k in the odometry frame (where the antenna was) and q_k in the map are related by a
turn and a shift. With both centred on their weighted means, the turn that minimises
sum w_k |q_k - R p_k|^2 is atan2(sum w_k p_k x q_k, sum w_k p_k . q_k): the planar case of Horn
1987 and Umeyama 1991, without scale. Its variance is 1 / sum w_k |p_k|^2 for white noise of
variance 1 / w_k in the positions.
"""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.config import AlignmentPolicy
from pose_graph_ros.core.se2 import FloatArray

# Where the lengths of a motion differ by more than this factor, one of the two does not follow
# the robot (spinning wheels, a frozen receiver), and the angle between them means nothing.
LARGEST_SCALE = 2.0


@dataclass(frozen=True, slots=True)
class Alignment:
    """Pose of the odometry frame in the map, from positions."""

    T_map_odom: FloatArray
    """Shape (3,) [m, m, rad]."""
    sigma_heading: float
    """Standard deviation of the heading [rad]; infinite without a baseline."""
    baseline: float
    """Diagonal of the box around the positions in the odometry frame [m]."""
    sigma_position: float
    """Of a position, by the mean of their weights: a few poor ones do not raise it [m]."""
    scale: float
    """Length of a motion in the map over its length by odometry; 1 if both tell the same."""

    def certain(self, policy: AlignmentPolicy) -> bool:
        """Tell whether the heading is known well enough to turn the graph."""
        return (self.sigma_heading <= policy.sigma_heading
                and self.baseline >= policy.minimum_baseline
                and self.baseline >= policy.baseline_in_sigmas * self.sigma_position
                and 1.0 / LARGEST_SCALE <= self.scale <= LARGEST_SCALE)


def align(odometry: FloatArray, observed: FloatArray, variance: FloatArray) -> Alignment:
    """
    Fit the pose of the odometry frame in the map.

    Parameters
    ----------
    odometry, observed : ndarray, shape (K, 2)
        The same positions in the odometry frame and in the map [m]; K >= 1.
    variance : ndarray, shape (K,)
        Variance of a coordinate of each observed position [m^2].

    """
    weight = 1.0 / variance
    p_mean = np.average(odometry, axis=0, weights=weight)
    q_mean = np.average(observed, axis=0, weights=weight)
    p, q = odometry - p_mean, observed - q_mean
    cross = np.sum(weight * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    dot = np.sum(weight * np.sum(p * q, axis=1))
    theta = float(np.arctan2(cross, dot))
    spread = float(np.sum(weight * np.sum(p**2, axis=1)))
    shift = q_mean - se2.rotation(theta) @ p_mean
    return Alignment(
        T_map_odom=np.array([shift[0], shift[1], theta]),
        sigma_heading=1.0 / np.sqrt(spread) if spread > 0.0 else np.inf,
        baseline=float(np.hypot(*np.ptp(odometry, axis=0))),
        sigma_position=float(np.sqrt(1.0 / np.mean(weight))),
        scale=float(np.hypot(cross, dot)) / spread if spread > 0.0 else 0.0)
