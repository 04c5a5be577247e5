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

# The weight of what is known of a fixed node, beside which all others vanish in rounding.
KNOWN = 1e30


@kernel(signature=(tb.HEAD, ROWS))
def solve_headings(head, poses):  # type: ignore[no-untyped-def]
    """
    Replace x and y of all poses by u, given the headings of fixed nodes.

    The cliques must be planted, without priors; their values are overwritten. Return False if a
    heading is not determined, or if it is interrupted.
    """
    nodes = tb.nodes(head)
    for v in range(head[tb.N_NODES]):
        nodes[v].index = -1     # place in the present front
    for c in range(head[tb.N_CLIQUES]):
        if tb.interrupt(head)[tb.ALL] != 0 or not _eliminate(head, c, poses):
            return False
    for c in range(head[tb.N_CLIQUES] - 1, -1, -1):     # back-substitution
        row = tb.cliques(head)[c]
        n = row.n_frontal + row.n_separator
        members, ld = tb.pool_i(head)[row.members:row.members + n], padded(n)
        front = tb.pool_f(head)[row.values:row.values + 2 * n * ld]
        for k in range(row.n_frontal - 1, -1, -1):
            r, v = 2 * k * ld, members[k]
            x, y = front[r + ld - 1], front[r + 2 * ld - 1]
            for j in range(k + 1, n):
                a, b, u = front[r + j], front[r + ld + j], poses[members[j]]
                x, y = x - (a * u[0] - b * u[1]), y - (a * u[1] + b * u[0])
            poses[v, 0], poses[v, 1] = x / front[r + k], y / front[r + k]
    return True


@kernel
def _eliminate(head, c, poses):  # type: ignore[no-untyped-def]
    """Assemble the front of a clique and factorise it; tell whether all pivots are positive."""
    nodes, cliques, row = tb.nodes(head), tb.cliques(head), tb.cliques(head)[c]
    pool_i, pool_f, n = tb.pool_i(head), tb.pool_f(head), row.n_frontal + row.n_separator
    members, ld = pool_i[row.members:row.members + n], padded(n)
    front = pool_f[row.values:row.values + 2 * n * ld]
    front[:] = 0.0
    for k in range(n):
        nodes[members[k]].index = k
    for k in range(row.n_frontal):
        at = nodes[members[k]].factor_list
        while at >= 0:
            f, side = tb.factors(head)[at >> 2], at & 3
            at, j = f.next[side], f.ends[1]
            a, b = nodes[f.ends[0]].index, nodes[j].index if j >= 0 else 0
            # one between frontal nodes is in both lists: added from the first of its ends
            if a < 0 or b < 0 or (side > 0 and a < row.n_frontal):
                continue
            kappa, th = f.weight * f.information[5], f.mean[2] - (
                f.constants[2] if j < 0 else 0.0)
            x, y = kappa * math.cos(th), kappa * math.sin(th)
            front[2 * a * ld + a] += kappa
            if j < 0:
                front[(2 * a + 1) * ld - 1] += x
                front[(2 * a + 2) * ld - 1] += y
                continue
            front[2 * b * ld + b] += kappa
            if a > b:
                a, b, y = b, a, -y
            front[2 * a * ld + b] -= x      # entry ij is -kappa conj(r)
            front[(2 * a + 1) * ld + b] += y
    child = row.child
    while child >= 0:
        below = cliques[child]
        size = below.n_frontal + below.n_separator
        width, separator = padded(size), pool_i[below.members:below.members + size]
        for k in range(2 * below.n_frontal, 2 * size):  # sorted by the order of elimination
            source = below.values + k * width
            target = (2 * nodes[separator[k >> 1]].index + (k & 1)) * ld
            for m in range(k >> 1, size):
                front[target + nodes[separator[m]].index] += pool_f[source + m]
            front[target + ld - 1] += pool_f[source + width - 1]
        child = below.sibling
    for k in range(row.n_frontal):
        r, v = 2 * k * ld, members[k]
        if nodes[v].fixed != 0:
            front[r + k] += KNOWN
            front[r + ld - 1] += KNOWN * math.cos(poses[v, 2])
            front[r + 2 * ld - 1] += KNOWN * math.sin(poses[v, 2])
        if not front[r + k] > 0.0:
            return False
        for i in range(k + 1, n):
            # the factor is the conjugate of the entry, over the pivot
            x, y, t = front[r + i] / front[r + k], front[r + ld + i] / front[r + k], 2 * i * ld
            real, plus, minus = spread(x), spread(y), spread(-y)
            for m in range(i // WIDTH * WIDTH, ld, WIDTH):
                a, b, q = load(front, r + m), load(front, r + ld + m), t + m
                store(front, q, fnmadd(fnmadd(load(front, q), real, a), plus, b))
                q += ld
                store(front, q, fnmadd(fnmadd(load(front, q), real, b), minus, a))
    for k in range(n):
        nodes[members[k]].index = -1
    return True
