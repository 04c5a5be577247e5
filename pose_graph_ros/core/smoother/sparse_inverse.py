# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marginal covariances of all nodes in one sweep down the Bayes tree.

The entries of the inverse Z = H^-1 within cliques follow from the roots down (K. Takahashi,
J. Fagan, M. Chen, "Formation of a sparse bus impedance matrix", 1973). With f the frontal and s
the separator nodes of a clique, and Z_ss a part of the inverse of its parent,

    Z_fs = -R_ff^-1 R_fs Z_ss,    Z_ff = R_ff^-1 (R_ff^-T - R_fs Z_sf).

Fixed nodes and clique frames are treated as in `covariances`.
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel, MATRICES
from pose_graph_ros.core.elimination import clique_frames
from pose_graph_ros.core.elimination.ordering import grown
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.pools import row_start

_FAST = {'reassoc', 'contract', 'nsz'}


@kernel(signature=(tb.HEAD, MATRICES), allocates=True)
def all_covariances(head, out):  # type: ignore[no-untyped-def]
    """
    Write the covariances of all nodes into zeros of shape (N, 3, 3).

    The sweep keeps a stack of cliques and a stack of their Z_ss.
    """
    nodes, pool_i = tb.nodes(head), tb.pool_i(head)
    cliques, blocks = np.empty(64, np.int32), np.empty(1024)
    for root in range(head[tb.N_CLIQUES]):
        if tb.cliques(head)[root].n_frontal <= 0 or tb.cliques(head)[root].parent >= 0:
            continue  # a free row, a prior, or no root
        cliques[0] = root
        depth, end = 1, 0
        while depth > 0:
            depth -= 1
            c = cliques[depth]
            row = tb.cliques(head)[c]
            rows, rest = 3 * row.n_frontal, 3 * row.n_separator
            inverse = np.empty((rows + rest, rows + rest))
            end -= rest * rest
            for i in range(rest):
                for q in range(rest):
                    inverse[rows + i, rows + q] = blocks[end + i * rest + q]
            _invert_clique(head, row, inverse)
            turn = clique_frames.present_turn(head, c)
            _write_blocks(pool_i[row.members:], rows, inverse, turn, out)
            for m in range(len(inverse) // 3):
                nodes[pool_i[row.members + m]].index = 3 * m
            child = row.child
            while child >= 0:
                if tb.cliques(head)[child].n_frontal > 0:
                    size = 3 * tb.cliques(head)[child].n_separator
                    if end + size * size > len(blocks):
                        blocks = grown(blocks, end + size * size)
                    below = blocks[end:end + size * size].reshape(size, size)
                    _read_separator(head, child, inverse, below)
                    turn_below = clique_frames.present_turn(head, child)
                    if turn_below != turn:
                        _rotate(below, turn - turn_below)
                    end += size * size
                    if depth == len(cliques):
                        cliques = grown(cliques, 0)
                    cliques[depth] = child
                    depth += 1
                child = tb.cliques(head)[child].sibling


@kernel
def _write_blocks(nodes, rows, inverse, turn, out):  # type: ignore[no-untyped-def]
    """Write the covariances of the frontal nodes of a clique, in map axes."""
    for k in range(0, rows, 3):
        block = out[nodes[k // 3]]
        for m in range(3):
            for q in range(3):
                block[m, q] = inverse[k + m, k + q]
        if turn != 0.0:
            _rotate(block, turn)
            for i, j in ((1, 0), (2, 0), (2, 1)):   # exactly symmetric
                block[i, j] = block[j, i]


@kernel
def _rotate(block, angle):  # type: ignore[no-untyped-def]
    """Rotate a covariance of nodes to axes in which angles are larger by `angle` [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    for r in range(0, len(block), 3):
        for q in range(len(block)):
            x, y = block[r, q], block[r + 1, q]
            block[r, q], block[r + 1, q] = cos * x - sin * y, sin * x + cos * y
    for r in range(len(block)):
        for q in range(0, len(block), 3):
            x, y = block[r, q], block[r, q + 1]
            block[r, q], block[r, q + 1] = cos * x - sin * y, sin * x + cos * y


@kernel
def _read_separator(head, child, inverse, block):  # type: ignore[no-untyped-def]
    """Copy Z_ss of a child from the inverse of its parent, whose nodes have their INDEX set."""
    nodes, cliques, pool_i = tb.nodes(head), tb.cliques(head), tb.pool_i(head)
    row = cliques[child]
    members = pool_i[row.members + row.n_frontal:]
    for a in range(row.n_separator):
        i = nodes[members[a]].index
        for b in range(row.n_separator):
            j = nodes[members[b]].index
            for m in range(3):
                for q in range(3):
                    block[3 * a + m, 3 * b + q] = inverse[i + m, j + q]


@kernel
def _invert_clique(head, row, inverse):  # type: ignore[no-untyped-def]
    """Fill the inverse of a clique, which has Z_ss already, from its last node to its first."""
    pool_f, nodes, pool_i = tb.pool_f(head), tb.nodes(head), tb.pool_i(head)
    n = len(inverse)
    values = pool_f[row.values:]
    for k in range(3 * row.n_frontal - 1, -1, -1):
        if nodes[pool_i[row.members + k // 3]].fixed == 0:
            _invert_row(values[row_start(k, n):], k, inverse)
        else:
            inverse[k, k:] = 0.0
            inverse[k:, k] = 0.0


@kernel(fastmath=_FAST)
def _invert_row(r, k, inverse):  # type: ignore[no-untyped-def]
    """Write row and column k of an inverse, from row k of R and from what is right of it."""
    n, of_row = len(inverse), inverse[k]
    of_row[k + 1:] = 0.0
    m = k + 1
    while m + 3 <= n:   # three rows at a time, which takes half of the time
        a, b, c = -r[k] * r[m], -r[k] * r[m + 1], -r[k] * r[m + 2]
        x, y, z = inverse[m], inverse[m + 1], inverse[m + 2]
        for q in range(k + 1, n):
            of_row[q] += a * x[q] + b * y[q] + c * z[q]
        m += 3
    while m < n:
        for q in range(k + 1, n):
            of_row[q] -= r[k] * r[m] * inverse[m, q]
        m += 1
    total = r[k]
    for q in range(k + 1, n):
        total -= r[q] * of_row[q]
        inverse[q, k] = of_row[q]
    of_row[k] = r[k] * total
