# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Factorising a front: the part of the work that grows with the cube of its size.

Rows are padded to whole vectors, the right-hand side is the last column. Vectors may begin left
of the diagonal: what they leave there is of no meaning, and nobody reads it.
"""

import math

from pose_graph_ros.core.jit import kernel
from pose_graph_ros.core.vectors import less, load, spread, store, times, WIDTH


@kernel
def padded(n):  # type: ignore[no-untyped-def]
    """Return how many numbers a row of a front takes that has n columns and a right-hand side."""
    return (n + WIDTH) // WIDTH * WIDTH


@kernel
def _take_3(front, k, i, ld):  # type: ignore[no-untyped-def]
    """Take three finished rows, from row k on, off three rows from row i on."""
    p, q, r, t = k * ld, (k + 1) * ld, (k + 2) * ld, i * ld
    a0, b0, c0 = spread(front[p + i]), spread(front[p + i + 1]), spread(front[p + i + 2])
    a1, b1, c1 = spread(front[q + i]), spread(front[q + i + 1]), spread(front[q + i + 2])
    a2, b2, c2 = spread(front[r + i]), spread(front[r + i + 1]), spread(front[r + i + 2])
    for c in range(i // WIDTH * WIDTH, ld, WIDTH):
        x, y, z = load(front, p + c), load(front, q + c), load(front, r + c)
        u, v, w = load(front, t + c), load(front, t + ld + c), load(front, t + 2 * ld + c)
        store(front, t + c, less(less(less(u, a0, x), a1, y), a2, z))
        store(front, t + ld + c, less(less(less(v, b0, x), b1, y), b2, z))
        store(front, t + 2 * ld + c, less(less(less(w, c0, x), c1, y), c2, z))


@kernel
def _take_6(front, k, i, ld):  # type: ignore[no-untyped-def]
    """Take six finished rows, from row k on, off three rows from row i on."""
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
        u, v, w = less(u, a0, x), less(v, b0, x), less(w, c0, x)
        x = load(front, o + ld)
        u, v, w = less(u, a1, x), less(v, b1, x), less(w, c1, x)
        x = load(front, o + 2 * ld)
        u, v, w = less(u, a2, x), less(v, b2, x), less(w, c2, x)
        x = load(front, o + 3 * ld)
        u, v, w = less(u, a3, x), less(v, b3, x), less(w, c3, x)
        x = load(front, o + 4 * ld)
        u, v, w = less(u, a4, x), less(v, b4, x), less(w, c4, x)
        x = load(front, o + 5 * ld)
        u, v, w = less(u, a5, x), less(v, b5, x), less(w, c5, x)
        store(front, t + c, u)
        store(front, t + ld + c, v)
        store(front, t + 2 * ld + c, w)


@kernel
def _factorize_3(front, k, ld, least):  # type: ignore[no-untyped-def]
    """Factorise the three rows from row k on; return the first bad one of them or -1."""
    p, q, r = k * ld, (k + 1) * ld, (k + 2) * ld
    # the 3x3 block first: all that the rows are then multiplied with follows from it
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
        y = times(less(load(front, q + c), vb, x), vg)
        z = times(less(less(load(front, r + c), vd, x), ve, y), vh)
        store(front, p + c, x)
        store(front, q + c, y)
        store(front, r + c, z)
    front[p + k], front[q + k + 1], front[r + k + 2] = f, g, h
    return -1


@kernel
def factorize(front, rows, n, ld, least):  # type: ignore[no-untyped-def]
    """
    Factorise the first rows of a front in place; the other rows become its update matrix.

    Parameters
    ----------
    front : ndarray, flat
        n rows of `ld` numbers, of which the upper triangle and the last column count.
    rows : int
        Rows to factorise, a multiple of 3 as n is.
    n : int
    ld : int
        `padded(n)`.
    least : ndarray, shape (rows,)
        A pivot must be larger than this.

    Returns
    -------
    int
        First row with a bad pivot, or -1.

    """
    k = 0
    while k < rows:
        bad = _factorize_3(front, k, ld, least)
        if bad >= 0:
            return bad
        if k + 6 <= rows:
            _take_3(front, k, k + 3, ld)
            bad = _factorize_3(front, k + 3, ld, least)
            if bad >= 0:
                return bad
            for i in range(k + 6, n, 3):
                _take_6(front, k, i, ld)
            k += 6
        else:
            for i in range(k + 3, n, 3):
                _take_3(front, k, i, ld)
            k += 3
    return -1
