# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factor on the sigmas of a source of closures that the residuals of its believed ones show.

The residual of a constraint in the graph has the covariance `s^2 R - C`, with R the claimed one, s
the factor and `C = J P J^T` its part that the estimate has followed. So `e^T R^-1 e / s^2` is
expected to be its redundancy, `r = 3 - tr(R^-1 C) / s^2`, and s^2 is the sum of all squares over
that of the redundancies, the estimate of a variance component by restricted maximum likelihood
(K.-R. Koch, "Parameter estimation and hypothesis testing in linear models", 1999, section 3.6). A
square counts up to where 99 % of them are, so that one wrong closure does not decide.

Closures of one place often share an error, as the same view is recognised again. So they are one
constraint: their mean, weighted by information, with the sum of the informations. If errors are
independent, it shows the same s, and else a larger one, with which the group counts as what it is.
Its C is taken to be the mean of those of its closures, a little too large.
"""

import math

import numpy as np
from scipy.special import gammainc, gammaincc

from pose_graph_ros.core.batch.optimizer import optimize, Status
from pose_graph_ros.core.batch.truncated import CONFIG
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.smoother.covariances import innovations

ROUNDS = 6  # of solving and learning
LEAST_SHOWN = 10  # closures, or sum of their redundancies, that show anything
PRIOR_CLOSURES = 10.0  # that a factor of 1 is believed as much as
PLACE_LENGTH = 2.0  # closures with both ends in one such stretch are of one place [m]
LARGEST_SCALE = 10.0
# What is left of the mean of chi2 with three degrees of freedom that counts up to `GATE`.
LEFT = float(gammainc(2.5, GATE / 2.0) + GATE / 3.0 * gammaincc(1.5, GATE / 2.0))


def give_scale(graph: Graph, closures: IntArray) -> float:
    """
    Return the factor on the sigmas of closures, with which the graph is optimised in place.

    All of them are believed; their weights are set to 1 / factor^2. Where odometry does not join
    all nodes, nobody knows which closures are neighbours, and the factor is 1.
    """
    chain, scale = OdometryChain(), 1.0
    chain.extend(graph)
    if len(chain) < graph.n_nodes or len(closures) == 0:
        return scale
    edges = graph.factors_at(closures)
    group = places(chain, edges)
    for _ in range(ROUNDS):
        if optimize(graph, CONFIG).status is Status.FAILED:
            break
        errors, covariances = innovations(graph.memory.head, edges)
        shown = residual_scale(errors, covariances, edges.information, group, scale)
        if shown <= scale:
            break
        scale = shown
        graph.apply(GraphUpdate(weigh=dict.fromkeys(closures.tolist(), scale**-2.0)))
    return scale


def places(chain: OdometryChain, edges: Factors) -> IntArray:
    """Return to which place closures belong, numbers from 0, shape (M,)."""
    stretch = np.floor(np.column_stack(
        [chain.travel(nodes) for nodes in (edges.j, edges.i)]) / PLACE_LENGTH)
    _, place = np.unique(stretch, axis=0, return_inverse=True)
    return np.asarray(place.ravel())


def residual_scale(
    errors: FloatArray, covariances: FloatArray, information: FloatArray, group: IntArray,
    scale: float,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1, given the present one.

    Errors are the residuals of believed closures, shape (M, 3), covariances their C with the
    closures in the graph, information what is claimed; `group` numbers closures of one place from
    0.
    """
    size = np.bincount(group)
    total, common = np.zeros((len(size), 3, 3)), np.zeros((len(size), 3, 3))
    weighted = np.zeros((len(size), 3))
    np.add.at(total, group, information)
    np.add.at(common, group, covariances)
    np.add.at(weighted, group, np.einsum('mij,mj->mi', information, errors))
    # what no closure of a group measures stays at 0
    largest = np.max(np.abs(total), axis=(1, 2))[:, None, None]
    mean = np.linalg.solve(total + 1e-12 * largest * np.eye(3), weighted[:, :, None])[:, :, 0]
    common /= size[:, None, None]
    trace = np.einsum('mij,mji->m', total, common)
    rank = np.count_nonzero(np.einsum('mii->mi', total) > 0.0, axis=1)
    redundancy = np.maximum(rank - trace / scale**2, 0.0) / 3.0
    n = float(np.sum(redundancy))
    if n < LEAST_SHOWN:
        return scale
    squares = np.einsum('mi,mij,mj->m', mean, total, mean)
    shown = math.sqrt(float(np.sum(squares)) / (3.0 * n))
    for _ in range(50):
        # from above, as the sum of what counts shrinks with its limits
        counted = np.minimum(squares, GATE * shown**2 * redundancy)
        shown, before = math.sqrt(float(np.sum(counted)) / (3.0 * LEFT * n)), shown
        if shown > 0.99 * before:
            break
    # if n closures show it
    return min(max(math.exp(
        math.log(max(shown, 1e-3)) * n / (n + PRIOR_CLOSURES)), 1.0), LARGEST_SCALE)
