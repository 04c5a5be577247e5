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

_SIZES: Final = np.array(tb.SIZES, dtype=np.int64)


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
def _size_class(n):  # type: ignore[no-untyped-def]
    """Return the smallest size class (index in `SIZES`) whose blocks hold n numbers."""
    if n <= 64:
        return n
    # not `np.searchsorted`, with which Numba loads its linear algebra and that of SciPy
    low, high = 64, len(_SIZES) - 1
    while low < high:
        middle = (low + high) // 2
        if _SIZES[middle] < n:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def rounded(n):  # type: ignore[no-untyped-def]
    """Return the size of the block that n numbers take from a pool."""
    return _SIZES[_size_class(n)]


@kernel
def _take(head, pool, end, free, n):  # type: ignore[no-untyped-def]
    """Take a block for n numbers from a pool, given its end and its free lists in the head."""
    size = _size_class(n)
    at = head[free + size]
    if at >= 0:
        head[free + size] = np.int64(pool[at])
        return at
    at = head[end]
    head[end] = at + _SIZES[size]
    return at


@kernel
def _give(head, pool, free, at, n):  # type: ignore[no-untyped-def]
    """Put a block of n numbers into the free list of its size."""
    size = _size_class(n)
    pool[at] = head[free + size]
    head[free + size] = at


@kernel
def take_values(head, n):  # type: ignore[no-untyped-def]
    """Take a block for n numbers from pool_f and return its index; the pool must have room."""
    return _take(head, tb.pool_f(head), tb.POOL_F_END, tb.FREE_F, n)


@kernel
def give_values(head, at, n):  # type: ignore[no-untyped-def]
    """Give a block back to pool_f."""
    _give(head, tb.pool_f(head), tb.FREE_F, at, n)


@kernel
def take_nodes(head, n):  # type: ignore[no-untyped-def]
    """Take a block for n nodes from pool_i and return its index; the pool must have room."""
    return _take(head, tb.pool_i(head), tb.POOL_I_END, tb.FREE_I, n)


@kernel
def give_nodes(head, at, n):  # type: ignore[no-untyped-def]
    """Give a block back to pool_i."""
    _give(head, tb.pool_i(head), tb.FREE_I, at, n)
