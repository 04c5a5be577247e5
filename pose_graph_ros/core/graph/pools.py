# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Memory for the values and the node lists of cliques, from two pools with free lists by size.

A clique holds its rows of R and its update matrix, both as upper triangles by rows, without gaps.
"""

from typing import Final

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb

# The pools pool_f and pool_i, by where the head has their ends and free lists.
VALUES: Final = (tb.POOL_F_END, tb.FREE_F)
NODES: Final = (tb.POOL_I_END, tb.FREE_I)


@kernel
def row_start(k, n):  # type: ignore[no-untyped-def]
    """
    Return the index at which column 0 of row k would be in an upper triangle stored by rows.

    A row holds its columns from k on, and its right-hand side as column n.
    """
    return k * n - k * (k - 1) // 2


@kernel
def triangle_size(rows, n):  # type: ignore[no-untyped-def]
    """Return the number of values in the first rows of an upper triangle with right-hand side."""
    return rows * (n + 1) - rows * (rows - 1) // 2


# Numba returns no arrays but arguments otherwise
@kernel(inline='always')
def separator(head, c):  # type: ignore[no-untyped-def]
    """Return the nodes of a clique's separator; a prior has no others."""
    row = tb.cliques(head)[c]
    begin = row.members + row.n_frontal
    return tb.pool_i(head)[begin:begin + row.n_separator]


@kernel(inline='always')
def update_matrix(head, c):  # type: ignore[no-untyped-def]
    """Return the update matrix of a clique, and what is behind it."""
    row = tb.cliques(head)[c]
    rows = 3 * row.n_frontal
    return tb.pool_f(head)[row.values + triangle_size(rows, rows + 3 * row.n_separator):]


@kernel
def is_among(v, members):  # type: ignore[no-untyped-def]
    """Tell whether a node is in a list; `v in members` would load the linear algebra of Numba."""
    found = False
    for u in members:
        found = found or u == v
    return found


@kernel
def product(update, size, x, minus, out):  # type: ignore[no-untyped-def]
    """
    Write U x, less `minus` times u; U is an upper triangle laid out by `row_start`.

    u is its right-hand side.
    """
    for i in range(size):
        out[i] = -minus * update[row_start(i, size) + size]
    for i in range(size):
        r = update[row_start(i, size):]
        total = r[i] * x[i]
        for k in range(i + 1, size):
            total += r[k] * x[k]
            out[k] += r[k] * x[i]
        out[i] += total


@kernel
def n_values(n_frontal, n_separator):  # type: ignore[no-untyped-def]
    """
    Return how many numbers a clique holds: rows of R, then the update matrix.

    A prior, with no frontal node, has more (see `prior_rows`).
    """
    rows, rest = 3 * n_frontal, 3 * n_separator
    more = 3 * rest + 1 if n_frontal == 0 else 0
    return triangle_size(rows, rows + rest) + triangle_size(rest, rest) + more


@kernel
def _block(n):  # type: ignore[no-untyped-def]
    """
    Return which free list the block for n numbers is in, and its size.

    Sizes are exact up to 64 numbers, and grow in steps of an eighth from there on.
    """
    number = size = min(n, 64)
    while size < n:
        number, size = number + 1, size + (size + 7) // 8
    return number, size


@kernel
def rounded(n):  # type: ignore[no-untyped-def]
    """Return the size of the block that n numbers take from a pool."""
    _, size = _block(n)
    return size


@kernel
def take(head, pool, n):  # type: ignore[no-untyped-def]
    """Take a block for n numbers from NODES or VALUES, which has room, and return its index."""
    (end, free), (number, size) = pool, _block(n)
    at = head[free + number]
    if at < 0:
        head[end] += size
        return head[end] - size
    head[free + number] = tb.pool_i(head)[at] if pool == NODES else np.int64(tb.pool_f(head)[at])
    return at


@kernel
def give(head, pool, at, n):  # type: ignore[no-untyped-def]
    """Give a block of n numbers back to NODES or VALUES: put it into the list of its size."""
    number, _ = _block(n)
    free = pool[1] + number
    if pool == NODES:
        tb.pool_i(head)[at] = head[free]
    else:
        tb.pool_f(head)[at] = head[free]
    head[free] = at
