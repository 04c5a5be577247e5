# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether two loop closures agree, by the odometry between their ends alone.

Closure a, from node i to node j, is predicted through closure b, from k to l, and the two chains
of odometry from i to k and from l to j (J. Mangelson et al., "Pairwise consistent measurement set
maximization", ICRA 2018). With T_n the pose of node n by odometry, `T_i^-1 T_k z_b T_l^-1 T_j` is
to be z_a. Edges that are in both chains are counted with their correlation.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import INTEGERS, kernel, MATRICES, NUMBERS, ROWS
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.judgement.odometry_chain import composed, inverted, OdometryChain

# Relative difference of lengths that is rounding.
_TIE = 1e-9


class Closures(NamedTuple):
    """M loop closures as columns."""

    i: IntArray
    """Nodes that they start from, shape (M,)."""
    j: IntArray
    """Nodes that they lead to, shape (M,)."""
    mean: FloatArray
    """Measured poses of j in i, shape (M, 3) [m, m, rad]."""
    noise: FloatArray
    """Covariances in the frames of the measured poses, shape (M, 3, 3)."""


def squared_distances(
    chain: OdometryChain, closures: Closures, first: IntArray, second: IntArray,
) -> FloatArray:
    """
    Return the squared Mahalanobis distances of pairs of closures, shape (P,).

    The first of a pair is compared with its prediction through the second one, which may have
    been measured in the opposite direction: the shorter chains decide. The distance is infinite
    if a node is not chained by odometry.

    Parameters
    ----------
    first, second : ndarray of int, shape (P,), rows of `closures`

    """
    first, second = (np.ascontiguousarray(rows, np.int64) for rows in (first, second))
    places = [chain.places(nodes[rows]) for rows in (first, second)
              for nodes in (closures.i, closures.j)]
    out = np.empty(len(first))
    _squared_distances(
        chain.poses, chain.sums, chain.travelled, *places, np.ascontiguousarray(closures.mean),
        np.ascontiguousarray(closures.noise), first, second, out)
    return out


@kernel
def _set_adjoint(out, a):  # type: ignore[no-untyped-def]
    """Write Ad of a pose, as `se2.adjoint` does."""
    c, s = math.cos(a[2]), math.sin(a[2])
    out[0, 0], out[0, 1], out[0, 2] = c, -s, a[1]
    out[1, 0], out[1, 1], out[1, 2] = s, c, -a[0]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@kernel
def _add_product(out, factor, a, m, b):  # type: ignore[no-untyped-def]
    """Add `factor A M B^T` to a matrix; all have the shape (3, 3)."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for n in range(3):
                    total += a[i, k] * m[k, n] * b[j, n]
            out[i, j] += factor * total


@kernel
def _sum_between(sums, low, high, out):  # type: ignore[no-untyped-def]
    """Write the sum of the covariances of the edges between two places, from the prefix sums."""
    k = 0
    for i in range(3):
        for j in range(i, 3):
            out[i, j] = out[j, i] = sums[high, k] - sums[low, k]
            k += 1


@kernel
def solved_form(m, e):  # type: ignore[no-untyped-def]
    """
    Return `e^T M^-1 e`.

    Parameters
    ----------
    m, e : ndarray, shapes (3, 3) and (3,), the matrix positive definite

    """
    l00 = math.sqrt(m[0, 0])
    l10, l20 = m[1, 0] / l00, m[2, 0] / l00
    l11 = math.sqrt(m[1, 1] - l10 * l10)
    l21 = (m[2, 1] - l20 * l10) / l11
    x = e[0] / l00
    y = (e[1] - l10 * x) / l11
    z = e[2] - l20 * x - l21 * y
    return x * x + y * y + z * z / (m[2, 2] - l20 * l20 - l21 * l21)


@kernel(signature=(
    ROWS, ROWS, NUMBERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, ROWS, MATRICES, INTEGERS,
    INTEGERS, NUMBERS), allocates=True)
def _squared_distances(  # type: ignore[no-untyped-def]
    poses, sums, travel, start_a, end_a, start_b, end_b, mean, noise, first, second, out,
):
    """
    Write the squared distances of pairs of closures.

    Parameters
    ----------
    poses, sums, travel : ndarray, of the chain
    start_a, end_a, start_b, end_b : ndarray of int, places of the ends of each pair
    mean, noise, first, second, out : ndarray, as in `squared_distances`

    """
    work = np.empty((6, 3, 3))
    noise_b, adjoint = work[0], work[1]
    for p in range(len(out)):
        a, b = first[p], second[p]
        i, j, k, l = start_a[p], end_a[p], start_b[p], end_b[p]     # noqa: E741  as the formula
        if min(i, j, k, l) < 0:
            out[p] = np.inf
            continue
        z_a, z_b = (mean[a, 0], mean[a, 1], mean[a, 2]), (mean[b, 0], mean[b, 1], mean[b, 2])
        noise_b[:] = noise[b]
        straight = abs(travel[i] - travel[k]) + abs(travel[l] - travel[j])
        crossed = abs(travel[i] - travel[l]) + abs(travel[k] - travel[j])
        if crossed < (1.0 - _TIE) * straight:
            k, l = l, k     # noqa: E741
            _set_adjoint(adjoint, z_b)
            noise_b[:] = 0.0
            _add_product(noise_b, 1.0, adjoint, noise[b], adjoint)
            z_b = inverted(z_b)
        out[p] = _squared_distance(poses, sums, (i, j, k, l), z_a, noise[a], z_b, work)


@kernel
def _squared_distance(  # type: ignore[no-untyped-def]
    poses, sums, places, z_a, noise_a, z_b, work,
):
    """
    Return the squared distance of closure a, from i to j, from its prediction through b, k to l.

    Parameters
    ----------
    poses, sums : ndarray, of the chain
    places : tuple of int, i, j, k and l in the chain
    z_a, z_b : tuple of float, measured poses
    noise_a : ndarray, shape (3, 3)
    work : ndarray, shape (6, 3, 3), the first with the noise of b, the others to be overwritten

    """
    noise_b, to_k, to_l, to_end, total, part = (
        work[0], work[1], work[2], work[3], work[4], work[5])
    i, j, k, l = places     # noqa: E741
    T_i, T_k = (poses[i, 0], poses[i, 1], poses[i, 2]), (poses[k, 0], poses[k, 1], poses[k, 2])
    T_l, T_j = (poses[l, 0], poses[l, 1], poses[l, 2]), (poses[j, 0], poses[j, 1], poses[j, 2])
    behind = composed(inverted(T_l), T_j)
    from_k = composed(T_k, composed(z_b, behind))
    predicted = composed(inverted(T_i), from_k)
    dx, dy = predicted[0] - z_a[0], predicted[1] - z_a[1]
    c, s = math.cos(z_a[2]), math.sin(z_a[2])
    error = (c * dx + s * dy, c * dy - s * dx, factors.wrap(predicted[2] - z_a[2]))
    # the noises of both chains and of b, in the frame at the end of the prediction
    _set_adjoint(to_k, inverted(from_k))
    _set_adjoint(to_end, inverted(behind))
    _set_adjoint(to_l, inverted(T_j))
    total[:] = 0.0
    _add_product(total, 1.0, to_end, noise_b, to_end)
    _sum_between(sums, min(i, k), max(i, k), part)
    _add_product(total, 1.0, to_k, part, to_k)
    _sum_between(sums, min(l, j), max(l, j), part)
    _add_product(total, 1.0, to_l, part, to_l)
    low, high = max(min(i, k), min(l, j)), min(max(i, k), max(l, j))
    if low < high:
        # edges in both chains; one of them may be run through backwards
        same = 1.0 if (i < k) == (l < j) else -1.0
        _sum_between(sums, low, high, part)
        _add_product(total, same, to_k, part, to_l)
        _add_product(total, same, to_l, part, to_k)
    # turned to the axes of the error
    turn = to_k
    _set_adjoint(turn, (0.0, 0.0, error[2]))
    for m in range(3):
        for n in range(3):
            part[m, n] = noise_a[m, n]
    _add_product(part, 1.0, turn, total, turn)
    return solved_form(part, error)
