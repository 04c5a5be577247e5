# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Numeric elimination of one clique: assemble its front, factorise it and store the result."""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.simd import add
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.fronts import factorize, LEAST_PIVOT, padded, write_rows
from pose_graph_ros.core.graph import normal_equations, prior_rows, tables as tb, transaction_log
from pose_graph_ros.core.graph.factors import anchors, linearize
from pose_graph_ros.core.graph.pools import row_start, separator, triangle_size, update_matrix

# Where factors are stiff in one direction and weak in another, as those of a turn on the spot,
# small pivots are expected: the smallest one, as a fraction of what the factors of its node
# add in their weakest direction, and, because of rounding, of all that they add.
LEAST_WEAK_PIVOT = 1e-9
LEAST_STIFF_PIVOT = 1e-15
@kernel
def eliminate_clique(head, c, relinearized):  # type: ignore[no-untyped-def]
    """
    Return a node with a bad pivot, or -1, after the elimination of a clique.

    Its front is assembled and factorised, and the rows of R and the update matrix are stored. If
    a pivot is small, it is judged again by the weakest direction of the factors of its node. With
    `relinearized`, factors are logged and linearized again first, as their frame may have turned.
    """
    nodes, pool_f, work_f = tb.nodes(head), tb.pool_f(head), tb.work_f(head)
    damping, pool_i, cliques = tb.scalars(head)[0].damping, tb.pool_i(head), tb.cliques(head)
    row = cliques[c]
    n_frontal, n_all = row.n_frontal, row.n_frontal + row.n_separator
    rows, n = 3 * n_frontal, 3 * n_all
    ld = padded(n)
    members = pool_i[row.members:row.members + n_all]
    front, least = work_f[:n * ld], work_f[n * ld:n * ld + rows]
    serial = head[tb.FRONT_SERIAL] + 1
    head[tb.FRONT_SERIAL] = serial
    for k in range(n_all):
        nodes[members[k]].index = 3 * k
        nodes[members[k]].front = serial
    bad, any_padded = -1, False
    for by_weakest in (False, True):
        front[:] = 0.0
        anchored = 0
        for k in range(n_frontal):
            v, node = members[k], nodes[members[k]]
            anchored |= _add_factors(head, v, c, relinearized, rows, front, ld)
            scale_t, scale_r = node.scale_t * node.scale_t, node.scale_r * node.scale_r
            least[3 * k] = least[3 * k + 1] = LEAST_PIVOT * scale_t
            least[3 * k + 2] = LEAST_PIVOT * scale_r
            if by_weakest:
                _lower_bounds(head, v, least[3 * k:3 * k + 3])
            for m in range(3 if damping > 0.0 else 0):
                more = damping * (scale_t if m < 2 else scale_r)
                front[(3 * k + m) * ld + 3 * k + m] += more
                front[(3 * k + m + 1) * ld - 1] += more * node.delta[m]
            for m in range(node.dimension, 3):
                front[(3 * k + m) * (ld + 1)] += 1.0
                any_padded = True
        child = row.child
        while child >= 0:
            _extend_add(head, child, front, ld)
            anchored |= cliques[child].anchored
            child = cliques[child].sibling
        for k in range(n_frontal):
            if nodes[members[k]].fixed != 0:
                substitute_fixed(head, members[k], 3 * k, front, n, ld)
                least[3 * k:3 * k + 3] = 0.0
                anchored = 1
        row.anchored, row.turn_seen = anchored, 0.0
        row.turn_zero = clique_frames.mean_turn(head, c)
        bad = factorize(front, rows, n, ld, least)
        if bad < 0:
            break
    if bad >= 0:
        return members[bad // 3]
    if any_padded:
        # 0 for the reciprocal of the pivot: the coordinate is 0, without uncertainty
        for k in range(n_frontal):
            for m in range(3 * k + nodes[members[k]].dimension, 3 * k + 3):
                front[m * (ld + 1)] = 0.0
    # the rows of R, directly followed by the update matrix
    write_rows(front, n, ld, pool_f, row.values)
    # the squared error of the parent's linear model of a slip beta is about SLIP_SCALE beta^4
    scale, first = 0.0, nodes[members[min(n_frontal, n_all - 1)]]
    for k in range(n_frontal + 1, n_all):
        f, i = nodes[members[k]], 3 * k * ld + 3 * k
        arm2 = (f.pose[0] - first.pose[0]) ** 2 + (f.pose[1] - first.pose[1]) ** 2
        scale += arm2 * (front[i] + front[i + ld + 1])
    cliques[c].slip_scale = 0.25 * scale
    return -1


@kernel
def _add_factors(head, v, c, relinearized, rows, front, ld):  # type: ignore[no-untyped-def]
    """
    Add the factors of a frontal node of a clique to its front, which has so many frontal rows.

    Return whether one of them anchors the clique.
    """
    anchored, at = False, tb.nodes(head)[v].factor_list
    while at >= 0:
        e, side = at >> 2, at & 3
        f = tb.factors(head)[e]
        at = f.next[side]
        at_i, at_j, at_k = (
            _place(head, f.ends[0]), _place(head, f.ends[1]), _place(head, f.ends[2]))
        # one between frontal nodes is in all their lists: added from the first of its ends
        if (at_i < 0 or (f.ends[1] >= 0 and at_j < 0) or (f.ends[2] >= 0 and at_k < 0)
                or (side > 0 and at_i < rows) or (side == 2 and at_j < rows)):
            continue
        if relinearized:
            transaction_log.log_factor(head, e)
            linearize(head, e)
        f.owner = c
        anchored |= anchors(f)
        normal_equations.add(head, e, (at_i, at_j, at_k), front, ld)
    return anchored


@kernel
def _place(head, v):  # type: ignore[no-untyped-def]
    """Return the row of the present front at which the block of a node begins, or -1."""
    nodes = tb.nodes(head)
    if v < 0:
        return -1
    return nodes[v].index if nodes[v].front == head[tb.FRONT_SERIAL] else -1


@kernel
def _lower_bounds(head, v, least):  # type: ignore[no-untyped-def]
    """Lower the bounds of a node's pivots, shape (3,), where its factors are weak."""
    cliques, at = tb.cliques(head), tb.nodes(head)[v].factor_list
    weak_t = weak_r = 0.0
    while at >= 0:
        f = tb.factors(head)[at >> 2]
        w, at = f.information, f.next[at & 3]
        t, r = normal_equations.weakest(w[0], w[1], w[2], w[3], w[4], w[5])
        weak_t, weak_r = weak_t + f.weight * t, weak_r + f.weight * r
    c = cliques[tb.nodes(head)[v].clique].child
    while c >= 0:
        if cliques[c].n_frontal == 0:
            t, r = prior_rows.weakest(head, c, v)
            weak_t, weak_r = weak_t + t, weak_r + r
        c = cliques[c].sibling
    for m in range(3):
        weak = LEAST_WEAK_PIVOT * (weak_t if m < 2 else weak_r)
        if weak > 0.0:
            least[m] = max(min(least[m], weak), least[m] * (LEAST_STIFF_PIVOT / LEAST_PIVOT))


@kernel
def _extend_add(head, child, front, ld):  # type: ignore[no-untyped-def]
    """Add the update matrix of a child to the front; INDEX of the front's nodes must be set."""
    row, members, nodes = tb.cliques(head)[child], separator(head, child), tb.nodes(head)
    n_separator = len(members)
    size = 3 * n_separator
    if n_separator == 0:
        return
    update, turned = update_matrix(head, child), tb.work_f(head)[len(front) + len(front) // ld:]
    phi = clique_frames.present_turn(head, child)
    if phi != row.turn_seen:
        transaction_log.log_clique(head, child)
    row.turn_seen = phi
    if row.n_frontal == 0:
        clique_frames.linearize_prior(head, child, phi, turned, turned[triangle_size(size, size):])
        update = turned
    elif phi != 0.0:
        clique_frames.turned_update(head, child, phi, turned)
        update = turned
    index = tb.work_i(head)[head[tb.NODE_ROOM]:]
    in_order = True
    for a in range(n_separator):
        index[a] = nodes[members[a]].index
        in_order = in_order and (a == 0 or index[a] > index[a - 1])
    for k in range(size):
        front[(index[k // 3] + k % 3) * ld + ld - 1] += update[row_start(k, size) + size]
    if not in_order:
        for a in range(n_separator):
            i = index[a]
            for m in range(3):
                source = update[row_start(3 * a + m, size):]
                for q in range(m, 3):
                    front[(i + m) * ld + i + q] += source[3 * a + q]
                for b in range(a + 1, n_separator):
                    j = index[b]
                    if j > i:   # else the entry is below the diagonal there: add its transpose
                        to, step = (i + m) * ld + j, 1
                    else:
                        to, step = j * ld + i + m, ld
                    for q in range(3):
                        front[to + q * step] += source[3 * b + q]
        return
    # add runs of columns that are contiguous both in the update matrix and in the front
    begin = 0
    while begin < n_separator:
        end = begin + 1
        while end < n_separator and index[end] == index[end - 1] + 3:
            end += 1
        width, column = 3 * (end - begin), index[begin]
        for a in range(begin):
            target = index[a] * ld + column
            for k in range(3 * a, 3 * a + 3):
                add(update, row_start(k, size) + 3 * begin, front, target, width)
                target += ld
        target = column * (ld + 1)
        for k in range(3 * begin, 3 * end):
            add(update, row_start(k, size) + k, front, target, 3 * end - k)
            target += ld + 1
        begin = end


@kernel
def substitute_fixed(head, v, at, front, n, ld):  # type: ignore[no-untyped-def]
    """Substitute the known solution of a fixed node: move its columns to the right-hand side."""
    right = ld - 1
    for m in range(3):
        r = at + m
        x = tb.nodes(head)[v].delta[m]
        for k in range(r):
            front[k * ld + right] -= front[k * ld + r] * x
            front[k * ld + r] = 0.0
        for k in range(r + 1, n):
            front[k * ld + right] -= front[r * ld + k] * x
            front[r * ld + k] = 0.0
        front[r * ld + r] = 1.0
        front[r * ld + right] = x


@kernel
def work_size(n_nodes):  # type: ignore[no-untyped-def]
    """Return the size of the work space for a front of n nodes and a child's update matrix."""
    n = 3 * n_nodes
    return n * padded(n) + n + triangle_size(n, n) + 5 * n
