# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Errors that edges would have at the present estimate, with their covariances.

With J the Jacobian of the error and `P = H^-1` the covariance of all nodes, `H = R^T R`, that is
`J P J^T = Y^T Y` with `R^T Y = J^T`. J^T has nonzero rows at the two nodes of an edge alone, so
Y has them in the cliques from there to the roots. The right-hand sides of the two nodes
of an edge are added in the lowest clique that is above both; the large cliques near the root are
solved for once, and what is common to both nodes cancels before it is squared: the covariance
between two neighbours is exact however uncertain both are in the map.

Fixed nodes and clique frames are treated as in `covariances`.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import (
    BYTES,
    INTEGERS,
    kernel,
    MATRICES,
    ROWS,
)
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import factor_types, factors, tables as tb
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.error_functions import write_data
from pose_graph_ros.core.graph.pools import row_start
from pose_graph_ros.core.smoother.covariances import cleared, pass_up

_FAST = {'reassoc', 'contract', 'nsz'}


class Innovations(NamedTuple):
    """What K edges disagree with the estimate by, in the axes of their errors."""

    errors: FloatArray
    """At the present estimate, shape (K, 3) [m, m, rad]."""
    covariances: FloatArray
    """Those of the errors from the uncertainty of the estimate alone, J P J^T, (K, 3, 3)."""

    def squared_distances(self, information: FloatArray) -> FloatArray:
        """
        Return `e^T (J P J^T + information^-1)^-1 e`, shape (K,), chi2 of independent constraints.

        The information matrices, shape (K, 3, 3), may be singular, as those of positions are.
        """
        joint = np.eye(3) + self.covariances @ information
        scaled = np.linalg.solve(joint, self.errors[:, :, None])[:, :, 0]
        return np.einsum('mi,mij,mj->m', self.errors, information, scaled)


def at_estimate(head: IntArray, edges: Edges) -> Innovations:
    """
    Return by how much edges, not in the graph or with weight 0, disagree with the estimate.

    Parameters
    ----------
    head : ndarray of int, of the memory of a graph all of whose edits have been solved for
    edges : Edges, without third nodes

    """
    result = Innovations(np.empty((len(edges), 3)), np.zeros((len(edges), 3, 3)))
    columns = edges.i, edges.j, edges.mean, edges.kind, edges.bias
    of_edges(head, *map(np.ascontiguousarray, columns), *result)
    return result


@kernel(signature=(tb.HEAD, INTEGERS, INTEGERS, ROWS, BYTES, ROWS, ROWS, MATRICES), allocates=True)
def of_edges(head, i, j, mean, kind, bias, error, out):  # type: ignore[no-untyped-def]
    """
    Write the errors of edges, which need not be in the graph, and their covariances J P J^T.

    Parameters
    ----------
    i, j, mean, kind, bias : ndarray, columns of `Edges`, M rows
    error, out : ndarray, shapes (M, 3) and (M, 3, 3), output; `out` holds zeros

    """
    node_f, node_i, clique_i = tb.node_f(head), tb.node_i(head), tb.clique_i(head)
    f, start_j, end_j = np.empty(tb.EDGE_F), np.empty((3, 3)), np.empty((3, 3))
    first, second, spare = np.empty((3, 96)), np.empty((3, 96)), np.empty((3, 96))
    for k in range(len(i)):
        write_data(f, kind[k], mean[k], bias[k])
        _edge_jacobians(f, kind[k], node_f[i[k]], node_f[j[k]], error[k], start_j, end_j)
        a, b = node_i[i[k], tb.CLIQUE], node_i[j[k], tb.CLIQUE]
        common = _lowest_common(clique_i, a, b)
        first, spare, at_a = _begin(head, i[k], start_j, common, first, spare, out[k])
        second, spare, at_b = _begin(head, j[k], end_j, common, second, spare, out[k])
        if common >= 0:
            n = 3 * (clique_i[common, tb.N_FRONTAL] + clique_i[common, tb.N_SEPARATOR])
            for m in range(3):
                for q in range(n):
                    first[m, q] += second[m, q]
            first, spare = _climb(head, common, -1, min(at_a, at_b), first, spare, out[k])
        _mirror(out[k])


@kernel
def _edge_jacobians(f, kind, start, end, error, start_j, end_j):  # type: ignore[no-untyped-def]
    """
    Write the error of an edge and its Jacobians, in map axes.

    Parameters
    ----------
    f, kind : ndarray and int, row of the edge as in edge_f
    start, end : ndarray, rows of its nodes in node_f
    error, start_j, end_j : ndarray, shapes (3,), (3, 3) and (3, 3), output

    """
    error[0], error[1], error[2], c, s, ax, ay = factors.model(f, kind, start, end, 0.0)
    ft, fth = factor_types.factors_of_end(f, kind)
    start_j[:] = 0.0
    end_j[:] = 0.0
    start_j[0, 0], start_j[0, 1], start_j[0, 2] = -c, -s, c * ay - s * ax
    start_j[1, 0], start_j[1, 1], start_j[1, 2] = s, -c, -s * ay - c * ax
    start_j[2, 2] = -1.0
    end_j[0, 0], end_j[0, 1], end_j[1, 0], end_j[1, 1] = ft * c, ft * s, -ft * s, ft * c
    end_j[2, 2] = fth


@kernel
def _depth(clique_i, c):  # type: ignore[no-untyped-def]
    depth = 0
    while c >= 0:
        depth += 1
        c = clique_i[c, tb.PARENT]
    return depth


@kernel
def _lowest_common(clique_i, a, b):  # type: ignore[no-untyped-def]
    """Return the lowest clique on the paths of two cliques to their roots; -1 without one."""
    depth_a, depth_b = _depth(clique_i, a), _depth(clique_i, b)
    while depth_a > depth_b:
        a = clique_i[a, tb.PARENT]
        depth_a -= 1
    while depth_b > depth_a:
        b = clique_i[b, tb.PARENT]
        depth_b -= 1
    while a != b:
        a, b = clique_i[a, tb.PARENT], clique_i[b, tb.PARENT]
    return a


@kernel(allocates=True)
def _begin(head, v, jacobian, top, here, spare, out):  # type: ignore[no-untyped-def]
    """
    Climb from a node to a clique, which is not solved for.

    Parameters
    ----------
    v : int, node
    jacobian : ndarray, shape (3, 3), of the error with respect to it, in map axes
    top : int, clique; -1 to climb beyond the root
    here, spare : ndarray, work space
    out : ndarray, shape (3, 3); Y^T Y is added to its upper triangle

    Returns
    -------
    here, spare : ndarray
        Right-hand sides of `top`, and work space.
    first : int, number of frontal nodes of `top` before the first with a nonzero right-hand side

    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    c = node_i[v, tb.CLIQUE]
    row = clique_i[c]
    here = cleared(here, 3 * (row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]))
    first = 0
    while pool_i[row[tb.NODES] + first] != v:
        first += 1
    turn = clique_frames.present_turn(head, c)
    cos, sin = math.cos(turn), math.sin(turn)
    for m in range(3):
        x, y = jacobian[m, 0], jacobian[m, 1]
        here[m, 3 * first], here[m, 3 * first + 1] = cos * x + sin * y, cos * y - sin * x
        here[m, 3 * first + 2] = jacobian[m, 2]
    if c == top:
        return here, spare, first
    here, spare = _climb(head, c, top, first, here, spare, out)
    return here, spare, 0


@kernel(allocates=True)
def _climb(head, c, top, first, here, spare, out):  # type: ignore[no-untyped-def]
    """
    Solve for the cliques from c up to, and without, a clique above; return its right-hand sides.

    Parameters
    ----------
    c, top : int, cliques; top is -1 to climb beyond the root
    first : int, number of frontal nodes of c before the first with a nonzero right-hand side
    here, spare, out : ndarray, as for `_begin`; `here` has the right-hand sides of c

    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    pool_f = tb.pool_f(head)
    while c != top:
        row = clique_i[c]
        n_frontal, n_separator = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
        nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_frontal + n_separator]
        values = pool_f[row[tb.VALUES]:]
        for f in range(first, n_frontal):
            if node_i[nodes[f], tb.FIXED] == 0:
                _solve_block(values, 3 * f, 3 * (n_frontal + n_separator), here, out)
        first, below, c = 0, c, row[tb.PARENT]
        if c < 0:
            break
        spare = pass_up(head, below, here, spare)
        here, spare = spare, here
    return here, spare


@kernel(allocates=True, fastmath=_FAST)
def _solve_block(values, k, n, rhs, out):  # type: ignore[no-untyped-def]
    """Solve for the three rows of R from row k on; add Y^T Y to the upper triangle of `out`."""
    r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                  values[row_start(k + 2, n):])
    first, second, third = rhs[0, :n], rhs[1, :n], rhs[2, :n]
    a0, b0, c0 = first[k] * r0[k], second[k] * r0[k], third[k] * r0[k]
    a1 = (first[k + 1] - a0 * r0[k + 1]) * r1[k + 1]
    b1 = (second[k + 1] - b0 * r0[k + 1]) * r1[k + 1]
    c1 = (third[k + 1] - c0 * r0[k + 1]) * r1[k + 1]
    a2 = (first[k + 2] - a0 * r0[k + 2] - a1 * r1[k + 2]) * r2[k + 2]
    b2 = (second[k + 2] - b0 * r0[k + 2] - b1 * r1[k + 2]) * r2[k + 2]
    c2 = (third[k + 2] - c0 * r0[k + 2] - c1 * r1[k + 2]) * r2[k + 2]
    out[0, 0] += a0 * a0 + a1 * a1 + a2 * a2
    out[0, 1] += a0 * b0 + a1 * b1 + a2 * b2
    out[0, 2] += a0 * c0 + a1 * c1 + a2 * c2
    out[1, 1] += b0 * b0 + b1 * b1 + b2 * b2
    out[1, 2] += b0 * c0 + b1 * c1 + b2 * c2
    out[2, 2] += c0 * c0 + c1 * c1 + c2 * c2
    for q in range(k + 3, n):
        first[q] -= a0 * r0[q] + a1 * r1[q] + a2 * r2[q]
        second[q] -= b0 * r0[q] + b1 * r1[q] + b2 * r2[q]
        third[q] -= c0 * r0[q] + c1 * r1[q] + c2 * r2[q]


@kernel
def _mirror(out):  # type: ignore[no-untyped-def]
    """Copy the upper triangle of a matrix, shape (3, 3), to the lower one."""
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
