# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The best set of believed loop closures of a whole graph, at the end of a stream or of a file.

It is a function of the graph alone, while what is believed before depends on the order in which
measurements come. `select` believes the surest ones first; `best` compares that with other sets.
While the robot drives, `decide` looks for a set that is better than the present one.
"""

from collections.abc import Generator

import numpy as np

from pose_graph_ros.core.batch import final_optimization, optimizer
from pose_graph_ros.core.batch.optimizer import Start, Status
from pose_graph_ros.core.batch.truncated import (
    Choosing,
    ROUGH,
    Surrogate,
    TruncatedProblem,
)
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closures import floored, forward, GATE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.smoother.covariances import Innovations, innovations


def select(problem: TruncatedProblem) -> Generator[None, None, BoolArray | None]:
    """
    Return a set of believed constraints, shape (M,), and lower the limits of the problem.

    With S the covariance of the error that a constraint would have by what is believed already, it
    passes the gate if `e^T S^-1 e` is small. A wrong one, whose error could be anything, passes
    with a chance that is proportional to the volume of the gate, and so to sqrt(det S). So they
    are believed in the order of this volume: first those that span little odometry, then those
    that these make sure. Wrong ones meet a narrow gate in the end, also where many of them agree.

    What is believed also shows how large errors really are. Where covariances are far too large,
    the limits are lowered; else a wrong one would fit wherever the graph is claimed to be soft.

    None if the graph cannot be solved.
    """
    believed = np.zeros(len(problem), dtype=bool)
    if not (yield from problem.solve(believed.astype(np.float64))):
        return None
    gates, thrown = _Gates(problem), np.zeros(len(problem), dtype=np.int64)
    limits, seen = problem.limits, np.zeros(len(problem))
    for _ in range(BELIEF.most_rounds):
        waiting = gates.plausible(np.flatnonzero(~believed & (thrown < BELIEF.thrown_out)))
        waiting = waiting[np.argsort(gates.volume[waiting], kind='stable')]
        n_first = max(BELIEF.first_volumes, int(BELIEF.first_volumes_share * len(waiting)))
        # volumes only shrink, so what is widest now is looked at where nothing else passes
        passing = waiting[:0]
        for some in (waiting[:n_first], waiting[n_first:]):
            if len(passing) == 0:
                passing = yield from gates.passing(some)
        if len(passing) == 0:
            break
        volume = gates.volume[passing]
        new = passing[volume <= BELIEF.round_factor * np.min(volume)]
        believed[new], seen[new] = True, gates.squared[new] / limits[new]
        if np.sum(believed) >= BELIEF.limits_from:
            shown = np.quantile(seen[believed], BELIEF.limits_share) * GATE / BELIEF.limits_chi2
            problem.limits = limits * np.clip(
                BELIEF.limits_margin * shown, BELIEF.least_limits, 1.0)
        if not (yield from problem.solve(believed.astype(np.float64), go_on=True)):
            return None
        wrong = believed & (problem.energies() > limits)
        if np.any(wrong):
            thrown[wrong] += 1
            believed[wrong] = False
            if not (yield from problem.solve(believed.astype(np.float64), go_on=True)):
                return None
    return believed


class _Gates:
    """The gates of all constraints of a problem, as they were when each was last computed."""

    def __init__(self, problem: TruncatedProblem) -> None:
        self._problem = problem
        self._edges = problem.edges.renumbered(problem.graph.node_rows)
        self._information = problem.edges.information
        measured = np.einsum('mii->mi', self._information) > 0.0
        filled = self._information + np.einsum('mi,ij->mij', ~measured, np.eye(3))
        with np.errstate(divide='ignore'):
            self._own = np.prod(np.where(measured, 1.0, BELIEF.error_extent), axis=1) / np.sqrt(
                np.abs(np.linalg.det(filled)))
        # J P J^T of each; they never grow while more is believed
        self._covariances = np.full((len(problem), 3, 3), np.nan)
        self.volume = np.zeros(len(problem))
        self.squared = np.zeros(len(problem))  # Mahalanobis distances
        self._begin_with_odometry()

    def _begin_with_odometry(self) -> None:
        """Set gates by odometry, the largest: it is quicker than the tree without closures."""
        problem, chain = self._problem, OdometryChain(weighted=True)
        chain.extend(problem.graph)
        numbers = np.flatnonzero(np.isin(problem.edges.i, chain.nodes)
                                 & np.isin(problem.edges.j, chain.nodes))
        some = problem.edges.rows(numbers)
        pose, covariance = chain.between(some.i, some.j)
        # from the axes of the predicted pose to those of the measured one
        turn = np.zeros((len(numbers), 3))
        turn[:, 2] = pose[:, 2] - some.mean[:, 2]
        axes = se2.adjoint(turn)
        self._set(numbers, axes @ covariance @ np.swapaxes(axes, 1, 2))

    def plausible(self, numbers: IntArray) -> IntArray:
        """Return constraints inside of old gates: S only shrinks, so no others can pass now."""
        old = np.nan_to_num(self._squared(numbers, self._problem.errors(numbers)), nan=0.0)
        return numbers[old <= self._problem.limits[numbers]]

    def passing(self, waiting: IntArray) -> Generator[None, None, IntArray]:
        """Return which of some constraints pass their gates by what is believed now."""
        inside = np.zeros(len(waiting), dtype=bool)
        size = max(BELIEF.nodes_in_part // self._problem.graph.n_nodes, 1)
        for begin in range(0, len(waiting), size):
            part = waiting[begin:begin + size]
            errors, covariances = innovations(
                self._problem.graph.memory.head, self._edges.rows(part))
            self._set(part, covariances)
            self.squared[part] = self._squared(part, errors)
            inside[begin:begin + len(part)] = self.squared[part] <= self._problem.limits[part]
            yield
        return waiting[inside]

    def _squared(self, numbers: IntArray, errors: FloatArray) -> FloatArray:
        return Innovations(errors, self._covariances[numbers]).squared_distances(
            self._information[numbers])

    def _set(self, numbers: IntArray, covariances: FloatArray) -> None:
        self._covariances[numbers] = covariances
        grown = np.linalg.det(np.eye(3) + covariances @ self._information[numbers])
        self.volume[numbers] = self._own[numbers] * np.sqrt(np.maximum(grown, 1.0))


def best(problem: TruncatedProblem) -> Choosing:
    """
    Return the set with the lowest truncated cost; None if the graph cannot be solved.

    All constraints are believed if they contradict nothing. Otherwise the sets compared are none,
    and those of `select` and of graduated non-convexity, each after retests.
    """
    everything = np.ones(len(problem), dtype=bool)
    # with wrong ones among them each iteration can take longer than a part may
    if problem.factorisation(everything.astype(np.float64)) <= (
            BELIEF.most_numbers * problem.graph.n_nodes):
        choice = yield from problem.choice(everything, ROUGH)
        if choice is not None and np.all(choice.energies <= problem.limits):
            return (yield from problem.choice(everything))
    surest, solved = (yield from select(problem)), []
    sets = [*([] if surest is None else [surest]), ~everything]
    for looking in (*map(problem.choice, sets), problem.graduated(Surrogate.TRUNCATED)):
        choice = yield from looking
        if choice is not None:
            solved.append((yield from problem.improved(choice)))
    return min(solved, key=lambda each: each.cost, default=None)


def surest(problem: TruncatedProblem) -> Choosing:
    """
    Return the set of `select` after retests; None if the graph cannot be solved.

    Early in a drive little contradicts a group of wrong constraints that agree, and to believe it
    can cost less than to doubt each of them. But such a group does not pass the gates.
    """
    believed = yield from select(problem)
    choice = None if believed is None else (yield from problem.choice(believed))
    return None if choice is None else (yield from problem.improved(choice))


# Least reduction of the truncated cost, that of one constraint [sigma^2].
LEAST_GAIN = GATE
CONFIG = SolverConfig(max_iterations=100)


def decide(
    graph: Graph, ids: IntArray, forced: IntArray, inside: BoolArray,
    losses: Reweighting | None = None,
) -> Choosing:
    """
    Return which loop closures to believe, with poses by row; None if the graph cannot be solved.

    All closures are taken out, and the rest is solved: with robust weights from initial values, if
    `losses` are given, else with the present weights. Then, while the robot drives, the result is
    the surest set, or None if `inside`, the present one, costs as little. With more than
    `most_at_end` nodes and closures it is `inside`, improved.
    """
    copy, present = _copy(graph, np.union1d(ids, forced)), graph.poses.copy()
    others = Reweighting()
    if losses is not None:
        others.restore(losses.saved())
    yield
    if graph.n_nodes + len(ids) > BELIEF.most_at_end:
        problem = TruncatedProblem(copy, ids, start=present)
        choice = yield from problem.choice(inside)
        if choice is not None:
            choice = yield from problem.improved(choice, BELIEF.retests_at_end)
    else:
        weights = dict.fromkeys(ids.tolist(), 0.0) | dict.fromkeys(forced.tolist(), 1.0)
        copy.apply(GraphUpdate(weigh=weights))
        starts = (Start.CHORDAL, Start.JOINT, Start.PRESENT)
        result = yield from optimizer.in_parts(copy, CONFIG, starts)
        if result.status is not Status.FAILED and len(others) > 0:
            for number, weight in weights.items():
                others.set_base_weight(number, weight)
            result = final_optimization.optimize(copy, others, CONFIG, optimizer.optimize)
        if result.status is Status.FAILED:
            return None
        problem = TruncatedProblem(copy, ids, start=copy.poses.copy())
        choice = yield from (surest if losses is None else best)(problem)
    if choice is None or losses is not None:
        return choice
    solved = yield from problem.choice(inside)
    cost = min(problem.cost_at(present), np.inf if solved is None else solved.cost)
    return choice if choice.cost < cost - LEAST_GAIN else None


def _copy(graph: Graph, closures: IntArray) -> Graph:
    """Return a copy of a graph in which closures, by id, have the information to decide by."""
    rows, copy, at = graph.rows(), Graph(), graph.factor_rows(closures)
    factors = rows.factors.replaced()
    factors.records[at] = floored(forward(factors.rows(at))).records
    copy.fill(rows._replace(factors=factors))
    return copy
