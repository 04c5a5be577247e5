# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The best set of believed loop closures of a whole graph, while the robot drives and at the end.

What is believed while closures come depends on their order, and little contradicts a group of
wrong ones that came first. So `decide` looks for a set with a lower truncated cost on a copy of
the graph, part by part. It compares the present set, that which believes the surest ones first
(`select`) and none, each after retests.
"""

from collections.abc import Callable, Generator, Mapping
from copy import deepcopy
import math
from typing import Any, TypeAlias

import numpy as np

from pose_graph_ros.core.batch import final_optimization, optimizer
from pose_graph_ros.core.batch.optimizer import Start, Status
from pose_graph_ros.core.batch.truncated import Choice, Choosing, TruncatedProblem
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.judgement.closures import floored, forward, GATE
from pose_graph_ros.core.judgement.odometry_chain import moved, OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.smoother.covariances import Innovations, innovations
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Squared Mahalanobis distance that 90 % of errors with three components are within.
WITHIN_90 = 6.251
Job: TypeAlias = Generator[None, None, Any]
"""Work on a copy of the graph, which pauses after each part."""


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

    None if the graph cannot be solved; else its poses are near the minimum of the set.
    """
    believed = np.zeros(len(problem), dtype=bool)
    if not (yield from problem.solve(believed.astype(np.float64))):
        return None
    gates, thrown = _Gates(problem), np.zeros(len(problem), dtype=np.int64)
    limits, seen = problem.limits, np.zeros(len(problem))
    for _ in range(BELIEF.most_rounds):
        waiting = np.flatnonzero(~believed & (thrown < BELIEF.thrown_out))
        # those outside of old gates cannot pass now: S only shrinks
        old = np.nan_to_num(gates.squares(waiting, problem.errors(waiting)), nan=0.0)
        waiting = waiting[old <= problem.limits[waiting]]
        waiting = waiting[np.argsort(gates.volume[waiting], kind='stable')]
        # volumes only shrink, so what is widest now is looked at where nothing else passes
        passing = yield from gates.passing(waiting[:BELIEF.first_volumes])
        if len(passing) == 0:
            passing = yield from gates.passing(waiting[BELIEF.first_volumes:])
        if len(passing) == 0:
            break
        volume = gates.volume[passing]
        new = passing[volume <= BELIEF.round_factor * np.min(volume)]
        believed[new], seen[new] = True, gates.squared[new] / limits[new]
        if np.sum(believed) >= BELIEF.limits_from:
            shown = np.quantile(seen[believed], 0.9) * GATE / WITHIN_90
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
        # gates by odometry, the largest: it is quicker than the tree without closures
        chain = OdometryChain(weighted=True)
        chain.extend(problem.graph)
        numbers = np.flatnonzero(np.isin(problem.edges.i, chain.nodes)
                                 & np.isin(problem.edges.j, chain.nodes))
        some = problem.edges.rows(numbers)
        pose, covariance = chain.between(some.i, some.j)
        # from the axes of the predicted pose to those of the measured one
        turn = np.zeros((len(numbers), 3))
        turn[:, 2] = pose[:, 2] - some.mean[:, 2]
        self._set(numbers, moved(covariance, turn))

    def passing(self, waiting: IntArray) -> Generator[None, None, IntArray]:
        """Return which of some constraints pass their gates by what is believed now."""
        inside = np.zeros(len(waiting), dtype=bool)
        size = max(BELIEF.nodes_in_part // self._problem.graph.n_nodes, 1)
        for begin in range(0, len(waiting), size):
            part = waiting[begin:begin + size]
            errors, covariances = innovations(
                self._problem.graph.memory.head, self._edges.rows(part))
            self._set(part, covariances)
            self.squared[part] = self.squares(part, errors)
            inside[begin:begin + len(part)] = self.squared[part] <= self._problem.limits[part]
            yield
        return waiting[inside]

    def squares(self, numbers: IntArray, errors: FloatArray) -> FloatArray:
        return Innovations(errors, self._covariances[numbers]).squared_distances(
            self._information[numbers])

    def _set(self, numbers: IntArray, covariances: FloatArray) -> None:
        self._covariances[numbers] = covariances
        grown = np.linalg.det(np.eye(3) + covariances @ self._information[numbers])
        self.volume[numbers] = self._own[numbers] * np.sqrt(np.maximum(grown, 1.0))


def best(problem: TruncatedProblem, inside: BoolArray | None = None,
         present: FloatArray | None = None, gain: float = 0.0) -> Choosing:
    """
    Return the set with the lowest truncated cost; None if the graph cannot be solved.

    One set is `inside`, by default that of all constraints, from the `present` poses, by default
    the start of the problem; another one costs less by some gain. If it contradicts nothing and
    no constraint, it is the best one. The others are none, and that of `select`.
    """
    odometry, everything = problem.start, np.ones(len(problem), dtype=bool)
    inside = everything if inside is None else inside
    present = odometry if present is None else present
    # with wrong ones among them each iteration can take longer than a part may
    is_sparse = problem.factorisation(inside.astype(np.float64)) <= (
        BELIEF.most_numbers * problem.graph.n_nodes)
    if is_sparse and np.all(inside):
        problem.begin_at(present)
        choice = yield from problem.choice(inside)
        if choice is not None and np.all(choice.energies <= problem.limits):
            return choice
    problem.begin_at(odometry)
    surest = yield from select(problem)
    # the surest ones have led to a minimum that is better than that from odometry
    found = odometry if surest is None else problem.graph.poses.copy()
    choices = list[tuple[float, Choice]]()
    for believed, start, less in ((inside if is_sparse else None, present, gain),
                                  (surest, found, 0.0), (~everything, found, 0.0)):
        problem.begin_at(start)
        choice = None if believed is None else (yield from problem.choice(believed))
        if choice is not None:
            choice = yield from problem.improved(choice)
            choices.append((choice.cost - less, choice))
    choice = min(choices, key=lambda each: each[0], default=(0.0, None))[1]
    return None if choice is None else (yield from _completed(problem, choice))


def _completed(problem: TruncatedProblem, choice: Choice) -> Choosing:
    """
    Return a set with all that passes its gate by what it believes, if that costs less.

    What is beyond its limit at the poses of the set may be well within it if it is believed.
    """
    problem.begin_at(choice.poses)
    if not (yield from problem.solve(choice.believed.astype(np.float64))):
        return choice
    passing = yield from _Gates(problem).passing(np.flatnonzero(~choice.believed))
    believed = choice.believed | np.isin(np.arange(len(problem)), passing)
    other = None if len(passing) == 0 else (yield from problem.choice(believed))
    if other is not None:
        other = yield from problem.improved(other)
    return choice if other is None or other.cost >= choice.cost else other


CONFIG = SolverConfig(max_iterations=100)


def decide(graph: Graph, ids: IntArray, forced: IntArray, inside: BoolArray,
           losses: Reweighting | None = None) -> Choosing:
    """
    Return which loop closures to believe, with poses by row; None if the graph cannot be solved.

    `inside` tells which are believed at present. At the end, what has a loss is weighed anew
    without closures, if `losses` are given. While the robot drives, another set has to cost less
    than the present one by one constraint. With more than `most_at_end` nodes and closures it is
    the present set after retests.
    """
    copy, present = _copy(graph, np.union1d(ids, forced)), graph.poses.copy()
    others = Reweighting() if losses is None else deepcopy(losses)
    yield
    if graph.n_nodes + len(ids) > BELIEF.most_at_end:
        problem = TruncatedProblem(copy, ids, start=present)
        choice = yield from problem.choice(inside)
        return None if choice is None else (yield from problem.improved(choice))
    weights = dict.fromkeys(ids.tolist(), 0.0) | dict.fromkeys(forced.tolist(), 1.0)
    copy.apply(GraphUpdate(weigh=weights))
    result = yield from optimizer.in_parts(
        copy, CONFIG, (Start.CHORDAL, Start.JOINT, Start.PRESENT))
    if result.status is not Status.FAILED and len(others) > 0:
        for number, weight in weights.items():
            others.set_base_weight(number, weight)
        result = final_optimization.optimize(copy, others, CONFIG)
    if result.status is Status.FAILED:
        return None
    problem = TruncatedProblem(copy, ids, start=copy.poses.copy())
    return (yield from best(problem, inside, present, GATE if losses is None else 0.0))


def _copy(graph: Graph, closures: IntArray) -> Graph:
    """Return a copy of a graph in which closures, by id, have the information to decide by."""
    rows, copy, at = graph.rows(), Graph(graph), graph.factor_rows(closures)
    factors = rows.factors.replaced()
    factors.records[at] = floored(forward(factors.rows(at))).records
    copy.fill(rows._replace(factors=factors))
    return copy


class Redecision:
    """
    What is solved on copies of the graph, part by part, between the updates: one job at a time.

    A job looks for a better set of closures, or solves for weights with which an update diverges.
    The graph has to grow by a share until another one of either kind, so that all of them together
    take a time in proportion to the drive.
    """

    def __init__(self, smoother: IncrementalSmoother) -> None:
        self._smoother = smoother
        self.job: Job | None = None
        self._solves = False  # whether the job solves for what an update has diverged with
        # next id of a node from which on there may be another one
        self._next_search = self._next_solution = 0

    def search(self, job: Job) -> None:
        """Begin a search, unless there is a job or the graph has not grown since the last one."""
        graph = self._smoother.graph
        if self.job is None and graph.next_ids.node >= self._next_search:
            self._next_search = _grown(graph, BELIEF.search_again)
            self.job, self._solves = job, False

    def solve_later(self, weights: Mapping[int, float]) -> None:
        """Solve for weights, by id, with which an update diverges, but during a pause."""
        if self.may_solve():
            self.job, self._solves = self.tried(weights), True

    def may_solve(self) -> bool:
        """Tell whether all may be solved for now that an update has diverged; else in a pause."""
        if self.is_due_or_pausing:
            return False
        self._next_solution = _grown(self._smoother.graph, BELIEF.pause)
        return True

    @property
    def is_due_or_pausing(self) -> bool:
        """Whether a copy is solved, or has to wait until the graph has grown."""
        graph = self._smoother.graph
        return (self.job is not None and self._solves) or (
            graph.n_nodes > BELIEF.small and graph.next_ids.node < self._next_solution)

    def tried(self, weights: Mapping[int, float], poses: FloatArray | None = None,
              may_adopt: Callable[[], bool] = lambda: True) -> Generator[None, None, bool]:
        """Solve a copy with other weights; return whether the graph is that now."""
        trial = self._smoother.trial(GraphUpdate(weigh=weights), poses)
        while trial.work():
            yield
        yield
        return may_adopt() and self._smoother.adopt(trial).status is not Status.FAILED

    def work(self) -> bool:
        """Do a part of the job; tell whether there was one."""
        if self.job is None:
            return False
        if next(self.job, self) is self:
            self.job = None
        return True


def _grown(graph: Graph, share: float) -> int:
    return graph.next_ids.node + math.ceil(share * graph.n_nodes)
