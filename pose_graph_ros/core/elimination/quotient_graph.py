# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quotient graph for the ordering of nodes, and amalgamation of the resulting cliques."""

import numpy as np

from pose_graph_ros.core.compiled.jit import INDICES, INTEGER, kernel
from pose_graph_ros.core.graph import tables as tb

# Number of the newest nodes that are eliminated last, since the next constraints involve them.
NEWEST_LAST = 10


@kernel(signature=(INDICES, INTEGER))
def newest_last(affected, newest):  # type: ignore[no-untyped-def]
    """
    Return how many of the newest nodes were moved to the end of the list, in order of age.

    The very last is the newest pose, if it is affected: biases may have been added after it, but
    the next odometry edge starts at it.

    Parameters
    ----------
    affected : ndarray of int32, nodes to be ordered; sorted in place
    newest : int, newest node that is a pose, or -1

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
    The graph is given as `start` and `adjacency` of `ordering.minimum_degree`; node k is
    `affected[k]`.

    Parameters
    ----------
    marked : ndarray of int32
        Cliques that are to be replaced, with FRONT_SERIAL of the head in their column MARKED.
    loose : ndarray of int32, further orphans
    affected : ndarray of int32, nodes to be ordered

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
    # the orphans, and an upper bound of the entries in the list of each node
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
    count = np.zeros(n + 1, np.int32)
    for k in range(n_orphans):
        row = clique_i[orphans[k]]
        begin = row[tb.NODES] + row[tb.N_FRONTAL]
        for m in range(begin, begin + row[tb.N_SEPARATOR]):
            count[node_i[pool_i[m], tb.INDEX]] += 1
    for k in range(n):
        entry = node_i[affected[k], tb.EDGE_LIST]
        while entry >= 0:
            e, side = entry >> 2, entry & 3
            for other in _other_ends(edge_i, e, side):
                if other >= 0 and node_i[other, tb.FRONT] == serial:
                    count[k] += 1
            entry = edge_i[e, tb.NEXT_I + side]
    start = np.empty(n + n_orphans + 1, np.int32)
    start[0] = 0
    for k in range(n):
        start[k + 1] = start[k] + count[k]
    position = start[:n].copy()
    adjacency = np.empty(2 * start[n] + 16, np.int32)
    end = start[n]
    for k in range(n_orphans):
        row = clique_i[orphans[k]]
        begin = row[tb.NODES] + row[tb.N_FRONTAL]
        for m in range(begin, begin + row[tb.N_SEPARATOR]):
            i = node_i[pool_i[m], tb.INDEX]
            adjacency[end] = i
            end += 1
            adjacency[position[i]] = n + k
            position[i] += 1
        start[n + k + 1] = end
    # add each neighbour once
    last_seen = np.full(n, -1, np.int32)
    to = 0
    for k in range(n):
        begin, begin_neighbours = start[k], position[k]
        entry = node_i[affected[k], tb.EDGE_LIST]
        end = begin_neighbours
        while entry >= 0:
            e, side = entry >> 2, entry & 3
            for other in _other_ends(edge_i, e, side):
                if other >= 0 and node_i[other, tb.FRONT] == serial:
                    i = node_i[other, tb.INDEX]
                    if last_seen[i] != k:
                        last_seen[i] = k
                        adjacency[end] = i
                        end += 1
            entry = edge_i[e, tb.NEXT_I + side]
        # close the gaps left by repeated neighbours
        for m in range(begin, end):
            adjacency[to + m - begin] = adjacency[m]
        start[k], to = to, to + end - begin
    if to < start[n]:
        gap = start[n] - to
        for m in range(start[n], start[n + n_orphans]):
            adjacency[m - gap] = adjacency[m]
        for k in range(n, n + n_orphans + 1):
            start[k] -= gap
    return orphans, start, adjacency


@kernel(allocates=True)
def amalgamate(  # type: ignore[no-untyped-def]
    n_cliques, n_frontal, offset, parent, n_apart, most_zeros, most_frontal,
):
    """
    Return into which clique to merge each: a parent where that stores few explicit zero blocks.

    That is itself, or a later one, but never the last, that of the newest pose: the next edge
    changes it. With them come the numbers of frontal nodes after merging.

    Parameters
    ----------
    n_cliques, n_frontal, offset, parent : as returned by `ordering.minimum_degree`
    n_apart : int, number of the first cliques, none of which is merged with one of the others
    most_zeros, most_frontal : int, limits of the zero blocks and frontal nodes of a merged clique

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
