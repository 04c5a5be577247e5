# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marginal covariances from the Bayes tree: of a node, of two jointly, and of errors of edges.

With J the Jacobian of an error and `P = H^-1` the covariance of all nodes, `H = R^T R`, that is
`J P J^T = Y^T Y` with `R^T Y = J^T`; for the covariance of nodes, J has rows of the identity. J^T
has nonzero rows at one or two nodes alone, so Y has them in the cliques from there to the roots.
The right-hand sides of two nodes are added in the lowest clique that is above both; the large
cliques near the root are solved for once, and what is common to both nodes cancels before it is
squared: the covariance between two neighbours is exact however uncertain both are in the map.

Rows of R hold the reciprocal of their diagonal. A fixed node has rows of the identity; it is left
out, and so gets no uncertainty. The rows of a clique are equations in its frame (`clique_frames`),
so right-hand sides are rotated by the angle of the frame. A node is updated by adding to its pose
in map axes, so covariances are in map axes [m, m, rad].
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import (
    INTEGER,
    kernel,
    MATRICES,
    ROWS,
)
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.factors import write_data
from pose_graph_ros.core.graph.pools import row_start

_FAST = {'reassoc', 'contract', 'nsz'}


class Innovations(NamedTuple):
    """What K edges disagree with the estimate by, in the axes of their errors."""

    errors: Poses   # at the present estimate
    covariances: Covariances    # from the uncertainty of the estimate alone, J P J^T

    def squared_distances(self, information: FloatArray) -> FloatArray:
        """
        Return `e^T (J P J^T + information^-1)^-1 e`, shape (K,), chi2 of independent constraints.

        The information matrices, shape (K, 3, 3), may be singular, as those of positions are.
        """
        joint = np.eye(3) + self.covariances @ information
        scaled = np.linalg.solve(joint, self.errors[:, :, None])[:, :, 0]
        return np.einsum('mi,mij,mj->m', self.errors, information, scaled)


def innovations(head: IntArray, edges: Factors) -> Innovations:
    """Return by how much edges, not in the graph or with weight 0, disagree with the estimate."""
    result = Innovations(np.empty((len(edges), 3)), np.empty((len(edges), 3, 3)))
    _write_innovations(head, np.ascontiguousarray(edges.records), *result)
    return result


@kernel(signature=(tb.HEAD, ROWS), allocates=True)
def newest_covariance(head, out):  # type: ignore[no-untyped-def]
    """Write that of the newest pose; False if there is none, or edits are not solved for."""
    if head[tb.NEWEST] < 0 or head[tb.N_TOUCHED] > 0:
        return False
    node_covariance(head, head[tb.NEWEST], out)
    return True


@kernel(signature=(tb.HEAD, INTEGER, ROWS), allocates=True)
def node_covariance(head, v, out):  # type: ignore[no-untyped-def]
    """Write the covariance of a node, shape (3, 3)."""
    out[:] = 0.0
    _begin(head, v, np.eye(3), -1, np.empty((3, 48)), np.empty((3, 48)), out)
    _mirror(out)


@kernel(signature=(tb.HEAD, INTEGER, INTEGER, ROWS), allocates=True)
def pair_covariance(head, i, j, out):  # type: ignore[no-untyped-def]
    """Write the joint covariance of two nodes, shape (6, 6)."""
    of_i, of_j = np.zeros((6, 3)), np.zeros((6, 3))
    for m in range(3):
        of_i[m, m] = of_j[3 + m, m] = 1.0
    _write_covariance(head, i, of_i, j, of_j, out)


@kernel(signature=(tb.HEAD, tb.RECORDS, ROWS, MATRICES), allocates=True)
def _write_innovations(head, records, error, out):  # type: ignore[no-untyped-def]
    """Write errors, (M, 3), of edges given by records of `Factors`, and J P J^T, (M, 3, 3)."""
    nodes = tb.nodes(head)
    record, start_j, end_j = np.empty(1, tb.FACTOR), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(records)):
        f = record[0]   # in here, as Numba frees the array after its last use
        new = records[k]
        write_data(f, new)
        _edge_jacobians(
            f, new.kind, nodes[new.i].pose, nodes[new.j].pose, error[k], start_j, end_j)
        _write_covariance(head, new.i, start_j, new.j, end_j, out[k])


@kernel
def _edge_jacobians(f, kind, start, end, error, start_j, end_j):  # type: ignore[no-untyped-def]
    """Write the error of an edge between two poses, and its Jacobians, in map axes."""
    error[0], error[1], error[2], c, s, ax, ay = factors.model(
        f, kind, start, end, factors.NO_THIRD[0])
    ft, fth = factors.factors_of_end(f, kind)
    start_j[:] = 0.0
    end_j[:] = 0.0
    start_j[0, 0], start_j[0, 1], start_j[0, 2] = -c, -s, c * ay - s * ax
    start_j[1, 0], start_j[1, 1], start_j[1, 2] = s, -c, -s * ay - c * ax
    start_j[2, 2] = -1.0
    end_j[0, 0], end_j[0, 1], end_j[1, 0], end_j[1, 1] = ft * c, ft * s, -ft * s, ft * c
    end_j[2, 2] = fth


@kernel(allocates=True)
def _write_covariance(head, i, of_i, j, of_j, out):  # type: ignore[no-untyped-def]
    """Write J P J^T, shape (m, m), of an error with Jacobians by two nodes, shape (m, 3)."""
    nodes, cliques, m = tb.nodes(head), tb.cliques(head), len(out)
    out[:] = 0.0
    common = _lowest_common(cliques, nodes[i].clique, nodes[j].clique)
    spare = np.empty((m, 96))
    first, spare, at_i = _begin(head, i, of_i, common, np.empty((m, 96)), spare, out)
    second, spare, at_j = _begin(head, j, of_j, common, np.empty((m, 96)), spare, out)
    if common >= 0:
        n = 3 * (cliques[common].n_frontal + cliques[common].n_separator)
        for r in range(m):
            for q in range(n):
                first[r, q] += second[r, q]
        _climb(head, common, -1, min(at_i, at_j), first, spare, out)
    _mirror(out)


@kernel
def _depth(cliques, c):  # type: ignore[no-untyped-def]
    depth = 0
    while c >= 0:
        depth += 1
        c = cliques[c].parent
    return depth


@kernel
def _lowest_common(cliques, a, b):  # type: ignore[no-untyped-def]
    """Return the lowest clique on the paths of two cliques to their roots; -1 without one."""
    depth_a, depth_b = _depth(cliques, a), _depth(cliques, b)
    while depth_a > depth_b:
        a = cliques[a].parent
        depth_a -= 1
    while depth_b > depth_a:
        b = cliques[b].parent
        depth_b -= 1
    while a != b:
        a, b = cliques[a].parent, cliques[b].parent
    return a


@kernel(allocates=True)
def _begin(head, v, jacobian, top, here, spare, out):  # type: ignore[no-untyped-def]
    """
    Climb from a node to a clique, which is not solved for; -1 to climb beyond the root.

    Add Y^T Y to the upper triangle of `out`. Return the right-hand sides of the clique, work
    space, and the number of its frontal nodes before the first with a nonzero right-hand side.
    """
    nodes, cliques, pool_i = tb.nodes(head), tb.cliques(head), tb.pool_i(head)
    c = nodes[v].clique
    row = cliques[c]
    here = _cleared(here, 3 * (row.n_frontal + row.n_separator))
    first = 0
    while pool_i[row.members + first] != v:
        first += 1
    turn = clique_frames.present_turn(head, c)
    cos, sin = math.cos(turn), math.sin(turn)
    for r in range(len(jacobian)):
        x, y = jacobian[r, 0], jacobian[r, 1]
        here[r, 3 * first], here[r, 3 * first + 1] = cos * x + sin * y, cos * y - sin * x
        here[r, 3 * first + 2] = jacobian[r, 2]
    if c == top:
        return here, spare, first
    here, spare = _climb(head, c, top, first, here, spare, out)
    return here, spare, 0


@kernel(allocates=True)
def _climb(head, c, top, first, here, spare, out):  # type: ignore[no-untyped-def]
    """Solve for the cliques from c up to, and without, one above; return its right-hand sides."""
    nodes, pool_i, pool_f = tb.nodes(head), tb.pool_i(head), tb.pool_f(head)
    while c != top:
        row = tb.cliques(head)[c]
        n_frontal, n_separator = row.n_frontal, row.n_separator
        members = pool_i[row.members:row.members + n_frontal + n_separator]
        values = pool_f[row.values:]
        for f in range(first, n_frontal):
            if nodes[members[f]].fixed == 0:
                _solve_block(values, 3 * f, 3 * (n_frontal + n_separator), here, out)
        first, below, c = 0, c, row.parent
        if c < 0:
            break
        spare = _passed_up(head, below, here, spare)
        here, spare = spare, here
    return here, spare


@kernel(allocates=True)
def _passed_up(head, c, here, above):  # type: ignore[no-untyped-def]
    """Return the right-hand sides of a clique's separator as those of its parent, in its frame."""
    nodes, cliques, pool_i = tb.nodes(head), tb.cliques(head), tb.pool_i(head)
    row = cliques[c]
    parent = cliques[row.parent]
    n_above = parent.n_frontal + parent.n_separator
    above = _cleared(above, 3 * n_above)
    for m in range(n_above):
        nodes[pool_i[parent.members + m]].index = 3 * m
    turn = (clique_frames.present_turn(head, c)
            - clique_frames.present_turn(head, row.parent))
    cos, sin = math.cos(turn), math.sin(turn)
    for s in range(row.n_frontal, row.n_frontal + row.n_separator):
        at = nodes[pool_i[row.members + s]].index
        for r in range(len(here)):
            p, q = here[r, 3 * s], here[r, 3 * s + 1]
            above[r, at], above[r, at + 1] = cos * p - sin * q, sin * p + cos * q
            above[r, at + 2] = here[r, 3 * s + 2]
    return above


@kernel(allocates=True)
def _cleared(vectors, n):  # type: ignore[no-untyped-def]
    """Return vectors whose first n entries are zero; `vectors` themselves if long enough."""
    if vectors.shape[1] < n:
        return np.zeros((len(vectors), 2 * n))
    vectors[:, :n] = 0.0
    return vectors


@kernel(allocates=True, fastmath=_FAST)
def _solve_block(values, k, n, rhs, out):  # type: ignore[no-untyped-def]
    """Solve for the three rows of R from row k on; add Y^T Y to the upper triangle of `out`."""
    r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                  values[row_start(k + 2, n):])
    for r in range(len(rhs)):
        x = rhs[r, :n]
        a = x[k] * r0[k]
        b = (x[k + 1] - a * r0[k + 1]) * r1[k + 1]
        c = (x[k + 2] - a * r0[k + 2] - b * r1[k + 2]) * r2[k + 2]
        x[k], x[k + 1], x[k + 2] = a, b, c
        for q in range(k + 3, n):
            x[q] -= a * r0[q] + b * r1[q] + c * r2[q]
        for s in range(r + 1):
            y = rhs[s]
            out[s, r] += y[k] * a + y[k + 1] * b + y[k + 2] * c


@kernel
def _mirror(out):  # type: ignore[no-untyped-def]
    """Copy the upper triangle of a matrix to the lower one."""
    for r in range(len(out)):
        for s in range(r):
            out[r, s] = out[s, r]
