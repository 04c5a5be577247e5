# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Kernels for judging loop closures: how far they are from the estimate, and from one another.

A closure is a measured pose z of a later node in an earlier one. Its error (3.48) at the estimate
is `e = (R_z^T (R_i^T (t_j - t_i) - t_z), wrap(th_j - th_i - th_z))`, in the frame of the
measured pose, and so are all covariances here.

Two closures k and l are compared through the odometry between their ends: `A z_l B` predicts z_k,
with A the motion from the earlier end of k to that of l, B that from the later end of l to that
of k. Let C be poses by odometry alone, Q the noise of an edge in the frame of its end, and S the
prefix sums of `Ad_C Q Ad_C^T` along the chain. The covariance of the motion between two nodes a
and b, in the frame of any x, is `Ad_Cx^-1 |S_b - S_a| Ad_Cx^-T`.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel, MATRICES, NUMBERS, ROWS
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.factors import wrap


@kernel
def _error(start, end, z, out):  # type: ignore[no-untyped-def]
    """Write the error of a closure."""
    phi = start[2] + z[2]
    c, s = math.cos(phi), math.sin(phi)
    dx, dy = end[0] - start[0], end[1] - start[1]
    cz, sz = math.cos(z[2]), math.sin(z[2])
    out[0] = c * dx + s * dy - (cz * z[0] + sz * z[1])
    out[1] = c * dy - s * dx - (cz * z[1] - sz * z[0])
    out[2] = wrap(end[2] - start[2] - z[2])


@kernel(signature=(tb.HEAD, INTEGERS, INTEGERS, ROWS, ROWS))
def errors_at(head, first, second, mean, errors):  # type: ignore[no-untyped-def]
    """
    Write the errors of closures at the estimate.

    Parameters
    ----------
    first, second : ndarray of int, shape (M,), nodes
    mean : ndarray, shape (M, 3), poses of the second nodes in the first ones [m, m, rad]
    errors : ndarray, shape (M, 3), output [m, m, rad]

    """
    node_f = tb.node_f(head)
    for k in range(len(first)):
        _error(node_f[first[k]][tb.POSE:], node_f[second[k]][tb.POSE:], mean[k], errors[k])


@kernel
def _quadratic_form(e, a):  # type: ignore[no-untyped-def]
    """
    Return `e^T A^-1 e`.

    Parameters
    ----------
    e, a : ndarray, shapes (3,) and (3, 3), symmetric positive definite

    """
    l00 = math.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = math.sqrt(a[1, 1] - l10 * l10)
    l21 = (a[2, 1] - l20 * l10) / l11
    x = e[0] / l00
    y = (e[1] - l10 * x) / l11
    z = e[2] - l20 * x - l21 * y
    return x * x + y * y + z * z / (a[2, 2] - l20 * l20 - l21 * l21)


@kernel(signature=(ROWS, MATRICES, NUMBERS))
def distances(errors, covariances, out):  # type: ignore[no-untyped-def]
    """
    Write squared Mahalanobis distances.

    Parameters
    ----------
    errors, covariances : ndarray, shapes (M, 3) and (M, 3, 3)
    out : ndarray, shape (M,), output

    """
    for k in range(len(errors)):
        out[k] = _quadratic_form(errors[k], covariances[k])


@kernel
def _compose(a, b, out):  # type: ignore[no-untyped-def]
    """Write the composition of two poses."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y = a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1]
    out[0], out[1], out[2] = x, y, a[2] + b[2]


@kernel
def _between(a, b, out):  # type: ignore[no-untyped-def]
    """Write the pose of b in a."""
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    out[0], out[1], out[2] = c * dx + s * dy, c * dy - s * dx, wrap(b[2] - a[2])


@kernel
def _add_inverse_adjoint(pose, factor, a, b, out):  # type: ignore[no-untyped-def]
    """Add `factor Ad^-1 (A - B) Ad^-T` of a pose to a symmetric matrix."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    # of the inverse: its translation is -R^T t
    x, y = -(c * pose[0] + s * pose[1]), s * pose[0] - c * pose[1]
    rows = ((c, s, y), (-s, c, -x), (0.0, 0.0, 1.0))
    for m in range(3):
        for n in range(3):
            total = 0.0
            for p in range(3):
                for q in range(3):
                    total += rows[m][p] * (a[p, q] - b[p, q]) * rows[n][q]
            out[m, n] += factor * total


@kernel(signature=(
    ROWS, MATRICES, INTEGERS, INTEGERS, ROWS, MATRICES, INTEGERS, INTEGERS, NUMBERS),
    allocates=True)
def pair_distances(  # type: ignore[no-untyped-def]
    poses, sums, first, second, mean, covariance, these, others, out,
):
    """
    Write the squared Mahalanobis distances between pairs of closures.

    Parameters
    ----------
    poses, sums : ndarray, shapes (N, 3) and (N, 3, 3)
        Of the nodes of the chain: poses by odometry alone, and prefix sums of its noise.
    first, second : ndarray of int, shape (M,), ends of all closures in the chain
    mean, covariance : ndarray, shapes (M, 3) and (M, 3, 3), of all closures
    these, others : ndarray of int, shape (K,), the pairs
    out : ndarray, shape (K,), output

    """
    a, b, whole, e = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    total, zero = np.empty((3, 3)), np.zeros((3, 3))
    for n in range(len(these)):
        k, m = these[n], others[n]
        _between(poses[first[k]], poses[first[m]], a)
        _between(poses[second[m]], poses[second[k]], b)
        _compose(mean[m], b, whole)
        _compose(poses[first[m]], whole, e)
        total[:] = covariance[k]
        one, two = sums[first[k]], sums[first[m]]
        _add_inverse_adjoint(e, 1.0 if first[k] > first[m] else -1.0, one, two, total)
        one, two = sums[second[k]], sums[second[m]]
        _add_inverse_adjoint(
            poses[second[k]], 1.0 if second[k] > second[m] else -1.0, one, two, total)
        _add_inverse_adjoint(b, 1.0, covariance[m], zero, total)
        _compose(a, whole, whole)
        _between(mean[k], whole, e)
        out[n] = _quadratic_form(e, total)
