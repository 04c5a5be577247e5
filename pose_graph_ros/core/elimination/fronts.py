# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Dense kernels: partial Cholesky factorisation of a front, and triangular solves of a clique.

A *front* is the upper triangle of the equations of one clique, `(H | rhs)`, its frontal nodes
first. Factorising the frontal rows gives rows of R with `R^T R = H`. It leaves the Schur
complement in the other rows: the *update matrix*, which is added to the front of the parent
(J. Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34 (1992)). Rows of R
hold the reciprocal of their diagonal.

In a front, each row is padded to a multiple of the SIMD width and the right-hand side is the last
column. SIMD vectors may begin left of the diagonal; the numbers there are never read. A clique
keeps its rows of R and its update matrix as upper triangles without gaps (`graph.pools`).
"""

import math

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.simd import copy, fnmadd, load, spread, store, times, WIDTH
from pose_graph_ros.core.graph.pools import row_start

# Smallest pivot, as a fraction of what the constraints of its node add to it. A smaller one has
# lost all its digits to cancellation: the node is not determined.
LEAST_PIVOT = 1e-12

_FAST = {'reassoc', 'contract', 'nsz', 'arcp'}


@kernel
def padded(n):  # type: ignore[no-untyped-def]
    """Return the padded length of a front's row with n columns and a right-hand side."""
    return (n + WIDTH) // WIDTH * WIDTH


@kernel
def _subtract_3(front, k, i, ld):  # type: ignore[no-untyped-def]
    """Subtract the contribution of the rows of R from k to k + 2 from rows i to i + 2."""
    p, q, r, t = k * ld, (k + 1) * ld, (k + 2) * ld, i * ld
    a0, b0, c0 = spread(front[p + i]), spread(front[p + i + 1]), spread(front[p + i + 2])
    a1, b1, c1 = spread(front[q + i]), spread(front[q + i + 1]), spread(front[q + i + 2])
    a2, b2, c2 = spread(front[r + i]), spread(front[r + i + 1]), spread(front[r + i + 2])
    for c in range(i // WIDTH * WIDTH, ld, WIDTH):
        x, y, z = load(front, p + c), load(front, q + c), load(front, r + c)
        u, v, w = load(front, t + c), load(front, t + ld + c), load(front, t + 2 * ld + c)
        store(front, t + c, fnmadd(fnmadd(fnmadd(u, a0, x), a1, y), a2, z))
        store(front, t + ld + c, fnmadd(fnmadd(fnmadd(v, b0, x), b1, y), b2, z))
        store(front, t + 2 * ld + c, fnmadd(fnmadd(fnmadd(w, c0, x), c1, y), c2, z))


@kernel
def _subtract_6(front, k, i, ld):  # type: ignore[no-untyped-def]
    """Subtract the contribution of the rows of R from k to k + 5 from rows i to i + 2."""
    p, t = k * ld, i * ld
    o = p + i
    a0, b0, c0 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    o += ld
    a1, b1, c1 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    o += ld
    a2, b2, c2 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    o += ld
    a3, b3, c3 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    o += ld
    a4, b4, c4 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    o += ld
    a5, b5, c5 = spread(front[o]), spread(front[o + 1]), spread(front[o + 2])
    for c in range(i // WIDTH * WIDTH, ld, WIDTH):
        o = p + c
        u, v, w = load(front, t + c), load(front, t + ld + c), load(front, t + 2 * ld + c)
        x = load(front, o)
        u, v, w = fnmadd(u, a0, x), fnmadd(v, b0, x), fnmadd(w, c0, x)
        x = load(front, o + ld)
        u, v, w = fnmadd(u, a1, x), fnmadd(v, b1, x), fnmadd(w, c1, x)
        x = load(front, o + 2 * ld)
        u, v, w = fnmadd(u, a2, x), fnmadd(v, b2, x), fnmadd(w, c2, x)
        x = load(front, o + 3 * ld)
        u, v, w = fnmadd(u, a3, x), fnmadd(v, b3, x), fnmadd(w, c3, x)
        x = load(front, o + 4 * ld)
        u, v, w = fnmadd(u, a4, x), fnmadd(v, b4, x), fnmadd(w, c4, x)
        x = load(front, o + 5 * ld)
        u, v, w = fnmadd(u, a5, x), fnmadd(v, b5, x), fnmadd(w, c5, x)
        store(front, t + c, u)
        store(front, t + ld + c, v)
        store(front, t + 2 * ld + c, w)


@kernel
def factorize(front, rows, n, ld, least):  # type: ignore[no-untyped-def]
    """
    Return the first row with a bad pivot, or -1, after factorising the first rows of a front.

    They are replaced by rows of R; the other ones of all n rows, of `ld = padded(n)` numbers,
    become the update matrix. Each pivot must be above its `least`.
    """
    for k in range(0, rows, 3):
        p, q, r = k * ld, (k + 1) * ld, (k + 2) * ld
        # the 3x3 block on the diagonal first: it gives all factors for the rest of the rows
        pivot = front[p + k]
        if not pivot > least[k]:
            return k
        f = 1.0 / math.sqrt(pivot)
        b, d = front[p + k + 1] * f, front[p + k + 2] * f
        pivot = front[q + k + 1] - b * b
        if not pivot > least[k + 1]:
            return k + 1
        g = 1.0 / math.sqrt(pivot)
        e = (front[q + k + 2] - b * d) * g
        pivot = front[r + k + 2] - d * d - e * e
        if not pivot > least[k + 2]:
            return k + 2
        h = 1.0 / math.sqrt(pivot)
        vf, vg, vh, vb, vd, ve = spread(f), spread(g), spread(h), spread(b), spread(d), spread(e)
        for c in range(k // WIDTH * WIDTH, ld, WIDTH):
            x = times(load(front, p + c), vf)
            y = times(fnmadd(load(front, q + c), vb, x), vg)
            z = times(fnmadd(fnmadd(load(front, r + c), vd, x), ve, y), vh)
            store(front, p + c, x)
            store(front, q + c, y)
            store(front, r + c, z)
        front[p + k], front[q + k + 1], front[r + k + 2] = f, g, h
        # from all others six rows are subtracted at once, those of the next node need these three
        if k % 6 == 3:
            for i in range(k + 3, n, 3):
                _subtract_6(front, k - 3, i, ld)
        else:
            for i in range(k + 3, k + 6 if k + 6 <= rows else n, 3):
                _subtract_3(front, k, i, ld)
    return -1


@kernel
def write_rows(front, n, ld, pool_f, at):  # type: ignore[no-untyped-def]
    """Write the upper triangle of the n rows of a front with right-hand sides, without gaps."""
    for k in range(n):
        copy(front, k * (ld + 1), pool_f, at, n - k)
        at += n - k + 1
        pool_f[at - 1] = front[(k + 1) * ld - 1]


@kernel(fastmath=_FAST)
def forward_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """
    Solve `R^T y = x` for the frontal rows of a clique, and subtract them from the separator's.

    The values are the first rows of a triangle of n columns, laid out by `pools.row_start`.
    """
    for k in range(0, rows, 3):
        r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                      values[row_start(k + 2, n):])
        a = x[k] * r0[k]
        b = (x[k + 1] - r0[k + 1] * a) * r1[k + 1]
        c = (x[k + 2] - r0[k + 2] * a - r1[k + 2] * b) * r2[k + 2]
        x[k], x[k + 1], x[k + 2] = a, b, c
        for m in range(k + 3, n):
            x[m] -= a * r0[m] + b * r1[m] + c * r2[m]


@kernel(fastmath=_FAST)
def backward_rows(values, rows, n, x, stored):  # type: ignore[no-untyped-def]
    """
    Solve `R x = y` for the frontal nodes of a clique.

    Values are as for `forward_rows`; x has the solution of the separator, and before it y, unless
    y is the right-hand side that is stored with R.
    """
    for k in range(rows - 3, -1, -3):
        r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                      values[row_start(k + 2, n):])
        a, b, c = (r0[n], r1[n], r2[n]) if stored else (x[k], x[k + 1], x[k + 2])
        for m in range(k + 3, n):
            a -= r0[m] * x[m]
            b -= r1[m] * x[m]
            c -= r2[m] * x[m]
        c *= r2[k + 2]
        b = (b - r1[k + 2] * c) * r1[k + 1]
        x[k] = (a - r0[k + 1] * b - r0[k + 2] * c) * r0[k]
        x[k + 1], x[k + 2] = b, c
