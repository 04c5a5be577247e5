# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of planar poses: check, rotate, invert, propagate.

Covariances from outside are checked here before anything is built on them. A covariance of a pose
has the order (x, y, theta); docs/conventions.md says in which axes.
"""

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.motion import Motion
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import OdometryNoise

# A heading that is uniform on the circle has the variance pi^2 / 3; what claims to be less
# certain than a flat guess carries no heading at all.
UNKNOWN_HEADING_VARIANCE = np.pi**2 / 3.0
# Beyond this a position says nothing: larger than the Earth, squared [m^2].
LARGEST_VARIANCE = 1e15


def defect(covariance: FloatArray) -> str | None:
    """
    Say in one word what keeps a matrix, shape (d, d), from being a covariance; None if nothing.

    The words are reasons of rejections: `not_finite`, `not_positive`, `too_large`,
    `not_symmetric`, `not_positive_definite`.
    """
    if not np.all(np.isfinite(covariance)):
        return 'not_finite'
    diagonal = np.diagonal(covariance)
    if np.any(diagonal <= 0.0):
        return 'not_positive'
    if np.any(diagonal > LARGEST_VARIANCE):
        return 'too_large'
    deviation = np.sqrt(diagonal)
    with np.errstate(over='ignore'):
        correlation = covariance / deviation / deviation[:, None]
    # beyond 1 it is none; how far beyond does not matter, and might overflow
    correlation = np.clip(correlation, -2.0, 2.0)
    if np.any(np.abs(correlation - correlation.T) > 1e-6):
        return 'not_symmetric'
    if np.min(np.linalg.eigvalsh(correlation)) < 1e-9:
        return 'not_positive_definite'
    return None


def floored(covariance: FloatArray, floors: FloatArray) -> FloatArray:
    """
    Return the symmetric covariance with variances raised to the floors, shape (d,).

    What a variance lacks is added to the diagonal, which keeps the matrix positive definite.
    """
    covariance = 0.5 * (covariance + covariance.T)
    missing = np.maximum(floors - np.diagonal(covariance), 0.0)
    return covariance + np.diag(missing)


def turned(covariance: FloatArray, theta: float) -> FloatArray:
    """
    Express a covariance, shape (2, 2) or (3, 3), in axes turned by theta.

    With theta the heading of a measured pose it goes from the axes of the parent frame, where ROS
    has it, to the frame of the measured pose, where the errors (3.48) and (3.52) live (the other
    way around is footnote 4 of the source).
    """
    axes = np.eye(len(covariance))
    axes[:2, :2] = se2.rotation(theta)
    return axes.T @ covariance @ axes


def information(covariance: FloatArray) -> FloatArray:
    """Return the symmetric inverse of a covariance that `defect` has nothing against."""
    inverse = np.linalg.inv(covariance)
    return 0.5 * (inverse + inverse.T)


def odometry_covariance(
    noise: OdometryNoise, motion: Motion, *, floor: bool = True,
) -> FloatArray:
    """
    Return the covariance, shape (3, 3), of a motion by odometry in the frame at its end.

    The heading is a random walk along the path. An error of the heading turns what is still to
    come of the path: with c the chord in the frame at the end, n the same turned by 90 degrees
    and q the variance of the heading, the position varies by q n n^T / 3 and is correlated with
    the heading by q n / 2.

    Parameters
    ----------
    noise : OdometryNoise
        Grows with the path and the turns of the motion, beside what the motion itself brings.
    motion : Motion
    floor : bool
        Add the floors, which stand once in every increment.

    """
    increment, distance, turn, variance = motion
    # no heading is less certain than a flat guess
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


def propagated(
    pose: FloatArray, covariance: FloatArray, increment: FloatArray, noise: FloatArray,
) -> FloatArray:
    """
    Return the covariance of `compose(pose, increment)` in map axes, shape (3, 3).

    Parameters
    ----------
    pose : ndarray, shape (3,)
        T_map_a.
    covariance : ndarray, shape (3, 3)
        Of the pose, in map axes.
    increment : ndarray, shape (3,)
        T_a_b.
    noise : ndarray, shape (3, 3)
        Of the increment, in the frame at its end.

    """
    end = se2.compose(pose, increment)
    jacobian = np.eye(3)
    jacobian[0, 2] = -(end[1] - pose[1])
    jacobian[1, 2] = end[0] - pose[0]
    result = jacobian @ covariance @ jacobian.T + turned(noise, -float(end[2]))
    return 0.5 * (result + result.T)
