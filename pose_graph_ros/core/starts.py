# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Optimise from two starts: the present estimate and, where that may be a bad one, a linear start.

After a long time without a position the heading may have drifted far. Gauss-Newton from there can
wind it the wrong way round, and it shows by not converging soon.
"""

from collections.abc import Callable

from pose_graph_ros.core.batch import BatchResult, Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.graph import Graph

# Two optima whose chi2 differs by less than this fraction are one.
SAME_MINIMUM = 1e-9

Solve = Callable[[Graph, SolverConfig], BatchResult]


def solve_from_two_starts(
    graph: Graph, config: SolverConfig, solve: Solve, *, closing: bool,
) -> BatchResult:
    """
    Optimise a graph in place and keep the lower of the minima that are found.

    Parameters
    ----------
    graph : Graph
    config : SolverConfig
    solve : callable
        Optimises a graph in place.
    closing : bool
        Try both starts in any case, so that the result does not depend on the updates before.

    """
    before = graph.poses.copy()
    result = solve(graph, config)
    unsure = result.status in (Status.MAX_ITERATIONS, Status.STALLED)
    if len(graph.observed) == 0 or not (unsure or closing):
        return result
    poses = graph.poses.copy()
    from pose_graph_ros.core.joint_start import joint  # noqa: PLC0415  (it needs SciPy)

    try:
        graph.set_poses(joint(graph))
        other = solve(graph, config)
    except LinearSolveError:
        other = None
    if (other is None or other.status is Status.FAILED
            or not other.chi2 < result.chi2 * (1.0 - SAME_MINIMUM)):
        graph.set_poses(before if result.status is Status.FAILED else poses)
        return result
    return other
