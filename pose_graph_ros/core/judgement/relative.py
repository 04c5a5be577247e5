# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far loop closures are from the estimate.

A closure is a measured pose z of a later node in an earlier one. Its error (3.48) is in the frame
of the measured pose, and so are all covariances here.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel, MATRICES, NUMBERS, ROWS
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.consistency import Closures, solved_form


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
        out[k] = solved_form(covariances[k], errors[k])


def as_edges(some: Closures) -> Edges:
    """Return closures as a table; its information is not that of the closures."""
    return Edges(some.i, some.j, some.mean, some.noise,
                 np.full(len(some.i), int(EdgeKind.LOOP_CLOSURE)))


def errors_of(graph: Graph, some: Closures) -> FloatArray:
    """
    Return the errors of closures at the estimate of a graph, shape (M, 3) [m, m, rad].

    Parameters
    ----------
    some : Closures, M of them

    """
    return graph.edge_errors(as_edges(some))


def residuals(graph: Graph, some: Closures) -> FloatArray:
    """
    Return squared residuals at the estimate of a graph, by the floored covariances, shape (M,).

    Parameters
    ----------
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
    edges : ndarray of int, shape (M,), ids
    limit : float

    """
    rows, table = graph.edge_rows(edges), graph.memory['edge_f']
    return np.asarray(table[rows, tb.ENERGY] > limit * table[rows, tb.WEIGHT])
