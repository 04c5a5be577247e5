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


@kernel(allocates=True)
def _numbered(leaves):  # type: ignore[no-untyped-def]
    """Write the numbers of the rows that stay, -1 where the entry is not 0; return the array."""
    kept = 0
    for k in range(len(leaves)):
        if leaves[k] != 0:
            leaves[k] = -1
        else:
            leaves[k] = kept
            kept += 1
    return leaves


@kernel(allocates=True)
def _new_node_rows(head):  # type: ignore[no-untyped-def]
    """Return the new row of each node, -1 for those that leave."""
    node_i = tb.node_i(head)
    leaves = np.empty(head[tb.N_NODES], np.int32)
    for v in range(head[tb.N_NODES]):
        leaves[v] = node_i[v, tb.EDGE_LIST] == tb.LEAVES
    return _numbered(leaves)


@kernel(allocates=True)
def _new_edge_rows(head, nodes):  # type: ignore[no-untyped-def]
    """Return the new row of each edge, -1 for those that leave, with a node or alone."""
    edge_i = tb.edge_i(head)
    leaves = np.empty(head[tb.N_EDGES], np.int32)
    for e in range(head[tb.N_EDGES]):
        row = edge_i[e]
        stays = (nodes[row[tb.END_I]] >= 0 and nodes[row[tb.END_J]] >= 0
                 and (row[tb.END_K] < 0 or nodes[row[tb.END_K]] >= 0))
        leaves[e] = 0 if stays and row[tb.NEXT_I] != tb.LEAVES else 1
    return _numbered(leaves)


@kernel(allocates=True)
def _new_observed_rows(head, nodes):  # type: ignore[no-untyped-def]
    """Return the new row of each observed node, -1 for those that leave."""
    observed_i = tb.observed_i(head)
    leaves = np.empty(head[tb.N_OBSERVED], np.int32)
    for k in range(head[tb.N_OBSERVED]):
        row = observed_i[k]
        leaves[k] = row[tb.OBS_NEXT] == tb.LEAVES or nodes[row[tb.OBS_NODE]] < 0
    return _numbered(leaves)


@kernel(allocates=True)
def _move(where, numbers, integers, ids):  # type: ignore[no-untyped-def]
    """Move the rows of a table up; return the ids of those that leave."""
    n = 0
    for k in range(len(where)):
        n += 1 if where[k] < 0 else 0
    gone, n = np.empty(n, np.int32), 0
    for k in range(len(where)):
        to = where[k]
        if to < 0:
            gone[n] = ids[k]
            n += 1
        elif to != k:
            for m in range(numbers.shape[1]):
                numbers[to, m] = numbers[k, m]
            for m in range(integers.shape[1]):
                integers[to, m] = integers[k, m]
            ids[to] = ids[k]
    return gone


@kernel
def _rewrite_nodes(head, nodes):  # type: ignore[no-untyped-def]
    """Rewrite the nodes of all constraints that stay."""
    edge_i, observed_i = tb.edge_i(head), tb.observed_i(head)
    for e in range(head[tb.N_EDGES]):
        for side in range(3):
            if edge_i[e, side] >= 0:
                edge_i[e, side] = nodes[edge_i[e, side]]
    for k in range(head[tb.N_OBSERVED]):
        observed_i[k, tb.OBS_NODE] = nodes[observed_i[k, tb.OBS_NODE]]


@kernel
def _entry(entry, edges):  # type: ignore[no-untyped-def]
    """Return an entry of the list of a node's edges with the new row of the edge."""
    return 4 * edges[entry >> 2] + (entry & 3) if entry >= 0 else -1


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
            for side in range(3):
                if edge_i[e, side] >= 0:
                    edge_i[e, tb.NEXT_I + side] = _entry(edge_i[e, tb.NEXT_I + side], edges)
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
    """
    Take out all rows that leave; return the ids of nodes, edges and observed nodes, ascending.

    The time is proportional to the size of the graph.
    """
    nodes = _new_node_rows(head)
    edges, observed = _new_edge_rows(head, nodes), _new_observed_rows(head, nodes)
    gone = (_move(nodes, tb.node_f(head), tb.node_i(head), tb.node_id(head)),
            _move(edges, tb.edge_f(head), tb.edge_i(head), tb.edge_id(head)),
            _move(observed, tb.observed_f(head), tb.observed_i(head), tb.observed_id(head)))
    head[tb.N_NODES] -= len(gone[0])
    head[tb.N_EDGES] -= len(gone[1])
    head[tb.N_OBSERVED] -= len(gone[2])
    _rewrite_nodes(head, nodes)
    _rewrite_lists(head, edges, observed)
    _rewrite_cliques(head, nodes)
    _rewrite_touched(head, nodes)
    _rewrite_waiting(head, edges, observed)
    if head[tb.NEWEST] >= 0:
        head[tb.NEWEST] = nodes[head[tb.NEWEST]]
    head[tb.N_LEAVING] = 0
    return gone
