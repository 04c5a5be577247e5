# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The structure of cliques: what `ordering` starts from, what becomes of its result, whole graphs.

`structure` is the quotient graph of the nodes that an update orders, `in_postorder` merges and
sorts the resulting cliques, and `plant` writes them into the tables. `analyse` and `plant_all` do
so for a whole graph, once for all iterations of a batch optimisation.

Cliques are in postorder: children precede their parent, and each subtree is contiguous. So the
elimination is a loop over all cliques, the back-substitution is the same loop in reverse, and the
update matrices of the children are still in the processor's cache when the parent needs them.
Separators are sorted by the order of elimination. Columns that are adjacent are therefore mostly
adjacent in the parent's front as well, and are added in runs.
"""

from typing import Any, NamedTuple

from numba import types
import numpy as np

from pose_graph_ros.core.compiled.jit import INDICES, INTEGER, kernel
from pose_graph_ros.core.elimination.assembly import work_size
from pose_graph_ros.core.elimination.ordering import grown, minimum_degree
from pose_graph_ros.core.graph import pools, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.rows import forget_touched

# Number of the newest nodes that are eliminated last, since the next constraints involve them.
NEWEST_LAST = 10
# More than there are nodes.
_MANY = 2**32
# Limits of amalgamated cliques: stored zero blocks (3x3) and frontal nodes.
MOST_ZEROS, MOST_FRONTAL = 32, 16


class Cliques(NamedTuple):
    """C cliques in postorder."""

    first: Any  # (C + 1,); the nodes of clique k are `nodes[first[k]:first[k + 1]]`
    n_frontal: Any  # (C,) number of frontal nodes, which come first; the others are the separator
    parent: Any     # (C + O,), -1 for a root; the last ones are those of orphans
    nodes: Any
    # memory that they need: numbers in the pool of values, `pool_f`, and in that of node lists,
    # `pool_i`, and of work space for the largest front
    need_f: int
    need_i: int
    largest: int


CLIQUES = types.NamedTuple((*[INDICES] * 4, *[INTEGER] * 3), Cliques)


@kernel
def newest_last(affected, newest, fixed):  # type: ignore[no-untyped-def]
    """
    Return how many of the affected nodes were moved to the end of the list, to stay near the root.

    They are the newest ones, in order of age. The very last is the newest pose: biases may have
    been added after it, but the next odometry edge starts at it. Before it comes a fixed node,
    since no frame of a clique above it turns, and a closure may turn all of the map about it.
    """
    n = len(affected)
    n_last = min(NEWEST_LAST, n)
    for k in range(n_last):
        best, latest = 0, np.int64(-1)
        for i in range(n - k):
            v = np.int64(affected[i])
            age = v + (2 * _MANY if v == newest else _MANY if v == fixed else 0)
            if age > latest:
                best, latest = i, age
        last = n - k - 1
        affected[best], affected[last] = affected[last], affected[best]
    return n_last


@kernel(allocates=True)
def structure(head, marked, loose, affected):  # type: ignore[no-untyped-def]
    """
    Return the orphans, and the quotient graph of the affected nodes with them as elements.

    Orphans are the children of cliques with FRONT_SERIAL in their field `marked` that do not have
    it, then the loose priors. The graph is `start` and `adjacency` of `ordering.minimum_degree`,
    its node k is `affected[k]`.
    """
    nodes, factors, cliques = tb.nodes(head), tb.factors(head), tb.cliques(head)
    n = len(affected)
    serial = head[tb.FRONT_SERIAL] + 1
    head[tb.FRONT_SERIAL] = serial
    for k in range(n):
        nodes[affected[k]].index = k
        nodes[affected[k]].front = serial
    orphans, n_orphans = np.empty(len(loose) + 16, np.int32), 0
    for k in range(len(marked)):
        c = cliques[marked[k]].child
        while c >= 0:
            if cliques[c].marked != serial - 1:
                if n_orphans + len(loose) == len(orphans):
                    orphans = grown(orphans, 0)
                orphans[n_orphans] = c
                n_orphans += 1
            c = cliques[c].sibling
    transaction_log.copied(loose, orphans[n_orphans:n_orphans + len(loose)])
    n_orphans += len(loose)
    # which orphans each node is a member of
    first = np.zeros(n + 1, np.int32)
    n_entries = 0
    for k in range(n_orphans):
        for v in pools.separator(head, orphans[k]):
            first[nodes[v].index + 1] += 1
            n_entries += 2
    for k in range(n):
        first[k + 1] += first[k]
        entry = nodes[affected[k]].factor_list
        while entry >= 0:
            n_entries += 2
            entry = factors[entry >> 2].next[entry & 3]
    orphans_of, filled = np.empty(first[n], np.int32), first.copy()
    for k in range(n_orphans):
        for v in pools.separator(head, orphans[k]):
            i = nodes[v].index
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
        entry = nodes[affected[k]].factor_list
        while entry >= 0:
            f = factors[entry >> 2]
            for other in f.ends:
                if other >= 0 and nodes[other].front == serial:
                    i = nodes[other].index
                    if i != k and last_seen[i] != k:    # each neighbour once
                        last_seen[i] = k
                        adjacency[end] = i
                        end += 1
            entry = f.next[entry & 3]
    for k in range(n_orphans):
        start[n + k] = end
        for v in pools.separator(head, orphans[k]):
            adjacency[end] = nodes[v].index
            end += 1
    start[n + n_orphans] = end
    return orphans[:n_orphans], start, adjacency


@kernel(signature=(tb.HEAD,), allocates=True)
def analyse(head):  # type: ignore[no-untyped-def]
    """Return the cliques of a fill-reducing order of all nodes, without storing them."""
    order = np.arange(head[tb.N_NODES]).astype(np.int32)
    n_last = newest_last(order, head[tb.NEWEST], head[tb.FIXED])
    priors = prior_rows.all_priors(head)
    _, start, adjacency = structure(head, np.empty(0, np.int32), priors, order)
    raw = minimum_degree(len(order), len(priors), 0, n_last, start, adjacency)
    first, n_frontal, parent, nodes, need_f, need_i, largest = in_postorder(order, raw, 0)
    for c in priors:
        n_separator = np.int64(tb.cliques(head)[c].n_separator)
        need_f += pools.rounded(pools.n_values(0, n_separator))
        need_i += pools.rounded(n_separator)
    return Cliques(first, n_frontal, parent, nodes, need_f, need_i, largest)


@kernel(allocates=True)
def in_postorder(order, raw, n_before):  # type: ignore[no-untyped-def]
    """
    Return the cliques found by `minimum_degree`, amalgamated and in postorder.

    Its node k is `order[k]`; the first `n_before` are not in a clique with others.
    """
    n_raw, offset, raw_frontal, raw_parent, raw_nodes = raw
    n_apart = 0
    while n_apart < n_raw and raw_nodes[offset[n_apart]] < n_before:
        n_apart += 1
    # A clique is merged with its parent where that stores few explicit zero blocks, but not with
    # the last one, that of the newest pose, which the next edge changes.
    into = np.arange(n_raw).astype(np.int32)
    n_frontal_of, zeros = raw_frontal[:n_raw].copy(), np.zeros(n_raw, np.int32)
    for k in range(n_raw - 1):
        q = raw_parent[k]
        if q < 0 or q == n_raw - 1 or k < n_apart <= q:
            continue
        separator = offset[k + 1] - offset[k] - raw_frontal[k]
        width = n_frontal_of[q] + offset[q + 1] - offset[q] - raw_frontal[q]
        added = zeros[k] + zeros[q] + n_frontal_of[k] * (width - separator)
        if added <= MOST_ZEROS and n_frontal_of[k] + n_frontal_of[q] <= MOST_FRONTAL:
            into[k], zeros[q] = q, added
            n_frontal_of[q] += n_frontal_of[k]
    for k in range(n_raw - 1, -1, -1):
        into[k] = into[into[k]]
    raw_order = _postorder(n_raw, into, raw_parent)
    n_cliques = len(raw_order)
    place = np.full(n_raw, -1, np.int32)
    n_frontal = np.empty(n_cliques, np.int32)
    first = np.zeros(n_cliques + 1, np.int32)
    need_f = need_i = largest = 0
    for k in range(n_cliques):
        q = raw_order[k]
        place[q] = k
        n_frontal[k] = n_frontal_of[q]
        n_separator = offset[q + 1] - offset[q] - raw_frontal[q]
        n_all = n_separator + n_frontal[k]
        first[k + 1] = first[k] + n_all
        need_f += pools.rounded(pools.n_values(np.int64(n_frontal[k]), n_separator))
        need_i += pools.rounded(n_all)
        largest = max(largest, work_size(n_all))
    parent = np.full(n_cliques + len(raw_parent) - n_raw, -1, np.int32)
    for k in range(len(parent)):
        q = raw_parent[raw_order[k] if k < n_cliques else n_raw + k - n_cliques]
        if q >= 0:
            parent[k] = place[into[q]]
    # the frontal nodes, the parts of a merged clique in their order of elimination
    nodes, filled = np.empty(first[n_cliques], np.int32), first[:n_cliques].copy()
    for q in range(n_raw):
        k = place[into[q]]
        for m in range(offset[q], offset[q] + raw_frontal[q]):
            nodes[filled[k]] = raw_nodes[m]
            filled[k] += 1
    # the separators by the places of their nodes in the order of elimination
    eliminated_at, at = np.empty(len(order), np.int32), 0
    for k in range(n_cliques):
        for m in range(first[k], filled[k]):
            eliminated_at[nodes[m]] = at
            at += 1
    for k in range(n_cliques):
        q = raw_order[k]
        for m in range(offset[q] + raw_frontal[q], offset[q + 1]):  # they are nearly sorted
            v, i = raw_nodes[m], filled[k]
            while (i > first[k] + n_frontal[k]
                    and eliminated_at[nodes[i - 1]] > eliminated_at[v]):
                nodes[i] = nodes[i - 1]
                i -= 1
            nodes[i] = v
            filled[k] += 1
    for m in range(len(nodes)):
        nodes[m] = order[nodes[m]]
    return Cliques(first, n_frontal, parent, nodes, need_f, need_i, largest)


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
def plant(head, cliques, orphans):  # type: ignore[no-untyped-def]
    """
    Return the rows of new cliques without values, given memory for them.

    The last parents are those of the orphans, rows of cliques that there are already.
    """
    first, n_frontal, parent = cliques.first, cliques.n_frontal, cliques.parent
    rows = np.empty(len(n_frontal), np.int32)
    for k in range(len(rows)):
        rows[k] = transaction_log.take_clique(
            head, np.int64(n_frontal[k]), np.int64(first[k + 1] - first[k] - n_frontal[k]))
        at = tb.cliques(head)[rows[k]].members
        for m in range(first[k], first[k + 1]):
            tb.pool_i(head)[at + m - first[k]] = cliques.nodes[m]
        for m in range(first[k], first[k] + n_frontal[k]):
            transaction_log.log_node(head, cliques.nodes[m])
            tb.nodes(head)[cliques.nodes[m]].clique = rows[k]
    for k in range(len(orphans)):
        transaction_log.log_clique(head, orphans[k])
    for m in range(len(parent)):
        # of siblings, the last one in postorder is the first to be found
        k = len(rows) - 1 - m if m < len(rows) else m
        if parent[k] >= 0:
            child = rows[k] if k < len(rows) else orphans[k - len(rows)]
            row, above = tb.cliques(head)[child], tb.cliques(head)[rows[parent[k]]]
            row.parent, row.sibling = rows[parent[k]], above.child
            above.child = child
    head[tb.LOOSE] = -1
    return rows


@kernel(signature=(tb.HEAD, CLIQUES), allocates=True)
def plant_all(head, cliques):  # type: ignore[no-untyped-def]
    """
    Replace all cliques in the tables by those of a symbolic factorisation, without values.

    The pools must have been enlarged by what the cliques need. The rows are in the order of the
    elimination, behind those of the priors. No node is touched afterwards, and the log of the
    update is empty: a rollback is not possible.
    """
    prior_rows.remove_cliques(head)
    forget_touched(head)
    head[tb.STRUCTURE] = 0
    plant(head, cliques, prior_rows.all_priors(head))
    head[tb.LOG_END] = head[tb.N_FREED] = 0
