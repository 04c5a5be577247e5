# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Fill-reducing order of elimination by approximate minimum degree.

The quotient graph is that of P. Amestoy, T. Davis, I. Duff, "An approximate minimum degree
ordering algorithm", SIAM J. Matrix Anal. Appl. 17 (1996). An eliminated node becomes an *element*,
the set of nodes that it connects, and absorbs the elements that it was a member of. There are
three extensions. The separators of unchanged subtrees (*orphans*) are elements from the start. The
last nodes of the list can be eliminated last, in their order, so that the newest nodes stay near
the root of the tree, where the next nodes are attached. The first nodes can be eliminated before
all others, in any order among themselves: nodes that are about to leave the graph.

The elements are the cliques, so the ordering yields the symbolic factorisation as well.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import INDICES, INTEGER, kernel


@kernel(allocates=True)
def _grown(array, size):  # type: ignore[no-untyped-def]
    """Return a copy with room for at least `size` numbers."""
    grown = np.empty(max(size, 2 * len(array)), np.int32)
    for k in range(len(array)):
        grown[k] = array[k]
    return grown


@kernel
def _insert(i, d, first, after, before):  # type: ignore[no-untyped-def]
    """Put node i at the front of the list of degree d."""
    before[i] = -1
    after[i] = first[d]
    if first[d] >= 0:
        before[first[d]] = i
    first[d] = i


@kernel
def _remove(i, d, first, after, before):  # type: ignore[no-untyped-def]
    """Remove node i from the list of degree d."""
    if before[i] >= 0:
        after[before[i]] = after[i]
    else:
        first[d] = after[i]
    if after[i] >= 0:
        before[after[i]] = before[i]


@kernel
def _put(i, member, nodes, end):  # type: ignore[no-untyped-def]
    """Write all nodes of a supernode, given by its principal node; return where they end."""
    while i >= 0:
        nodes[end] = i
        end += 1
        i = member[i]
    return end


@kernel(signature=(INTEGER, INTEGER, INTEGER, INTEGER, INDICES, INDICES), allocates=True)
def minimum_degree(n, n_elements, n_before, n_last, start, adjacency):  # type: ignore[no-untyped-def]
    """
    Order n nodes and return the cliques of the elimination, children before parents.

    Parameters
    ----------
    n, n_elements : int, nodes are 0 to n - 1, elements from the start n to n + n_elements - 1
    n_before : int, number of nodes, the first of the list, that are eliminated before all others
    n_last : int, number of nodes, the last of the list, that are eliminated last, in their order
    start : ndarray of int32, shape (n + n_elements + 1,), where each list begins in `adjacency`
    adjacency : ndarray of int32
        For a node, first the elements that it is a member of (numbers from n on), then its
        neighbours, without repetitions; for an element, its nodes.

    Returns
    -------
    n_cliques : int
    offset : ndarray of int32, where the nodes of each clique begin in `nodes`, and the last end
    n_frontal : ndarray of int32, number of frontal nodes, which come before the separator
    parent : ndarray of int32, shape (n_cliques + n_elements,)
        Parent of each clique, -1 for a root, then of each element from the start. The nodes of the
        parent include the separator, or the nodes of the element.
    nodes : ndarray of int32, nodes of all cliques

    """
    iw = np.empty(start[n + n_elements] + 4 * n + 16, np.int32)
    end = np.int64(start[n + n_elements])
    for k in range(end):    # a slice assignment would take two seconds to compile
        iw[k] = adjacency[k]
    total = n + n_elements
    # lists of nodes and elements in iw; an element has the number of its eliminated node
    begin = np.empty(total, np.int64)
    length = np.empty(total, np.int32)
    n_in = np.zeros(n, np.int32)  # number of elements at the front of a node's list
    weight = np.ones(n, np.int32)  # nodes in the supernode of a principal node; 0: not principal
    size = np.zeros(total, np.int32)  # number of nodes in an element; 0: absorbed
    outside = np.zeros(total, np.int64)  # w of the paper: flag + nodes not in the new element
    clique_of = np.full(total, -1, np.int32)
    member = np.full(n, -1, np.int32)  # next node of the same supernode
    member_end = np.arange(n).astype(np.int32)
    mark = np.zeros(total, np.int32)
    stamp = 0
    # doubly linked lists of principal nodes by degree
    degree = np.zeros(n, np.int32)
    first = np.full(n + 1, -1, np.int32)
    after = np.full(n, -1, np.int32)
    before = np.full(n, -1, np.int32)
    bucket = np.full(n, -1, np.int32)
    bucket_next = np.full(n, -1, np.int32)
    code = np.zeros(n, np.int32)

    n_first = n_before if n_before > 0 else n - n_last
    for i in range(total):
        begin[i] = start[i]
        length[i] = start[i + 1] - start[i]
        if i >= n:
            size[i] = length[i]
    for i in range(n):
        d = 0
        for k in range(begin[i], begin[i] + length[i]):
            if iw[k] >= n:
                n_in[i] += 1
                d += size[iw[k]] - 1
            else:
                d += 1
        degree[i] = min(d, n - 1)
        if i < n_first:
            _insert(i, degree[i], first, after, before)

    offset = np.empty(n + 1, np.int64)
    n_frontal = np.empty(n, np.int32)
    parent = np.full(n + n_elements, -1, np.int32)
    nodes = np.empty(4 * n + 16, np.int32)
    nodes_end = np.int64(0)
    n_cliques = 0
    smallest = 0
    flag = np.int64(1)
    eliminated = 0
    next_last = n - n_last
    while eliminated < n:
        if eliminated == n_first and n_first < n - n_last:  # the nodes before all others are done
            n_first = n - n_last
            for i in range(n_before, n_first):
                degree[i] = max(min(degree[i], n - eliminated - 1), 0)
                _insert(i, degree[i], first, after, before)
            smallest = 0
        # 1. the pivot
        if eliminated < n_first:
            while first[smallest] < 0:
                smallest += 1
            p = first[smallest]
            _remove(p, degree[p], first, after, before)
        else:
            p = next_last
            next_last += 1
        # 2. its element: its neighbours and the nodes of the elements that it is a member of
        bound = np.int64(length[p])
        for k in range(begin[p], begin[p] + n_in[p]):
            bound += length[iw[k]]
        if end + bound > len(iw):
            iw = _grown(iw, end + bound)
        if nodes_end + n > len(nodes):
            nodes = _grown(nodes, nodes_end + n)
        stamp += 1
        mark[p] = stamp
        weight_p = weight[p]
        weight[p] = 0
        eliminated += weight_p
        top = end
        element_size = 0
        for k in range(begin[p], begin[p] + length[p]):
            e = iw[k]
            if k < begin[p] + n_in[p]:
                if size[e] == 0:
                    continue
                for m in range(begin[e], begin[e] + length[e]):
                    i = iw[m]
                    if weight[i] > 0 and mark[i] != stamp:
                        mark[i] = stamp
                        iw[top] = i
                        top += 1
                        element_size += weight[i]
                size[e] = 0
                if e < n:
                    parent[clique_of[e]] = n_cliques
                else:
                    parent[e] = n_cliques
            elif weight[e] > 0 and mark[e] != stamp:
                mark[e] = stamp
                iw[top] = e
                top += 1
                element_size += weight[e]
        e_begin, e_end = end, top
        offset[n_cliques] = nodes_end
        nodes_end = _put(p, member, nodes, nodes_end)
        # 3. how many nodes of each other element are not in the new one
        for k in range(e_begin, e_end):
            i = iw[k]
            for m in range(begin[i], begin[i] + n_in[i]):
                e = iw[m]
                if size[e] > 0:
                    if outside[e] < flag:
                        outside[e] = flag + size[e]
                    outside[e] -= weight[i]
        # 4. prune the lists and update the approximate degrees
        keep = e_begin
        for k in range(e_begin, e_end):
            i = iw[k]
            if i < n_first:
                _remove(i, degree[i], first, after, before)
            to = begin[i]
            d = 0
            h = np.int64(0)
            for m in range(begin[i], begin[i] + n_in[i]):
                e = iw[m]
                if size[e] > 0:
                    if outside[e] > flag or p < n_before:
                        d += outside[e] - flag
                        iw[to] = e
                        to += 1
                        h += e
                    else:
                        # aggressive absorption: all its nodes are in the new element, but not of
                        # a node before all others, as what is below such a node leaves with it
                        size[e] = 0
                        if e < n:
                            parent[clique_of[e]] = n_cliques
                        else:
                            parent[e] = n_cliques
            first_node = to
            for m in range(begin[i] + n_in[i], begin[i] + length[i]):
                j = iw[m]
                if weight[j] > 0 and mark[j] != stamp:
                    d += weight[j]
                    iw[to] = j
                    to += 1
                    h += j
            if d == 0 and i < n_first and (p >= n_before or first_node == begin[i]):
                # mass elimination: all its neighbours are in the new element
                nodes_end = _put(i, member, nodes, nodes_end)
                eliminated += weight[i]
                element_size -= weight[i]
                weight[i] = 0
                continue
            # the new element comes first; there is room, as at least one entry was removed
            iw[to] = iw[first_node]
            iw[first_node] = iw[begin[i]]
            iw[begin[i]] = p
            n_in[i] = first_node - begin[i] + 1
            length[i] = to - begin[i] + 1
            degree[i] = min(degree[i] + element_size - weight[i], d + element_size - weight[i])
            code[i] = (h + p) % n
            iw[keep] = i
            keep += 1
        e_end = keep
        # 5. merge indistinguishable nodes, found by a hash of their lists, into supernodes
        if eliminated < n_first:
            for k in range(e_begin, e_end):
                i = iw[k]
                if i < n_first:
                    bucket_next[i] = bucket[code[i]]
                    bucket[code[i]] = i
            for k in range(e_begin, e_end):
                i = iw[k]
                if i >= n_first or bucket[code[i]] < 0:
                    continue
                i, bucket[code[i]] = bucket[code[i]], -1
                while i >= 0:
                    if weight[i] > 0 and bucket_next[i] >= 0:
                        stamp += 1
                        for m in range(begin[i], begin[i] + length[i]):
                            mark[iw[m]] = stamp
                        j = bucket_next[i]
                        while j >= 0:
                            if weight[j] > 0 and length[j] == length[i] and n_in[j] == n_in[i]:
                                same = True
                                for m in range(begin[j], begin[j] + length[j]):
                                    if mark[iw[m]] != stamp:
                                        same = False
                                        break
                                if same:
                                    degree[i] -= weight[j]
                                    weight[i] += weight[j]
                                    weight[j] = 0
                                    member[member_end[i]] = j
                                    member_end[i] = member_end[j]
                            j = bucket_next[j]
                    i = bucket_next[i]
        # 6. write the clique
        n_frontal[n_cliques] = nodes_end - offset[n_cliques]
        keep = e_begin
        for k in range(e_begin, e_end):
            i = iw[k]
            if weight[i] > 0:
                iw[keep] = i
                keep += 1
                nodes_end = _put(i, member, nodes, nodes_end)
                if i < n_first:
                    degree[i] = max(min(degree[i], n - eliminated - weight[i]), 0)
                    smallest = min(smallest, degree[i])
                    _insert(i, degree[i], first, after, before)
        begin[p] = e_begin
        length[p] = keep - e_begin
        end = keep
        size[p] = element_size
        clique_of[p] = n_cliques
        n_cliques += 1
        flag += n + 1
    offset[n_cliques] = nodes_end
    # parents of the elements from the start, behind those of the cliques
    for k in range(n_elements):
        parent[n_cliques + k] = parent[n + k]
    return n_cliques, offset, n_frontal, parent, nodes
