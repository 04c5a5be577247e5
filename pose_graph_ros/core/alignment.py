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
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.config import AlignmentPolicy
from pose_graph_ros.core.constraints import ObservedKind, ObservedNodes
from pose_graph_ros.core.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.linearize import observed_errors
from pose_graph_ros.core.se2 import FloatArray

# A global pose tells the angle at once if its heading is at least this certain [rad].
ALIGNING_SIGMA = 0.5

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


class Turn(NamedTuple):
    """What observed nodes tell of the pose of a graph in the map."""

    T_map_graph: FloatArray | None
    """Shape (3,) [m, m, rad]; None while the angle is not known well enough."""
    sigma: float
    """Standard deviation of the angle [rad]."""


def find_turn(poses: FloatArray, observed: ObservedNodes, policy: AlignmentPolicy) -> Turn:
    """
    Find the rigid motion that takes a graph into the map.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Of the hidden nodes, in a frame of the graph's own.
    observed : ObservedNodes
        Observed nodes on these hidden nodes; K >= 1.
    policy : AlignmentPolicy

    """
    predicted = se2.compose(poses[observed.node], observed.offset)
    sigma = np.full(len(observed), np.inf)
    full = observed.kind == ObservedKind.GLOBAL_POSE
    sigma[full] = np.sqrt(np.linalg.inv(observed.information[full])[:, 2, 2])
    best = int(np.argmin(sigma))
    if sigma[best] <= ALIGNING_SIGMA:
        return Turn(se2.compose(observed.mean[best], se2.inverse(predicted[best])),
                    float(sigma[best]))
    variance = 1.0 / (0.5 * np.trace(observed.information[:, :2, :2], axis1=1, axis2=2))
    found = align(predicted[:, :2], observed.mean[:, :2], variance)
    return Turn(found.T_map_odom if found.certain(policy) else None, found.sigma_heading)


class Guess(NamedTuple):
    """Where the robot is while the angle is not known."""

    shift: FloatArray
    """Of the graph into the map, shape (3,); the heading's is 0."""
    covariance: FloatArray
    """Of the robot's pose, shape (3, 3)."""


def guess(poses: FloatArray, newest: FloatArray, observed: ObservedNodes) -> Guess:
    """
    Say where the robot is while the angle is not known, and how little that is.

    The graph is shifted onto the most certain position. With d the distance from there and an
    angle that is uniform on the circle, the mean square error of each coordinate is d^2, that of
    the heading pi^2 / 3.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Of the hidden nodes, in a frame of the graph's own.
    newest : ndarray, shape (3,)
        Of the robot, in the same frame.
    observed : ObservedNodes
        Observed nodes on these hidden nodes; K >= 1.

    """
    certainty = np.trace(observed.information[:, :2, :2], axis1=1, axis2=2)
    best = int(np.argmax(certainty))
    first = observed.rows(slice(best, best + 1))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(first.mean[0, 2])
    shift = -(turn @ observed_errors(poses, first)[0])
    shift[2] = 0.0
    where = se2.compose(poses[first.node], first.offset)[0]
    variance = float(np.sum((newest[:2] - where[:2])**2) + 2.0 / certainty[best])
    return Guess(shift, np.diag((variance, variance, UNKNOWN_HEADING_VARIANCE)))
