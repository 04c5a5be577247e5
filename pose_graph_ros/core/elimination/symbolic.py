# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The structure of cliques: what `ordering` starts from, what becomes of its result, whole graphs.

`structure` is the quotient graph of the nodes that an update orders, `amalgamate` merges the
resulting cliques. `analyse` and `plant` are the symbolic factorisation of a whole graph, done once
for all iterations of a batch optimisation.

Its cliques are in postorder: children precede their parent, and each subtree is contiguous. So the
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
from pose_graph_ros.core.graph import pools, prior_rows, tables as tb, transaction_log

# Number of the newest nodes that are eliminated last, since the next constraints involve them.
NEWEST_LAST = 10
# Limits of amalgamation: explicit zero blocks and frontal nodes of a merged clique. They differ
# from those of the incremental smoother, as every clique is eliminated in every iteration here.
RELAXED_ZEROS = 8
RELAXED_FRONTAL = 24


class Cliques(NamedTuple):
    """The C cliques of a whole graph, in postorder."""

    first: Any  # (C + 1,); the nodes of clique k are `nodes[first[k]:first[k + 1]]`
    n_frontal: Any  # (C,) number of frontal nodes, which come first; the others are the separator
    parent: Any     # (C,), -1 for a root
    nodes: Any


# What `minimum_degree` returns.
ELIMINATED = types.Tuple((INTEGER, INTEGERS, INDICES, INDICES, INDICES))
CLIQUES = types.NamedUniTuple(INDICES, len(Cliques._fields), Cliques)


class Analysis(NamedTuple):
    """The cliques and the memory that they need."""

    cliques: Cliques
    need_f: int     # numbers in the pool of values, `pool_f`
    need_i: int     # numbers in the pool of node lists, `pool_i`
    largest: int    # numbers of work space for the largest front


@kernel(signature=(INDICES, INTEGER))
def newest_last(affected, newest):  # type: ignore[no-untyped-def]
    """
    Return how many of the newest nodes were moved to the end of the list, in order of age.

    The very last is the newest pose, if it is affected: biases may have been added after it, but
    the next odometry edge starts at it.
    """
    n = len(affected)
    n_last = min(NEWEST_LAST, n)
    for k in range(n_last):
        best = 0
        for i in range(1, n - k):
            if affected[best] != newest and (
                    affected[i] > affected[best] or affected[i] == newest):
                best = i
        last = n - k - 1
        affected[best], affected[last] = affected[last], affected[best]
    return n_last


@kernel
def _other_ends(edge_i, e, side):  # type: ignore[no-untyped-def]
    """Return the nodes at the other ends of an edge; the second is -1 where there is but one."""
    return (edge_i[e, tb.END_J if side == 0 else tb.END_I],
            edge_i[e, tb.END_J if side == 2 else tb.END_K])


@kernel(allocates=True)
def structure(head, marked, loose, affected):  # type: ignore[no-untyped-def]
    """
    Return the orphans, and the quotient graph of the affected nodes with them as elements.

    Orphans are children of marked cliques that are not marked themselves, then the loose priors.
    Marked cliques have FRONT_SERIAL of the head in their column MARKED. The graph is given as
    `start` and `adjacency` of `ordering.minimum_degree`; node k is `affected[k]`.
    """
    node_i, edge_i = tb.node_i(head), tb.edge_i(head)
    clique_i, pool_i = tb.clique_i(head), tb.pool_i(head)
    n = len(affected)
    serial = head[tb.FRONT_SERIAL] + 1
    head[tb.FRONT_SERIAL] = serial
    for k in range(n):
        node_i[affected[k], tb.INDEX] = k
        node_i[affected[k], tb.FRONT] = serial
    stamp = serial - 1
    n_orphans = len(loose)
    for k in range(len(marked)):
        c = clique_i[marked[k], tb.CHILD]
        while c >= 0:
            if clique_i[c, tb.MARKED] != stamp:
                n_orphans += 1
            c = clique_i[c, tb.SIBLING]
    orphans = np.empty(n_orphans, np.int32)
    n_orphans = 0
    for k in range(len(marked)):
        c = clique_i[marked[k], tb.CHILD]
        while c >= 0:
            if clique_i[c, tb.MARKED] != stamp:
                orphans[n_orphans] = c
                n_orphans += 1
            c = clique_i[c, tb.SIBLING]
    for k in range(len(loose)):
        orphans[n_orphans + k] = loose[k]
    n_orphans = len(orphans)
    # which orphans each node is a member of
    first = np.zeros(n + 1, np.int32)
    n_entries = 0
    for k in range(n_orphans):
        row = clique_i[orphans[k]]
        begin = row[tb.NODES] + row[tb.N_FRONTAL]
        for m in range(begin, begin + row[tb.N_SEPARATOR]):
            first[node_i[pool_i[m], tb.INDEX] + 1] += 1
            n_entries += 2
    for k in range(n):
        first[k + 1] += first[k]
        entry = node_i[affected[k], tb.EDGE_LIST]
        while entry >= 0:
            n_entries += 2
            entry = edge_i[entry >> 2, tb.NEXT_I + (entry & 3)]
    orphans_of, filled = np.empty(first[n], np.int32), first.copy()
    for k in range(n_orphans):
        row = clique_i[orphans[k]]
        begin = row[tb.NODES] + row[tb.N_FRONTAL]
        for m in range(begin, begin + row[tb.N_SEPARATOR]):
            i = node_i[pool_i[m], tb.INDEX]
            orphans_of[filled[i]] = n + k
            filled[i] += 1
    start = np.empty(n + n_orphans + 1, np.int32)
    adjacency = np.empty(n_entries, np.int32)
    last_seen = np.full(n, -1, np.int32)
    end = 0
    for k in range(n):
        start[k] = end
        for m in range(first[k], first[k + 1]):
            adjacency[end] = orphans_of[m]
            end += 1
        entry = node_i[affected[k], tb.EDGE_LIST]
        while entry >= 0:
            e, side = entry >> 2, entry & 3
            for other in _other_ends(edge_i, e, side):
                if other >= 0 and node_i[other, tb.FRONT] == serial:
                    i = node_i[other, tb.INDEX]
                    if last_seen[i] != k:   # each neighbour once
                        last_seen[i] = k
                        adjacency[end] = i
                        end += 1
            entry = edge_i[e, tb.NEXT_I + side]
    for k in range(n_orphans):
        start[n + k] = end
        row = clique_i[orphans[k]]
        begin = row[tb.NODES] + row[tb.N_FRONTAL]
        for m in range(begin, begin + row[tb.N_SEPARATOR]):
            adjacency[end] = node_i[pool_i[m], tb.INDEX]
            end += 1
    start[n + n_orphans] = end
    return orphans, start, adjacency


@kernel(allocates=True)
def amalgamate(  # type: ignore[no-untyped-def]
    n_cliques, n_frontal, offset, parent, n_apart, most_zeros, most_frontal,
):
    """
    Return into which clique to merge each: a parent where that stores few explicit zero blocks.

    That is itself, or a later one, but never the last, that of the newest pose: the next edge
    changes it. With them come the numbers of frontal nodes after merging.
    """
    into = np.arange(n_cliques).astype(np.int32)
    frontal = n_frontal[:n_cliques].copy()
    zeros = np.zeros(n_cliques, np.int32)
    for k in range(n_cliques - 1):
        q = parent[k]
        if q < 0 or q == n_cliques - 1 or k < n_apart <= q:
            continue
        separator = offset[k + 1] - offset[k] - n_frontal[k]
        width = frontal[q] + offset[q + 1] - offset[q] - n_frontal[q]
        added = zeros[k] + zeros[q] + frontal[k] * (width - separator)
        if added <= most_zeros and frontal[k] + frontal[q] <= most_frontal:
            into[k] = q
            frontal[q] += frontal[k]
            zeros[q] = added
    for k in range(n_cliques - 1, -1, -1):
        into[k] = into[into[k]]
    return into, frontal


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
    """Return what cliques and priors need in both pools, and work space of the largest front."""
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
    """Write the separators, each sorted by the order of elimination."""
    first, n_frontal, nodes = cliques.first, cliques.n_frontal, cliques.nodes
    n_cliques = len(n_frontal)
    order, position = np.empty(n, np.int32), np.empty(n, np.int32)
    at = 0
    for k in range(n_cliques):
        for m in range(first[k], first[k] + n_frontal[k]):
            order[at], position[nodes[m]] = nodes[m], at
            at += 1
    for k in range(n_cliques):
        places = nodes[first[k] + n_frontal[k]:first[k + 1]]
        for m in range(len(places)):    # they are nearly sorted
            place = position[raw_nodes[separators[k, 0] + m]]
            i = m
            while i > 0 and places[i - 1] > place:
                places[i] = places[i - 1]
                i -= 1
            places[i] = place
        for m in range(len(places)):
            places[m] = order[places[m]]


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
            attach(head, n_priors + cliques.parent[k], n_priors + k)
    for c in range(n_priors):   # to the clique of the node that is eliminated first
        parent = head[tb.N_CLIQUES]
        for m in range(clique_i[c, tb.NODES], clique_i[c, tb.NODES] + clique_i[c, tb.N_SEPARATOR]):
            parent = min(parent, node_i[pool_i[m], tb.CLIQUE])
        attach(head, parent, c)
    head[tb.LOOSE] = -1
    head[tb.LOG_F_END] = head[tb.LOG_I_END] = head[tb.N_FREED] = 0


@kernel
def attach(head, parent, child):  # type: ignore[no-untyped-def]
    """Make a clique a child of another one."""
    clique_i = tb.clique_i(head)
    clique_i[child, tb.PARENT] = parent
    clique_i[child, tb.SIBLING], clique_i[parent, tb.CHILD] = clique_i[parent, tb.CHILD], child
