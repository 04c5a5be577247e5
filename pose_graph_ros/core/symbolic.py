# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The cliques of a whole graph, worked out once and filled with numbers in every iteration.

The cliques are in postorder: children before their parent, each subtree in one piece. So the
elimination is a loop over all of them, back-substitution the same loop backwards, and what a
parent takes from its children is still in the processor's cache. Separators are sorted by the
order of elimination, so that neighbours in a separator are mostly neighbours in the front of the
parent too, and whole runs of columns are added at once.
"""

from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.core import tables as tb, undo
from pose_graph_ros.core.assembly import work_size
from pose_graph_ros.core.jit import kernel
from pose_graph_ros.core.ordering import minimum_degree
from pose_graph_ros.core.structure import amalgamate, newest_last, structure

# Cliques are joined if that stores at most so many zero blocks, up to so many frontal nodes: more
# than while driving, as here every clique is met in every iteration.
RELAXED_ZEROS = 8
RELAXED_FRONTAL = 24


class Cliques(NamedTuple):
    """The cliques of a whole graph, C of them, in postorder."""

    first: Any
    """Where the nodes of clique k begin in `nodes`, where those of k - 1 end, shape (C + 1,)."""
    n_frontal: Any
    """So many of them are eliminated here, the others are the separator, shape (C,)."""
    parent: Any
    """A clique, or -1 for a root, shape (C,)."""
    nodes: Any


class Analysis(NamedTuple):
    """The cliques, and what they take in the pools and in the work space."""

    cliques: Cliques
    need_f: int
    need_i: int
    largest: int


def analyse(head: tb.IntHead) -> Analysis:
    """Order all nodes and return the cliques; no table is changed."""
    order = np.arange(int(head[tb.N_NODES])).astype(np.int32)
    n_last = newest_last(order, int(head[tb.NEWEST]))
    start, adjacency = _adjacency(head, order)
    cliques = _arranged(order, minimum_degree(len(order), 0, n_last, start, adjacency))
    return Analysis(cliques, *_needs(cliques))


@kernel(allocates=True)
def _adjacency(head, order):  # type: ignore[no-untyped-def]
    """Return the graph of all nodes, in this order, as `minimum_degree` takes it."""
    _, start, adjacency = structure(head, np.empty(0, np.int32), order)
    return start, adjacency


@kernel(allocates=True)
def _arranged(order, eliminated):  # type: ignore[no-untyped-def]
    """Return the cliques that `minimum_degree` has found, joined where that is of use."""
    n_raw, offset, raw_frontal, raw_parent, raw_nodes = eliminated
    for m in range(offset[n_raw]):
        raw_nodes[m] = order[raw_nodes[m]]
    into, _ = amalgamate(
        n_raw, raw_frontal, offset, raw_parent, RELAXED_ZEROS, RELAXED_FRONTAL)
    raw_order = _postorder(n_raw, into, raw_parent)
    n_cliques = len(raw_order)
    place = np.full(n_raw, -1, np.int32)
    for k in range(n_cliques):
        place[raw_order[k]] = k
    n_frontal = np.zeros(n_cliques, np.int32)
    n_separator = np.zeros(n_cliques, np.int32)
    parent = np.full(n_cliques, -1, np.int32)
    separators = np.empty((n_cliques, 2), np.int64)
    for q in range(n_raw):
        k = place[into[q]]
        n_frontal[k] += raw_frontal[q]
        if into[q] == q:
            separators[k, 0], separators[k, 1] = offset[q] + raw_frontal[q], offset[q + 1]
            n_separator[k] = separators[k, 1] - separators[k, 0]
            if raw_parent[q] >= 0:
                parent[k] = place[into[raw_parent[q]]]
    first = np.zeros(n_cliques + 1, np.int32)
    for k in range(n_cliques):
        first[k + 1] = first[k] + n_frontal[k] + n_separator[k]
    nodes = np.empty(first[n_cliques], np.int32)
    cliques = Cliques(first, n_frontal, parent, nodes)
    filled = first[:n_cliques].copy()
    for q in range(n_raw):  # in order of elimination, parts that were joined one after the other
        k = place[into[q]]
        for m in range(offset[q], offset[q] + raw_frontal[q]):
            nodes[filled[k]] = raw_nodes[m]
            filled[k] += 1
    _put_separators(cliques, separators, raw_nodes, len(order))
    return cliques


@kernel(allocates=True)
def _needs(cliques):  # type: ignore[no-untyped-def]
    """Return the memory that cliques take in both pools, and the work space of the largest."""
    need_f, need_i, largest = np.int64(0), np.int64(0), np.int64(0)
    for k in range(len(cliques.n_frontal)):
        n_all = np.int64(cliques.first[k + 1] - cliques.first[k])
        n_frontal = np.int64(cliques.n_frontal[k])
        need_f += undo.rounded(undo.n_values(n_frontal, n_all - n_frontal))
        need_i += undo.rounded(n_all)
        largest = max(largest, work_size(n_all))
    return need_f, need_i, largest


@kernel(allocates=True)
def _postorder(n_cliques, into, parent):  # type: ignore[no-untyped-def]
    """Return the cliques that are left, children before parents, each subtree in one piece."""
    child = np.full(n_cliques, -1, np.int32)
    sibling = np.full(n_cliques, -1, np.int32)
    stack = np.empty(n_cliques, np.int32)
    depth, left = 0, 0
    for k in range(n_cliques):
        if into[k] == k:
            left += 1
            if parent[k] >= 0:
                q = into[parent[k]]
                sibling[k], child[q] = child[q], k
            else:
                stack[depth] = k
                depth += 1
    order = np.empty(left, np.int32)
    while depth > 0:
        depth -= 1
        k = stack[depth]
        left -= 1
        order[left] = k
        k = child[k]
        while k >= 0:
            stack[depth] = k
            depth += 1
            k = sibling[k]
    return order


@kernel(allocates=True)
def _put_separators(cliques, separators, raw_nodes, n):  # type: ignore[no-untyped-def]
    """Write the separators, each sorted by the order of elimination: two transpositions."""
    first, n_frontal, nodes = cliques.first, cliques.n_frontal, cliques.nodes
    n_cliques = len(n_frontal)
    order = np.empty(n, np.int32)
    position = np.empty(n, np.int32)
    at = 0
    for k in range(n_cliques):
        for m in range(first[k], first[k] + n_frontal[k]):
            order[at], position[nodes[m]] = nodes[m], at
            at += 1
    # for each node, by position, the cliques in whose separator it is
    begin = np.zeros(n + 1, np.int32)
    for k in range(n_cliques):
        for m in range(separators[k, 0], separators[k, 1]):
            begin[position[raw_nodes[m]] + 1] += 1
    for i in range(n):
        begin[i + 1] += begin[i]
    holders = np.empty(begin[n], np.int32)
    to = begin[:n].copy()
    for k in range(n_cliques):
        for m in range(separators[k, 0], separators[k, 1]):
            i = position[raw_nodes[m]]
            holders[to[i]] = k
            to[i] += 1
    filled = first[:n_cliques] + n_frontal
    for i in range(n):
        for m in range(begin[i], begin[i + 1]):
            nodes[filled[holders[m]]] = order[i]
            filled[holders[m]] += 1


@kernel(allocates=True)
def plant(head, cliques):  # type: ignore[no-untyped-def]
    """
    Replace all cliques in the tables by these, without values; there is room for them.

    Clique k gets row k, so that the order of the rows is that of the elimination.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    seeds = tb.seeds(head)
    first, n_frontal = cliques.first, cliques.n_frontal
    head[tb.N_CLIQUES] = head[tb.POOL_F_END] = head[tb.POOL_I_END] = 0
    head[tb.FREE_CLIQUE] = -1
    head[tb.FREE_F:] = -1
    for s in range(head[tb.N_SEEDS]):
        node_i[seeds[s], tb.SEEDED] = 0
    head[tb.N_SEEDS] = head[tb.STRUCTURE] = 0
    for k in range(len(n_frontal)):
        c = undo.take_clique(
            head, np.int64(n_frontal[k]), np.int64(first[k + 1] - first[k] - n_frontal[k]))
        at = clique_i[c, tb.NODES]
        for m in range(first[k], first[k + 1]):
            pool_i[at + m - first[k]] = cliques.nodes[m]
        for m in range(first[k], first[k] + n_frontal[k]):
            node_i[cliques.nodes[m], tb.CLIQUE] = c
    for k in range(len(n_frontal)):
        q = cliques.parent[k]
        if q >= 0:
            clique_i[k, tb.PARENT] = q
            clique_i[k, tb.SIBLING], clique_i[q, tb.CHILD] = clique_i[q, tb.CHILD], k
    head[tb.LOG_F_END] = head[tb.LOG_I_END] = head[tb.N_FREED] = 0


@kernel(allocates=True)
def loose_part(head):  # type: ignore[no-untyped-def]
    """
    Look for parts of the graph that are tied to no fixed and no observed node.

    Returns
    -------
    node : int
        The first hidden node of one, or -1.
    count : int
        Hidden nodes in all of them.

    """
    edge_f = tb.edge_f(head)
    observed_f = tb.observed_f(head)
    node_i = tb.node_i(head)
    edge_i = tb.edge_i(head)
    observed_i = tb.observed_i(head)
    n = head[tb.N_NODES]
    part = np.arange(n).astype(np.int32)  # a node of the same part with a smaller number
    for e in range(head[tb.N_EDGES]):
        if edge_f[e, tb.WEIGHT] > 0.0:
            i, j = _top(part, edge_i[e, tb.END_I]), _top(part, edge_i[e, tb.END_J])
            part[max(i, j)] = min(i, j)
    held = np.zeros(n, np.bool_)
    for v in range(n):
        if node_i[v, tb.FIXED] != 0:
            held[_top(part, v)] = True
    for k in range(head[tb.N_OBSERVED]):
        if observed_f[k, tb.WEIGHT] > 0.0:
            held[_top(part, observed_i[k, tb.OBS_NODE])] = True
    node, count = -1, 0
    for v in range(n - 1, -1, -1):
        if not held[_top(part, v)]:
            node = v
            count += 1
    return node, count


@kernel(allocates=True)
def _top(part, v):  # type: ignore[no-untyped-def]
    while part[v] != v:
        part[v] = part[part[v]]
        v = part[v]
    return v
