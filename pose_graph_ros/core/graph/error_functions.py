# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of constraints, vectorised.

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

The energy of a constraint is `e^T information e`, without a factor 1/2; chi2 is the sum of all
energies. The compiled kernels in `factors` have the same errors, with their Jacobians.
"""

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedNodes


def edge_errors(poses: FloatArray, edges: Edges) -> FloatArray:
    """
    Return the errors (3.48) of edges, shape (M, 3) [m, m, rad], theta in [-pi, pi).

    They are in the frames of the measured poses, those of edges to a bias in map axes.

    Parameters
    ----------
    poses : ndarray, shape (N, 3), hidden nodes in the map [m, m, rad]
    edges : Edges

    """
    start, end, mean = poses[edges.i], poses[edges.j], edges.mean
    moved = _unrotate(start[:, 2], end[:, :2] - start[:, :2])
    translation = _unrotate(mean[:, 2], moved - mean[:, :2])
    theta = se2.wrap(end[:, 2] - start[:, 2] - mean[:, 2])
    error = np.column_stack((translation, theta))
    rows = np.flatnonzero(edges.kind == EdgeKind.BIAS)
    if len(rows) > 0:
        bias = edges.bias[rows]
        error[rows] = bias[:, [2, 2, 3]] * end[rows] + mean[rows] - start[rows]
        error[rows, :2] -= _unrotate(-start[rows, 2], bias[:, :2])
        error[rows, 2] = se2.wrap(error[rows, 2])
    return error


def observed_errors(poses: FloatArray, observed: ObservedNodes) -> FloatArray:
    """
    Return the errors (3.52) of observed nodes, with their offsets, shape (K, 3) [m, m, rad].

    They are in the frames of the observed poses; theta lies in [-pi, pi).

    Parameters
    ----------
    poses : ndarray, shape (N, 3), hidden nodes in the map [m, m, rad]
    observed : ObservedNodes

    """
    pose, mean = poses[observed.node], observed.mean
    predicted = se2.transform(pose, observed.offset[:, :2])
    translation = _unrotate(mean[:, 2], predicted - mean[:, :2])
    theta = se2.wrap(pose[:, 2] + observed.offset[:, 2] - mean[:, 2])
    return np.column_stack((translation, theta))


def energies(error: FloatArray, information: FloatArray) -> FloatArray:
    """
    Return the energies `e^T information e`, shape (M,) [sigma^2].

    Parameters
    ----------
    error : ndarray, shape (M, 3)
    information : ndarray, shape (M, 3, 3), in the frames of the errors

    """
    return np.einsum('mi,mij,mj->m', error, information, error)


def _unrotate(theta: FloatArray, vector: FloatArray) -> FloatArray:
    """Return R(theta)^T v for each row."""
    c, s = np.cos(theta), np.sin(theta)
    x, y = vector[:, 0], vector[:, 1]
    return np.column_stack((c * x + s * y, c * y - s * x))
