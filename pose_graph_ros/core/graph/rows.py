# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Rows of the tables: found by their ids, marked, and written behind the ends.

Ids are permanent, and rows are in the order of their ids, so the row of an id is found by
bisection. A new row is *valid* if it passes the quick checks in here. Those that do not are
checked again by `checks.check`, which accepts them or raises an exception with the reason.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import factors, tables as tb, transaction_log
from pose_graph_ros.core.graph.constraints import FACTORS, NodeKind

# By kind of factors: bits of the kinds of nodes (1 << kind) that its ends may be, END_J also none
# where it has one end, END_K also none, and of the rows that its error has.
_NO_NODE = len(NodeKind)
_ENDS = np.array([[sum(1 << kind for kind in kinds) for kinds in (
    factor.i, factor.j or (_NO_NODE,), (*factor.k, _NO_NODE))] for factor in FACTORS.values()])
_ROWS = np.array([sum(1 << row for row in factor.rows) for factor in FACTORS.values()])


@kernel
def _node_row(head, node):  # type: ignore[no-untyped-def]
    """
    Return the row of a hidden node, negative if it has left the graph.

    The next new ids have the rows behind the last, so those of an update that is being added are
    found as well.
    """
    ids, n, next_id = tb.node_id(head), head[tb.N_NODES], head[tb.NEXT_NODE]
    if node >= next_id:
        return n + node - next_id
    if next_id == n:    # nothing has left: ids are rows
        return node
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if ids[middle] < node:
            low = middle + 1
        else:
            high = middle
    return low if low < n and ids[low] == node else -1


@kernel
def touch(head, v):  # type: ignore[no-untyped-def]
    """Log a node, which may be changed then, and mark it for elimination in the next iteration."""
    transaction_log.log_node(head, v)
    nodes, touched = tb.nodes(head), tb.touched(head)
    if nodes[v].touched == 0:
        nodes[v].touched = 1
        touched[head[tb.N_TOUCHED]] = v
        head[tb.N_TOUCHED] += 1


@kernel
def forget_touched(head):  # type: ignore[no-untyped-def]
    """Empty the list of the touched nodes, which have been eliminated."""
    for k in range(head[tb.N_TOUCHED]):
        tb.nodes(head)[tb.touched(head)[k]].touched = 0
    head[tb.N_TOUCHED] = 0


# --- diagonal scales: the information that the constraints of each node have on it alone --------

@kernel
def add_to_scale(head, v, position, heading):  # type: ignore[no-untyped-def]
    """Add information [1/m^2, 1/rad^2], or its change, to the squared scales of a node."""
    f = tb.nodes(head)[v]
    f.scale_t = math.sqrt(max(f.scale_t * f.scale_t + position, 0.0))
    f.scale_r = math.sqrt(max(f.scale_r * f.scale_r + heading, 0.0))


@kernel
def scale_by(head, e, weight):  # type: ignore[no-untyped-def]
    """Add the information of a factor with a weight to the diagonal scales of its ends."""
    f = tb.factors(head)[e]
    position = 0.5 * weight * (f.information[0] + f.information[3])
    heading = weight * f.information[5]
    # of a relative error the length of the mean, of others that of the offset
    arm2 = f.constants[0] * f.constants[0] + f.constants[1] * f.constants[1]
    add_to_scale(head, f.ends[0], position, heading + position * arm2)
    if f.ends[1] >= 0:
        ft, fth = factors.factors_of_end(f, f.kind)
        add_to_scale(head, f.ends[1], ft * ft * position, fth * fth * heading)
    if f.ends[2] >= 0:
        turn2 = f.constants[3] * f.constants[3]
        third = heading * turn2 + position * arm2 * (1.0 + 0.25 * turn2)
        add_to_scale(head, f.ends[2], third, 0.0)


@kernel
def start_node(head, v):  # type: ignore[no-untyped-def]
    """Initialise a new node, of which the pose is known."""
    node = tb.nodes(head)[v]
    factors.refer_to_pose(node)
    node.scale_t = node.scale_r = 0.0
    node.clique = node.factor_list = -1
    node.index = node.front = node.changed = 0
    node.logged = head[tb.UPDATE]
    node.fixed = node.touched = 0


# --- new rows -----------------------------------------------------------------------------------

@kernel
def write_measurement(f, mean, information):  # type: ignore[no-untyped-def]
    """
    Write mean and information of a factor; return whether both are valid.

    That is, they are finite, and the matrix is symmetric, positive semidefinite and not zero.
    """
    # for symmetry and eigenvalues with the diagonal scaled to 1; a tenth of that in `checks.check`
    tolerance = 1e-6
    to, w = f.information, information
    xx, yy, tt = w[0, 0], w[1, 1], w[2, 2]
    xy, xt, yt = 0.5 * (w[0, 1] + w[1, 0]), 0.5 * (w[0, 2] + w[2, 0]), 0.5 * (w[1, 2] + w[2, 1])
    to[0], to[1], to[2] = xx, xy, xt
    to[3], to[4], to[5] = yy, yt, tt
    f.mean[0], f.mean[1], f.mean[2] = mean[0], mean[1], mean[2]
    total = xx + yy + tt
    if not (abs(mean[0]) < math.inf and abs(mean[1]) < math.inf and abs(mean[2]) < math.inf
            and xx >= 0.0 and yy >= 0.0 and tt >= 0.0 and 0.0 < total <= 1e300):
        return False
    sx, sy, st = math.sqrt(xx), math.sqrt(yy), math.sqrt(tt)
    skew = max(abs(w[0, 1] - w[1, 0]) - tolerance * sx * sy,
               abs(w[0, 2] - w[2, 0]) - tolerance * sx * st,
               abs(w[1, 2] - w[2, 1]) - tolerance * sy * st)
    if not skew <= 0.0:
        return False
    # leading minors of the correlation matrix, with the tolerance added to its diagonal
    a = xy / (sx * sy) if xy != 0.0 else 0.0
    b = xt / (sx * st) if xt != 0.0 else 0.0
    c = yt / (sy * st) if yt != 0.0 else 0.0
    d = 1.0 + tolerance
    return (d * d - a * a > 0.0
            and d * (d * d - c * c) - a * (a * d - b * c) + b * (a * c - b * d) > 0.0)


@kernel
def write_row(head, e, i, j, mean, information, kind, weight):  # type: ignore[no-untyped-def]
    """Write a factor; return whether it is valid, its nodes, kind and constants apart."""
    f = tb.factors(head)[e]
    f.ends[0], f.ends[1], f.ends[2], f.kind, f.weight = i, j, -1, kind, weight
    return write_measurement(f, mean, information) and 0.0 <= weight < math.inf and i != j


@kernel
def write_nodes(head, first, poses, types):  # type: ignore[no-untyped-def]
    """
    Write new hidden nodes, headings wrapped; return whether all poses are finite.

    The types are those of `checks.new_nodes`.
    """
    valid = True
    for k in range(len(poses)):
        node, code = tb.nodes(head)[first + k], np.int64(types[k])
        node.kind, node.dimension = code & 3, 3 - (code >> 2)
        for m in range(3):
            node.pose[m] = poses[k, m]
            valid = valid and abs(poses[k, m]) < math.inf
        node.pose[2] = factors.wrap(node.pose[2])
    return valid


@kernel
def _node(head, v):  # type: ignore[no-untyped-def]
    """Return kind and dimension of a node; _NO_NODE, 3 for -1."""
    if v < 0:
        return _NO_NODE, 3
    return np.int64(tb.nodes(head)[v].kind), np.int64(tb.nodes(head)[v].dimension)


@kernel
def write_rows(head, n_nodes, records):  # type: ignore[no-untyped-def]
    """
    Write new factors, records of `Factors`, behind the last row; return whether all are valid.

    The graph will have n_nodes nodes, of which the new ones have been written.
    """
    valid = True
    for k in range(len(records)):
        e, new, kind = head[tb.N_FACTORS] + k, records[k], records[k].kind
        a, b, c = _node_row(head, new.i), _node_row(head, new.j), _node_row(head, new.k)
        valid = write_row(head, e, a, b, new.mean, new.information, kind, new.weight) and valid
        f = tb.factors(head)[e]
        f.ends[2] = c
        for m in range(4):
            f.constants[m] = new.constants[m]
            valid = valid and abs(new.constants[m]) < math.inf
        # an id that is not in the graph has a negative row, too
        valid = (valid and 0 <= kind < len(_ROWS) and max(a, b, c) < n_nodes
                 and (b >= 0 or new.j == -1) and (c >= 0 or new.k == -1))
        if not valid:
            continue
        ends = _node(head, a), _node(head, b), _node(head, c)
        for m in range(3):
            valid = valid and (_ENDS[kind, m] >> ends[m][0]) & 1 == 1
        if kind < factors.BIAS and c >= 0:  # bias and error of the scale
            valid = valid and ends[2][1] > 1
        # the rows that the error has; of one on a bias, or on a single node, those of the nodes
        by_nodes = kind == factors.BIAS or kind >= factors.OBSERVED
        rows = (1 << min(ends[0][1], ends[1][1])) - 1 if by_nodes else _ROWS[kind]
        for m in range(3):
            if (rows >> m) & 1 == 0:
                valid = (valid and f.information[(0, 3, 5)[m]] == 0.0
                         and (by_nodes or f.mean[m] == 0.0))
    return valid
