# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The full optimisation at the end of a stream.

Its result must not depend on what the updates before it did. So the graph is solved from two
starts, and where sources have a robust loss, their weights begin anew.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pose_graph_ros.core import tables as tb
from pose_graph_ros.core.batch import BatchResult, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.incremental import IncrementalSmoother
from pose_graph_ros.core.reweighing import Reweighing
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.starts import SAME_MINIMUM, Solve, solve_from_two_starts

# So often the weights of robust losses follow the estimate at the most ...
REWEIGHINGS = 200
# ... and they are settled when none changes by more than this.
SAME_WEIGHT = 1e-12
# Factors on the thresholds on the way from plain least squares to the losses.
WIDENED = (32.0, 16.0, 8.0, 4.0, 2.0)
# Weight of constraints with a loss where those without one are to speak first.
FAINT = 1e-4


def optimize(
    smoother: IncrementalSmoother, reweighing: Reweighing, config: SolverConfig, solve: Solve,
) -> BatchResult:
    """
    Optimise the whole graph of a smoother in place; chi2 of the result has the robust weights.

    If that fails, whatever happens, all poses and weights are as before.
    """
    graph = smoother.graph
    poses, weights = graph.poses.copy(), graph.weights
    try:
        if len(reweighing) == 0:
            result = solve_from_two_starts(graph, config, solve, closing=True)
        else:
            result = _optimize_robustly(graph, reweighing, config, solve)
    except Exception as error:
        # whatever it is: no pose must stay on its way
        reason = f'{type(error).__name__}: {error}'
        result = BatchResult(Status.FAILED, reason, 0, float('nan'), float('nan'))
    if result.status is Status.FAILED:
        if len(reweighing) > 0:
            _weigh_all(graph, weights)
        graph.set_poses(poses)
    elif graph.memory.head[tb.N_SEEDS] > 0:
        # the solver has left the elimination to the smoother
        smoother.update(GraphUpdate())
    return result


def _optimize_robustly(
    graph: Graph, reweighing: Reweighing, config: SolverConfig, solve: Solve,
) -> BatchResult:
    """
    Reweigh from two starts, and keep the lower of the robust costs.

    One start is plain least squares, from where the thresholds narrow; the other is where the
    constraints without a loss put the nodes. Neither looks at the weights that there are: what
    the updates have made of them depends on the order in which measurements came.
    """
    best, poses, weights = None, graph.poses, graph.weights
    for weight, widened in ((1.0, WIDENED), (FAINT, ())):
        _weigh(graph, *reweighing.all_alike(weight))
        result = solve_from_two_starts(graph, config, solve, closing=True)
        for factor in widened:
            if result.status is not Status.FAILED:
                _weigh(graph, *reweighing.all_changes(graph, factor))
                result = solve(graph, config)
        if result.status is not Status.FAILED:
            result = _reweighed(graph, reweighing, config, solve)
        failed = result.status is Status.FAILED
        if best is None or best.status is Status.FAILED or (
                not failed and result.chi2 < best.chi2 * (1.0 - SAME_MINIMUM)):
            best, poses, weights = result, graph.poses.copy(), graph.weights
    assert best is not None
    _weigh_all(graph, weights)
    graph.set_poses(poses)
    return best


def _reweighed(
    graph: Graph, reweighing: Reweighing, config: SolverConfig, solve: Solve,
) -> BatchResult:
    """Solve and reweigh in turn until the weights stay; chi2 of the result is the robust cost."""
    iterations, largest = 0, 1.0
    for _ in range(REWEIGHINGS):
        before = graph.weights
        _weigh(graph, *reweighing.all_changes(graph))
        largest = max(float(np.max(np.abs(new - old), initial=0.0))
                      for new, old in zip(graph.weights, before, strict=True))
        result = solve(graph, config)
        iterations += result.iterations
        if result.status is Status.FAILED or largest < SAME_WEIGHT:
            break
    if result.status is Status.FAILED:
        return result
    if largest >= SAME_WEIGHT:
        result = replace(result, status=Status.MAX_ITERATIONS)
    return replace(result, iterations=iterations, chi2=result.chi2 + reweighing.cost(graph))


def _weigh_all(graph: Graph, weights: tuple[FloatArray, FloatArray]) -> None:
    """Give all edges and observed nodes these weights, where they differ."""
    _weigh(graph, *(
        {int(row): float(wanted[row]) for row in np.flatnonzero(wanted != present)}
        for wanted, present in zip(weights, graph.weights, strict=True)))


def _weigh(graph: Graph, edges: Mapping[int, float], observed: Mapping[int, float]) -> None:
    graph.apply(GraphUpdate(weigh_edges=edges, weigh_observed=observed))
