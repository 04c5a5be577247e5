# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marginal covariances from the Bayes tree: of nodes, alone and jointly, and of errors of edges.

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

Those of all nodes come in one sweep down the tree. The entries of the inverse Z = H^-1 within
cliques follow from the roots down (K. Takahashi, J. Fagan, M. Chen, "Formation of a sparse bus
impedance matrix", 1973). With f the frontal and s the separator nodes of a clique, and Z_ss a part
of the inverse of its parent,

    Z_fs = -R_ff^-1 R_fs Z_ss,    Z_ff = R_ff^-1 (R_ff^-T - R_fs Z_sf).
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGER, kernel, MATRICES, ROWS
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.fronts import forward_rows
from pose_graph_ros.core.elimination.ordering import grown
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.factors import write_data
from pose_graph_ros.core.graph.pools import row_start, separator

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


@kernel(signature=(tb.HEAD, tb.RECORDS, ROWS, MATRICES), allocates=True)
def _write_innovations(head, records, error, out):  # type: ignore[no-untyped-def]
    """Write errors, (M, 3), of edges given by records of `Factors`, and J P J^T, (M, 3, 3)."""
    nodes = tb.nodes(head)
    record, start_j, end_j = np.empty(1, tb.FACTOR), np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(len(records)):
        f = record[0]   # in here, as Numba frees the array after its last use
        new, e = records[k], error[k]
        write_data(f, new)
        e[0], e[1], e[2], c, s, ax, ay = factors.model(
            f, new.kind, nodes[new.i].pose, nodes[new.j].pose, factors.NO_THIRD[0])
        ft, fth = factors.factors_of_end(f, new.kind)
        start_j[0, 0], start_j[0, 1], start_j[0, 2] = -c, -s, c * ay - s * ax
        start_j[1, 0], start_j[1, 1], start_j[1, 2] = s, -c, -s * ay - c * ax
        start_j[2, 2] = -1.0
        end_j[0, 0], end_j[0, 1], end_j[1, 0], end_j[1, 1] = ft * c, ft * s, -ft * s, ft * c
        end_j[2, 2] = fth
        write_covariance(head, new.i, start_j, new.j, end_j, out[k])


@kernel(signature=(tb.HEAD, INTEGER, ROWS, INTEGER, ROWS, ROWS), allocates=True)
def write_covariance(head, i, of_i, j, of_j, out):  # type: ignore[no-untyped-def]
    """
    Write J P J^T, shape (m, m), of an error with Jacobians by two nodes, shape (m, 3).

    Without a second node j is -1.
    """
    nodes, cliques, pool_f = tb.nodes(head), tb.cliques(head), tb.pool_f(head)
    pool_i, m = tb.pool_i(head), len(out)
    path = _path(head, nodes[i].clique, nodes[j].clique if j >= 0 else -1)
    # each node of these cliques is frontal in one of them
    n = largest = 0
    for c in path:
        row = cliques[c]
        largest = max(largest, row.n_frontal + row.n_separator)
        for v in pool_i[row.members:row.members + row.n_frontal]:
            nodes[v].index = n
            n += 3
    # right-hand sides in map axes, of which the solutions of frontal nodes take the place
    right, x, places = np.zeros((m, n)), np.zeros(3 * largest + 3), np.empty(largest, np.int32)
    right[:, nodes[i].index:nodes[i].index + 3] = of_i
    if j >= 0:
        right[:, nodes[j].index:nodes[j].index + 3] += of_j
    for c in path:
        row, turn = cliques[c], clique_frames.present_turn(head, c)
        cos, sin, size = math.cos(turn), math.sin(turn), row.n_frontal + row.n_separator
        for k in range(size):
            places[k] = nodes[pool_i[row.members + k]].index
        for r in range(m):
            of_r = right[r]
            for k in range(size):
                at = places[k]
                x[3 * k] = cos * of_r[at] + sin * of_r[at + 1]
                x[3 * k + 1] = cos * of_r[at + 1] - sin * of_r[at]
                x[3 * k + 2] = of_r[at + 2]
            forward_rows(pool_f[row.values:], 3 * row.n_frontal, 3 * size, x)
            for k in range(size):
                at = places[k]
                of_r[at] = cos * x[3 * k] - sin * x[3 * k + 1]
                of_r[at + 1] = sin * x[3 * k] + cos * x[3 * k + 1]
                of_r[at + 2] = x[3 * k + 2]
        for k in range(row.n_frontal):
            if nodes[pool_i[row.members + k]].fixed != 0:
                right[:, places[k]:places[k] + 3] = 0.0
    out[:] = 0.0
    for q in range(n):
        for r in range(m):
            for s in range(m):
                out[r, s] += right[r, q] * right[s, q]


@kernel(allocates=True)
def _path(head, i, j):  # type: ignore[no-untyped-def]
    """Return the cliques from one, and another one or -1, up to the roots, children first."""
    cliques, path, n = tb.cliques(head), np.empty(64, np.int32), 0
    # Each path to a root goes on along the other one: they meet in the lowest clique above both,
    # or both end at -1.
    common, other = i, j
    while common != other:
        common = cliques[common].parent if common >= 0 else j
        other = cliques[other].parent if other >= 0 else i
    for begin, end in ((i, common), (j, common), (common, -1)):
        c = begin
        while c != end:
            if n == len(path):
                path = grown(path, 0)
            path[n], c = c, cliques[c].parent
            n += 1
    return path[:n]


@kernel(signature=(tb.HEAD, MATRICES), allocates=True)
def all_covariances(head, out):  # type: ignore[no-untyped-def]
    """
    Write the covariances of all nodes into zeros of shape (N, 3, 3).

    The sweep keeps a stack of cliques and a stack of their Z_ss, in map axes.
    """
    nodes, pool_i = tb.nodes(head), tb.pool_i(head)
    cliques, blocks = np.empty(64, np.int32), np.empty(1024)
    for root in range(head[tb.N_CLIQUES]):
        if tb.cliques(head)[root].n_frontal <= 0 or tb.cliques(head)[root].parent >= 0:
            continue  # a free row, a prior, or no root
        cliques[0] = root
        depth, end = 1, 0
        while depth > 0:
            depth -= 1
            c = cliques[depth]
            row = tb.cliques(head)[c]
            rows, rest = 3 * row.n_frontal, 3 * row.n_separator
            inverse = np.empty((rows + rest, rows + rest))
            end -= rest * rest
            of_separator = blocks[end:end + rest * rest].reshape(rest, rest)
            turn = clique_frames.present_turn(head, c)
            _rotate(of_separator, -turn)
            inverse[rows:, rows:] = of_separator
            _invert_clique(head, row, inverse)
            _rotate(inverse, turn)
            for k in range(0, rows, 3):
                block = out[pool_i[row.members + k // 3]]
                for m in range(3):
                    for q in range(3):  # exactly symmetric
                        block[m, q] = inverse[k + min(m, q), k + max(m, q)]
            for m in range(len(inverse) // 3):
                nodes[pool_i[row.members + m]].index = 3 * m
            child = row.child
            while child >= 0:
                if tb.cliques(head)[child].n_frontal > 0:
                    size = 3 * tb.cliques(head)[child].n_separator
                    if end + size * size > len(blocks):
                        blocks = grown(blocks, end + size * size)
                    below = blocks[end:end + size * size].reshape(size, size)
                    members = separator(head, child)
                    for a in range(size):
                        i = nodes[members[a // 3]].index + a % 3
                        for b in range(size):
                            below[a, b] = inverse[i, nodes[members[b // 3]].index + b % 3]
                    end += size * size
                    if depth == len(cliques):
                        cliques = grown(cliques, 0)
                    cliques[depth] = child
                    depth += 1
                child = tb.cliques(head)[child].sibling


@kernel
def _rotate(block, angle):  # type: ignore[no-untyped-def]
    """Rotate a covariance of nodes to axes in which angles are larger by `angle` [rad]."""
    if angle == 0.0:
        return
    cos, sin = math.cos(angle), math.sin(angle)
    for r in range(0, len(block), 3):
        for q in range(len(block)):
            x, y = block[r, q], block[r + 1, q]
            block[r, q], block[r + 1, q] = cos * x - sin * y, sin * x + cos * y
    for r in range(len(block)):
        for q in range(0, len(block), 3):
            x, y = block[r, q], block[r, q + 1]
            block[r, q], block[r, q + 1] = cos * x - sin * y, sin * x + cos * y


@kernel(fastmath=_FAST)
def _invert_clique(head, row, inverse):  # type: ignore[no-untyped-def]
    """Fill the inverse of a clique, which has Z_ss already, from its last row to its first."""
    pool_f, nodes, pool_i, n = tb.pool_f(head), tb.nodes(head), tb.pool_i(head), len(inverse)
    for k in range(3 * row.n_frontal - 1, -1, -1):
        r, of_row = pool_f[row.values + row_start(k, n):], inverse[k]
        of_row[k:] = 0.0
        if nodes[pool_i[row.members + k // 3]].fixed != 0:
            inverse[k:, k] = 0.0
            continue
        m = k + 1
        while m + 3 <= n:   # three rows at a time, which takes half of the time
            a, b, c = -r[k] * r[m], -r[k] * r[m + 1], -r[k] * r[m + 2]
            x, y, z = inverse[m], inverse[m + 1], inverse[m + 2]
            for q in range(k + 1, n):
                of_row[q] += a * x[q] + b * y[q] + c * z[q]
            m += 3
        while m < n:
            for q in range(k + 1, n):
                of_row[q] -= r[k] * r[m] * inverse[m, q]
            m += 1
        total = r[k]
        for q in range(k + 1, n):
            total -= r[q] * of_row[q]
            inverse[q, k] = of_row[q]
        of_row[k] = r[k] * total
