# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write new rows behind the ends of the tables, with a quick validation.

A row is *valid* if it passes the quick checks in here. Rows that do not are checked again by
`constraints.check`, which accepts them or raises an exception with the reason.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factors, identities, tables as tb
from pose_graph_ros.core.graph.factor_types import BIAS
from pose_graph_ros.core.graph.kinds import FACTORS, NodeKind, ObservedKind

# Tolerance of the symmetry and the eigenvalues of an information matrix whose diagonal is scaled
# to 1; a tenth of that in `constraints.check`.
_TOLERANCE = 1e-6
# By kind of edges: bits of the kinds of nodes (1 << kind) that its ends may be, END_K also none,
# and of the rows that its error has.
_NO_NODE = len(NodeKind)
_ENDS = np.array([[sum(1 << kind for kind in kinds) for kinds in (factor.i, factor.j, (
    *factor.k, _NO_NODE))] for factor in FACTORS.values()])
_ROWS = np.array([sum(1 << row for row in factor.rows) for factor in FACTORS.values()])
_OBSERVED_KINDS = tuple(map(int, ObservedKind))


@kernel
def _is_finite(x):  # type: ignore[no-untyped-def]
    """Tell whether the magnitude of a number is at most 1e300; neither infinite nor NaN is."""
    return abs(x) <= 1e300


@kernel
def _pack_information(to, w):  # type: ignore[no-untyped-def]
    """
    Write the upper triangle of an information matrix to a row of edge_f or observed_f.

    Return whether the matrix is finite, symmetric, positive semidefinite and not zero.
    """
    at = tb.INFO
    xx, yy, tt = w[0, 0], w[1, 1], w[2, 2]
    xy, xt, yt = 0.5 * (w[0, 1] + w[1, 0]), 0.5 * (w[0, 2] + w[2, 0]), 0.5 * (w[1, 2] + w[2, 1])
    to[at], to[at + 1], to[at + 2] = xx, xy, xt
    to[at + 3], to[at + 4], to[at + 5] = yy, yt, tt
    total = xx + yy + tt
    if not (_is_finite(total) and xx >= 0.0 and yy >= 0.0 and tt >= 0.0 and total > 0.0):
        return False
    sx, sy, st = math.sqrt(xx), math.sqrt(yy), math.sqrt(tt)
    skew = max(abs(w[0, 1] - w[1, 0]) - _TOLERANCE * sx * sy,
               abs(w[0, 2] - w[2, 0]) - _TOLERANCE * sx * st,
               abs(w[1, 2] - w[2, 1]) - _TOLERANCE * sy * st)
    if not skew <= 0.0:
        return False
    # leading minors of the correlation matrix, with the tolerance added to its diagonal
    a = xy / (sx * sy) if xy != 0.0 else 0.0
    b = xt / (sx * st) if xt != 0.0 else 0.0
    c = yt / (sy * st) if yt != 0.0 else 0.0
    d = 1.0 + _TOLERANCE
    return (d * d - a * a > 0.0
            and d * (d * d - c * c) - a * (a * d - b * c) + b * (a * c - b * d) > 0.0)


@kernel
def _copy_pose(to, at, pose):  # type: ignore[no-untyped-def]
    """Write a pose to three columns of a row; return whether it is finite."""
    to[at], to[at + 1], to[at + 2] = pose[0], pose[1], pose[2]
    return _is_finite(pose[0]) and _is_finite(pose[1]) and _is_finite(pose[2])


@kernel
def write_measurement(f, mean, information):  # type: ignore[no-untyped-def]
    """Write mean and information to a row; return whether both are valid."""
    valid = _copy_pose(f, tb.MEAN, mean)
    return _pack_information(f, information) and valid


@kernel
def write_edge(head, e, i, j, mean, information, kind, weight):  # type: ignore[no-untyped-def]
    """
    Return whether an edge is valid after writing it; its nodes, kind and bias are not checked.

    Parameters
    ----------
    e : int, row
    i, j, mean, information, kind, weight : int, ndarray or float, values of the columns of `Edges`

    """
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    f, row = edge_f[e], edge_i[e]
    row[tb.END_I], row[tb.END_J], row[tb.END_K], row[tb.EDGE_KIND] = i, j, -1, kind
    f[tb.WEIGHT] = weight
    valid = _is_finite(weight) and weight >= 0.0 and i != j
    return write_measurement(f, mean, information) and valid


@kernel
def write_observed(  # type: ignore[no-untyped-def]
    head, k, node, offset, mean, information, kind, weight,
):
    """
    Return whether an observed node is valid after writing it; its node and kind are not checked.

    Parameters
    ----------
    k : int, row
    node, offset, mean, information, kind, weight : int, ndarray or float
        Values of the columns of `ObservedNodes`.

    """
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    f, row = observed_f[k], observed_i[k]
    row[tb.OBS_NODE], row[tb.OBS_KIND] = node, kind
    f[tb.WEIGHT] = weight
    valid = _copy_pose(f, tb.MEAN, mean) and _is_finite(weight) and weight >= 0.0
    valid = _copy_pose(f, tb.OFFSET, offset) and valid
    return _pack_information(f, information) and valid


@kernel
def write_nodes(head, first, poses):  # type: ignore[no-untyped-def]
    """
    Return whether the poses of new hidden nodes are finite after writing them, headings wrapped.

    Parameters
    ----------
    first : int, first row
    poses : ndarray, shape (N, 3) [m, m, rad]

    """
    node_f = tb.node_f(head)
    valid = True
    for k in range(len(poses)):
        f = node_f[first + k]
        if not _copy_pose(f, tb.POSE, poses[k]):
            valid = False
        f[tb.POSE + 2] = factors.wrap(f[tb.POSE + 2])
    return valid


@kernel
def _node(head, v, first_other, types):  # type: ignore[no-untyped-def]
    """
    Return kind and dimension of a node, _NO_NODE and 0 for -1.

    Parameters as for `write_edges`.
    """
    if v < 0:
        return _NO_NODE, 0
    if v < head[tb.N_NODES]:
        node = tb.node_i(head)[v, tb.NODE_TYPE]
    else:
        node = types[v - first_other] if v >= first_other else 0
    return node & 3, 3 - (node >> 2)


@kernel
def _has_rows_only(f, rows, of_mean):  # type: ignore[no-untyped-def]
    """Tell whether information, and the mean if asked for, are zero but in some rows (bits)."""
    for m in range(3):
        if (rows >> m) & 1 == 0 and (
                f[tb.INFO + (0, 3, 5)[m]] != 0.0 or (of_mean and f[tb.MEAN + m] != 0.0)):
            return False
    return True


@kernel
def write_edges(  # type: ignore[no-untyped-def]
    head, n_nodes, first_other, types, i, j, mean, information, kind, weight, bias, third,
):
    """
    Return whether new edges are all valid after writing them behind the last row.

    Parameters
    ----------
    n_nodes : int, number of hidden nodes, with the new ones
    first_other : int, first row of the new nodes that are no poses
    types : ndarray, NODE_TYPE of these
    i, j, mean, information, kind, weight, bias, third : ndarray, columns of `Edges`

    """
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    valid = True
    for k in range(len(i)):
        e = head[tb.N_EDGES] + k
        a, b, c = identities.node_row(head, i[k]), identities.node_row(head, j[k]), -1
        if third[k] != -1:
            c = identities.node_row(head, third[k])
            valid = valid and c >= 0
        valid = write_edge(
            head, e, a, b, mean[k], information[k], kind[k], weight[k]) and valid
        f = edge_f[e]
        edge_i[e, tb.END_K] = c
        f[tb.OFFSET], f[tb.OFFSET + 1] = bias[k, 0], bias[k, 1]
        f[tb.FACTOR_T], f[tb.FACTOR_TH] = bias[k, 2], bias[k, 3]
        for m in range(4):
            valid = _is_finite(bias[k, m]) and valid
        valid = (valid and 0 <= a < n_nodes and 0 <= b < n_nodes and c < n_nodes
                 and kind[k] < len(_ROWS))
        if valid:
            ends = (_node(head, a, first_other, types), _node(head, b, first_other, types),
                    _node(head, c, first_other, types))
            for m in range(3):
                valid = valid and (_ENDS[kind[k], m] >> ends[m][0]) & 1 == 1
            if kind[k] == BIAS:     # of the rows that both nodes have
                valid = valid and _has_rows_only(
                    f, (1 << min(ends[0][1], ends[1][1])) - 1, False)
            elif kind[k] > BIAS:
                valid = valid and _has_rows_only(f, _ROWS[kind[k]], True)
    return valid


@kernel
def write_all_observed(  # type: ignore[no-untyped-def]
    head, n_nodes, first_other, types, node, offset, mean, information, kind, weight,
):
    """
    Return whether new observed nodes are all valid after writing them behind the last row.

    Parameters
    ----------
    n_nodes, first_other, types : int or ndarray, as for `write_edges`
    node, offset, mean, information, kind, weight : ndarray, columns of `ObservedNodes`

    """
    valid = True
    for k in range(len(node)):
        row = head[tb.N_OBSERVED] + k
        v = identities.node_row(head, node[k])
        valid = write_observed(head, row, v, offset[k], mean[k], information[k], kind[k],
                               weight[k]) and valid
        valid = valid and 0 <= v < n_nodes and kind[k] in _OBSERVED_KINDS
        if valid:
            dimension = _node(head, v, first_other, types)[1]
            valid = dimension == 3 or _has_rows_only(
                tb.observed_f(head)[row], (1 << dimension) - 1, False)
    return valid
