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
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.beliefs import Beliefs, ScaleLeft
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.closures import ClosureTable, GATE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import STATES
from pose_graph_ros.core.smoother.covariances import innovations
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

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
    for _ in range(BELIEF.scale_rounds):
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
        [chain.travel(nodes) for nodes in (edges.j, edges.i)]) / BELIEF.place_length)
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
    if n < BELIEF.least_shown:
        return scale
    squares = np.einsum('mi,mij,mj->m', mean, total, mean)
    shown = math.sqrt(float(np.sum(squares)) / (3.0 * n))
    for _ in range(BELIEF.scale_steps):
        # from above, as the sum of what counts shrinks with its limits
        counted = np.minimum(squares, GATE * shown**2 * redundancy)
        shown, before = math.sqrt(float(np.sum(counted)) / (3.0 * LEFT * n)), shown
        if shown > 0.99 * before:
            break
    # if n closures show it
    return _stepped(math.log(max(shown, 1e-3)) * n / (n + BELIEF.prior_closures))


def _stepped(logarithm: float) -> float:
    """Return the nearest of the factors that are used, by its logarithm."""
    steps = round(logarithm / math.log(BELIEF.scale_ratio))
    return min(BELIEF.scale_ratio ** max(steps, 0), BELIEF.largest_scale)


def together(shown: float, n: float, left: ScaleLeft) -> float:
    """Return the factor that closures in the graph and those that have left it show."""
    n_left = min(left.n, BELIEF.most_counted)
    if n_left == 0:
        return shown
    prior = BELIEF.prior_closures
    return _stepped(((n + prior) * math.log(shown) + n_left * math.log(left.scale)) / (
        n + (prior if n > 0.0 else 0.0) + n_left))


class ScaleLearner:
    def __init__(
        self, smoother: IncrementalSmoother, states: ClosureStates, table: ClosureTable,
        beliefs: Beliefs,
    ) -> None:
        self._smoother, self._states, self._table = smoother, states, table
        self._beliefs = beliefs
        # number of believed closures of each source when its factor was learnt
        self._learnt_from: list[int] = []

    def add_sources(self) -> None:
        """Give new sources the factor that closures have shown that have left, or 1."""
        for source in range(len(self._learnt_from), len(self._states.sources)):
            if source == len(self._beliefs.scales_left):
                self._beliefs.scales_left.append(ScaleLeft())
            self._beliefs.scales.append(
                together(1.0, 0.0, self._beliefs.scales_left[source]))
            self._learnt_from.append(0)

    def begin(self) -> None:
        """Forget what was learnt from closures that are in the graph."""
        self._beliefs.scales.clear()
        self._learnt_from.clear()
        self.add_sources()

    def state(self) -> tuple[list[float], list[int]]:
        return [*self._beliefs.scales], [*self._learnt_from]

    def set_state(self, scales: list[float], learnt_from: list[int]) -> None:
        self._beliefs.scales[:], self._learnt_from[:] = scales, learnt_from

    def learn(self) -> bool:
        """Learn the factor of a source with many more closures; tell whether one has changed."""
        for source in range(len(self._states.sources)):
            n_believed, before = int(np.sum(self._of(source))), self._learnt_from[source]
            n = n_believed + self._beliefs.scales_left[source].n
            if n_believed >= BELIEF.and_more_believed and n - before >= (
                    BELIEF.more_believed * min(n_believed, before) + BELIEF.and_more_believed):
                self._learnt_from[source] = n
                if self._learn(source):
                    return True
        return False

    def learn_all(self) -> None:
        """Learn all factors from 1, until the residuals show none that is larger."""
        for source in range(len(self._states.sources)):
            n_believed = int(np.sum(self._of(source)))
            self._learnt_from[source] = n_believed + self._beliefs.scales_left[source].n
            if n_believed >= BELIEF.and_more_believed:
                for _ in range(BELIEF.scale_rounds):
                    if not self._learn(source, larger=True):
                        break

    def _of(self, source: int) -> BoolArray:
        return np.asarray(self._states.in_graph & (self._states.source == source))

    def _learn(self, source: int, *, larger: bool = False) -> bool:
        """Learn the factor of a source, if it is a `larger` one; tell whether it has changed."""
        before = self._beliefs.scales[source]
        numbers = np.flatnonzero(self._of(source))
        most = BELIEF.most_looked_at_at_end if larger else BELIEF.most_looked_at
        scale = self._shown(source, numbers, most)
        if scale == before or (larger and scale < before):
            return False
        self._beliefs.scales[source] = scale
        if self._beliefs.apply({k: STATES[self._states.state[k]] for k in numbers.tolist()}):
            self._table.spread[:] = 0.0
            return True
        self._beliefs.scales[source] = before
        return not larger

    def _shown(self, source: int, numbers: IntArray, most: int) -> float:
        states, graph = self._states, self._smoother.graph
        some, group = self._sample(numbers, most)
        edges = graph.factors_at(states.held[some])
        return together(
            residual_scale(*self._smoother.innovations(edges), edges.information, group,
                           self._beliefs.scales[source]),
            float(len(some)), self._beliefs.scales_left[source])

    def _sample(self, numbers: IntArray, most: int) -> tuple[IntArray, IntArray]:
        """Return at most so many closures, from all along the path, and the group of each."""
        edges = self._smoother.graph.factors_at(self._states.held[numbers])
        group = places(self._table.chain, edges)
        n_groups = int(group.max()) + 1
        n_chosen = min(max(n_groups * most // len(numbers), 1), n_groups)
        chosen = np.linspace(0, n_groups - 1, n_chosen).astype(np.int64)
        some = np.flatnonzero(np.isin(group, chosen))
        # by their stamps, as numbers depend on the order of arrival
        some = some[np.lexsort((*self._states.stamps_ns[numbers[some]].T, group[some]))][:most]
        _, of_each = np.unique(group[some], return_inverse=True)
        return numbers[some], of_each.ravel()
