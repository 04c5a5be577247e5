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
from pose_graph_ros.core.compiled.simd import (
    fnmadd,
    load,
    spread,
    store,
    times,
    total,
    WIDTH,
)
from pose_graph_ros.core.graph.pools import row_start

# Smallest pivot, as a fraction of what the constraints of its node add to it. A smaller one has
# lost all its digits to cancellation: the node is not determined.
LEAST_PIVOT = 1e-12


@kernel
def padded(n):  # type: ignore[no-untyped-def]
    """Return the padded length of a front's row with n columns and a right-hand side."""
    return (n + WIDTH) // WIDTH * WIDTH


@kernel
def _spread_block(front, at, ld):  # type: ignore[no-untyped-def]
    """Return the entries of a 3x3 block, row by row, as vectors of equal numbers."""
    b, c = at + ld, at + 2 * ld
    return (spread(front[at]), spread(front[at + 1]), spread(front[at + 2]),
            spread(front[b]), spread(front[b + 1]), spread(front[b + 2]),
            spread(front[c]), spread(front[c + 1]), spread(front[c + 2]))


@kernel
def _minus(front, at, ld, s, u, v, w):  # type: ignore[no-untyped-def]
    """Subtract a spread block times three rows, of which a vector begins at an index."""
    x, y, z = load(front, at), load(front, at + ld), load(front, at + 2 * ld)
    return (fnmadd(fnmadd(fnmadd(u, s[0], x), s[3], y), s[6], z),
            fnmadd(fnmadd(fnmadd(v, s[1], x), s[4], y), s[7], z),
            fnmadd(fnmadd(fnmadd(w, s[2], x), s[5], y), s[8], z))


@kernel
def _subtract(front, k, i, ld, six):  # type: ignore[no-untyped-def]
    """Subtract the contribution of the three, or six, rows of R from row k on from i to i + 2."""
    p, q, t = k * ld, (k + 3) * ld if six else k * ld, i * ld
    first, second = _spread_block(front, p + i, ld), _spread_block(front, q + i, ld)
    for c in range(i // WIDTH * WIDTH, ld, WIDTH):
        u, v, w = load(front, t + c), load(front, t + ld + c), load(front, t + 2 * ld + c)
        u, v, w = _minus(front, p + c, ld, first, u, v, w)
        if six:
            u, v, w = _minus(front, q + c, ld, second, u, v, w)
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
                _subtract(front, k - 3, i, ld, True)
        else:
            for i in range(k + 3, k + 6 if k + 6 <= rows else n, 3):
                _subtract(front, k, i, ld, False)
    return -1


@kernel
def write_rows(front, n, ld, pool_f, at):  # type: ignore[no-untyped-def]
    """Write the upper triangle of the n rows of a front with right-hand sides, without gaps."""
    for k in range(n - 1):
        m = 0
        while m < n - k:    # what a vector writes beyond the row is overwritten by the next ones
            store(pool_f, at + m, load(front, k * (ld + 1) + m))
            m += WIDTH
        at += n - k + 1
        pool_f[at - 1] = front[(k + 1) * ld - 1]
    pool_f[at], pool_f[at + 1] = front[(n - 1) * (ld + 1)], front[n * ld - 1]


@kernel
def forward_rows(values, rows, n, x):  # type: ignore[no-untyped-def]
    """
    Solve `R^T y = x` for the frontal rows of a clique, and subtract them from the separator's.

    The values are the first rows of a triangle of n columns, laid out by `pools.row_start`. Behind
    what x holds there is room for three numbers.
    """
    for k in range(0, rows, 3):
        # where column 0 of each row would be
        p, q, r = row_start(k, n), row_start(k + 1, n), row_start(k + 2, n)
        a = x[k] * values[p + k]
        b = (x[k + 1] - values[p + k + 1] * a) * values[q + k + 1]
        c = (x[k + 2] - values[p + k + 2] * a - values[q + k + 2] * b) * values[r + k + 2]
        x[k], x[k + 1], x[k + 2] = a, b, c
        va, vb, vc = spread(a), spread(b), spread(c)
        for m in range(k + 3, n, WIDTH):
            y = fnmadd(fnmadd(load(x, m), va, load(values, p + m)), vb, load(values, q + m))
            store(x, m, fnmadd(y, vc, load(values, r + m)))


@kernel
def backward_rows(values, rows, n, x, stored):  # type: ignore[no-untyped-def]
    """
    Solve `R x = y` for the frontal nodes of a clique.

    Values are as for `forward_rows`; x has the solution of the separator, and before it y, unless
    y is the right-hand side that is stored with R.
    """
    x[n] = x[n + 1] = x[n + 2] = 0.0    # what the last vector reads beyond the row counts nothing
    for k in range(rows - 3, -1, -3):
        p, q, r = row_start(k, n), row_start(k + 1, n), row_start(k + 2, n)
        u = v = w = spread(0.0)
        for m in range(k + 3, n, WIDTH):
            y = load(x, m)
            u = fnmadd(u, load(values, p + m), y)
            v = fnmadd(v, load(values, q + m), y)
            w = fnmadd(w, load(values, r + m), y)
        a, b, c = total(u), total(v), total(w)
        if stored:
            a, b, c = a + values[p + n], b + values[q + n], c + values[r + n]
        else:
            a, b, c = a + x[k], b + x[k + 1], c + x[k + 2]
        c *= values[r + k + 2]
        b = (b - values[q + k + 2] * c) * values[q + k + 1]
        x[k] = (a - values[p + k + 1] * b - values[p + k + 2] * c) * values[p + k]
        x[k + 1], x[k + 2] = b, c
