# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Kernels that say how far loop closures are from the estimate.

A closure is a measured pose z of a later node in an earlier one. Its error (3.48) at the estimate
is `e = (R_z^T (R_i^T (t_j - t_i) - t_z), wrap(th_j - th_i - th_z))`, in the frame of the measured
pose, and so are all covariances here.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel, MATRICES, NUMBERS, ROWS
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.factors import wrap
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.consistency import Closures


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
    first, second : ndarray of int, shape (M,), rows of nodes
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


def errors_of(graph: Graph, some: Closures) -> FloatArray:
    """
    Return the errors of closures at the estimate of a graph, shape (M, 3) [m, m, rad].

    Parameters
    ----------
    graph : Graph
    some : Closures, M of them

    """
    errors = np.empty((len(some.i), 3))
    errors_at(graph.memory.head, graph.node_rows(some.i), graph.node_rows(some.j), some.mean,
              errors)
    return errors


def residuals(graph: Graph, some: Closures) -> FloatArray:
    """
    Return squared residuals at the estimate of a graph, by the floored covariances, shape (M,).

    Parameters
    ----------
    graph : Graph
    some : Closures, M of them

    """
    errors, out = errors_of(graph, some), np.empty(len(some.i))
    distances(errors, some.noise, out)
    return out


def are_above(graph: Graph, edges: IntArray, limit: float) -> BoolArray:
    """
    Tell which squared residuals of edges, by their own covariances, are above a limit.

    Parameters
    ----------
    graph : Graph
    edges : ndarray of int, shape (M,), ids
    limit : float

    """
    rows, table = graph.edge_rows(edges), graph.memory['edge_f']
    return np.asarray(table[rows, tb.ENERGY] > limit * table[rows, tb.WEIGHT])
