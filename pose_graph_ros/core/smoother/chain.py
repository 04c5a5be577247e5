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
from pose_graph_ros.core.graph import factors, normal_equations, tables as tb, transaction_log
from pose_graph_ros.core.graph.pools import give, NODES, take, VALUES
from pose_graph_ros.core.graph.rows import scale_by, start_node, write_row
from pose_graph_ros.core.smoother.tree_update import lacks_memory

# Return codes of `extend`.
EXTENDED, NO_ROOM, NOT_A_CHAIN = range(3)

# Numbers in a clique of one frontal and one separator node, and in a root of one frontal node.
_PAIR = 27
_ROOT = 9


@kernel
def _write_node(head, v, last, mean):  # type: ignore[no-untyped-def]
    """Write a new node at the pose that an edge from the last one predicts."""
    pose, before = tb.nodes(head)[v].pose, tb.nodes(head)[last].pose
    c, s = math.cos(before[2]), math.sin(before[2])
    pose[0] = before[0] + c * mean[0] - s * mean[1]
    pose[1] = before[1] + s * mean[0] + c * mean[1]
    pose[2] = factors.wrap(before[2] + mean[2])
    tb.nodes(head)[v].kind, tb.nodes(head)[v].dimension = 0, 3
    start_node(head, v)
    tb.node_id(head)[v] = head[tb.NEXT_NODE]


@kernel
def _root_equations(head, v, values, front, ld):  # type: ignore[no-untyped-def]
    """Write the equations of a node that is alone in a root, from its rows of R."""
    pool_f, nodes = tb.pool_f(head), tb.nodes(head)
    if nodes[v].fixed != 0:
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
    node = tb.nodes(head)[v]
    least[0] = least[1] = LEAST_PIVOT * node.scale_t * node.scale_t
    least[2] = LEAST_PIVOT * node.scale_r * node.scale_r


@kernel(signature=(tb.HEAD, NUMBERS, ROWS, NUMBER))
def extend(head, mean, information, weight):  # type: ignore[no-untyped-def]
    """
    Return EXTENDED after appending a node to the newest pose by an edge, or why that failed.

    NO_ROOM: a table is full. NOT_A_CHAIN: a general update is necessary. After these two the graph
    is unchanged.
    """
    cliques, nodes, pool_f = tb.cliques(head), tb.nodes(head), tb.pool_f(head)
    work_f, pool_i = tb.work_f(head), tb.pool_i(head)
    v, e = head[tb.N_NODES], head[tb.N_FACTORS]
    lacks = lacks_memory(head, head[tb.POOL_F_END] + _PAIR + _ROOT, head[tb.POOL_I_END] + 3, 256)
    if lacks or v + head[tb.N_PRIORS] >= head[tb.NODE_ROOM] or e >= head[tb.FACTOR_ROOM]:
        return NO_ROOM
    last = head[tb.NEWEST]
    if (len(mean) != 3 or information.shape != (3, 3) or last < 0 or head[tb.N_TOUCHED] > 0
            or nodes[last].clique < 0):
        return NOT_A_CHAIN
    c = nodes[last].clique
    old = cliques[c]
    if old.n_frontal != 1 or old.n_separator != 0:
        return NOT_A_CHAIN
    if not write_row(head, e, last, v, mean, information, 0, weight):
        return NOT_A_CHAIN
    head[tb.UPDATE] += 1    # rows are stamped, but not logged: nothing has to be rolled back
    _write_node(head, v, last, mean)
    f = tb.factors(head)[e]
    f.constants[2] = f.constants[3] = 0.0
    factors.prepare(f, 0)
    tb.factor_id(head)[e] = head[tb.NEXT_FACTOR]
    f.checked = f.waits = 0
    f.owner, f.logged = c, head[tb.UPDATE]
    factors.linearize(head, e)
    f.error2 = f.energy = 0.0
    # the front of the old root and the new node, in work space that holds the new root as well
    ld, ld_root = padded(6), padded(3)
    front, root, least = work_f[:6 * ld], work_f[6 * ld:6 * ld + 3 * ld_root], work_f[250:253]
    front[:] = 0.0
    _root_equations(head, last, old.values, front, ld)
    normal_equations.add(head, e, (0, 3, -1), front, ld)
    scale_t, scale_r = nodes[last].scale_t, nodes[last].scale_r
    scale_by(head, e, weight)
    _set_least_pivots(head, last, least)
    if nodes[last].fixed != 0:
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
        nodes[last].scale_t, nodes[last].scale_r = scale_t, scale_r
        return NOT_A_CHAIN
    # nothing can fail from here on
    give(head, VALUES, old.values, _ROOT)
    give(head, NODES, old.members, 1)
    r = transaction_log.take_clique(head, 1, 0)
    new = cliques[r]
    pool_i[new.members] = v
    write_rows(root, 3, ld_root, pool_f, new.values)
    new.child, new.anchored = c, old.anchored
    for clique in (new, old):   # frames are the map; with one separator node no turn is an error
        clique.turn_seen = clique.turn_zero = clique.turn = 0.0
        clique.slip_error2 = clique.slip_scale = clique.drift = 0.0
    old.parent, old.sibling, old.n_separator = r, -1, 1
    old.members, old.values = take(head, NODES, 2), take(head, VALUES, _PAIR)
    pool_i[old.members], pool_i[old.members + 1] = last, v
    write_rows(front, 6, ld, pool_f, old.values)
    nodes[v].clique = r
    f.next[0], nodes[last].factor_list = nodes[last].factor_list, 4 * e
    f.next[1], nodes[v].factor_list = -1, 4 * e + 1
    head[tb.N_NODES], head[tb.N_FACTORS], head[tb.NEWEST] = v + 1, e + 1, v
    head[tb.N_EDGES] += 1
    head[tb.NEXT_NODE] += 1
    head[tb.NEXT_FACTOR] += 1
    head[tb.LOG_END] = 0
    return EXTENDED
