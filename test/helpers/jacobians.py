# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jacobians of the errors as the source prints them: a reference for the compiled factors."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.factors import errors


class EdgeLinearization(NamedTuple):
    """Errors, shape (M, 3), and their Jacobians by x_i, x_j and x_k, shape (M, 3, 3)."""

    error: FloatArray
    jacobian_i: FloatArray
    jacobian_j: FloatArray
    jacobian_k: FloatArray


class ObservedLinearization(NamedTuple):
    """Errors, shape (K, 3), and Jacobians A = de/dx_i, shape (K, 3, 3)."""

    error: FloatArray
    jacobian: FloatArray


def linearize_edges(poses: FloatArray, edges: Factors) -> EdgeLinearization:
    """
    Return the errors (3.48) of edges with their Jacobians (3.49) and (3.50).

    Parameters and frames are those of `errors`.
    """
    error = errors(poses, edges)
    start, end = poses[edges.i], poses[edges.j]
    # R_z^T R_i^T is the inverse rotation by the sum of both angles
    heading = start[:, 2] + edges.mean[:, 2]
    unrotation = np.swapaxes(se2.rotation(heading), 1, 2)
    difference = _unrotate(heading, end[:, :2] - start[:, :2])
    jacobian_j = np.zeros((len(edges), 3, 3))
    jacobian_j[:, :2, :2] = unrotation
    jacobian_j[:, 2, 2] = 1.0
    jacobian_i = -jacobian_j
    # d(R_i^T)/dth_i v is R_i^T v rotated by -90 degrees, and rotations commute
    jacobian_i[:, 0, 2] = difference[:, 1]
    jacobian_i[:, 1, 2] = -difference[:, 0]
    rows = np.flatnonzero(edges.kind == FactorKind.BIAS)
    if len(rows) > 0:
        jacobian_i[rows], jacobian_j[rows] = -np.eye(3), 0.0
        arm = _unrotate(-start[rows, 2], edges.constants[rows, :2])
        jacobian_i[rows, 0, 2], jacobian_i[rows, 1, 2] = arm[:, 1], -arm[:, 0]
        for k in range(3):
            jacobian_j[rows, k, k] = edges.constants[rows[:, None], [2, 2, 3]][:, k]
    own, jacobian_k = _unrotate(edges.mean[:, 2], edges.mean[:, :2]), np.zeros_like(jacobian_i)
    half = 0.5 * edges.constants[:, 3]
    jacobian_k[:, :, 0] = np.column_stack((-half * own[:, 1], half * own[:, 0], 2.0 * half))
    jacobian_k[:, :2, 1] = -own
    jacobian_k[edges.k < 0] = 0.0
    return EdgeLinearization(error, jacobian_i, jacobian_j, jacobian_k)


def linearize_observed(poses: FloatArray, observed: Factors) -> ObservedLinearization:
    """
    Return the errors (3.52) of observed nodes with their Jacobians (3.53).

    The offset adds the third column: the derivative of R_i t_o by the heading.
    """
    error = errors(poses, observed)
    heading, mean = poses[observed.i][:, 2], observed.mean
    jacobian = np.zeros((len(observed), 3, 3))
    jacobian[:, :2, :2] = np.swapaxes(se2.rotation(mean[:, 2]), 1, 2)
    arm = _unrotate(mean[:, 2] - heading, observed.offset[:, :2])
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arm[:, 1], arm[:, 0]
    jacobian[:, 2, 2] = 1.0
    return ObservedLinearization(error, jacobian)


def _unrotate(theta: FloatArray, vector: FloatArray) -> FloatArray:
    """Return R(theta)^T v for each row."""
    c, s = np.cos(theta), np.sin(theta)
    x, y = vector[:, 0], vector[:, 1]
    return np.column_stack((c * x + s * y, c * y - s * x))
