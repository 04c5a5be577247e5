# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What new rows, new weights and fixed nodes mean for the tables: lists, sums, seeds.

What is not plainly sound has been checked by `graph.Graph`.
"""

import math

from pose_graph_ros.core import factors, rows, tables as tb, undo
from pose_graph_ros.core.jit import kernel

# Answers of `add_rows`.
ADDED, NO_ROOM, UNSOUND = range(3)
# What `edit` does to a row.
WEIGH_EDGE, WEIGH_OBSERVED, FIX = range(3)


@kernel
def add_seed(head, v):  # type: ignore[no-untyped-def]
    """Have a node eliminated again in the next iteration; the caller has logged it."""
    node_i, seeds = tb.node_i(head), tb.seeds(head)
    if node_i[v, tb.SEEDED] == 0:
        node_i[v, tb.SEEDED] = 1
        seeds[head[tb.N_SEEDS]] = v
        head[tb.N_SEEDS] += 1


@kernel
def start_nodes(head, first, first_bias, last):  # type: ignore[no-untyped-def]
    """Make new rows with their poses, and biases from a row on, nodes without a clique."""
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    for v in range(first, last):
        f, i = node_f[v], node_i[v]
        factors.refer_to_pose(f)
        f[tb.STIFF_T] = f[tb.STIFF_R] = 0.0
        i[:] = 0
        i[tb.CLIQUE] = i[tb.EDGE_LIST] = i[tb.OBSERVED_LIST] = -1
        i[tb.NODE_UNDO] = head[tb.UPDATE]
        i[tb.IS_BIAS] = 1 if v >= first_bias else 0
        add_seed(head, v)
        head[tb.STRUCTURE] = 1
    if first_bias > first:
        head[tb.NEWEST] = first_bias - 1


@kernel
def _stiffen(head, v, position, heading):  # type: ignore[no-untyped-def]
    """Add to the information that the constraints of a node have on it."""
    node_f = tb.node_f(head)
    f = node_f[v]
    f[tb.STIFF_T] = math.sqrt(max(f[tb.STIFF_T] * f[tb.STIFF_T] + position, 0.0))
    f[tb.STIFF_R] = math.sqrt(max(f[tb.STIFF_R] * f[tb.STIFF_R] + heading, 0.0))


@kernel
def stiffen_by_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """Add what an edge of this weight is worth to the stiffness of its ends."""
    edge_f, edge_i = tb.edge_f(head), tb.edge_i(head)
    f = edge_f[e]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    heading = weight * f[tb.INFO + 5]
    # of an edge to a bias these are its offset
    arm2 = f[tb.OWN_T] * f[tb.OWN_T] + f[tb.OWN_T + 1] * f[tb.OWN_T + 1]
    _stiffen(head, edge_i[e, tb.END_I], position, heading + position * arm2)
    if edge_i[e, tb.EDGE_KIND] == factors.BIAS:
        position *= f[tb.FACTOR_T] * f[tb.FACTOR_T]
        heading *= f[tb.FACTOR_TH] * f[tb.FACTOR_TH]
    _stiffen(head, edge_i[e, tb.END_J], position, heading)


@kernel
def stiffen_by_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """Add what an observed node of this weight is worth to the stiffness of its node."""
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    f = observed_f[k]
    position = 0.5 * weight * (f[tb.INFO] + f[tb.INFO + 3])
    arm2 = (f[tb.OBS_OFFSET] * f[tb.OBS_OFFSET]
            + f[tb.OBS_OFFSET + 1] * f[tb.OBS_OFFSET + 1])
    _stiffen(head, observed_i[k, tb.OBS_NODE], position,
             weight * f[tb.INFO + 5] + position * arm2)


@kernel
def _share_a_clique(head, a, b):  # type: ignore[no-untyped-def]
    """Tell whether a node is among the nodes of the other's clique."""
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
    """Have the ends of an edge eliminated again, in a new order if the edge asks for one."""
    edge_i = tb.edge_i(head)
    i, j = edge_i[e, tb.END_I], edge_i[e, tb.END_J]
    undo.log_node(head, i)
    undo.log_node(head, j)
    if head[tb.STRUCTURE] == 0 and not _share_a_clique(head, i, j):
        head[tb.STRUCTURE] = 1
    add_seed(head, i)
    add_seed(head, j)


@kernel
def start_edges(head, first, last):  # type: ignore[no-untyped-def]
    """Tie the new edges, rows first to last - 1, to their ends."""
    edge_f = tb.edge_f(head)
    scalars = tb.scalars(head)
    node_i = tb.node_i(head)
    edge_i = tb.edge_i(head)
    for e in range(first, last):
        f, row = edge_f[e], edge_i[e]
        if row[tb.EDGE_KIND] != factors.BIAS:
            c, s = math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])
            f[tb.OWN_T] = c * f[tb.MEAN] + s * f[tb.MEAN + 1]
            f[tb.OWN_T + 1] = c * f[tb.MEAN + 1] - s * f[tb.MEAN]
        row[tb.EDGE_CHECKED] = row[tb.EDGE_WAITS] = 0
        row[tb.EDGE_UNDO] = head[tb.UPDATE]
        _touch_edge(head, e)
        i, j = row[tb.END_I], row[tb.END_J]
        row[tb.NEXT_I], node_i[i, tb.EDGE_LIST] = node_i[i, tb.EDGE_LIST], 2 * e
        row[tb.NEXT_J], node_i[j, tb.EDGE_LIST] = node_i[j, tb.EDGE_LIST], 2 * e + 1
        stiffen_by_edge(head, e, f[tb.WEIGHT])
        factors.linearize_edge(head, e)
        factors.check_edge(head, e, 0.0)
        scalars[tb.CHI2] += f[tb.ENERGY]


@kernel
def start_observed(head, first, last):  # type: ignore[no-untyped-def]
    """Tie the new observed nodes, rows first to last - 1, to their hidden nodes."""
    observed_f = tb.observed_f(head)
    scalars = tb.scalars(head)
    node_i = tb.node_i(head)
    observed_i = tb.observed_i(head)
    for k in range(first, last):
        f, row = observed_f[k], observed_i[k]
        v = row[tb.OBS_NODE]
        undo.log_node(head, v)
        row[tb.OBS_NEXT], node_i[v, tb.OBSERVED_LIST] = node_i[v, tb.OBSERVED_LIST], k
        row[tb.OBS_CHECKED] = row[tb.OBS_WAITS] = 0
        row[tb.OBS_UNDO] = head[tb.UPDATE]
        stiffen_by_observed(head, k, f[tb.WEIGHT])
        factors.linearize_observed(head, k)
        factors.check_observed(head, k)
        scalars[tb.CHI2] += f[tb.OBS_ENERGY]
        add_seed(head, v)


@kernel
def weigh_edge(head, e, weight):  # type: ignore[no-untyped-def]
    """Set the weight of an edge; 0 removes it."""
    edge_f, scalars = tb.edge_f(head), tb.scalars(head)
    f = edge_f[e]
    undo.log_edge(head, e)
    _touch_edge(head, e)
    stiffen_by_edge(head, e, weight - f[tb.WEIGHT])
    scalars[tb.CHI2] -= f[tb.ENERGY]
    f[tb.WEIGHT] = weight
    factors.linearize_edge(head, e)
    factors.check_edge(head, e, 0.0)
    scalars[tb.CHI2] += f[tb.ENERGY]


@kernel
def weigh_observed(head, k, weight):  # type: ignore[no-untyped-def]
    """Set the weight of an observed node; 0 removes it."""
    observed_f, scalars, observed_i = tb.observed_f(head), tb.scalars(head), tb.observed_i(head)
    f, v = observed_f[k], observed_i[k, tb.OBS_NODE]
    undo.log_observed(head, k)
    undo.log_node(head, v)
    stiffen_by_observed(head, k, weight - f[tb.WEIGHT])
    scalars[tb.CHI2] -= f[tb.OBS_ENERGY]
    f[tb.WEIGHT] = weight
    factors.linearize_observed(head, k)
    factors.check_observed(head, k)
    scalars[tb.CHI2] += f[tb.OBS_ENERGY]
    add_seed(head, v)


@kernel
def set_fixed(head, v, fixed):  # type: ignore[no-untyped-def]
    """Fix a node at its present pose, or free it."""
    node_i = tb.node_i(head)
    if node_i[v, tb.FIXED] != fixed:
        undo.log_node(head, v)
        node_i[v, tb.FIXED] = fixed
        add_seed(head, v)


@kernel
def edit(head, what, number, value):  # type: ignore[no-untyped-def]
    """Set the weight of an edge or an observed node, or fix (1) or free (0) a hidden node."""
    if what == WEIGH_EDGE:
        weigh_edge(head, number, value)
    elif what == WEIGH_OBSERVED:
        weigh_observed(head, number, value)
    else:
        set_fixed(head, number, value)


@kernel
def _lengths_agree(n, mean, information, kind, weight):  # type: ignore[no-untyped-def]
    return (mean.shape == (n, 3) and information.shape == (n, 3, 3) and len(kind) == n
            and len(weight) == n)


@kernel
def add_rows(  # type: ignore[no-untyped-def]
    head, hidden, biases, i, j, mean, information, kind, weight, bias, node, offset,
    observed_mean, observed_information, observed_kind, observed_weight, checked,
):
    """
    Add hidden nodes, edges and observed nodes, all of them or none.

    Parameters
    ----------
    hidden, biases : ndarray, shapes (N, 3) and (S, 3)
        Poses of new hidden nodes, then values of new biases.
    i, j, mean, information, kind, weight, bias : ndarray
        Columns of `Edges`.
    node, offset, observed_mean, observed_information, observed_kind, observed_weight : ndarray
        Columns of `ObservedNodes`.
    checked : bool
        Whether all of it has been found to be sound.

    Returns
    -------
    int
        ADDED; NO_ROOM: a table is full; UNSOUND: not plainly sound, and not checked either.

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
    # rows behind the ends count for nothing yet
    sound = rows.write_nodes(head, first, hidden)
    sound = rows.write_nodes(head, first_bias, biases) and sound
    sound = rows.write_edges(head, n_nodes, first_bias, i, j, mean, information, kind, weight,
                             bias) and sound
    sound = rows.write_all_observed(
        head, n_nodes, node, offset, observed_mean, observed_information, observed_kind,
        observed_weight) and sound
    if not sound and not checked:
        return UNSOUND
    head[tb.N_NODES] = n_nodes
    start_nodes(head, first, first_bias, n_nodes)
    first, head[tb.N_EDGES] = head[tb.N_EDGES], n_edges
    start_edges(head, first, n_edges)
    first, head[tb.N_OBSERVED] = head[tb.N_OBSERVED], n_observed
    start_observed(head, first, n_observed)
    return ADDED


@kernel
def restart(head):  # type: ignore[no-untyped-def]
    """Linearize everything at the poses as they are and forget all cliques."""
    node_f = tb.node_f(head)
    edge_f = tb.edge_f(head)
    observed_f = tb.observed_f(head)
    scalars = tb.scalars(head)
    node_i = tb.node_i(head)
    edge_i = tb.edge_i(head)
    observed_i = tb.observed_i(head)
    head[tb.N_CLIQUES] = head[tb.POOL_F_END] = head[tb.POOL_I_END] = 0
    head[tb.FREE_CLIQUE] = -1
    head[tb.FREE_F:] = -1
    head[tb.N_FREED] = head[tb.N_SEEDS] = head[tb.N_WAITING] = 0
    scalars[tb.CHI2] = 0.0
    head[tb.STRUCTURE] = 1
    for v in range(head[tb.N_NODES]):
        factors.refer_to_pose(node_f[v])
        node_i[v, tb.CLIQUE] = -1
        node_i[v, tb.SEEDED] = 0
        add_seed(head, v)
    for e in range(head[tb.N_EDGES]):
        factors.linearize_edge(head, e)
        factors.check_edge(head, e, 0.0)
        edge_i[e, tb.EDGE_WAITS] = 0
        scalars[tb.CHI2] += edge_f[e, tb.ENERGY]
    for k in range(head[tb.N_OBSERVED]):
        factors.linearize_observed(head, k)
        factors.check_observed(head, k)
        observed_i[k, tb.OBS_WAITS] = 0
        scalars[tb.CHI2] += observed_f[k, tb.OBS_ENERGY]
