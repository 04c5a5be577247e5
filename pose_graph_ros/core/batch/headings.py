# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The headings of a linear start over the cliques of a graph: one complex number u for each node.

An edge requires u_j = r u_i, an observed node u = r, with the weight kappa: see `linear_starts`.
The fronts are those of `elimination.fronts` with one row for each node, Hermitian and in two
parts: real parts of a row, then imaginary parts. They are factorised where the clique keeps its
values, which has room for three times as many rows.
"""

import math

from pose_graph_ros.core.compiled.jit import kernel, ROWS
from pose_graph_ros.core.compiled.simd import fnmadd, load, spread, store, WIDTH
from pose_graph_ros.core.elimination.fronts import padded
from pose_graph_ros.core.graph import tables as tb


@kernel(signature=(tb.HEAD, ROWS))
def solve_headings(head, poses):  # type: ignore[no-untyped-def]
    """
    Replace x and y of all poses by u, given the headings of fixed nodes.

    The cliques must be planted, without priors; their values are overwritten. Return False if a
    heading is not determined, or if it is interrupted.
    """
    nodes, cliques = tb.nodes(head), tb.cliques(head)
    for v in range(head[tb.N_NODES]):
        nodes[v].index = -1     # place in the present front
        if nodes[v].fixed != 0:
            poses[v, 0], poses[v, 1] = math.cos(poses[v, 2]), math.sin(poses[v, 2])
    for c in range(head[tb.N_CLIQUES]):
        if tb.interrupt(head)[tb.ALL] != 0 or not _eliminate(head, c, poses):
            return False
    for c in range(head[tb.N_CLIQUES] - 1, -1, -1):     # back-substitution
        row = cliques[c]
        n = row.n_frontal + row.n_separator
        members, ld = tb.pool_i(head)[row.members:row.members + n], padded(n)
        front = tb.pool_f(head)[row.values:row.values + 2 * n * ld]
        for k in range(row.n_frontal - 1, -1, -1):
            r = 2 * k * ld
            x, y = front[r + ld - 1], front[r + 2 * ld - 1]
            for j in range(k + 1, n):
                a, b = front[r + j], front[r + ld + j]
                v = members[j]
                x, y = x - (a * poses[v, 0] - b * poses[v, 1]), (
                    y - (a * poses[v, 1] + b * poses[v, 0]))
            poses[members[k], 0], poses[members[k], 1] = x / front[r + k], y / front[r + k]
    return True


@kernel
def _eliminate(head, c, poses):  # type: ignore[no-untyped-def]
    """Assemble the front of a clique and factorise it; tell whether all pivots are positive."""
    nodes, cliques, row = tb.nodes(head), tb.cliques(head), tb.cliques(head)[c]
    n = row.n_frontal + row.n_separator
    members, ld = tb.pool_i(head)[row.members:row.members + n], padded(n)
    front = tb.pool_f(head)[row.values:row.values + 2 * n * ld]
    front[:] = 0.0
    for k in range(n):
        nodes[members[k]].index = k
    for k in range(row.n_frontal):
        _add_factors(head, members[k], row.n_frontal, poses, front, ld)
    child = row.child
    while child >= 0:
        below = cliques[child]
        size, first = below.n_frontal + below.n_separator, below.n_frontal
        width, at = padded(size), below.members
        update = tb.pool_f(head)[below.values:below.values + 2 * size * width]
        for a in range(first, size):
            r = 2 * nodes[tb.pool_i(head)[at + a]].index * ld
            for part in range(2):
                source, target = (2 * a + part) * width, r + part * ld
                for b in range(a, size):    # separators are in the order of elimination
                    front[target + nodes[tb.pool_i(head)[at + b]].index] += update[source + b]
                front[target + ld - 1] += update[source + width - 1]
        child = below.sibling
    for k in range(row.n_frontal):
        r, v = 2 * k * ld, members[k]
        if nodes[v].fixed != 0:
            front[r + k], front[r + ld - 1], front[r + 2 * ld - 1] = 1.0, poses[v, 0], poses[v, 1]
        if not front[r + k] > 0.0:
            return False
        scale = 1.0 / front[r + k]
        for i in range(k + 1, n):
            # the factor is the conjugate of the entry, over the pivot
            x, y, t = front[r + i] * scale, front[r + ld + i] * scale, 2 * i * ld
            plus, minus, real = spread(y), spread(-y), spread(x)
            for at in range(i // WIDTH * WIDTH, ld, WIDTH):
                a, b = load(front, r + at), load(front, r + ld + at)
                store(front, t + at, fnmadd(fnmadd(load(front, t + at), real, a), plus, b))
                store(front, t + ld + at, fnmadd(
                    fnmadd(load(front, t + ld + at), real, b), minus, a))
    for k in range(n):
        nodes[members[k]].index = -1
    return True


@kernel
def _add_factors(head, v, n_frontal, poses, front, ld):  # type: ignore[no-untyped-def]
    """Add the equations of a frontal node to a front; what is fixed is known."""
    nodes, at = tb.nodes(head), tb.nodes(head)[v].factor_list
    while at >= 0:
        f, side = tb.factors(head)[at >> 2], at & 3
        at = f.next[side]
        i, j = f.ends[0], f.ends[1]
        a, b = nodes[i].index, nodes[j].index if j >= 0 else -1
        # one between frontal nodes is in both lists: added from the first of its ends
        if a < 0 or (j >= 0 and b < 0) or (side > 0 and a < n_frontal):
            continue
        kappa, th = f.weight * f.information[5], f.mean[2] - (f.constants[2] if j < 0 else 0.0)
        x, y = kappa * math.cos(th), kappa * math.sin(th)
        i_free, j_free = nodes[i].fixed == 0, j >= 0 and nodes[j].fixed == 0
        if i_free:
            front[2 * a * ld + a] += kappa
        if j_free:
            front[2 * b * ld + b] += kappa
        if i_free and j_free:   # entry ij is -kappa conj(r)
            if a < b:
                front[2 * a * ld + b] -= x
                front[(2 * a + 1) * ld + b] += y
            else:
                front[2 * b * ld + a] -= x
                front[(2 * b + 1) * ld + a] -= y
        elif i_free or j_free:  # entry of the right-hand side: conj(r) u_j, r u_i, or r
            at_free = a if i_free else b
            if i_free and j >= 0:
                x, y = x * poses[j, 0] + y * poses[j, 1], x * poses[j, 1] - y * poses[j, 0]
            elif j_free:
                x, y = x * poses[i, 0] - y * poses[i, 1], x * poses[i, 1] + y * poses[i, 0]
            front[(2 * at_free + 1) * ld - 1] += x
            front[(2 * at_free + 2) * ld - 1] += y
