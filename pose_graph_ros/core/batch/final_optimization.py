# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The optimisation of the whole graph at the end of a stream.

Its result must not depend on the earlier updates. So the graph is optimised from two starts, and
the weights of constraints with a robust loss are computed from initial values.
"""

from collections.abc import Mapping
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import BatchResult, SAME_MINIMUM, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting


class Tuning(NamedTuple):
    """Numbers of the optimisation with robust losses."""

    reweightings: int = 200  # at most
    # Where contradictions are believed, each solution can take all iterations that it may: that
    # many of these in all.
    solutions: int = 10
    # Numbers of iterations from one solution to the next, and of reweightings, that are many: more
    # than the last iterations without effect are, and than weights take that converge fast. Then
    # it is enough that the cost converges.
    many: int = 11
    many_reweightings: int = 50
    same_weight: float = 1e-12  # largest change of a weight at which the reweighting has converged
    # factors on the thresholds of the losses, one after the other, after plain least squares
    widened: tuple[float, ...] = (32.0, 16.0, 8.0, 4.0, 2.0)
    # weight of constraints with a loss in the start from the constraints without one
    small_weight: float = 1e-4


TUNING = Tuning()


def optimize(graph: Graph, reweighting: Reweighting, config: SolverConfig) -> BatchResult:
    """
    Return the result of optimising a whole graph in place, with the weights of robust losses.

    With robust losses, chi2 is the robust cost. All poses and weights are restored if it fails;
    an exception of the optimiser counts as a failure.
    """
    poses, weights = graph.poses.copy(), graph.weights
    try:
        if len(reweighting) == 0:
            result = optimizer.optimize_from_two_starts(graph, config)
        else:
            result = _optimize_robustly(graph, reweighting, config)
    except Exception as error:
        # whatever the error is, the poses and weights must be restored
        reason = f'{type(error).__name__}: {error}'
        result = BatchResult(Status.FAILED, reason, 0, float('nan'))
    if result.status is Status.FAILED:
        if len(reweighting) > 0:
            graph.set_weights(weights)
        graph.set_poses(poses)
    return result


def _optimize_robustly(graph: Graph, reweighting: Reweighting,
                       config: SolverConfig) -> BatchResult:
    """
    Reweight from two starts and keep the result with the lower robust cost.

    The first start is plain least squares, followed by wide thresholds that are narrowed in steps.
    The second start is determined by the constraints without a loss. Neither uses the present
    weights, because these depend on the order in which the measurements were received.
    """
    best, poses, weights = None, graph.poses, graph.weights
    for weight, widened in ((1.0, TUNING.widened), (TUNING.small_weight, ())):
        graph.apply(GraphUpdate(weigh=dict(zip(
            reweighting['id'].tolist(), (weight * reweighting['base']).tolist(), strict=True))))
        result = optimizer.optimize_from_two_starts(graph, config)
        for factor in widened:
            if result.status is not Status.FAILED:
                result = _solved_with(
                    graph, reweighting.all_changes(graph, factor), config) or result
        if result.status is not Status.FAILED:
            result = _reweighted(graph, reweighting, result, config)
        if best is None or result.is_better_than(best):
            best, poses, weights = result, graph.poses.copy(), graph.weights
    assert best is not None
    graph.set_weights(weights)
    graph.set_poses(poses)
    return best


def _reweighted(graph: Graph, reweighting: Reweighting, result: BatchResult,
                config: SolverConfig) -> BatchResult:
    """
    Reweight and solve until the weights converge; chi2 of the result is the robust cost.

    Where each solution takes many iterations, although it begins at the last one, it is enough
    that the cost converges.
    A loss may give weight 0 to all that determines a node. The last weights with a solution are
    kept then, and the status is MAX_ITERATIONS.
    """
    iterations, largest, cost = 0, 1.0, math.inf
    for k in range(TUNING.reweightings):
        before, cost_before = graph.weights, cost
        found = _solved_with(graph, reweighting.all_changes(graph), config)
        if found is None:
            largest = 1.0
            break
        largest = float(np.max(np.abs(graph.weights - before), initial=0.0))
        result = found
        iterations += result.iterations
        cost = result.chi2 + reweighting.cost(graph)
        is_slow = result.iterations >= TUNING.many or k >= TUNING.many_reweightings
        if (is_slow and result.status is not Status.MAX_ITERATIONS
                and not cost < cost_before * (1.0 - SAME_MINIMUM)):
            largest = 0.0
        if largest < TUNING.same_weight or iterations > TUNING.solutions * config.max_iterations:
            break
    if result.status is Status.FAILED:
        return result
    if largest >= TUNING.same_weight:
        result = replace(result, status=Status.MAX_ITERATIONS)
    return replace(result, iterations=iterations, chi2=result.chi2 + reweighting.cost(graph))


def _solved_with(graph: Graph, weights: Mapping[int, float],
                 config: SolverConfig) -> BatchResult | None:
    """
    Return the result of solving with other weights.

    It is None, with the old weights, if they leave too little to determine all nodes.
    """
    before = graph.weights
    graph.apply(GraphUpdate(weigh=weights))
    result = optimizer.optimize(graph, config)
    if result.status is not Status.FAILED or (
            min(weights.values(), default=1.0) > TUNING.small_weight):
        return result
    graph.set_weights(before)
    return None
