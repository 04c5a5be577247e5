# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compaction of the tables after an update that nodes or constraints have left.

The rows that stay move up, in their order, and everything that refers to a row is rewritten: ends
of constraints, lists of nodes and of cliques, what is touched or waits, the newest pose. Cliques
keep their rows. There is no way back, so the update must have been committed.

Reference to a row that leaves: an edge leaves with any of its nodes, an observed node with its
hidden node; from lists of constraints, cliques and touched nodes they have been taken out before.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb


@kernel
def _move_row(numbers, integers, ids, k, to):  # type: ignore[no-untyped-def]
    """Copy row k of the tables of nodes, edges or observed nodes."""
    if k == to:
        return
    for m in range(numbers.shape[1]):
        numbers[to, m] = numbers[k, m]
    for m in range(integers.shape[1]):
        integers[to, m] = integers[k, m]
    ids[to] = ids[k]


@kernel(allocates=True)
def _move_nodes(head):  # type: ignore[no-untyped-def]
    """Move the rows of nodes up; return where each has gone, -1 for those that leave."""
    node_f, node_i, node_id = tb.node_f(head), tb.node_i(head), tb.node_id(head)
    n = head[tb.N_NODES]
    where, kept = np.empty(n, np.int32), 0
    for v in range(n):
        if node_i[v, tb.NODE_LEAVES] != 0:
            where[v] = -1
            continue
        where[v] = kept
        _move_row(node_f, node_i, node_id, v, kept)
        kept += 1
    head[tb.N_NODES] = kept
    return where


@kernel(allocates=True)
def _move_edges(head, nodes):  # type: ignore[no-untyped-def]
    """Move the rows of edges up, with the new rows of their ends; return as `_move_nodes`."""
    edge_f, edge_i, edge_id = tb.edge_f(head), tb.edge_i(head), tb.edge_id(head)
    n = head[tb.N_EDGES]
    where, kept = np.empty(n, np.int32), 0
    for e in range(n):
        i, j = nodes[edge_i[e, tb.END_I]], nodes[edge_i[e, tb.END_J]]
        if edge_i[e, tb.EDGE_LEAVES] != 0 or i < 0 or j < 0:
            where[e] = -1
            continue
        where[e] = kept
        _move_row(edge_f, edge_i, edge_id, e, kept)
        edge_i[kept, tb.END_I], edge_i[kept, tb.END_J] = i, j
        kept += 1
    head[tb.N_EDGES] = kept
    return where


@kernel(allocates=True)
def _move_observed(head, nodes):  # type: ignore[no-untyped-def]
    """Move the rows of observed nodes up, as `_move_edges`."""
    observed_f, observed_i = tb.observed_f(head), tb.observed_i(head)
    observed_id = tb.observed_id(head)
    n = head[tb.N_OBSERVED]
    where, kept = np.empty(n, np.int32), 0
    for k in range(n):
        v = nodes[observed_i[k, tb.OBS_NODE]]
        if observed_i[k, tb.OBS_LEAVES] != 0 or v < 0:
            where[k] = -1
            continue
        where[k] = kept
        _move_row(observed_f, observed_i, observed_id, k, kept)
        observed_i[kept, tb.OBS_NODE] = v
        kept += 1
    head[tb.N_OBSERVED] = kept
    return where


@kernel
def _entry(entry, edges):  # type: ignore[no-untyped-def]
    """Return an entry of the list of a node's edges with the new row of the edge."""
    return 2 * edges[entry >> 1] + (entry & 1) if entry >= 0 else -1


@kernel
def _rewrite_lists(head, edges, observed):  # type: ignore[no-untyped-def]
    """Rewrite the lists of constraints of all nodes."""
    node_i, edge_i, observed_i = tb.node_i(head), tb.edge_i(head), tb.observed_i(head)
    for v in range(head[tb.N_NODES]):
        row = node_i[v]
        row[tb.EDGE_LIST] = _entry(row[tb.EDGE_LIST], edges)
        if row[tb.OBSERVED_LIST] >= 0:
            row[tb.OBSERVED_LIST] = observed[row[tb.OBSERVED_LIST]]
    for e in range(head[tb.N_EDGES]):
        if tb.edge_f(head)[e, tb.WEIGHT] > 0.0:     # others are in no list
            edge_i[e, tb.NEXT_I] = _entry(edge_i[e, tb.NEXT_I], edges)
            edge_i[e, tb.NEXT_J] = _entry(edge_i[e, tb.NEXT_J], edges)
    for k in range(head[tb.N_OBSERVED]):
        if tb.observed_f(head)[k, tb.WEIGHT] > 0.0 and observed_i[k, tb.OBS_NEXT] >= 0:
            observed_i[k, tb.OBS_NEXT] = observed[observed_i[k, tb.OBS_NEXT]]


@kernel
def _rewrite_cliques(head, nodes):  # type: ignore[no-untyped-def]
    """Rewrite the node lists of all cliques."""
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    for c in range(head[tb.N_CLIQUES]):
        begin = clique_i[c, tb.NODES]
        # an unused row has no nodes
        for m in range(begin, begin + clique_i[c, tb.N_FRONTAL] + clique_i[c, tb.N_SEPARATOR]):
            pool_i[m] = nodes[pool_i[m]]


@kernel
def _rewrite_touched(head, nodes):  # type: ignore[no-untyped-def]
    touched, kept = tb.touched(head), 0
    for k in range(head[tb.N_TOUCHED]):
        v = nodes[touched[k]]
        if v >= 0:
            touched[kept] = v
            kept += 1
    head[tb.N_TOUCHED] = kept


@kernel
def _rewrite_waiting(head, edges, observed):  # type: ignore[no-untyped-def]
    waiting, kept = tb.waiting(head), 0
    for k in range(head[tb.N_WAITING]):
        entry = waiting[k]
        at = edges[entry] if entry >= 0 else observed[-1 - entry]
        if at >= 0:
            waiting[kept] = at if entry >= 0 else -1 - at
            kept += 1
    head[tb.N_WAITING] = kept


@kernel(signature=(tb.HEAD,), allocates=True)
def compact(head):  # type: ignore[no-untyped-def]
    """Take out all rows that leave; the time is proportional to the size of the graph."""
    nodes = _move_nodes(head)
    edges = _move_edges(head, nodes)
    observed = _move_observed(head, nodes)
    _rewrite_lists(head, edges, observed)
    _rewrite_cliques(head, nodes)
    _rewrite_touched(head, nodes)
    _rewrite_waiting(head, edges, observed)
    if head[tb.NEWEST] >= 0:
        head[tb.NEWEST] = nodes[head[tb.NEWEST]]
    head[tb.N_LEAVING] = 0
