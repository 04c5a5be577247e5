# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The block-diagonal information that is nearest to a Gaussian from below.

Given measurements of a Gaussian with covariance I (any other is whitened first), each with three
rows J_m, wanted are their information matrices W_m with

    A = sum_m J_m^T W_m J_m <= I                              (conservative)
    D = (tr A - log det A - r) / 2  as small as possible      (Kullback-Leibler divergence)

D is the divergence of the Gaussian with the information A from that with I, both of the same mean.
This is the convex problem of M. Mazuran, W. Burgard, G. Tipaldi, "Nonlinear factor recovery for
long-term SLAM", IJRR 35 (2016), with the order of N. Carlevaris-Bianco, R. Eustice, "Conservative
edge sparsification for graph SLAM node removal", ICRA 2014. Without the order, and for rows that
are a basis, its solution is the inverse of each measurement's covariance; that solution, made
smaller as a whole until it is conservative, is where Newton's method starts, with the barrier
`-mu log det(I - A)` instead of the order (S. Boyd, L. Vandenberghe, "Convex optimization", 11.3).
"""

import math

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGER, kernel, MATRICES, ROWS
from pose_graph_ros.core.geometry.se2 import FloatArray

# The weights of the barrier. The last one costs at most r mu / 2 of the divergence, and the last
# scaling gives part of that back.
_BARRIERS = (0.03, 0.003)
_MAX_STEPS = 20
# Part of the way to the border at which the descent starts.
_START = 0.95
# A step must bring this part of what the slope promises.
_DESCENT = 0.1
# Eigenvalues of the measurements' Gram matrix below this part of the largest one count as zero.
_RANK = 1e-10

_FAST = {'reassoc', 'contract', 'nsz'}

# Upper triangle of a symmetric 3x3 matrix.
_P, _Q = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def nearest_below(rows: FloatArray) -> FloatArray:
    """
    Return the information W, shape (M, 3, 3), that is nearest to I from below.

    The rows, (M, 3, r), are J with `J_m J_m^T = I`; rows of zeros are padding.
    """
    n = len(rows)
    stacked = rows.reshape(3 * n, -1)
    used = np.any(stacked != 0.0, axis=1)
    gram = stacked @ stacked.T
    values, vectors = np.linalg.eigh(gram)
    largest = float(values[-1])
    blocks = np.eye(3) / max(largest, 1.0)
    start = np.repeat(blocks[None], n, axis=0) * used.reshape(n, 3, 1)
    if largest <= 1.0 + 1e-9:   # but for rounding the closed form is exact
        return start
    kept = values > _RANK * largest
    # coordinates in which the measurements determine everything
    stacked = vectors[:, kept] * np.sqrt(values[kept])
    stacked[~used] = 0.0    # padding is known by that, and rounding is not
    redundant = np.count_nonzero(kept) < np.count_nonzero(used)
    blocks = _START * start
    descend(np.ascontiguousarray(stacked), blocks, int(redundant))
    weighted = np.matmul(blocks, stacked.reshape(n, 3, -1)).reshape(3 * n, -1)
    # up to the border, and not beyond it by rounding
    largest = float(np.linalg.eigvalsh(stacked.T @ weighted)[-1])
    return np.asarray(blocks / (largest * (1.0 + 1e-14)))


def divergence(rows: FloatArray, blocks: FloatArray) -> float:
    """Return the divergence D [nats] of measurements J, (M, 3, r), with information W."""
    information = np.einsum('mir,mij,mjs->rs', rows, blocks, rows)
    sign, log_det = np.linalg.slogdet(information)
    if sign <= 0.0:
        return np.inf
    return 0.5 * float(np.trace(information) - log_det - len(information))


@kernel(signature=(ROWS, MATRICES, INTEGER), allocates=True)
def descend(stacked, blocks, redundant):  # type: ignore[no-untyped-def]
    """
    Move blocks W with A < I, zero for padding, in place to the minimum with the last barrier.

    The rows of J are stacked, (3 M, r). Compiled, as NumPy takes 3 to 6 times as long: 14 ms
    instead of 5 for 20 measurements. Redundant ones need a barrier that keeps W positive definite.
    """
    n_rows = len(stacked)
    # J A^-1 J^T and J (I - A)^-1 J^T
    inside, gap = np.empty((n_rows, n_rows)), np.empty((n_rows, n_rows))
    step, trial = np.zeros(blocks.shape), np.empty(blocks.shape)
    now, way, then = (blocks.reshape(blocks.size), step.reshape(step.size),
                      trial.reshape(trial.size))
    for mu in _BARRIERS:
        for _ in range(_MAX_STEPS):
            A, below_one = _information(stacked, blocks)
            _products(stacked, A, inside)
            _products(stacked, below_one, gap)
            decrement = _newton(stacked, blocks, inside, gap, mu, redundant, step)
            before, length = _value(stacked, blocks, mu, redundant), 1.0
            while length > 1e-9:
                for k in range(len(now)):
                    then[k] = now[k] + length * way[k]
                if (_value(stacked, trial, mu, redundant)
                        <= before - _DESCENT * length * decrement):
                    for k in range(len(now)):
                        now[k] = then[k]
                    break
                length *= 0.5
            if decrement < mu:
                break


@kernel(allocates=True, fastmath=_FAST)
def _information(stacked, blocks):  # type: ignore[no-untyped-def]
    """Return A and I - A, shape (r, r)."""
    r = stacked.shape[1]
    A, below_one, weighted = np.zeros((r, r)), np.empty((r, r)), np.empty(r)
    for m in range(len(blocks)):
        for p in range(3):
            row = stacked[3 * m + p]
            for k in range(r):
                weighted[k] = (blocks[m, p, 0] * stacked[3 * m, k]
                               + blocks[m, p, 1] * stacked[3 * m + 1, k]
                               + blocks[m, p, 2] * stacked[3 * m + 2, k])
            for k in range(r):
                value = row[k]
                for q in range(r):
                    A[k, q] += value * weighted[q]
    for k in range(r):  # loops, as an expression of arrays takes seconds to compile
        for q in range(r):
            below_one[k, q] = (1.0 if k == q else 0.0) - A[k, q]
    return A, below_one


@kernel(fastmath=_FAST)
def _factorize(A):  # type: ignore[no-untyped-def]
    """
    Replace the lower triangle by L with `A = L L^T`; return `log det A`.

    It is minus infinity if A is not positive definite.
    """
    n, log_det = len(A), 0.0
    for k in range(n):
        for m in range(k + 1):
            value = A[k, m]
            for q in range(m):
                value -= A[k, q] * A[m, q]
            if m < k:
                A[k, m] = value / A[m, m]
            elif value > 0.0:
                A[k, k] = math.sqrt(value)
                log_det += 2.0 * math.log(A[k, k])
            else:
                return -np.inf
    return log_det


@kernel(allocates=True, fastmath=_FAST)
def _products(stacked, A, out):  # type: ignore[no-untyped-def]
    """Write `J A^-1 J^T`, shape (3 M, 3 M)."""
    n_rows, r = stacked.shape
    L, y = np.empty((r, r)), np.empty((n_rows, r))
    for k in range(r):
        for m in range(k + 1):
            L[k, m] = A[k, m]
    _factorize(L)
    for m in range(n_rows):
        for k in range(r):
            value = stacked[m, k]
            for q in range(k):
                value -= L[k, q] * y[m, q]
            y[m, k] = value / L[k, k]
    for m in range(n_rows):
        for n in range(m + 1):
            value = 0.0
            for k in range(r):
                value += y[m, k] * y[n, k]
            out[m, n] = out[n, m] = value


@kernel(allocates=True)
def _value(stacked, blocks, mu, redundant):  # type: ignore[no-untyped-def]
    """Return what is minimised; infinite where A or W are not inside."""
    A, below_one = _information(stacked, blocks)
    total = 0.0
    for k in range(len(A)):
        total += A[k, k]
    total -= _factorize(A) + mu * _factorize(below_one)
    for m in range(len(blocks) if redundant != 0 else 0):
        total -= mu * _factorize(_padded(blocks[m]))
    return total


@kernel(allocates=True)
def _padded(block):  # type: ignore[no-untyped-def]
    """Return a block with ones on the diagonal of its padding."""
    W = np.empty((3, 3))
    for k in range(3):
        for m in range(3):
            W[k, m] = block[k, m]
        if W[k, k] == 0.0:
            W[k, k] = 1.0
    return W


@kernel
def _second(product, i, j, k, m):  # type: ignore[no-untyped-def]
    """Return the second derivative of `-log det` by two entries of the blocks, not scaled."""
    return product[i, k] * product[j, m] + product[i, m] * product[j, k]


@kernel(allocates=True, fastmath=_FAST)
def _newton(stacked, blocks, inside, gap, mu, redundant, step):  # type: ignore[no-untyped-def]
    """Write Newton's step of all blocks, and return its squared decrement."""
    n, r = len(blocks), stacked.shape[1]
    gradient, hessian = np.zeros(6 * n), np.zeros((6 * n, 6 * n))
    inverse, unit = np.zeros((n, 3, 3)), np.zeros((3, 3))
    for k in range(3):
        unit[k, k] = 1.0
    if redundant != 0:
        for m in range(n):
            _products(unit, _padded(blocks[m]), inverse[m])
    for m in range(n):
        for a in range(6):
            p, q = 3 * m + _P[a], 3 * m + _Q[a]
            at = 6 * m + a
            # padding has neither slope nor curvature
            if inside[p, p] == 0.0 or inside[q, q] == 0.0:
                hessian[at, at] = 1.0
                continue
            slope = mu * gap[p, q] - inside[p, q] - mu * inverse[m, _P[a], _Q[a]]
            for k in range(r):
                slope += stacked[p, k] * stacked[q, k]
            gradient[at] = slope if p == q else 2.0 * slope
            for other in range(m + 1):
                for b in range(6):
                    s, t = 3 * other + _P[b], 3 * other + _Q[b]
                    value = _second(inside, p, q, s, t) + mu * _second(gap, p, q, s, t)
                    if other == m:
                        value += mu * _second(inverse[m], _P[a], _Q[a], _P[b], _Q[b])
                    if s == t:
                        value *= 0.5
                    if p != q:
                        value *= 2.0
                    hessian[at, 6 * other + b] = value
    _factorize(hessian)
    decrement = 0.0
    for k in range(6 * n):
        for q in range(k):
            gradient[k] -= hessian[k, q] * gradient[q]
        gradient[k] /= hessian[k, k]
        decrement += gradient[k]**2
    for k in range(6 * n - 1, -1, -1):
        for q in range(k + 1, 6 * n):
            gradient[k] -= hessian[q, k] * gradient[q]
        gradient[k] /= hessian[k, k]
    for m in range(n):
        for a in range(6):
            step[m, _P[a], _Q[a]] = step[m, _Q[a], _P[a]] = -gradient[6 * m + a]
    return decrement
