# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marginal covariances from the Bayes tree: of one node, of two nodes jointly, of all nodes.

With `H = R^T R`, the covariance of nodes i and j is the product `Y_i^T Y_j` of the solutions of
`R^T Y_i = E_i`, where E_i are the three columns of the identity that belong to node i. Y_i is zero
except in the frontal rows of the cliques from that of i up to its root. The product therefore only
involves the cliques that are on the paths of both nodes, and is zero under different roots.

The covariances of all nodes are computed in one sweep (`sparse_inverse`).

Rows of R hold the reciprocal of their diagonal. A fixed node has rows of the identity; taking 0 as
their reciprocals gives it no uncertainty. The rows of a clique are equations in its frame
(`clique_frames`), so right-hand sides and results are rotated by the angle of the frame. A node is
updated by adding to its pose in map axes, so covariances are in map axes [m, m, rad].
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGER, kernel, ROWS
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.pools import row_start

_FAST = {'reassoc', 'contract', 'nsz'}


@kernel(signature=(tb.HEAD, ROWS), allocates=True)
def newest_covariance(head, out):  # type: ignore[no-untyped-def]
    """
    Write the covariance of the newest pose, shape (3, 3), in constant time if alone in a root.

    Return False, with nothing written, if there is no pose or edits are not solved for.
    """
    v = head[tb.NEWEST]
    if v < 0 or head[tb.N_TOUCHED] > 0:
        return False
    pool_f, node_i, clique_i = tb.pool_f(head), tb.node_i(head), tb.clique_i(head)
    row = clique_i[node_i[v, tb.CLIQUE]]
    if row[tb.N_FRONTAL] != 1 or row[tb.N_SEPARATOR] != 0:
        node_covariance(head, v, out)
        return True
    if node_i[v, tb.FIXED] != 0:
        out[:] = 0.0
        return True
    # the inverse of R, row by row, and its product with its transpose
    at = row[tb.VALUES]
    a, d, f = pool_f[at], pool_f[at + 4], pool_f[at + 7]
    e = -d * pool_f[at + 5] * f
    b = -a * pool_f[at + 1] * d
    c = -a * (pool_f[at + 1] * e + pool_f[at + 2] * f)
    out[0, 0], out[1, 1], out[2, 2] = a * a + b * b + c * c, d * d + e * e, f * f
    out[0, 1] = out[1, 0] = b * d + c * e
    out[0, 2] = out[2, 0] = c * f
    out[1, 2] = out[2, 1] = e * f
    return True


@kernel(signature=(tb.HEAD, INTEGER, ROWS), allocates=True)
def node_covariance(head, v, out):  # type: ignore[no-untyped-def]
    """
    Write the covariance of a node.

    Parameters
    ----------
    v : int, node
    out : ndarray, shape (3, 3)

    """
    path, n_rows = _path_to_root(head, v)
    y = _solution(head, v, path, n_rows)
    _product(y, y, n_rows, out)


@kernel(signature=(tb.HEAD, INTEGER, INTEGER, ROWS), allocates=True)
def pair_covariance(head, i, j, out):  # type: ignore[no-untyped-def]
    """
    Write the joint covariance of two nodes.

    Parameters
    ----------
    i, j : int
    out : ndarray, shape (6, 6), zeros

    """
    clique_i = tb.clique_i(head)
    path_i, rows_i = _path_to_root(head, i)
    path_j, rows_j = _path_to_root(head, j)
    y_i, y_j = _solution(head, i, path_i, rows_i), _solution(head, j, path_j, rows_j)
    _product(y_i, y_i, rows_i, out[:3, :3])
    _product(y_j, y_j, rows_j, out[3:, 3:])
    # rows of the cliques on both paths, from the root down
    common, k = 0, 1
    while (k <= min(len(path_i), len(path_j))
           and path_i[len(path_i) - k] == path_j[len(path_j) - k]):
        common += 3 * clique_i[path_i[len(path_i) - k], tb.N_FRONTAL]
        k += 1
    _product(y_i, y_j, common, out[:3, 3:])
    for m in range(3):
        for n in range(3):
            out[3 + n, m] = out[m, 3 + n]


@kernel(allocates=True)
def _path_to_root(head, v):  # type: ignore[no-untyped-def]
    """Return the cliques from that of a node to its root, and the number of frontal rows."""
    node_i, clique_i = tb.node_i(head), tb.clique_i(head)
    n, n_rows = 0, 0
    c = node_i[v, tb.CLIQUE]
    while c >= 0:
        n += 1
        n_rows += 3 * clique_i[c, tb.N_FRONTAL]
        c = clique_i[c, tb.PARENT]
    path = np.empty(n, np.int32)
    c = node_i[v, tb.CLIQUE]
    for k in range(n):
        path[k] = c
        c = clique_i[c, tb.PARENT]
    return path, n_rows


@kernel(allocates=True)
def _solution(head, v, path, n_rows):  # type: ignore[no-untyped-def]
    """Return Y^T of `R^T Y = E` for a node, in the frontal rows of the cliques of `path`."""
    pool_f, node_i, clique_i = tb.pool_f(head), tb.node_i(head), tb.clique_i(head)
    pool_i = tb.pool_i(head)
    y = np.empty((3, n_rows))
    # right-hand sides of the present clique and of its parent
    here, above = np.empty((3, 48)), np.empty((3, 48))
    end = 0
    for k in range(len(path)):
        row = clique_i[path[k]]
        n_frontal, n_separator = row[tb.N_FRONTAL], row[tb.N_SEPARATOR]
        rows, n = 3 * n_frontal, 3 * (n_frontal + n_separator)
        nodes = pool_i[row[tb.NODES]:row[tb.NODES] + n_frontal + n_separator]
        first = 0
        if k == 0:
            here = cleared(here, n)
            while nodes[first] != v:
                first += 1
            turn = clique_frames.present_turn(head, path[k])
            cos, sin = math.cos(turn), math.sin(turn)
            here[0, 3 * first], here[0, 3 * first + 1] = cos, -sin
            here[1, 3 * first], here[1, 3 * first + 1] = sin, cos
            here[2, 3 * first + 2] = 1.0
            y[:, :3 * first] = 0.0
        values = pool_f[row[tb.VALUES]:]
        for f in range(first, n_frontal):
            if node_i[nodes[f], tb.FIXED] != 0:
                y[:, end + 3 * f:end + 3 * f + 3] = 0.0
            else:
                _solve_block(values, 3 * f, n, here, y[:, end:])
        end += rows
        if n_separator > 0:
            above = pass_up(head, path[k], here, above)
            here, above = above, here
    return y


@kernel(allocates=True)
def pass_up(head, c, here, above):  # type: ignore[no-untyped-def]
    """
    Return the right-hand sides of a clique's separator as those of its parent, in its frame.

    Parameters
    ----------
    c : int, clique with a parent
    here : ndarray, three right-hand sides of the clique
    above : ndarray, three vectors to be overwritten, if they are long enough

    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    row = clique_i[c]
    parent = clique_i[row[tb.PARENT]]
    n_above = parent[tb.N_FRONTAL] + parent[tb.N_SEPARATOR]
    above = cleared(above, 3 * n_above)
    for m in range(n_above):
        node_i[pool_i[parent[tb.NODES] + m], tb.INDEX] = 3 * m
    turn = (clique_frames.present_turn(head, c)
            - clique_frames.present_turn(head, row[tb.PARENT]))
    cos, sin = math.cos(turn), math.sin(turn)
    for s in range(row[tb.N_FRONTAL], row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]):
        at = node_i[pool_i[row[tb.NODES] + s], tb.INDEX]
        for m in range(3):
            p, q = here[m, 3 * s], here[m, 3 * s + 1]
            above[m, at], above[m, at + 1] = cos * p - sin * q, sin * p + cos * q
            above[m, at + 2] = here[m, 3 * s + 2]
    return above


@kernel(allocates=True)
def cleared(vectors, n):  # type: ignore[no-untyped-def]
    """
    Return three vectors whose first n entries are zero; `vectors` themselves if long enough.

    Parameters
    ----------
    vectors : ndarray, shape (3, M)
    n : int

    """
    if vectors.shape[1] < n:
        return np.zeros((3, 2 * n))
    vectors[:, :n] = 0.0
    return vectors


@kernel(allocates=True, fastmath=_FAST)
def _solve_block(values, k, n, rhs, y):  # type: ignore[no-untyped-def]
    """Solve for the three rows of R from row k on; subtract them from the right-hand sides."""
    for m in range(3):
        r, row = k + m, values[row_start(k + m, n):]
        a, b, c = rhs[0, r] * row[r], rhs[1, r] * row[r], rhs[2, r] * row[r]
        y[0, r], y[1, r], y[2, r] = a, b, c
        first, second, third = rhs[0, :n], rhs[1, :n], rhs[2, :n]
        for q in range(r + 1, n):
            first[q] -= a * row[q]
            second[q] -= b * row[q]
            third[q] -= c * row[q]


@kernel(allocates=True, fastmath=_FAST)
def _product(a, b, n, out):  # type: ignore[no-untyped-def]
    """Write the 3x3 inner products of the rows of a and of b, over their last n entries."""
    for i in range(3):
        for j in range(3):
            x, y = a[i, a.shape[1] - n:], b[j, b.shape[1] - n:]
            total = 0.0
            for k in range(n):
                total += x[k] * y[k]
            out[i, j] = total
