# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Symbolic factorisation of a whole graph, done once for all iterations of a batch optimisation.

The cliques are in postorder: children precede their parent, and each subtree is contiguous. So the
elimination is a loop over all cliques, the back-substitution is the same loop in reverse, and the
update matrices of the children are still in the processor's cache when the parent needs them.
Separators are sorted by the order of elimination. Columns that are adjacent in a separator are
therefore mostly adjacent in the parent's front as well, and are added in runs.
"""

from typing import Any, NamedTuple

from numba import types
import numpy as np

from pose_graph_ros.core.compiled.jit import INDICES, INTEGER, INTEGERS, kernel
from pose_graph_ros.core.elimination.assembly import work_size
from pose_graph_ros.core.elimination.ordering import minimum_degree
from pose_graph_ros.core.elimination.quotient_graph import amalgamate, newest_last, structure
from pose_graph_ros.core.graph import pools, prior_rows, tables as tb, transaction_log

# Limits of amalgamation: explicit zero blocks and frontal nodes of a merged clique. They differ
# from those of the incremental smoother, as every clique is eliminated in every iteration here.
RELAXED_ZEROS = 8
RELAXED_FRONTAL = 24


class Cliques(NamedTuple):
    """The C cliques of a whole graph, in postorder."""

    first: Any
    """The nodes of clique k are `nodes[first[k]:first[k + 1]]`, shape (C + 1,)."""
    n_frontal: Any
    """Number of frontal nodes, which come first; the others are the separator, shape (C,)."""
    parent: Any
    """Parent of each clique, -1 for a root, shape (C,)."""
    nodes: Any
    """Nodes of all cliques."""


# What `minimum_degree` returns.
ELIMINATED = types.Tuple((INTEGER, INTEGERS, INDICES, INDICES, INDICES))
CLIQUES = types.NamedUniTuple(INDICES, len(Cliques._fields), Cliques)


class Analysis(NamedTuple):
    """The cliques and the memory that they need."""

    cliques: Cliques
    need_f: int
    """Numbers in the pool of values, `pool_f`."""
    need_i: int
    """Numbers in the pool of node lists, `pool_i`."""
    largest: int
    """Numbers of work space for the largest front."""


def analyse(head: tb.IntHead) -> Analysis:
    """Return the cliques of a fill-reducing order of all nodes, without storing them."""
    order = np.arange(int(head[tb.N_NODES])).astype(np.int32)
    n_last = newest_last(order, int(head[tb.NEWEST]))
    start, adjacency = _adjacency(head, order)
    n_priors = len(start) - 1 - len(order)
    cliques = _amalgamated(order, minimum_degree(
        len(order), n_priors, 0, n_last, start, adjacency))
    return Analysis(cliques, *_required_memory(head, cliques))


@kernel(signature=(tb.HEAD, INDICES), allocates=True)
def _adjacency(head, order):  # type: ignore[no-untyped-def]
    """Return the lists of neighbours of all nodes, in this order, and of the priors' nodes."""
    _, start, adjacency = structure(
        head, np.empty(0, np.int32), prior_rows.all_priors(head), order)
    return start, adjacency


@kernel(signature=(INDICES, ELIMINATED), allocates=True)
def _amalgamated(order, eliminated):  # type: ignore[no-untyped-def]
    """Return the cliques found by `minimum_degree`, amalgamated and in postorder."""
    n_raw, offset, raw_frontal, raw_parent, raw_nodes = eliminated
    for m in range(offset[n_raw]):
        raw_nodes[m] = order[raw_nodes[m]]
    into, _ = amalgamate(
        n_raw, raw_frontal, offset, raw_parent, 0, RELAXED_ZEROS, RELAXED_FRONTAL)
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
    for q in range(n_raw):  # the parts of a merged clique in their order of elimination
        k = place[into[q]]
        for m in range(offset[q], offset[q] + raw_frontal[q]):
            nodes[filled[k]] = raw_nodes[m]
            filled[k] += 1
    _write_separators(cliques, separators, raw_nodes, len(order))
    return cliques


@kernel(signature=(tb.HEAD, CLIQUES), allocates=True)
def _required_memory(head, cliques):  # type: ignore[no-untyped-def]
    """
    Return what cliques and priors need in both pools, and the work space of the largest front.

    Parameters
    ----------
    cliques : Cliques

    """
    need_f, need_i, largest = np.int64(0), np.int64(0), np.int64(0)
    for c in prior_rows.all_priors(head):
        n_separator = np.int64(tb.clique_i(head)[c, tb.N_SEPARATOR])
        need_f += pools.rounded(pools.n_values(0, n_separator))
        need_i += pools.rounded(n_separator)
    for k in range(len(cliques.n_frontal)):
        n_all = np.int64(cliques.first[k + 1] - cliques.first[k])
        n_frontal = np.int64(cliques.n_frontal[k])
        need_f += pools.rounded(pools.n_values(n_frontal, n_all - n_frontal))
        need_i += pools.rounded(n_all)
        largest = max(largest, work_size(n_all))
    return need_f, need_i, largest


@kernel(allocates=True)
def _postorder(n_cliques, into, parent):  # type: ignore[no-untyped-def]
    """Return the merged cliques, children before parents, each subtree contiguous."""
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
def _write_separators(cliques, separators, raw_nodes, n):  # type: ignore[no-untyped-def]
    """Write the separators, each sorted by the order of elimination by two transpositions."""
    first, n_frontal, nodes = cliques.first, cliques.n_frontal, cliques.nodes
    n_cliques = len(n_frontal)
    order = np.empty(n, np.int32)
    position = np.empty(n, np.int32)
    at = 0
    for k in range(n_cliques):
        for m in range(first[k], first[k] + n_frontal[k]):
            order[at], position[nodes[m]] = nodes[m], at
            at += 1
    # for each node, in order of elimination, the cliques whose separator contains it
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


@kernel(signature=(tb.HEAD, CLIQUES), allocates=True)
def plant(head, cliques):  # type: ignore[no-untyped-def]
    """
    Replace all cliques in the tables by those of a symbolic factorisation, without values.

    The pools must have been enlarged by what `Analysis` requires. The rows are in the order of the
    elimination, behind those of the priors. No node is touched afterwards, and the log of the
    update is empty: a rollback is not possible.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    touched = tb.touched(head)
    first, n_frontal = cliques.first, cliques.n_frontal
    prior_rows.remove_cliques(head)
    n_priors = head[tb.N_CLIQUES]
    for s in range(head[tb.N_TOUCHED]):
        node_i[touched[s], tb.TOUCHED] = 0
    head[tb.N_TOUCHED] = head[tb.STRUCTURE] = 0
    for k in range(len(n_frontal)):
        c = transaction_log.take_clique(
            head, np.int64(n_frontal[k]), np.int64(first[k + 1] - first[k] - n_frontal[k]))
        at = clique_i[c, tb.NODES]
        for m in range(first[k], first[k + 1]):
            pool_i[at + m - first[k]] = cliques.nodes[m]
        for m in range(first[k], first[k] + n_frontal[k]):
            node_i[cliques.nodes[m], tb.CLIQUE] = c
    for k in range(len(n_frontal)):
        if cliques.parent[k] >= 0:
            _attach(head, n_priors + cliques.parent[k], n_priors + k)
    for c in range(n_priors):   # to the clique of the node that is eliminated first
        parent = head[tb.N_CLIQUES]
        for m in range(clique_i[c, tb.NODES], clique_i[c, tb.NODES] + clique_i[c, tb.N_SEPARATOR]):
            parent = min(parent, node_i[pool_i[m], tb.CLIQUE])
        _attach(head, parent, c)
    head[tb.LOOSE] = -1
    head[tb.LOG_F_END] = head[tb.LOG_I_END] = head[tb.N_FREED] = 0


@kernel
def _attach(head, parent, child):  # type: ignore[no-untyped-def]
    clique_i = tb.clique_i(head)
    clique_i[child, tb.PARENT] = parent
    clique_i[child, tb.SIBLING], clique_i[parent, tb.CHILD] = clique_i[parent, tb.CHILD], child


@kernel(signature=(tb.HEAD,), allocates=True)
def loose_part(head):  # type: ignore[no-untyped-def]
    """
    Find the parts of the graph that contain no fixed and no observed node, nor an anchored prior.

    Return the first hidden node in such a part, or -1, and the number of nodes in all of them.
    """
    edge_f, observed_f, node_i = tb.edge_f(head), tb.observed_f(head), tb.node_i(head)
    edge_i, observed_i = tb.edge_i(head), tb.observed_i(head)
    n = head[tb.N_NODES]
    part = np.arange(n).astype(np.int32)  # union-find: an earlier node of the same part
    for e in range(head[tb.N_EDGES]):
        if edge_f[e, tb.WEIGHT] > 0.0:
            i = _first_node(part, edge_i[e, tb.END_I])
            for m in range(1, 3):
                if edge_i[e, m] >= 0:
                    j = _first_node(part, edge_i[e, m])
                    part[max(i, j)] = i = min(i, j)
    clique_i, pool_i, priors = tb.clique_i(head), tb.pool_i(head), prior_rows.all_priors(head)
    for c in priors:
        begin = clique_i[c, tb.NODES]
        for m in range(begin + 1, begin + clique_i[c, tb.N_SEPARATOR]):
            i, j = _first_node(part, pool_i[begin]), _first_node(part, pool_i[m])
            part[max(i, j)] = min(i, j)
    held = np.zeros(n, np.bool_)
    for c in priors:
        if clique_i[c, tb.ANCHORED] != 0:
            held[_first_node(part, pool_i[clique_i[c, tb.NODES]])] = True
    for v in range(n):
        if node_i[v, tb.FIXED] != 0:
            held[_first_node(part, v)] = True
    for k in range(head[tb.N_OBSERVED]):
        if observed_f[k, tb.WEIGHT] > 0.0:
            held[_first_node(part, observed_i[k, tb.OBS_NODE])] = True
    node, count = -1, 0
    for v in range(n - 1, -1, -1):
        if not held[_first_node(part, v)]:
            node = v
            count += 1
    return node, count


@kernel(allocates=True)
def _first_node(part, v):  # type: ignore[no-untyped-def]
    """Return the first node of the part that v is in, and shorten the path to it."""
    while part[v] != v:
        part[v] = part[part[v]]
        v = part[v]
    return v
