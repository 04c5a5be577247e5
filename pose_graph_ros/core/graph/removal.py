# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Removal of nodes for good, in two steps.

Within an update they and their constraints leave all lists, and with it the tree, but keep their
rows, which are logged as any other edit; so a rollback brings them back. After the update
`compaction` takes the rows out.
"""

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel
from pose_graph_ros.core.graph import identities, prior_edits, tables as tb, transaction_log
from pose_graph_ros.core.graph.editing import touch, weigh_edge, weigh_one_observed


@kernel
def _holds(head, c, v):  # type: ignore[no-untyped-def]
    """Tell whether a node is in the separator of a clique."""
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    row = clique_i[c]
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    m, end = begin, begin + row[tb.N_SEPARATOR]
    while m < end and pool_i[m] != v:
        m += 1
    return m < end


@kernel
def _touch_cliques_with(head, v):  # type: ignore[no-untyped-def]
    """
    Touch a node of each clique that has a given one, so that all of them are built anew.

    They are a subtree below the clique that it is frontal in. A clique may have it in the
    separator although no constraint below leads to it any more.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    top = node_i[v, tb.CLIQUE]
    if top < 0:
        return
    c = clique_i[top, tb.CHILD]
    parent = top
    while True:
        if c >= 0 and _holds(head, c, v):
            u = pool_i[clique_i[c, tb.NODES]]
            transaction_log.log_node(head, u)
            touch(head, u)
            parent, c = c, clique_i[c, tb.CHILD]
        elif c >= 0:
            c = clique_i[c, tb.SIBLING]
        elif parent == top:
            return
        else:
            c, parent = clique_i[parent, tb.SIBLING], clique_i[parent, tb.PARENT]


@kernel
def _forget_newest(head):  # type: ignore[no-untyped-def]
    """Let the newest pose be the last one that does not leave."""
    node_i = tb.node_i(head)
    v = head[tb.NEWEST]
    while v >= 0 and (node_i[v, tb.EDGE_LIST] == tb.LEAVES or node_i[v, tb.NODE_TYPE] != 0):
        v -= 1
    head[tb.NEWEST] = v


@kernel(signature=(tb.HEAD, INTEGERS))
def remove_nodes(head, nodes):  # type: ignore[no-untyped-def]
    """
    Take hidden nodes out of the graph with all their constraints; their rows leave later.

    Parameters
    ----------
    nodes : ndarray of int, shape (N,), ids; none that has left

    """
    node_i = tb.node_i(head)
    for node in nodes:
        v = identities.node_row(head, node)
        prior_edits.remove_of_node(head, v)
        if node_i[v, tb.EDGE_LIST] == tb.LEAVES:
            continue
        transaction_log.log_node(head, v)
        while node_i[v, tb.EDGE_LIST] >= 0:
            weigh_edge(head, node_i[v, tb.EDGE_LIST] >> 2, 0.0)
        while node_i[v, tb.OBSERVED_LIST] >= 0:
            weigh_one_observed(head, node_i[v, tb.OBSERVED_LIST], 0.0)
        _touch_cliques_with(head, v)
        touch(head, v)
        node_i[v, tb.EDGE_LIST] = tb.LEAVES
        head[tb.N_LEAVING] += 1
        head[tb.STRUCTURE] = 1
    _forget_newest(head)
