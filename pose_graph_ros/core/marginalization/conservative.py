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

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

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
    redundant = bool(np.count_nonzero(kept) < np.count_nonzero(used))
    blocks = descend(stacked, _START * start, redundant)
    # up to the border, and not beyond it by rounding
    largest = float(np.linalg.eigvalsh(_information(stacked, blocks))[-1])
    return np.asarray(blocks / (largest * (1.0 + 1e-14)))


def divergence(rows: FloatArray, blocks: FloatArray) -> float:
    """Return the divergence D [nats] of measurements J, (M, 3, r), with information W."""
    information = np.einsum('mir,mij,mjs->rs', rows, blocks, rows)
    sign, log_det = np.linalg.slogdet(information)
    if sign <= 0.0:
        return np.inf
    return 0.5 * float(np.trace(information) - log_det - len(information))


def descend(stacked: FloatArray, blocks: FloatArray, redundant: bool) -> FloatArray:
    """
    Return the blocks W at the minimum with the last barrier, given some with A < I.

    The rows of J are stacked, (3 M, r); padding has zeros in all of them. Redundant rows need a
    barrier that keeps W positive definite.
    """
    for mu in _BARRIERS:
        value = _value(stacked, blocks, mu, redundant)
        for _ in range(_MAX_STEPS):
            step, decrement = _newton(stacked, blocks, mu, redundant)
            length = 1.0
            while length > 1e-9:
                trial = blocks + length * step
                reached = _value(stacked, trial, mu, redundant)
                if reached <= value - _DESCENT * length * decrement:
                    blocks, value = trial, reached
                    break
                length *= 0.5
            if decrement < mu:
                break
    return blocks


def _information(stacked: FloatArray, blocks: FloatArray) -> FloatArray:
    """Return A, shape (r, r)."""
    weighted = np.matmul(blocks, stacked.reshape(len(blocks), 3, -1))
    return np.asarray(stacked.T @ weighted.reshape(stacked.shape))


def _padded(stacked: FloatArray, blocks: FloatArray) -> FloatArray:
    """Return blocks with ones on the diagonal of their padding."""
    unused = ~np.any(stacked != 0.0, axis=1).reshape(-1, 3)
    return np.asarray(blocks + unused[:, :, None] * np.eye(3))


def _value(stacked: FloatArray, blocks: FloatArray, mu: float, redundant: bool) -> float:
    """Return what is minimised; infinite where A or W are not inside."""
    A = _information(stacked, blocks)
    try:
        of_A, of_gap = (np.linalg.cholesky(each) for each in (A, np.eye(len(A)) - A))
        of_W = np.linalg.cholesky(_padded(stacked, blocks)) if redundant else np.ones((1, 1, 1))
    except np.linalg.LinAlgError:
        return math.inf
    inside, gap, each = (2.0 * np.sum(np.log(np.diagonal(L, axis1=-2, axis2=-1)))
                         for L in (of_A, of_gap, of_W))
    return float(np.trace(A) - inside - mu * (gap + each))


def _second(product: FloatArray) -> FloatArray:
    """Return the second derivatives of `-log det` by all entries of the blocks, not scaled."""
    p, q = _entries(len(product) // 3)
    of_p, of_q = product.take(p, 0), product.take(q, 0)     # indexing takes ten times as long
    crossed = of_p.take(q, 1)
    return np.asarray(of_p.take(p, 1) * of_q.take(q, 1) + crossed * crossed.T)


def _entries(n: int) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the upper triangles of n blocks in a matrix with all of them."""
    first, (row, column) = 3 * np.arange(n)[:, None], np.triu_indices(3)
    return (first + row).ravel(), (first + column).ravel()


def _newton(
    stacked: FloatArray, blocks: FloatArray, mu: float, redundant: bool,
) -> tuple[FloatArray, float]:
    """Return Newton's step of all blocks, and its squared decrement."""
    n, A = len(blocks), _information(stacked, blocks)
    inside, gap = (stacked @ np.linalg.solve(each, stacked.T) for each in (A, np.eye(len(A)) - A))
    of_blocks = np.zeros_like(inside)
    if redundant:
        at = np.arange(3 * n).reshape(n, 3)
        of_blocks[at[:, :, None], at[:, None]] = np.linalg.inv(_padded(stacked, blocks))
    p, q = _entries(n)
    # an entry beside the diagonal is there twice
    twice = np.where(p == q, 1.0, 2.0)
    slope = (stacked @ stacked.T - inside + mu * (gap - of_blocks))[p, q] * twice
    curvature = _second(inside) + mu * _second(gap)
    if redundant:
        curvature += mu * _second(of_blocks)
    curvature *= 0.5 * twice[:, None] * twice
    # padding has neither slope nor curvature
    unused = np.flatnonzero(~np.any(stacked != 0.0, axis=1))
    unused = np.flatnonzero(np.isin(p, unused) | np.isin(q, unused))
    slope[unused], curvature[unused], curvature[:, unused] = 0.0, 0.0, 0.0
    curvature[unused, unused] = 1.0
    change = np.linalg.solve(curvature, slope)
    step = np.empty((3 * n, 3))
    step[p, q % 3] = step[q, p % 3] = -change
    return step.reshape(n, 3, 3), float(slope @ change)
