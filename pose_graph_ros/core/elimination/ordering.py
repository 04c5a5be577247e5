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

# A node or an element; an element has the number of its eliminated node.
ENTRY = np.dtype([(name, 'i8' if name == 'outside' else 'i4') for name in (
    'begin', 'length',  # of its list in `iw`
    'n_in',     # number of elements at the front of a node's list
    'weight',   # nodes in the supernode of a principal node; 0: not principal
    'size',     # number of nodes in an element; 0: absorbed
    'absorber',     # what has absorbed an element
    'outside',  # w of the paper: a flag and the nodes of an element that are not in the new one
    'member', 'member_end',     # next node of the supernode, and the last one
    'mark',
    'degree',   # approximate
    'first', 'after', 'before',     # doubly linked lists of the principal nodes by degree
    'bucket', 'bucket_next',    # lists by the hash of a node's list, its `code`
    'code',
)])


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
    d = t[i].degree
    t[i].before = -1
    t[i].after = t[d].first
    if t[d].first >= 0:
        t[t[d].first].before = i
    t[d].first = i


@kernel
def _remove(t, i):  # type: ignore[no-untyped-def]
    """Remove node i from the list of its degree."""
    if t[i].before >= 0:
        t[t[i].before].after = t[i].after
    else:
        t[t[i].degree].first = t[i].after
    if t[i].after >= 0:
        t[t[i].after].before = t[i].before


@kernel
def _put(t, i, nodes, end):  # type: ignore[no-untyped-def]
    """Write all nodes of a supernode, given by its principal node; return where they end."""
    while i >= 0:
        nodes[end] = i
        end += 1
        i = t[i].member
    return end


@kernel
def _fill(t, n, start, iw):  # type: ignore[no-untyped-def]
    """Write the first state of nodes and elements, whose lists begin at `start`."""
    for i in range(len(t)):
        e = t[i]
        e.n_in = e.weight = e.size = e.outside = e.mark = e.degree = e.code = 0
        e.absorber = e.member = e.first = e.after = e.before = e.bucket = e.bucket_next = -1
        e.member_end, e.begin, e.length = i, start[i], start[i + 1] - start[i]
        if i < n:
            e.weight = 1
        else:
            e.size = e.length
    for i in range(n):
        d = 0
        for k in range(t[i].begin, t[i].begin + t[i].length):
            if iw[k] >= n:
                t[i].n_in += 1
                d += t[iw[k]].size - 1
            else:
                d += 1
        t[i].degree = min(d, n - 1)


@kernel
def _write_element(t, iw, p, stamp, top):  # type: ignore[no-untyped-def]
    """
    Write the nodes of the element of p, with the nodes of elements that it absorbs, marked.

    Return where they end, and their number.
    """
    n = 0
    for k in range(t[p].begin, t[p].begin + t[p].length):
        e = iw[k]
        if k < t[p].begin + t[p].n_in:
            if t[e].size == 0:
                continue
            for m in range(t[e].begin, t[e].begin + t[e].length):
                i = iw[m]
                if t[i].weight > 0 and t[i].mark != stamp:
                    t[i].mark = stamp
                    iw[top] = i
                    top += 1
                    n += t[i].weight
            t[e].size = 0
            t[e].absorber = p
        elif t[e].weight > 0 and t[e].mark != stamp:
            t[e].mark = stamp
            iw[top] = e
            top += 1
            n += t[e].weight
    return top, n


@kernel
def _merge_twins(t, iw, first, last, n_first, stamp):  # type: ignore[no-untyped-def]
    """Merge indistinguishable nodes, found by a hash of their lists, into supernodes."""
    for k in range(first, last):
        i = iw[k]
        if i < n_first:
            t[i].bucket_next = t[t[i].code].bucket
            t[t[i].code].bucket = i
    for k in range(first, last):
        i = iw[k]
        if i >= n_first or t[t[i].code].bucket < 0:
            continue
        i, t[t[i].code].bucket = t[t[i].code].bucket, -1
        while i >= 0:
            if t[i].weight > 0 and t[i].bucket_next >= 0:
                stamp += 1
                for m in range(t[i].begin, t[i].begin + t[i].length):
                    t[iw[m]].mark = stamp
                j = t[i].bucket_next
                while j >= 0:
                    same = t[j].weight > 0 and (
                        t[j].length == t[i].length and t[j].n_in == t[i].n_in)
                    m = t[j].begin
                    while same and m < t[j].begin + t[j].length:
                        same = t[iw[m]].mark == stamp
                        m += 1
                    if same:
                        t[i].degree -= t[j].weight
                        t[i].weight += t[j].weight
                        t[j].weight = 0
                        t[t[i].member_end].member = j
                        t[i].member_end = t[j].member_end
                    j = t[j].bucket_next
            i = t[i].bucket_next
    return stamp


@kernel
def _shorten_lists(t, iw, p, within, stamps, nodes, sums):  # type: ignore[no-untyped-def]
    """
    Update the members of the new element p, which are `iw[new:top]`, and keep those that stay.

    What p has is removed from their lists. Return where they end, where `nodes` end, and the
    numbers of nodes that are eliminated and in the element. Those all of whose neighbours are in
    the element are eliminated with p. Aggressive absorption: an element all of whose nodes are in
    the new one goes, but not for a node before all others, as what is below such a node leaves
    with it.
    """
    (n, new, top, n_before, n_first), (flag, stamp) = within, stamps
    nodes_end, eliminated, element_size = sums
    # how many nodes of each other element are not in the new one
    for k in range(new, top):
        i = iw[k]
        for m in range(t[i].begin, t[i].begin + t[i].n_in):
            e = iw[m]
            if t[e].size > 0:
                if t[e].outside < flag:
                    t[e].outside = flag + t[e].size
                t[e].outside -= t[i].weight
    keep = new
    for k in range(new, top):
        i = iw[k]
        if i < n_first:
            _remove(t, i)
        # the approximate degree outside, and a hash of the list
        begin, to, d, h = t[i].begin, t[i].begin, 0, np.int64(0)
        for m in range(begin, begin + t[i].n_in):
            e = iw[m]
            if t[e].size > 0 and t[e].outside <= flag and p >= n_before:
                t[e].size = 0
                t[e].absorber = p
            elif t[e].size > 0:
                d += t[e].outside - flag
                iw[to] = e
                to += 1
                h += e
        first_node = to
        for m in range(begin + t[i].n_in, begin + t[i].length):
            j = iw[m]
            if t[j].weight > 0 and t[j].mark != stamp:
                d += t[j].weight
                iw[to] = j
                to += 1
                h += j
        if d == 0 and i < n_first and (p >= n_before or first_node == begin):
            nodes_end = _put(t, i, nodes, nodes_end)
            eliminated += t[i].weight
            element_size -= t[i].weight
            t[i].weight = 0
            continue
        # the new element comes first; there is room, as at least one entry was removed
        iw[to], iw[first_node], iw[begin] = iw[first_node], iw[begin], p
        t[i].n_in = first_node - begin + 1
        t[i].length = to - begin + 1
        t[i].degree = min(t[i].degree, d) + element_size - t[i].weight
        t[i].code = (h + p) % n
        iw[keep] = i
        keep += 1
    return keep, nodes_end, eliminated, element_size


@kernel(signature=(INTEGER, INTEGER, INTEGER, INTEGER, INDICES, INDICES), allocates=True)
def minimum_degree(n, n_elements, n_before, n_last, start, adjacency):  # type: ignore[no-untyped-def]
    """
    Order nodes 0 to n - 1; return the cliques of the elimination, children before parents.

    Elements from the start have the numbers from n on. The first `n_before` nodes are eliminated
    before all others, the last `n_last` after them in their order. Of entry k the list begins at
    `adjacency[start[k]]`: elements that a node is a member of, then its neighbours, without
    repetitions; or the nodes of an element. Returned are the number of cliques; where the nodes of
    each begin in `nodes`, and the last end; their numbers of frontal nodes, which come first; the
    parent of each clique, or -1, then of each element from the start, whose nodes include the
    separator or the nodes of the element; and `nodes`.
    """
    iw = np.empty(start[n + n_elements] + 4 * n + 16, np.int32)
    end = np.int64(start[n + n_elements])
    for k in range(end):    # a slice assignment would take two seconds to compile
        iw[k] = adjacency[k]
    t = np.empty(n + n_elements, ENTRY)
    _fill(t, n, start, iw)
    n_first = n_before if n_before > 0 else n - n_last
    for i in range(n_first):
        _insert(t, i)
    offset, n_frontal = np.empty(n + 1, np.int64), np.empty(n, np.int32)
    nodes, nodes_end = np.empty(4 * n + 16, np.int32), np.int64(0)
    n_cliques = smallest = eliminated = stamp = 0
    flag = np.int64(1)
    next_last = n - n_last
    while eliminated < n:
        if eliminated == n_first and n_first < n - n_last:  # the nodes before all others are done
            n_first = n - n_last
            for i in range(n_before, n_first):
                t[i].degree = max(min(t[i].degree, n - eliminated - 1), 0)
                _insert(t, i)
            smallest = 0
        if eliminated < n_first:
            while t[smallest].first < 0:
                smallest += 1
            p = t[smallest].first
            _remove(t, p)
        else:
            p = next_last
            next_last += 1
        bound = end + t[p].length
        for k in range(t[p].begin, t[p].begin + t[p].n_in):
            bound += t[iw[k]].length
        if bound > len(iw):
            iw = grown(iw, bound)
        if nodes_end + n > len(nodes):
            nodes = grown(nodes, nodes_end + n)
        stamp += 1
        t[p].mark = stamp
        eliminated += t[p].weight
        t[p].weight = 0
        new = end
        top, size = _write_element(t, iw, p, stamp, new)
        offset[n_cliques] = nodes_end
        nodes_end = _put(t, p, nodes, nodes_end)
        keep, nodes_end, eliminated, size = _shorten_lists(
            t, iw, p, (n, new, top, n_before, n_first), (flag, stamp), nodes,
            (nodes_end, eliminated, size))
        if eliminated < n_first:
            stamp = _merge_twins(t, iw, new, keep, n_first, stamp)
        n_frontal[n_cliques] = nodes_end - offset[n_cliques]
        for k in range(new, keep):
            i = iw[k]
            if t[i].weight > 0:
                iw[end] = i
                end += 1
                nodes_end = _put(t, i, nodes, nodes_end)
                if i < n_first:
                    t[i].degree = max(min(t[i].degree, n - eliminated - t[i].weight), 0)
                    smallest = min(smallest, t[i].degree)
                    _insert(t, i)
        t[p].begin, t[p].length, t[p].size = new, end - new, size
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
        if t[e].absorber >= 0:
            parent[k] = clique_of[t[e].absorber]
    return parent
