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
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.pools import row_start

_FAST = {'reassoc', 'contract', 'nsz'}


@kernel(signature=(tb.HEAD, MATRICES), allocates=True)
def all_covariances(head, out):  # type: ignore[no-untyped-def]
    """
    Write the covariances of all nodes into zeros of shape (N, 3, 3).

    The sweep keeps a stack of cliques and a stack of their Z_ss.
    """
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    cliques = np.empty(64, np.int32)
    blocks = np.empty(1024)
    inverse = np.empty(1024)
    row_f = np.empty(96)
    for root in range(head[tb.N_CLIQUES]):
        if clique_i[root, tb.N_FRONTAL] <= 0 or clique_i[root, tb.PARENT] >= 0:
            continue  # a free row, a prior, or no root
        cliques[0] = root
        depth, end = 1, 0
        while depth > 0:
            depth -= 1
            c = cliques[depth]
            row = clique_i[c]
            rest = 3 * row[tb.N_SEPARATOR]
            n = 3 * row[tb.N_FRONTAL] + rest
            inverse, row_f = _enlarged(inverse, n * n), _enlarged(row_f, 3 * n)
            end -= rest * rest
            _write_separator(blocks[end:end + rest * rest], inverse, n, rest)
            _invert_clique(head, row, inverse, row_f, out)
            turn = clique_frames.present_turn(head, c)
            if turn != 0.0:
                for m in range(row[tb.NODES], row[tb.NODES] + row[tb.N_FRONTAL]):
                    block = out[pool_i[m]]
                    _rotate(block.reshape(9), 3, turn)
                    for i, j in ((1, 0), (2, 0), (2, 1)):   # exactly symmetric
                        block[i, j] = block[j, i]
            child = row[tb.CHILD]
            if child < 0:
                continue
            for m in range(n // 3):
                node_i[pool_i[row[tb.NODES] + m], tb.INDEX] = 3 * m
            while child >= 0:
                if clique_i[child, tb.N_FRONTAL] == 0:
                    child = clique_i[child, tb.SIBLING]
                    continue
                size = 3 * clique_i[child, tb.N_SEPARATOR]
                if end + size * size > len(blocks):
                    longer = np.empty(2 * (end + size * size))
                    for m in range(end):
                        longer[m] = blocks[m]
                    blocks = longer
                below = blocks[end:end + size * size]
                _read_separator(head, child, inverse, n, below)
                turn_below = clique_frames.present_turn(head, child)
                if turn_below != turn:
                    _rotate(below, size, turn - turn_below)
                end += size * size
                if depth == len(cliques):
                    more = np.empty(2 * depth, np.int32)
                    for m in range(depth):
                        more[m] = cliques[m]
                    cliques = more
                cliques[depth] = child
                depth += 1
                child = clique_i[child, tb.SIBLING]


@kernel(allocates=True)
def _rotate(block, size, angle):  # type: ignore[no-untyped-def]
    """Rotate a covariance of nodes to axes in which angles are larger by `angle` [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    for r in range(0, size, 3):
        first, second = block[r * size:(r + 1) * size], block[(r + 1) * size:(r + 2) * size]
        for q in range(size):
            x, y = first[q], second[q]
            first[q], second[q] = cos * x - sin * y, sin * x + cos * y
    for r in range(size):
        row = block[r * size:(r + 1) * size]
        for q in range(0, size, 3):
            x, y = row[q], row[q + 1]
            row[q], row[q + 1] = cos * x - sin * y, sin * x + cos * y


@kernel(allocates=True)
def _enlarged(work, n):  # type: ignore[no-untyped-def]
    """Return `work` if it holds n numbers, else a longer array without its contents."""
    return work if len(work) >= n else np.empty(2 * n)


@kernel(allocates=True)
def _write_separator(block, inverse, n, rest):  # type: ignore[no-untyped-def]
    """Copy Z_ss, of `rest` rows, to the end of the inverse of a clique, of n rows."""
    rows = n - rest
    for i in range(rest):
        target = inverse[(rows + i) * n + rows:(rows + i) * n + n]
        source = block[i * rest:(i + 1) * rest]
        for q in range(rest):
            target[q] = source[q]


@kernel(allocates=True)
def _read_separator(head, child, inverse, n, block):  # type: ignore[no-untyped-def]
    """Copy Z_ss of a child from the inverse of its parent, whose nodes have their INDEX set."""
    node_i, clique_i, pool_i = tb.node_i(head), tb.clique_i(head), tb.pool_i(head)
    row = clique_i[child]
    n_separator = row[tb.N_SEPARATOR]
    size = 3 * n_separator
    begin = row[tb.NODES] + row[tb.N_FRONTAL]
    nodes = pool_i[begin:begin + n_separator]
    for a in range(n_separator):
        i = node_i[nodes[a], tb.INDEX]
        for b in range(a, n_separator):
            j = node_i[nodes[b], tb.INDEX]
            for m in range(3):
                for q in range(3):
                    x = inverse[(i + m) * n + j + q]
                    block[(3 * a + m) * size + 3 * b + q] = x
                    block[(3 * b + q) * size + 3 * a + m] = x


@kernel(allocates=True)
def _invert_clique(head, row, inverse, product, out):  # type: ignore[no-untyped-def]
    """Fill the inverse of a clique, which has Z_ss already, from its last node to its first."""
    pool_f, node_i, pool_i = tb.pool_f(head), tb.node_i(head), tb.pool_i(head)
    n_frontal = row[tb.N_FRONTAL]
    n = 3 * (n_frontal + row[tb.N_SEPARATOR])
    values = pool_f[row[tb.VALUES]:]
    for f in range(n_frontal - 1, -1, -1):
        v = pool_i[row[tb.NODES] + f]
        k = 3 * f
        if node_i[v, tb.FIXED] != 0:
            inverse[k * n:(k + 3) * n] = 0.0
            for r in range(k + 3, n):
                inverse[r * n + k] = inverse[r * n + k + 1] = inverse[r * n + k + 2] = 0.0
            continue  # `out` holds zeros
        _multiply(values, k, n, inverse, product)
        _finish_block(values, k, n, inverse, product, out[v])


@kernel(allocates=True, fastmath=_FAST)
def _multiply(values, k, n, inverse, product):  # type: ignore[no-untyped-def]
    """Set `product` to three rows of R, right of their block at k, times the inverse."""
    rest = n - k - 3
    t0, t1, t2 = product[:rest], product[rest:2 * rest], product[2 * rest:3 * rest]
    t0[:] = 0.0
    t1[:] = 0.0
    t2[:] = 0.0
    p, q, r = row_start(k, n), row_start(k + 1, n), row_start(k + 2, n)
    r0, r1, r2 = values[p + k + 3:p + n], values[q + k + 3:q + n], values[r + k + 3:r + n]
    j = 0
    while j < rest:
        p = (k + 3 + j) * n + k + 3
        z0, z1, z2 = inverse[p:p + rest], inverse[p + n:p + n + rest], (
            inverse[p + 2 * n:p + 2 * n + rest])
        a0, a1, a2 = r0[j], r0[j + 1], r0[j + 2]
        b0, b1, b2 = r1[j], r1[j + 1], r1[j + 2]
        c0, c1, c2 = r2[j], r2[j + 1], r2[j + 2]
        if j + 6 <= rest:
            p += 3 * n
            z3, z4, z5 = inverse[p:p + rest], inverse[p + n:p + n + rest], (
                inverse[p + 2 * n:p + 2 * n + rest])
            a3, a4, a5 = r0[j + 3], r0[j + 4], r0[j + 5]
            b3, b4, b5 = r1[j + 3], r1[j + 4], r1[j + 5]
            c3, c4, c5 = r2[j + 3], r2[j + 4], r2[j + 5]
            for q in range(rest):
                u, v, w, x, y, z = z0[q], z1[q], z2[q], z3[q], z4[q], z5[q]
                t0[q] += a0 * u + a1 * v + a2 * w + a3 * x + a4 * y + a5 * z
                t1[q] += b0 * u + b1 * v + b2 * w + b3 * x + b4 * y + b5 * z
                t2[q] += c0 * u + c1 * v + c2 * w + c3 * x + c4 * y + c5 * z
            j += 6
        else:
            for q in range(rest):
                u, v, w = z0[q], z1[q], z2[q]
                t0[q] += a0 * u + a1 * v + a2 * w
                t1[q] += b0 * u + b1 * v + b2 * w
                t2[q] += c0 * u + c1 * v + c2 * w
            j += 3


@kernel(allocates=True, fastmath=_FAST)
def _finish_block(values, k, n, inverse, product, out):  # type: ignore[no-untyped-def]
    """Write the rows and columns of the node at k in the inverse, and its covariance in `out`."""
    rest = n - k - 3
    # the inverse of the block of R: (a b c; 0 d e; 0 0 f)
    r0, r1, r2 = (values[row_start(k, n):], values[row_start(k + 1, n):],
                  values[row_start(k + 2, n):])
    a, d, f = r0[k], r1[k + 1], r2[k + 2]
    e = -d * r1[k + 2] * f
    b = -a * r0[k + 1] * d
    c = -a * (r0[k + 1] * e + r0[k + 2] * f)
    t0, t1, t2 = product[:rest], product[rest:2 * rest], product[2 * rest:3 * rest]
    p = k * n + k + 3
    z0, z1, z2 = inverse[p:p + rest], inverse[p + n:p + n + rest], (
        inverse[p + 2 * n:p + 2 * n + rest])
    for q in range(rest):
        u, v, w = t0[q], t1[q], t2[q]
        z0[q] = -(a * u + b * v + c * w)
        z1[q] = -(d * v + e * w)
        z2[q] = -(f * w)
    # W = (R right of the block) (inverse right of the block)^T
    p, q, r = row_start(k, n), row_start(k + 1, n), row_start(k + 2, n)
    r0, r1, r2 = values[p + k + 3:p + n], values[q + k + 3:q + n], values[r + k + 3:r + n]
    w00 = w01 = w02 = w11 = w12 = w22 = 0.0
    w10 = w20 = w21 = 0.0
    for q in range(rest):
        x, y, z = z0[q], z1[q], z2[q]
        w00 += r0[q] * x
        w01 += r0[q] * y
        w02 += r0[q] * z
        w10 += r1[q] * x
        w11 += r1[q] * y
        w12 += r1[q] * z
        w20 += r2[q] * x
        w21 += r2[q] * y
        w22 += r2[q] * z
    out[0, 0] = a * (a - w00) + b * (b - w10) + c * (c - w20)
    out[0, 1] = out[1, 0] = -a * w01 + b * (d - w11) + c * (e - w21)
    out[0, 2] = out[2, 0] = -a * w02 - b * w12 + c * (f - w22)
    out[1, 1] = d * (d - w11) + e * (e - w21)
    out[1, 2] = out[2, 1] = -d * w12 + e * (f - w22)
    out[2, 2] = f * (f - w22)
    for m in range(3):
        for q in range(3):
            inverse[(k + m) * n + k + q] = out[m, q]
    for q in range(rest):
        p = (k + 3 + q) * n + k
        inverse[p], inverse[p + 1], inverse[p + 2] = z0[q], z1[q], z2[q]
