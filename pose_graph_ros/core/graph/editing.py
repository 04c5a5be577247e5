# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Edit the graph in its tables: new rows, new weights, fixed nodes.

Each edit keeps the lists, the diagonal scales and chi2 up to date, and touches the nodes that have
to be eliminated again. Edits of existing rows are not checked here; `graph.Graph` has done so.

Only constraints with a weight above 0 are in the lists of their nodes. The others are rows that
nothing looks at: adding one touches no node, and however many there are, solving takes no longer.
"""

import math

from pose_graph_ros.core.compiled.jit import (
    BYTES,
    FLAG,
    INTEGERS,
    kernel,
    MATRICES,
    NUMBERS,
    ROWS,
)
from pose_graph_ros.core.graph import factors, identities, rows, tables as tb, transaction_log

# Results of `add_rows`.
ADDED, NO_ROOM, UNSOUND = range(3)


@kernel
def touch(head, v):  # type: ignore[no-untyped-def]
    """Mark a node for elimination in the next iteration; the caller has logged its row."""
    node_i, touched = tb.node_i(head), tb.touched(head)
    if node_i[v, tb.TOUCHED] == 0:
        node_i[v, tb.TOUCHED] = 1
        touched[head[tb.N_TOUCHED]] = v
        head[tb.N_TOUCHED] += 1


@kernel
def _start_nodes(head, first, first_bias, last):  # type: ignore[no-untyped-def]
    """Initialise rows of new hidden nodes: the poses before `first_bias`, the biases from it."""
    node_f, node_i, node_id = tb.node_f(head), tb.node_i(head), tb.node_id(head)
    for v in range(first, last):
        f, i = node_f[v], node_i[v]
        factors.refer_to_pose(f)
        f[tb.SCALE_T] = f[tb.SCALE_R] = 0.0
        i[:] = 0
        i[tb.CLIQUE] = i[tb.EDGE_LIST] = i[tb.OBSERVED_LIST] = -1
        i[tb.NODE_LOGGED] = head[tb.UPDATE]
        i[tb.IS_BIAS] = 1 if v >= first_bias else 0
        node_id[v] = head[tb.NEXT_NODE]
        head[tb.NEXT_NODE] += 1
        touch(head, v)
        head[tb.STRUCTURE] = 1
    if first_bias > first:
        head[tb.NEWEST] = first_bias - 1


@kernel
def _add_to_scale(head, v, position, heading):  # type: ignore[no-untyped-def]
    """Add information on position and heading to the squared diagonal scales of a node."""
    node_f = tb.node_f(head)
    f = node_f[v]
    f[tb.SCALE_T] = math.sqrt(max(f[tb.SCALE_T] * f[tb.SCALE_T] + position, 0.0))
    f[tb.SCALE_R] = math.sqrt(max(f[tb.SCALE_R] * f[tb.SCALE_R] + heading, 0.0))


@kernel
def scale_by_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """
    Add the information of an edge to the diagonal scales of its ends.

    Parameters
    ----------
    e : int
    weight : float, its weight, or the change of it

    """
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    f = edge_f[e]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    heading = weight * f[tb.INFO + 5]
    # for an edge to a bias, OWN_T is BIAS_OFFSET
    arm2 = f[tb.OWN_T] * f[tb.OWN_T] + f[tb.OWN_T + 1] * f[tb.OWN_T + 1]
    _add_to_scale(head, edge_i[e, tb.END_I], position, heading + position * arm2)
    if edge_i[e, tb.EDGE_KIND] == factors.BIAS:
        position *= f[tb.FACTOR_T] * f[tb.FACTOR_T]
        heading *= f[tb.FACTOR_TH] * f[tb.FACTOR_TH]
    _add_to_scale(head, edge_i[e, tb.END_J], position, heading)


@kernel
def scale_by_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """
    Add the information of an observed node to the diagonal scales of its hidden node.

    Parameters
    ----------
    k : int
    weight : float, its weight, or the change of it

    """
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    f = observed_f[k]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    arm2 = (f[tb.OBS_OFFSET] * f[tb.OBS_OFFSET]
            + f[tb.OBS_OFFSET + 1] * f[tb.OBS_OFFSET + 1])
    _add_to_scale(head, observed_i[k, tb.OBS_NODE], position,
                  weight * f[tb.INFO + 5] + position * arm2)


@kernel
def _have_common_clique(head, a, b):  # type: ignore[no-untyped-def]
    """Tell whether one of two nodes is in the clique that the other is frontal in."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    for _ in range(2):
        c = node_i[a, tb.CLIQUE]
        if c < 0:
            return False
        row = clique_i[c]
        for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL] + row[tb.N_SEPARATOR]):
            if pool_i[m] == b:
                return True
        a, b = b, a
    return False


@kernel
def _touch_edge(head, e):  # type: ignore[no-untyped-def]
    """Log and touch the ends of an edge; ask for a new ordering if no clique has both."""
    edge_i = tb.edge_i(head)
    i, j = edge_i[e, tb.END_I], edge_i[e, tb.END_J]
    transaction_log.log_node(head, i)
    transaction_log.log_node(head, j)
    if head[tb.STRUCTURE] == 0 and not _have_common_clique(head, i, j):
        head[tb.STRUCTURE] = 1
    touch(head, i)
    touch(head, j)


@kernel
def _link_edge(head, e):  # type: ignore[no-untyped-def]
    """Put an edge at the heads of the lists of its ends; the caller has logged all three rows."""
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    row = edge_i[e]
    i, j = row[tb.END_I], row[tb.END_J]
    row[tb.NEXT_I], node_i[i, tb.EDGE_LIST] = node_i[i, tb.EDGE_LIST], 2 * e
    row[tb.NEXT_J], node_i[j, tb.EDGE_LIST] = node_i[j, tb.EDGE_LIST], 2 * e + 1


@kernel
def _unlink_edge(head, e, side):  # type: ignore[no-untyped-def]
    """Take an edge out of the list of its end I (side 0) or J (1), whose row has been logged."""
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    v = edge_i[e, tb.END_J if side == 1 else tb.END_I]
    after = edge_i[e, tb.NEXT_J if side == 1 else tb.NEXT_I]
    entry = node_i[v, tb.EDGE_LIST]
    if entry == 2 * e + side:
        node_i[v, tb.EDGE_LIST] = after
        return
    while True:
        before, column = entry >> 1, tb.NEXT_J if (entry & 1) == 1 else tb.NEXT_I
        entry = edge_i[before, column]
        if entry == 2 * e + side:
            transaction_log.log_edge(head, before)
            edge_i[before, column] = after
            return


@kernel
def _unlink_observed(head, k):  # type: ignore[no-untyped-def]
    """Take an observed node out of the list of its hidden node, whose row has been logged."""
    node_i, observed_i = tb.node_i(head), tb.observed_i(head)
    v, after = observed_i[k, tb.OBS_NODE], observed_i[k, tb.OBS_NEXT]
    before = node_i[v, tb.OBSERVED_LIST]
    if before == k:
        node_i[v, tb.OBSERVED_LIST] = after
        return
    while observed_i[before, tb.OBS_NEXT] != k:
        before = observed_i[before, tb.OBS_NEXT]
    transaction_log.log_observed(head, before)
    observed_i[before, tb.OBS_NEXT] = after


@kernel
def weigh_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """
    Change the weight of an edge; at 0 it is in no list.

    Parameters
    ----------
    e : int, row
    weight : float

    """
    edge_f, scalars = tb.edge_f(head), tb.scalars(head)
    f = edge_f[e]
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_edge(head, e)
    _touch_edge(head, e)
    scale_by_edge(head, e, weight - before)
    scalars[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    if weight == 0.0:
        _unlink_edge(head, e, 0)
        _unlink_edge(head, e, 1)
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        return
    if before == 0.0:
        _link_edge(head, e)
    factors.linearize_edge(head, e)
    factors.check_edge(head, e, 0.0)
    scalars[tb.CHI2] += f[tb.ENERGY]


@kernel
def weigh_one_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """
    Change the weight of an observed node; at 0 it is in no list.

    Parameters
    ----------
    k : int, row
    weight : float

    """
    observed_f, scalars, observed_i = tb.observed_f(head), tb.scalars(head), tb.observed_i(head)
    node_i = tb.node_i(head)
    f, v = observed_f[k], observed_i[k, tb.OBS_NODE]
    before = f[tb.WEIGHT]
    if weight == before:
        return
    transaction_log.log_observed(head, k)
    transaction_log.log_node(head, v)
    touch(head, v)
    scale_by_observed(head, k, weight - before)
    scalars[tb.CHI2] -= f[tb.OBS_ENERGY]
    f[tb.WEIGHT] = weight
    if weight == 0.0:
        _unlink_observed(head, k)
        f[tb.OBS_ERROR2] = f[tb.OBS_ENERGY] = 0.0
        return
    if before == 0.0:
        observed_i[k, tb.OBS_NEXT], node_i[v, tb.OBSERVED_LIST] = node_i[v, tb.OBSERVED_LIST], k
    factors.linearize_observed(head, k)
    factors.check_observed(head, k)
    scalars[tb.CHI2] += f[tb.OBS_ENERGY]


@kernel
def _start_edges(head, first, last):  # type: ignore[no-untyped-def]
    """Initialise new rows of edges, and add those with a weight to the graph."""
    edge_f, edge_i, edge_id = tb.edge_f(head), tb.edge_i(head), tb.edge_id(head)
    for e in range(first, last):
        edge_id[e] = head[tb.NEXT_EDGE]
        head[tb.NEXT_EDGE] += 1
        f, row = edge_f[e], edge_i[e]
        if row[tb.EDGE_KIND] != factors.BIAS:
            c, s = math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])
            f[tb.OWN_T] = c * f[tb.MEAN] + s * f[tb.MEAN + 1]
            f[tb.OWN_T + 1] = c * f[tb.MEAN + 1] - s * f[tb.MEAN]
        f[tb.ERROR2] = f[tb.ENERGY] = 0.0
        row[tb.EDGE_CHECKED] = row[tb.EDGE_WAITS] = row[tb.EDGE_LEAVES] = 0
        row[tb.EDGE_LOGGED] = head[tb.UPDATE]
        weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
        weigh_edge(head, e, weight)


@kernel
def _start_observed(head, first, last):  # type: ignore[no-untyped-def]
    """Initialise new rows of observed nodes, and add those with a weight to the graph."""
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    observed_id = tb.observed_id(head)
    for k in range(first, last):
        observed_id[k] = head[tb.NEXT_OBSERVED]
        head[tb.NEXT_OBSERVED] += 1
        f, row = observed_f[k], observed_i[k]
        f[tb.OBS_ERROR2] = f[tb.OBS_ENERGY] = 0.0
        row[tb.OBS_WAITS] = row[tb.OBS_LEAVES] = 0
        row[tb.OBS_LOGGED] = head[tb.UPDATE]
        weight, f[tb.WEIGHT] = f[tb.WEIGHT], 0.0
        weigh_one_observed(head, k, weight)


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def weigh_edges(head, edges, weights):  # type: ignore[no-untyped-def]
    """
    Set the weights of edges.

    Parameters
    ----------
    edges, weights : ndarray, shape (M,), ids and weights; 0 takes an edge out of all lists

    """
    for m in range(len(edges)):
        weigh_edge(head, identities.edge_row(head, edges[m]), weights[m])


@kernel(signature=(tb.HEAD, INTEGERS, NUMBERS))
def weigh_observed(head, observed, weights):  # type: ignore[no-untyped-def]
    """
    Set the weights of observed nodes.

    Parameters
    ----------
    observed, weights : ndarray, shape (K,), as for `weigh_edges`

    """
    for m in range(len(observed)):
        weigh_one_observed(head, identities.observed_row(head, observed[m]), weights[m])


@kernel(signature=(tb.HEAD, INTEGERS, FLAG))
def set_fixed(head, nodes, fixed):  # type: ignore[no-untyped-def]
    """
    Fix hidden nodes at their present poses, or free them.

    Parameters
    ----------
    nodes : ndarray of int, shape (N,), ids
    fixed : bool

    """
    node_i = tb.node_i(head)
    for node in nodes:
        v = identities.node_row(head, node)
        if (node_i[v, tb.FIXED] != 0) != fixed:
            transaction_log.log_node(head, v)
            node_i[v, tb.FIXED] = 1 if fixed else 0
            touch(head, v)


@kernel
def _lengths_agree(n, mean, information, kind, weight):  # type: ignore[no-untyped-def]
    return (mean.shape == (n, 3) and information.shape == (n, 3, 3) and len(kind) == n
            and len(weight) == n)


@kernel(signature=(
    tb.HEAD, ROWS, ROWS, INTEGERS, INTEGERS, ROWS, MATRICES, BYTES, NUMBERS, ROWS, INTEGERS,
    ROWS, ROWS, MATRICES, BYTES, NUMBERS, FLAG))
def add_rows(  # type: ignore[no-untyped-def]
    head, hidden, biases, i, j, mean, information, kind, weight, bias, node, offset,
    observed_mean, observed_information, observed_kind, observed_weight, checked,
):
    """
    Return ADDED after adding hidden nodes, edges and observed nodes, all of them, or why none.

    NO_ROOM: a table is full. UNSOUND: the rows fail the quick validation of `rows`, and were not
    checked.

    Parameters
    ----------
    hidden, biases : ndarray, shapes (N, 3) and (S, 3), poses of new nodes, values of new biases
    i, j, mean, information, kind, weight, bias : ndarray, columns of `Edges`
    node, offset, observed_mean, observed_information, observed_kind, observed_weight : ndarray
        Columns of `ObservedNodes`.
    checked : bool, whether `constraints.check` has accepted the rows

    """
    first = head[tb.N_NODES]
    first_bias = first + len(hidden)
    n_nodes = first_bias + len(biases)
    n_edges = head[tb.N_EDGES] + len(i)
    n_observed = head[tb.N_OBSERVED] + len(node)
    if (hidden.shape[1] != 3 or biases.shape[1] != 3 or len(j) != len(i)
            or not _lengths_agree(len(i), mean, information, kind, weight)
            or bias.shape != (len(i), 4)
            or offset.shape != (len(node), 3)
            or not _lengths_agree(len(node), observed_mean, observed_information, observed_kind,
                                  observed_weight)):
        return UNSOUND
    if (n_nodes > head[tb.NODE_ROOM] or n_edges > head[tb.EDGE_ROOM]
            or n_observed > head[tb.OBSERVED_ROOM]):
        return NO_ROOM
    # rows behind the ends are not part of the graph yet
    valid = rows.write_nodes(head, first, hidden)
    valid = rows.write_nodes(head, first_bias, biases) and valid
    valid = rows.write_edges(head, n_nodes, first_bias, i, j, mean, information, kind, weight,
                             bias) and valid
    valid = rows.write_all_observed(
        head, n_nodes, node, offset, observed_mean, observed_information, observed_kind,
        observed_weight) and valid
    if not valid and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    _start_nodes(head, first, first_bias, n_nodes)
    first, head[tb.N_EDGES] = head[tb.N_EDGES], n_edges
    _start_edges(head, first, n_edges)
    first, head[tb.N_OBSERVED] = head[tb.N_OBSERVED], n_observed
    _start_observed(head, first, n_observed)
    return ADDED


@kernel(signature=(tb.HEAD,))
def restart(head):  # type: ignore[no-untyped-def]
    """Remove all cliques, linearize all constraints at the present poses and touch all nodes."""
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    scalars, node_i, edge_i = tb.scalars(head), tb.node_i(head), tb.edge_i(head)
    observed_i = tb.observed_i(head)
    head[tb.N_CLIQUES] = head[tb.POOL_F_END] = head[tb.POOL_I_END] = 0
    head[tb.FREE_CLIQUE] = -1
    head[tb.FREE_F:] = -1
    head[tb.N_FREED] = head[tb.N_TOUCHED] = head[tb.N_WAITING] = 0
    scalars[tb.CHI2] = 0.0
    head[tb.STRUCTURE] = 1
    for v in range(head[tb.N_NODES]):
        factors.refer_to_pose(node_f[v])
        node_i[v, tb.CLIQUE] = -1
        node_i[v, tb.TOUCHED] = 0
        touch(head, v)
    for e in range(head[tb.N_EDGES]):
        edge_i[e, tb.EDGE_WAITS] = 0
        if edge_f[e, tb.WEIGHT] > 0.0:
            factors.linearize_edge(head, e)
            factors.check_edge(head, e, 0.0)
            scalars[tb.CHI2] += edge_f[e, tb.ENERGY]
    for k in range(head[tb.N_OBSERVED]):
        observed_i[k, tb.OBS_WAITS] = 0
        if observed_f[k, tb.WEIGHT] > 0.0:
            factors.linearize_observed(head, k)
            factors.check_observed(head, k)
            scalars[tb.CHI2] += observed_f[k, tb.OBS_ENERGY]
