# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of constraints and their Jacobians.

Numbers in parentheses are equations of C. Merfels, "Sensor fusion for localization of automated
vehicles", section 3.4.6. Symbols: x_i = (t_i, th_i) a hidden node, z = (t_z, th_z) a measured
pose, R_i and R_z their rotations (3.47). A node is updated by adding dx in map axes, its theta
wrapped.

Edge from i to j: the prediction (3.46) is `h = (R_i^T (t_j - t_i), th_j - th_i)`, the error (3.48)

    e = (R_z^T (R_i^T (t_j - t_i) - t_z), wrap(th_j - th_i - th_z))

in the frame of the measured pose. Observed node with offset o = (t_o, th_o) from its hidden node i
(the identity gives (3.51) and (3.52) as they stand in the source):

    e = (R_z^T (t_i + R_i t_o - t_z), wrap(th_i + th_o - th_z))

Edge to a bias m_j, in map axes, with an offset t_o from node i and factors f_t, f_th of the bias:

    e = (f_t m_t + t_z - (t_i + R_i t_o), wrap(f_th m_th + th_z - th_i))

The energy of a constraint is `e^T information e`, without a factor 1/2; chi2 is their sum.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import se2
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedNodes
from pose_graph_ros.core.se2 import FloatArray, IntArray


class EdgeLinearization(NamedTuple):
    """Errors, shape (M, 3), and Jacobians A = de/dx_i and B = de/dx_j, shape (M, 3, 3)."""

    error: FloatArray
    jacobian_i: FloatArray
    jacobian_j: FloatArray


class ObservedLinearization(NamedTuple):
    """Errors, shape (K, 3), and Jacobians A = de/dx_i, shape (K, 3, 3)."""

    error: FloatArray
    jacobian: FloatArray


def edge_errors(poses: FloatArray, edges: Edges) -> FloatArray:
    """
    Evaluate the errors (3.48) of edges.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Hidden nodes in the map [m, m, rad].
    edges : Edges

    Returns
    -------
    ndarray, shape (M, 3)
        In the frames of the measured poses, those of edges to a bias in map axes [m, m, rad];
        theta in [-pi, pi).

    """
    start, end, mean = poses[edges.i], poses[edges.j], edges.mean
    moved = _unrotate(start[:, 2], end[:, :2] - start[:, :2])
    translation = _unrotate(mean[:, 2], moved - mean[:, :2])
    theta = se2.wrap(end[:, 2] - start[:, 2] - mean[:, 2])
    error = np.column_stack((translation, theta))
    rows = np.flatnonzero(edges.kind == EdgeKind.BIAS)
    if len(rows) > 0:
        error[rows] = _factors(edges, rows) * end[rows] + mean[rows] - start[rows]
        error[rows, :2] -= _arms(start, edges, rows)
        error[rows, 2] = se2.wrap(error[rows, 2])
    return error


def linearize_edges(poses: FloatArray, edges: Edges) -> EdgeLinearization:
    """
    Evaluate the errors (3.48) of edges with the Jacobians (3.49) and (3.50).

    Parameters and frames are those of `edge_errors`.
    """
    error = edge_errors(poses, edges)
    start, end = poses[edges.i], poses[edges.j]
    # R_z^T R_i^T is the inverse rotation by the sum of both angles
    heading = start[:, 2] + edges.mean[:, 2]
    unrotation = np.swapaxes(se2.rotation(heading), 1, 2)
    difference = _unrotate(heading, end[:, :2] - start[:, :2])
    jacobian_j = np.zeros((len(edges), 3, 3))
    jacobian_j[:, :2, :2] = unrotation
    jacobian_j[:, 2, 2] = 1.0
    jacobian_i = -jacobian_j
    # d(R_i^T)/dth_i v = (R_i^T v) turned by -90 degrees, and turns commute
    jacobian_i[:, 0, 2] = difference[:, 1]
    jacobian_i[:, 1, 2] = -difference[:, 0]
    rows = np.flatnonzero(edges.kind == EdgeKind.BIAS)
    if len(rows) > 0:
        jacobian_i[rows], jacobian_j[rows] = -np.eye(3), 0.0
        arm = _arms(start, edges, rows)
        jacobian_i[rows, 0, 2], jacobian_i[rows, 1, 2] = arm[:, 1], -arm[:, 0]
        for k in range(3):
            jacobian_j[rows, k, k] = _factors(edges, rows)[:, k]
    return EdgeLinearization(error, jacobian_i, jacobian_j)


def _factors(edges: Edges, rows: IntArray) -> FloatArray:
    """Return the diagonals of F of edges to a bias, shape (M, 3)."""
    return edges.bias[rows[:, None], [2, 2, 3]]


def _arms(start: FloatArray, edges: Edges, rows: IntArray) -> FloatArray:
    """Return the offsets of edges to a bias in map axes, shape (M, 2)."""
    return _unrotate(-start[rows, 2], edges.bias[rows, :2])


def observed_errors(poses: FloatArray, observed: ObservedNodes) -> FloatArray:
    """
    Evaluate the errors (3.52) of observed nodes, each through its offset.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)
        Hidden nodes in the map [m, m, rad].
    observed : ObservedNodes

    Returns
    -------
    ndarray, shape (K, 3)
        In the frames of the observed poses [m, m, rad], theta in [-pi, pi).

    """
    pose, mean = poses[observed.node], observed.mean
    predicted = se2.transform(pose, observed.offset[:, :2])
    translation = _unrotate(mean[:, 2], predicted - mean[:, :2])
    theta = se2.wrap(pose[:, 2] + observed.offset[:, 2] - mean[:, 2])
    return np.column_stack((translation, theta))


def linearize_observed(poses: FloatArray, observed: ObservedNodes) -> ObservedLinearization:
    """
    Evaluate the errors (3.52) of observed nodes with their Jacobians (3.53).

    The offset adds the third column: the derivative of R_i t_o by the heading.
    """
    error = observed_errors(poses, observed)
    heading, mean = poses[observed.node][:, 2], observed.mean
    jacobian = np.zeros((len(observed), 3, 3))
    jacobian[:, :2, :2] = np.swapaxes(se2.rotation(mean[:, 2]), 1, 2)
    arm = _unrotate(mean[:, 2] - heading, observed.offset[:, :2])
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -arm[:, 1], arm[:, 0]
    jacobian[:, 2, 2] = 1.0
    return ObservedLinearization(error, jacobian)


def energies(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the energies `e^T information e`, shape (M,), of errors (M, 3): the "springs"."""
    return np.einsum('mi,mij,mj->m', error, information, error)


def _unrotate(theta: FloatArray, vector: FloatArray) -> FloatArray:
    """Return R(theta)^T v for each row."""
    c, s = np.cos(theta), np.sin(theta)
    x, y = vector[:, 0], vector[:, 1]
    return np.column_stack((c * x + s * y, c * y - s * x))
