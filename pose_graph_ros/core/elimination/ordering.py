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

The elements are the cliques, so the ordering yields the symbolic factorisation as well. SciPy has
no such ordering, and none with these extensions.
"""

import numpy as np

from pose_graph_ros.core.compiled.jit import INDICES, INTEGER, kernel

# Columns of the table of nodes and elements; an element has the number of its eliminated node.
# BEGIN, LENGTH: of its list in `iw`. N_IN: number of elements at the front of a node's list.
# WEIGHT: nodes in the supernode of a principal node; 0: not principal. SIZE: number of nodes in an
# element; 0: absorbed. ABSORBER: what has absorbed an element. OUTSIDE: w of the paper, a
# flag and the nodes of an element that are not in the new one. MEMBER: next node of the supernode,
# MEMBER_END the last one. DEGREE: approximate; FIRST, AFTER, BEFORE: doubly linked lists of the
# principal nodes by it. BUCKET, BUCKET_NEXT: lists by the hash of a node's list, its CODE.
(BEGIN, LENGTH, N_IN, WEIGHT, SIZE, ABSORBER, OUTSIDE, MEMBER, MEMBER_END, MARK, DEGREE, FIRST,
 AFTER, BEFORE, BUCKET, BUCKET_NEXT, CODE, COLUMNS) = range(18)


@kernel(allocates=True)
def grown(array, size):  # type: ignore[no-untyped-def]
    """Return a copy with room for twice as many numbers, and for at least `size`."""
    longer = np.empty(max(size, 2 * len(array)), array.dtype)
    for k in range(len(array)):
        longer[k] = array[k]
    return longer


@kernel
def _insert(t, i):  # type: ignore[no-untyped-def]
    """Put node i at the front of the list of its degree."""
    d = t[i, DEGREE]
    t[i, BEFORE] = -1
    t[i, AFTER] = t[d, FIRST]
    if t[d, FIRST] >= 0:
        t[t[d, FIRST], BEFORE] = i
    t[d, FIRST] = i


@kernel
def _remove(t, i):  # type: ignore[no-untyped-def]
    """Remove node i from the list of its degree."""
    if t[i, BEFORE] >= 0:
        t[t[i, BEFORE], AFTER] = t[i, AFTER]
    else:
        t[t[i, DEGREE], FIRST] = t[i, AFTER]
    if t[i, AFTER] >= 0:
        t[t[i, AFTER], BEFORE] = t[i, BEFORE]


@kernel
def _put(t, i, nodes, end):  # type: ignore[no-untyped-def]
    """Write all nodes of a supernode, given by its principal node; return where they end."""
    while i >= 0:
        nodes[end] = i
        end += 1
        i = t[i, MEMBER]
    return end


@kernel
def _fill(t, n, start, iw):  # type: ignore[no-untyped-def]
    """Write the first rows of nodes and elements, whose lists begin at `start`."""
    for i in range(len(t)):
        for m in range(COLUMNS):
            t[i, m] = 0
        t[i, ABSORBER] = t[i, MEMBER] = t[i, FIRST] = t[i, AFTER] = t[i, BEFORE] = -1
        t[i, BUCKET] = t[i, BUCKET_NEXT] = -1
        t[i, MEMBER_END] = i
        t[i, BEGIN] = start[i]
        t[i, LENGTH] = start[i + 1] - start[i]
        if i < n:
            t[i, WEIGHT] = 1
        else:
            t[i, SIZE] = t[i, LENGTH]
    for i in range(n):
        d = 0
        for k in range(t[i, BEGIN], t[i, BEGIN] + t[i, LENGTH]):
            if iw[k] >= n:
                t[i, N_IN] += 1
                d += t[iw[k], SIZE] - 1
            else:
                d += 1
        t[i, DEGREE] = min(d, n - 1)


@kernel
def _write_element(t, iw, p, stamp, top):  # type: ignore[no-untyped-def]
    """
    Write the nodes of the element of p, with the nodes of elements that it absorbs, marked.

    Return where they end, and their number.
    """
    n = 0
    for k in range(t[p, BEGIN], t[p, BEGIN] + t[p, LENGTH]):
        e = iw[k]
        if k < t[p, BEGIN] + t[p, N_IN]:
            if t[e, SIZE] == 0:
                continue
            for m in range(t[e, BEGIN], t[e, BEGIN] + t[e, LENGTH]):
                i = iw[m]
                if t[i, WEIGHT] > 0 and t[i, MARK] != stamp:
                    t[i, MARK] = stamp
                    iw[top] = i
                    top += 1
                    n += t[i, WEIGHT]
            t[e, SIZE] = 0
            t[e, ABSORBER] = p
        elif t[e, WEIGHT] > 0 and t[e, MARK] != stamp:
            t[e, MARK] = stamp
            iw[top] = e
            top += 1
            n += t[e, WEIGHT]
    return top, n


@kernel
def _count_outside(t, iw, first, last, flag):  # type: ignore[no-untyped-def]
    """Count how many nodes of each other element are not in the new one."""
    for k in range(first, last):
        i = iw[k]
        for m in range(t[i, BEGIN], t[i, BEGIN] + t[i, N_IN]):
            e = iw[m]
            if t[e, SIZE] > 0:
                if t[e, OUTSIDE] < flag:
                    t[e, OUTSIDE] = flag + t[e, SIZE]
                t[e, OUTSIDE] -= t[i, WEIGHT]


@kernel
def _prune(t, iw, i, p, flag, stamp, absorbs):  # type: ignore[no-untyped-def]
    """
    Remove from the list of a node what the new element p has.

    Return its approximate degree outside, where the nodes begin in the list, its end and a hash.
    Aggressive absorption: an element all of whose nodes are in the new one goes, but not for a
    node before all others, as what is below such a node leaves with it.
    """
    to, d, h = t[i, BEGIN], 0, np.int64(0)
    for m in range(t[i, BEGIN], t[i, BEGIN] + t[i, N_IN]):
        e = iw[m]
        if t[e, SIZE] > 0:
            if t[e, OUTSIDE] > flag or not absorbs:
                d += t[e, OUTSIDE] - flag
                iw[to] = e
                to += 1
                h += e
            else:
                t[e, SIZE] = 0
                t[e, ABSORBER] = p
    first_node = to
    for m in range(t[i, BEGIN] + t[i, N_IN], t[i, BEGIN] + t[i, LENGTH]):
        j = iw[m]
        if t[j, WEIGHT] > 0 and t[j, MARK] != stamp:
            d += t[j, WEIGHT]
            iw[to] = j
            to += 1
            h += j
    return d, first_node, to, h


@kernel
def _merge_twins(t, iw, first, last, n_first, stamp):  # type: ignore[no-untyped-def]
    """Merge indistinguishable nodes, found by a hash of their lists, into supernodes."""
    for k in range(first, last):
        i = iw[k]
        if i < n_first:
            t[i, BUCKET_NEXT] = t[t[i, CODE], BUCKET]
            t[t[i, CODE], BUCKET] = i
    for k in range(first, last):
        i = iw[k]
        if i >= n_first or t[t[i, CODE], BUCKET] < 0:
            continue
        i, t[t[i, CODE], BUCKET] = t[t[i, CODE], BUCKET], -1
        while i >= 0:
            if t[i, WEIGHT] > 0 and t[i, BUCKET_NEXT] >= 0:
                stamp += 1
                for m in range(t[i, BEGIN], t[i, BEGIN] + t[i, LENGTH]):
                    t[iw[m], MARK] = stamp
                j = t[i, BUCKET_NEXT]
                while j >= 0:
                    if t[j, WEIGHT] > 0 and _is_marked(t, iw, j, i, stamp):
                        t[i, DEGREE] -= t[j, WEIGHT]
                        t[i, WEIGHT] += t[j, WEIGHT]
                        t[j, WEIGHT] = 0
                        t[t[i, MEMBER_END], MEMBER] = j
                        t[i, MEMBER_END] = t[j, MEMBER_END]
                    j = t[j, BUCKET_NEXT]
            i = t[i, BUCKET_NEXT]
    return stamp


@kernel
def _is_marked(t, iw, j, i, stamp):  # type: ignore[no-untyped-def]
    """Tell whether node j has the list of node i, whose entries are marked."""
    same = t[j, LENGTH] == t[i, LENGTH] and t[j, N_IN] == t[i, N_IN]
    m = t[j, BEGIN]
    while same and m < t[j, BEGIN] + t[j, LENGTH]:
        same = t[iw[m], MARK] == stamp
        m += 1
    return same


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
    t = np.empty((n + n_elements, COLUMNS), np.int64)
    _fill(t, n, start, iw)
    n_first = n_before if n_before > 0 else n - n_last
    for i in range(n_first):
        _insert(t, i)
    offset = np.empty(n + 1, np.int64)
    n_frontal = np.empty(n, np.int32)
    nodes = np.empty(4 * n + 16, np.int32)
    nodes_end = np.int64(0)
    n_cliques = smallest = eliminated = stamp = 0
    flag = np.int64(1)
    next_last = n - n_last
    while eliminated < n:
        if eliminated == n_first and n_first < n - n_last:  # the nodes before all others are done
            n_first = n - n_last
            for i in range(n_before, n_first):
                t[i, DEGREE] = max(min(t[i, DEGREE], n - eliminated - 1), 0)
                _insert(t, i)
            smallest = 0
        if eliminated < n_first:
            while t[smallest, FIRST] < 0:
                smallest += 1
            p = t[smallest, FIRST]
            _remove(t, p)
        else:
            p = next_last
            next_last += 1
        bound = np.int64(t[p, LENGTH])
        for k in range(t[p, BEGIN], t[p, BEGIN] + t[p, N_IN]):
            bound += t[iw[k], LENGTH]
        if end + bound > len(iw):
            iw = grown(iw, end + bound)
        if nodes_end + n > len(nodes):
            nodes = grown(nodes, nodes_end + n)
        stamp += 1
        t[p, MARK] = stamp
        weight_p = t[p, WEIGHT]
        t[p, WEIGHT] = 0
        eliminated += weight_p
        new = end
        top, element_size = _write_element(t, iw, p, stamp, new)
        _count_outside(t, iw, new, top, flag)
        offset[n_cliques] = nodes_end
        nodes_end = _put(t, p, nodes, nodes_end)
        keep = new
        for k in range(new, top):
            i = iw[k]
            if i < n_first:
                _remove(t, i)
            d, first_node, to, h = _prune(t, iw, i, p, flag, stamp, p >= n_before)
            if d == 0 and i < n_first and (p >= n_before or first_node == t[i, BEGIN]):
                # mass elimination: all its neighbours are in the new element
                nodes_end = _put(t, i, nodes, nodes_end)
                eliminated += t[i, WEIGHT]
                element_size -= t[i, WEIGHT]
                t[i, WEIGHT] = 0
                continue
            # the new element comes first; there is room, as at least one entry was removed
            iw[to] = iw[first_node]
            iw[first_node] = iw[t[i, BEGIN]]
            iw[t[i, BEGIN]] = p
            t[i, N_IN] = first_node - t[i, BEGIN] + 1
            t[i, LENGTH] = to - t[i, BEGIN] + 1
            t[i, DEGREE] = min(t[i, DEGREE], d) + element_size - t[i, WEIGHT]
            t[i, CODE] = (h + p) % n
            iw[keep] = i
            keep += 1
        if eliminated < n_first:
            stamp = _merge_twins(t, iw, new, keep, n_first, stamp)
        n_frontal[n_cliques] = nodes_end - offset[n_cliques]
        end = new
        for k in range(new, keep):
            i = iw[k]
            if t[i, WEIGHT] > 0:
                iw[end] = i
                end += 1
                nodes_end = _put(t, i, nodes, nodes_end)
                if i < n_first:
                    t[i, DEGREE] = max(min(t[i, DEGREE], n - eliminated - t[i, WEIGHT]), 0)
                    smallest = min(smallest, t[i, DEGREE])
                    _insert(t, i)
        t[p, BEGIN] = new
        t[p, LENGTH] = end - new
        t[p, SIZE] = element_size
        n_cliques += 1
        flag += n + 1
    offset[n_cliques] = nodes_end
    return n_cliques, offset, n_frontal, _parents(t, n, n_cliques, offset, nodes), nodes


@kernel(allocates=True)
def _parents(t, n, n_cliques, offset, nodes):  # type: ignore[no-untyped-def]
    """Return the parent of each clique, then of each element from the start."""
    n_elements = len(t) - n
    clique_of = np.full(n, -1, np.int32)
    for k in range(n_cliques):
        clique_of[nodes[offset[k]]] = k
    parent = np.full(n_cliques + n_elements, -1, np.int32)
    for k in range(n_cliques + n_elements):
        e = nodes[offset[k]] if k < n_cliques else n + k - n_cliques
        if t[e, ABSORBER] >= 0:
            parent[k] = clique_of[t[e, ABSORBER]]
    return parent
