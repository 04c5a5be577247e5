# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The way out when the iterations of a step lead nowhere: optimise a copy of the whole graph.

Gauss-Newton converges from a good estimate. A closure that contradicts it by radians, over a part
with little stiffness, can throw it off. That is rare and shows at once, so a step need not be
damped for it: what the batch optimiser finds, from the poses before the step and from none, is
better than any damped step, and costs as much as a few of them.
"""

from pose_graph_ros.core import batch
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.graph import Graph, GraphUpdate
from pose_graph_ros.core.se2 import FloatArray

_CONFIG = SolverConfig(max_iterations=50, step_tolerance=1e-6)


def optimized_poses(graph: Graph, poses: FloatArray) -> FloatArray | None:
    """
    Return the best poses that the batch optimiser finds for a graph, which stays as it is.

    Parameters
    ----------
    graph : Graph
    poses : ndarray, shape (N, 3)
        Where to start if the linear start leads to something worse.

    Returns
    -------
    ndarray, shape (N, 3)
        None if there is no solution.

    """
    copy = Graph()
    copy.apply(GraphUpdate(
        hidden=poses, edges=graph.edges, observed=graph.observed,
        fix=[int(node) for node in graph.fixed.nonzero()[0]]))
    result = batch.optimize_from_nothing(copy, _CONFIG)
    return None if result.status is Status.FAILED else copy.poses
