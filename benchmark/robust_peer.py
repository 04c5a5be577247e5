# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
GTSAM on the graphs of our runs: graduated non-convexity, and robust losses, on the whole graph.

It gets the same nodes, edges and information matrices, starts from odometry, and knows that
odometry is right; only its optimiser is timed. Closures count as kept if their weight is at least
a half.
"""

from collections.abc import Callable
from dataclasses import dataclass
import time

import gtsam
import numpy as np

from benchmark.gtsam_peer import Models, poses_of, values_of
from benchmark.runs import quiet
from benchmark.worlds import integrate
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

PRIOR_SIGMA = 1e-5
MAX_ITERATIONS = 100
FLOORS = np.diag((0.3**2, 0.3**2, 0.05**2))
"""Least covariance of closures in the variant that does not take them at their word."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A graph of N nodes in a chain, with M loop closures."""

    steps: FloatArray
    """Shape (N - 1, 3)."""
    step_information: FloatArray
    i: IntArray
    j: IntArray
    means: FloatArray
    """Shape (M, 3)."""
    information: FloatArray
    """Shape (M, 3, 3)."""

    def start(self) -> FloatArray:
        """Return the poses by odometry alone, shape (N, 3)."""
        return integrate(np.zeros(3), self.steps)

    def with_floors(self) -> 'Problem':
        """Return the problem with covariances of closures of at least `FLOORS`."""
        cov = np.linalg.inv(self.information)
        short = np.maximum(np.diagonal(FLOORS) - np.diagonal(cov, axis1=1, axis2=2), 0.0)
        raised = cov + short[:, :, None] * np.eye(3)
        return Problem(self.steps, self.step_information, self.i, self.j, self.means,
                       np.linalg.inv(raised))


@dataclass(frozen=True, slots=True)
class Solved:
    """What a peer makes of a problem."""

    name: str
    poses: FloatArray
    seconds: float
    kept: int
    """Number of closures; -1 if the method does not tell."""


def solve(problem: Problem, *, losses: bool) -> list[Solved]:
    """
    Solve a problem by GNC, and by robust losses.

    Parameters
    ----------
    problem : Problem
    losses : bool, whether to run the losses, too

    """
    results = [_gnc('GTSAM GNC-TLS', problem),
               _gnc('GTSAM GNC-TLS, floors', problem.with_floors())]
    models = gtsam.noiseModel.mEstimator
    for name, make in (('Huber', lambda: models.Huber.Create(1.345)),
                       ('Cauchy', lambda: models.Cauchy.Create(1.0)),
                       ('DCS', lambda: models.DCS.Create(1.0))) if losses else ():
        results.append(_loss(f'GTSAM LM, {name}', problem, make))
    return results


def _graph(
    problem: Problem, loss: Callable[[], object] | None = None,
) -> gtsam.NonlinearFactorGraph:
    graph, models = gtsam.NonlinearFactorGraph(), Models()
    graph.push_back(gtsam.PriorFactorPose2(
        0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)))
    for k, (mean, information) in enumerate(
            zip(problem.steps, problem.step_information, strict=True)):
        graph.push_back(gtsam.BetweenFactorPose2(
            k, k + 1, gtsam.Pose2(*mean.tolist()), models.of(information)))
    for i, j, mean, information in zip(
            problem.i.tolist(), problem.j.tolist(), problem.means, problem.information,
            strict=True):
        model = models.of(information)
        if loss is not None:
            model = gtsam.noiseModel.Robust.Create(loss(), model)
        graph.push_back(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*mean.tolist()), model))
    return graph


def _gnc(name: str, problem: Problem) -> Solved:
    graph, start = _graph(problem), values_of(problem.start())
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(len(problem.steps) + 1)))
    optimizer = gtsam.GncLMOptimizer(graph, start, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    with quiet():
        begin = time.perf_counter()
        try:
            values = optimizer.optimize()
        except RuntimeError:    # its Cholesky has given up
            values = start
        seconds = time.perf_counter() - begin
    weights = np.asarray(optimizer.getWeights())[len(problem.steps) + 1:]
    return Solved(name, poses_of(values), seconds, int(np.sum(weights >= 0.5)))


def _loss(name: str, problem: Problem, make: Callable[[], object]) -> Solved:
    graph, start = _graph(problem, make), values_of(problem.start())
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    with quiet():
        begin = time.perf_counter()
        try:
            values = gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()
        except RuntimeError:
            values = start
        seconds = time.perf_counter() - begin
    return Solved(name, poses_of(values), seconds, -1)
