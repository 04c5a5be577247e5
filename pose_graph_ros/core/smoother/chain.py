# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Extension of a chain by a node behind the newest pose, in constant time.

The newest pose is alone in the root clique. Its rows of R give its equations `R^T R` and `R^T d`,
which make a front of two nodes with the new edge. The old root is eliminated from it, and the new
node becomes the root. The solution is known: the new node lies where odometry predicts it, and no
other node moves.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel, NUMBER, NUMBERS, ROWS
from pose_graph_ros.core.elimination.assembly import substitute_fixed
from pose_graph_ros.core.elimination.fronts import factorize, LEAST_PIVOT, padded, write_rows
from pose_graph_ros.core.graph import (
    factors,
    normal_equations,
    pools,
    rows,
    tables as tb,
    transaction_log,
)
from pose_graph_ros.core.graph.rows import scale_by
from pose_graph_ros.core.smoother.tree_update import lacks_memory

# Return codes of `extend`.
EXTENDED, NO_ROOM, NOT_A_CHAIN = range(3)

# Numbers in a clique of one frontal and one separator node, and in a root of one frontal node.
_PAIR = 27
_ROOT = 9


@kernel
def _write_node(head, v, last, mean):  # type: ignore[no-untyped-def]
    """Write a new node at the pose that an edge from the last one predicts."""
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    f, i, p = node_f[v], node_i[v], node_f[last]
    c, s = math.cos(p[tb.POSE + 2]), math.sin(p[tb.POSE + 2])
    f[tb.POSE] = p[tb.POSE] + c * mean[0] - s * mean[1]
    f[tb.POSE + 1] = p[tb.POSE + 1] + s * mean[0] + c * mean[1]
    f[tb.POSE + 2] = factors.wrap(p[tb.POSE + 2] + mean[2])
    factors.refer_to_pose(f)
    f[tb.SCALE_T] = f[tb.SCALE_R] = 0.0
    i[:] = 0
    i[tb.CLIQUE] = i[tb.FACTOR_LIST] = -1
    i[tb.NODE_LOGGED] = head[tb.UPDATE]
    tb.node_id(head)[v] = head[tb.NEXT_NODE]


@kernel
def _root_equations(head, v, values, front, ld):  # type: ignore[no-untyped-def]
    """Write the equations of a node that is alone in a root, from its rows of R."""
    pool_f, node_i = tb.pool_f(head), tb.node_i(head)
    if node_i[v, tb.FIXED] != 0:
        return  # `substitute_fixed` writes the rows of a fixed node
    r = pool_f[values:values + _ROOT]
    a, b, c, x = 1.0 / r[0], r[1], r[2], r[3]
    d, e, y = 1.0 / r[4], r[5], r[6]
    g, z = 1.0 / r[7], r[8]
    right = ld - 1
    front[0], front[1], front[2], front[right] = a * a, a * b, a * c, a * x
    front[ld + 1], front[ld + 2] = b * b + d * d, b * c + d * e
    front[ld + right] = b * x + d * y
    front[2 * ld + 2] = c * c + e * e + g * g
    front[2 * ld + right] = c * x + e * y + g * z


@kernel
def _set_least_pivots(head, v, least):  # type: ignore[no-untyped-def]
    node_f = tb.node_f(head)
    f = node_f[v]
    least[0] = least[1] = LEAST_PIVOT * f[tb.SCALE_T] * f[tb.SCALE_T]
    least[2] = LEAST_PIVOT * f[tb.SCALE_R] * f[tb.SCALE_R]


@kernel(signature=(tb.HEAD, NUMBERS, ROWS, NUMBER))
def extend(head, mean, information, weight):  # type: ignore[no-untyped-def]
    """
    Return EXTENDED after appending a node to the newest pose by an edge, or why that failed.

    NO_ROOM: a table is full. NOT_A_CHAIN: a general update is necessary. After these two the graph
    is unchanged.
    """
    clique_f, node_f, factor_f = tb.clique_f(head), tb.node_f(head), tb.factor_f(head)
    pool_f, work_f, node_i = tb.pool_f(head), tb.work_f(head), tb.node_i(head)
    factor_i, clique_i, pool_i = tb.factor_i(head), tb.clique_i(head), tb.pool_i(head)
    v, e = head[tb.N_NODES], head[tb.N_FACTORS]
    lacks = lacks_memory(head, head[tb.POOL_F_END] + _PAIR + _ROOT, head[tb.POOL_I_END] + 3, 256)
    if lacks or v + head[tb.N_PRIORS] >= head[tb.NODE_ROOM] or e >= head[tb.FACTOR_ROOM]:
        return NO_ROOM
    if len(mean) != 3 or information.shape != (3, 3):
        return NOT_A_CHAIN
    last = head[tb.NEWEST]
    if (last < 0 or head[tb.N_TOUCHED] > 0 or head[tb.UPDATE] > tb.LAST_STAMP
            or node_i[last, tb.CLIQUE] < 0):
        return NOT_A_CHAIN
    c = node_i[last, tb.CLIQUE]
    old = clique_i[c]
    if old[tb.N_FRONTAL] != 1 or old[tb.N_SEPARATOR] != 0:
        return NOT_A_CHAIN
    if not rows.write_row(head, e, last, v, mean, information, 0, weight):
        return NOT_A_CHAIN
    head[tb.UPDATE] += 1    # rows are stamped, but not logged: nothing has to be rolled back
    _write_node(head, v, last, mean)
    f = factor_f[e]
    factors.prepare(f, 0)
    tb.factor_id(head)[e] = head[tb.NEXT_FACTOR]
    factor_i[e, tb.FACTOR_CHECKED] = factor_i[e, tb.FACTOR_WAITS] = 0
    factor_i[e, tb.OWNER] = c
    factor_i[e, tb.FACTOR_LOGGED] = head[tb.UPDATE]
    factors.linearize(head, e)
    f[tb.ERROR2] = f[tb.ENERGY] = 0.0
    # the front of the old root and the new node, in work space that holds the new root as well
    ld, ld_root = padded(6), padded(3)
    front, root, least = work_f[:6 * ld], work_f[6 * ld:6 * ld + 3 * ld_root], work_f[250:253]
    front[:] = 0.0
    _root_equations(head, last, old[tb.VALUES], front, ld)
    normal_equations.add(head, e, 0, 3, -1, front, ld)
    scale_t, scale_r = node_f[last, tb.SCALE_T], node_f[last, tb.SCALE_R]
    scale_by(head, e, weight)
    _set_least_pivots(head, last, least)
    if node_i[last, tb.FIXED] != 0:
        substitute_fixed(head, last, 0, front, 6, ld)
        least[:] = 0.0
    bad = factorize(front, 3, 6, ld, least)
    for m in range(3):
        for n in range(3):
            root[ld_root * m + n] = front[ld * (m + 3) + n + 3]
        root[ld_root * (m + 1) - 1] = front[ld * (m + 4) - 1]
    _set_least_pivots(head, v, least)
    if bad < 0:
        bad = factorize(root, 3, 3, ld_root, least)
    if bad >= 0:
        node_f[last, tb.SCALE_T], node_f[last, tb.SCALE_R] = scale_t, scale_r
        return NOT_A_CHAIN
    # nothing can fail from here on
    values, nodes = old[tb.VALUES], old[tb.NODES]
    pools.give_values(head, values, _ROOT)
    pools.give_nodes(head, nodes, 1)
    r = transaction_log.take_clique(head, 1, 0)
    pool_i[clique_i[r, tb.NODES]] = v
    write_rows(root, 3, ld_root, pool_f, clique_i[r, tb.VALUES])
    clique_i[r, tb.CHILD] = c
    clique_i[r, tb.ANCHORED] = old[tb.ANCHORED]
    for m in range(tb.CLIQUE_F):
        clique_f[r, m] = clique_f[c, m] = 0.0  # SLIP_SCALE is 0 with one separator node
    old[tb.PARENT], old[tb.SIBLING], old[tb.N_SEPARATOR] = r, -1, 1
    old[tb.NODES], old[tb.VALUES] = pools.take_nodes(head, 2), pools.take_values(head, _PAIR)
    pool_i[old[tb.NODES]], pool_i[old[tb.NODES] + 1] = last, v
    write_rows(front, 6, ld, pool_f, old[tb.VALUES])
    node_i[v, tb.CLIQUE] = r
    factor_i[e, tb.NEXT_I], node_i[last, tb.FACTOR_LIST] = node_i[last, tb.FACTOR_LIST], 4 * e
    factor_i[e, tb.NEXT_J], node_i[v, tb.FACTOR_LIST] = -1, 4 * e + 1
    head[tb.N_NODES], head[tb.N_FACTORS], head[tb.NEWEST] = v + 1, e + 1, v
    head[tb.NEXT_NODE] += 1
    head[tb.NEXT_FACTOR] += 1
    head[tb.LOG_I_END] = 0
    return EXTENDED
