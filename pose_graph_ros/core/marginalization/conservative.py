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

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray

# The barrier's weight falls by the factor from the first to the last value. It costs less than
# r * mu / 2 of the divergence, and the last scaling gives part of that back.
_FIRST_BARRIER, _LAST_BARRIER, _FACTOR = 0.3, 1e-3, 0.1
_MAX_STEPS = 12
# Newton's decrement, squared and per mu, at which a barrier's minimum is near enough.
_CENTRED = 0.05
# Rounding of the largest eigenvalue: nearer to 1 than that the closed form is exact.
_ROUNDING = 1e-9
# Eigenvalues of the measurements' Gram matrix below this part of the largest one count as zero.
_RANK = 1e-10

# Upper triangle of a symmetric 3x3 matrix, and factors that make products of two such triangles
# those of the whole matrices.
_P, _Q = np.array((0, 0, 0, 1, 1, 2)), np.array((0, 1, 2, 1, 2, 2))
_TWICE = np.where(_P == _Q, 1.0, 2.0)
_HESSIAN = np.where(_P == _Q, np.sqrt(0.5), np.sqrt(2.0))


def nearest_below(rows: FloatArray) -> FloatArray:
    """
    Return the information W, shape (M, 3, 3), that is nearest to I from below.

    Parameters
    ----------
    rows : ndarray, shape (M, 3, r), J with `J_m J_m^T = I`; rows of zeros are padding

    """
    n = len(rows)
    stacked = rows.reshape(3 * n, -1)
    used = np.any(stacked != 0.0, axis=1)
    gram = stacked @ stacked.T
    values, vectors = np.linalg.eigh(gram)
    largest = float(values[-1])
    blocks = np.eye(3) / max(largest, 1.0)
    start = np.repeat(blocks[None], n, axis=0) * used.reshape(n, 3, 1)
    if largest <= 1.0 + _ROUNDING:
        return start
    kept = values > _RANK * largest
    # coordinates in which the measurements determine everything
    stacked = vectors[:, kept] * np.sqrt(values[kept])
    redundant = bool(np.count_nonzero(kept) < np.count_nonzero(used))
    return _descend(stacked, start, redundant)


def divergence(rows: FloatArray, blocks: FloatArray) -> float:
    """
    Return the divergence D of an approximation [nats].

    Parameters
    ----------
    rows : ndarray, shape (M, 3, r), the measurements J
    blocks : ndarray, shape (M, 3, 3), their information W

    """
    information = np.einsum('mir,mij,mjs->rs', rows, blocks, rows)
    sign, log_det = np.linalg.slogdet(information)
    if sign <= 0.0:
        return np.inf
    return 0.5 * float(np.trace(information) - log_det - len(information))


def _descend(stacked: FloatArray, start: FloatArray, redundant: bool) -> FloatArray:
    """Return the minimum over the blocks, from a multiple of the closed form."""
    blocks, mu = 0.9 * start, _FIRST_BARRIER
    identity = np.eye(stacked.shape[1])
    while True:
        for _ in range(_MAX_STEPS):
            step, decrement = _newton(stacked, blocks, mu, identity, redundant)
            length = min(1.0, 1.5 / (1.0 + np.sqrt(decrement / mu)))
            while not _is_inside(stacked, blocks + length * step, identity, redundant):
                length *= 0.5
            blocks = blocks + length * step
            if decrement < _CENTRED * mu:
                break
        if mu <= _LAST_BARRIER:
            break
        mu = max(mu * _FACTOR, _LAST_BARRIER)
    # up to the border, and not beyond it by rounding
    information = _information(stacked, blocks)
    return np.asarray(blocks / (np.linalg.eigvalsh(information)[-1] * (1.0 + 1e-14)))


def _information(stacked: FloatArray, blocks: FloatArray) -> FloatArray:
    """Return A, shape (r, r)."""
    n = len(blocks)
    weighted = np.matmul(blocks, stacked.reshape(n, 3, -1)).reshape(3 * n, -1)
    return np.asarray(stacked.T @ weighted)


def _newton(
    stacked: FloatArray, blocks: FloatArray, mu: float, identity: FloatArray, redundant: bool,
) -> tuple[FloatArray, float]:
    """Return Newton's step of all blocks, shape (M, 3, 3), and its squared decrement."""
    n = len(blocks)
    information = _information(stacked, blocks)
    both = np.linalg.inv(np.stack((information, identity - information)))
    inside, gap = stacked @ both @ stacked.T
    slope = stacked @ stacked.T - inside + mu * gap
    at = 3 * np.arange(n)[:, None]
    p, q = (at + _P).ravel(), (at + _Q).ravel()
    scale = np.tile(_HESSIAN, n)
    hessian = _second(inside, p, q) + mu * _second(gap, p, q)
    if redundant:
        inverse = np.zeros_like(slope)
        padded = blocks + np.eye(3) * (np.diagonal(blocks, axis1=1, axis2=2) == 0.0)[:, :, None]
        for k, block in enumerate(np.linalg.inv(padded)):
            inverse[3 * k:3 * k + 3, 3 * k:3 * k + 3] = block
        slope -= mu * inverse
        hessian += mu * _second(inverse, p, q)
    gradient = np.tile(_TWICE, n) * slope[p, q]
    hessian *= scale[:, None] * scale
    # padding has neither slope nor curvature
    used = np.diagonal(stacked @ stacked.T) > 0.0
    idle = ~(used[p] & used[q])
    gradient[idle] = 0.0
    hessian[idle] = hessian[:, idle] = 0.0
    hessian[idle, idle] = 1.0
    step = -np.linalg.solve(hessian, gradient)
    full = np.zeros((n, 3, 3))
    full[:, _P, _Q] = full[:, _Q, _P] = step.reshape(n, 6)
    return full, -float(gradient @ step)


def _second(product: FloatArray, p: FloatArray, q: FloatArray) -> FloatArray:
    """Return the second derivatives of `-log det` by the blocks' triangles, not scaled yet."""
    at_p, at_q = product[p], product[q]
    return np.asarray(at_q[:, p] * at_p[:, q] + at_q[:, q] * at_p[:, p])


def _is_inside(
    stacked: FloatArray, blocks: FloatArray, identity: FloatArray, redundant: bool,
) -> bool:
    """Tell whether blocks are positive definite, and A between 0 and I."""
    information = _information(stacked, blocks)
    try:
        np.linalg.cholesky(np.stack((information, identity - information)))
        if redundant:
            padding = np.diagonal(blocks, axis1=1, axis2=2) == 0.0
            np.linalg.cholesky(blocks + np.eye(3) * padding[:, :, None])
    except np.linalg.LinAlgError:
        return False
    return True
