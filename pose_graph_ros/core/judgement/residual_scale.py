# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factor on the sigmas of a source of closures that its believed closures show, in two ways.

By their *residuals*: that of a constraint in the graph has the covariance `s^2 R - C`, with R the
claimed one, s the factor and `C = J P J^T` its part that the estimate has followed. So
`e^T R^-1 e` is expected to be `3 s^2 - tr(R^-1 C)`. Its median over many closures, each divided
by the share of `3 s^2` that is left, gives s whatever a few wrong ones do. But closures that the
graph follows have no residuals left.

By their *agreement*: neighbours differ by their own errors and by the odometry of a few metres
between them, whatever the graph does. With these covariances `s^2 (R_a + R_b) + Q`, the median of
the squared distances is that of chi2 for the right s. But what neighbours have in common is not
seen.

Both are too small if anything, so the larger one counts.
"""

import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.judgement.closures import claims, ClosureTable

# Median of chi2 with three degrees of freedom.
MEDIAN = 2.366
# Closures with a smaller share of their residual left say little.
LEAST_SHARE = 0.2
# Number of neighbours that a closure is compared with.
NEIGHBOURS = 3
# A factor of 1 is believed as much as this number of closures.
PRIOR = 10.0
# Most closures that are looked at.
MOST = 100
# Largest factor, and the ratio of successive ones: few values, so that closures are rarely weighed
# anew, and the factor does not depend on rounding.
LARGEST, RATIO = 10.0, 1.2


def residual_scale(
    errors: FloatArray, covariances: FloatArray, information: FloatArray, scale: float,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1.

    Parameters
    ----------
    errors : ndarray, shape (M, 3), residuals of believed closures
    covariances : ndarray, shape (M, 3, 3), C, with the closures in the graph
    information : ndarray, shape (M, 3, 3), claimed
    scale : float, the present factor

    """
    trace = np.einsum('mij,mji->m', information, covariances)
    share = 1.0 - trace / (3.0 * scale**2)
    said = share > LEAST_SHARE
    n = int(np.count_nonzero(said))
    if n == 0:
        return scale
    energy = np.einsum('mi,mij,mj->m', errors, information, errors)[said] / share[said]
    return _believed(math.sqrt(float(np.median(energy)) / MEDIAN), n)


def agreement_scale(
    table: ClosureTable, numbers: IntArray, inside: BoolArray, edges: Edges,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1, by the neighbours of its closures.

    Parameters
    ----------
    table : ClosureTable
    numbers : ndarray of int, shape (K,), believed closures
    inside : ndarray of bool, shape (M,), which closures of the source are believed
    edges : Edges, those of `inside` with the claimed information

    """
    place = np.cumsum(inside) - 1    # among those of `inside`
    first, second = list[int](), list[int]()
    for number in numbers.tolist():
        agree, _ = table.neighbours(number)
        others = place[agree[inside[agree]]][:NEIGHBOURS].tolist()
        first += [int(place[number])] * len(others)
        second += others
    if len(first) == 0:
        return 1.0
    claimed, pairs = claims(edges, (0.0, 0.0, 0.0)), (np.array(first), np.array(second))
    scale = 1.0
    while scale < LARGEST and np.median(table.squared_distances(
            claimed._replace(noise=scale**2 * claimed.noise), *pairs)) > MEDIAN:
        scale *= RATIO
    return _believed(scale, len(set(first)))


def _believed(shown: float, n: int) -> float:
    """Return the factor to use if n closures show one."""
    steps = round(math.log(max(shown, 1e-3)) * n / (n + PRIOR) / math.log(RATIO))
    return min(RATIO ** max(steps, 0), LARGEST)
