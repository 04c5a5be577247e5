# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factor on the sigmas of a source of closures that its believed closures show, in three ways.

By their *residuals*: that of a constraint in the graph has the covariance `s^2 R - C`, with R the
claimed one, s the factor and `C = J P J^T` its part that the estimate has followed. So
`e^T R^-1 e / s^2` is expected to be its redundancy, `r = 3 - tr(R^-1 C) / s^2`, and s^2 is the sum
of all squares over that of the redundancies, the estimate of a variance component by restricted
maximum likelihood (K.-R. Koch, "Parameter estimation and hypothesis testing in linear models",
1999, section 3.6). A square counts up to where 99 % of them are, so that one wrong closure does
not decide. But closures that the graph follows have no residuals left.

By the residuals of *groups*: closures of one place often share an error, as the same view is
recognised again. The mean of a group, weighted by information, is a constraint with the sum of the
informations; if errors are independent, it shows the same s, and else a larger one, with which the
group counts as what it is. Its C is taken to be the mean of those of its closures, a little too
large.

By their *agreement*: neighbours differ by their own errors and by the odometry of a few metres
between them, whatever the graph does. With these covariances `s^2 (R_a + R_b) + Q`, the median of
the squared distances is that of chi2 for the right s. But what neighbours have in common is not
seen.

All are too small if anything, so the largest one counts.
"""

from dataclasses import dataclass
import math

import numpy as np
from scipy.special import gammainc, gammaincc

from pose_graph_ros.core.batch.optimizer import optimize, Status
from pose_graph_ros.core.batch.truncated import CONFIG
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.closures import claims, ClosureTable, GATE
from pose_graph_ros.core.judgement.consistency import squared_distances
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.smoother import innovations

# Median of chi2 with three degrees of freedom.
MEDIAN = 2.366
# Largest number of closures that count of those that have left the graph.
MOST_COUNTED = 100
# Smallest number of closures, or sum of their redundancies, that says anything.
LEAST = 10
# What is left of the mean of chi2 with three degrees of freedom that counts up to `GATE`.
LEFT = float(gammainc(2.5, GATE / 2.0) + GATE / 3.0 * gammaincc(1.5, GATE / 2.0))
# Number of neighbours that a closure is compared with.
NEIGHBOURS = 3
# A factor of 1 is believed as much as this number of closures.
PRIOR = 10.0
# Most closures that are looked at.
MOST = 100
# Largest number of steps to the limits of squares, and of rounds of a whole graph.
STEPS, ROUNDS = 50, 6
# Closures whose ends are both in one stretch of the path of this length are of one place [m].
STRETCH = 2.0
# Added to an information, relative to its largest entry, before equations with it are solved.
_SINGULAR = 1e-12
# Largest factor, and the ratio of successive ones: few values, so that closures are rarely weighed
# anew, and the factor does not depend on rounding.
LARGEST, RATIO = 10.0, 1.2


@dataclass(slots=True)
class ScaleLeft:
    """A factor on sigmas, and how many closures that have left have shown it."""

    n: int = 0
    scale: float = 1.0

    def add(self, n: int, scale: float) -> None:
        """
        Add closures.

        Parameters
        ----------
        n : int
        scale : float, factor that they were used with

        """
        self.n += n
        if n > 0:
            part = n / min(self.n, MOST_COUNTED)
            self.scale *= (scale / self.scale)**min(part, 1.0)


def give_scale(graph: Graph, closures: IntArray) -> float:
    """
    Return the factor on the sigmas of closures, with which the graph is optimised in place.

    All of them are believed; their weights are set to 1 / factor^2. Where odometry does not join
    all nodes, nobody knows which closures are neighbours, and the factor is 1.

    Parameters
    ----------
    graph : Graph, near its optimum
    closures : ndarray of int, shape (M,), rows of its edges

    """
    chain, scale = OdometryChain(), 1.0
    chain.extend(graph)
    if len(chain) < graph.n_nodes or len(closures) == 0:
        return scale
    edges, inside = graph.edges_at(closures), np.ones(len(closures), dtype=bool)
    table = ClosureTable(chain)
    table.append(claims(edges))
    group = places(table, edges)
    agreement = agreement_scale(table, np.arange(len(closures)), inside, edges)
    for _ in range(ROUNDS):
        if optimize(graph, CONFIG).status is Status.FAILED:
            break
        errors, covariances = innovations.at_estimate(graph.memory.head, edges)
        shown = max(agreement, residual_scale(
            errors, covariances, edges.information, group, scale))
        if shown <= scale:
            break
        scale = shown
        graph.apply(GraphUpdate(weigh_edges=dict.fromkeys(closures.tolist(), scale**-2.0)))
    return scale


def places(table: ClosureTable, edges: Edges) -> IntArray:
    """
    Return to which place closures belong, numbers from 0, shape (M,).

    Parameters
    ----------
    table : ClosureTable, which knows the path
    edges : Edges, M closures

    """
    stretch = np.floor(np.column_stack(
        [table.chain.travel(nodes) for nodes in (edges.j, edges.i)]) / STRETCH)
    _, place = np.unique(stretch, axis=0, return_inverse=True)
    return np.asarray(place.ravel())


def residual_scale(
    errors: FloatArray, covariances: FloatArray, information: FloatArray, group: IntArray,
    scale: float,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1.

    Parameters
    ----------
    errors : ndarray, shape (M, 3), residuals of believed closures
    covariances : ndarray, shape (M, 3, 3), C, with the closures in the graph
    information : ndarray, shape (M, 3, 3), claimed
    group : ndarray of int, shape (M,), from 0, of closures of one place
    scale : float, the present factor

    """
    size = np.bincount(group)
    total, common = np.zeros((len(size), 3, 3)), np.zeros((len(size), 3, 3))
    weighted = np.zeros((len(size), 3))
    np.add.at(total, group, information)
    np.add.at(common, group, covariances)
    np.add.at(weighted, group, np.einsum('mij,mj->mi', information, errors))
    # what no closure of a group measures stays at 0
    largest = np.max(np.abs(total), axis=(1, 2))[:, None, None]
    mean = np.linalg.solve(total + _SINGULAR * largest * np.eye(3), weighted[:, :, None])[:, :, 0]
    return max(_shown(errors, covariances, information, scale),
               _shown(mean, common / size[:, None, None], total, scale))


def _shown(
    errors: FloatArray, covariances: FloatArray, information: FloatArray, scale: float,
) -> float:
    """Return the factor that residuals show; the parameters are those of `residual_scale`."""
    trace = np.einsum('mij,mji->m', information, covariances)
    rank = np.count_nonzero(np.einsum('mii->mi', information) > 0.0, axis=1)
    redundancy = np.maximum(rank - trace / scale**2, 0.0) / 3.0
    n = float(np.sum(redundancy))
    if n < LEAST:
        return scale
    squares = np.einsum('mi,mij,mj->m', errors, information, errors)
    shown = math.sqrt(float(np.sum(squares)) / (3.0 * n))
    for _ in range(STEPS):
        # from above, as the sum of what counts shrinks with its limits
        counted = np.minimum(squares, GATE * shown**2 * redundancy)
        shown, before = math.sqrt(float(np.sum(counted)) / (3.0 * LEFT * n)), shown
        if shown > 0.99 * before:
            break
    return _believed(shown, n)


def agreement_scale(
    table: ClosureTable, numbers: IntArray, inside: BoolArray, edges: Edges,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1, by the neighbours of its closures.

    Parameters
    ----------
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
    if len(set(first)) < LEAST:
        return 1.0
    claimed, pairs = claims(edges, np.zeros(3)), (np.array(first), np.array(second))

    def distance(factor: float) -> float:
        return float(np.median(squared_distances(
            table.chain, claimed._replace(noise=factor**2 * claimed.noise), *pairs)))

    scale, share = 1.0, math.log(distance(1.0) / distance(RATIO)) / (2.0 * math.log(RATIO))
    while scale < LARGEST and distance(scale) > MEDIAN:
        scale *= RATIO
    # where odometry makes most of the distance, it tells little of closures
    return _believed(scale, share * len(set(first)))


def _believed(shown: float, n: float) -> float:
    """Return the factor to use if n closures show one."""
    steps = round(math.log(max(shown, 1e-3)) * n / (n + PRIOR) / math.log(RATIO))
    return min(RATIO ** max(steps, 0), LARGEST)


def together(shown: float, n: float, left: ScaleLeft) -> float:
    """
    Return the factor that closures in the graph and those that have left it show.

    Parameters
    ----------
    shown : float, by those in the graph
    n : float, their number

    """
    n_left = min(left.n, MOST_COUNTED)
    if n_left == 0:
        return shown
    logarithm = ((n + PRIOR) * math.log(shown) + n_left * math.log(left.scale)) / (
        n + (PRIOR if n > 0.0 else 0.0) + n_left)
    return min(RATIO ** max(round(logarithm / math.log(RATIO)), 0), LARGEST)
