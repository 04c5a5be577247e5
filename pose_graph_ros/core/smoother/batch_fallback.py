# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation of a copy of the graph, for a step whose iterations diverge.

Gauss-Newton converges from a good estimate. A loop closure that contradicts the estimate by
radians, over a part of the graph with little information, can make it diverge. That is rare and
detected at once, so steps are not damped. The batch optimiser begins at a linear start, and begins
again at the poses before the step if the result has a higher chi2 than these. The minimum that it
finds is better than the result of a damped step, at the cost of a few steps.
"""

import numpy as np

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Start, Status
from pose_graph_ros.core.graph import transaction_log
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.solver_config import SolverConfig

_CONFIG = SolverConfig(max_iterations=50, step_tolerance=1e-6)
# Unit headings take longer than an update may.
_STARTS = (Start.CHORDAL, Start.JOINT, Start.PRESENT)


def optimize_copy(graph: Graph, copy: Graph) -> bool:
    """
    Return whether the batch optimiser finds a solution for a copy of the graph.

    Parameters
    ----------
    graph : Graph, in the middle of an update; not changed
    copy : Graph, empty; afterwards all its nodes are touched, to be eliminated at the next step

    """
    poses = np.empty((graph.n_nodes, 3))
    # the start if the linear start leads to a higher chi2
    transaction_log.poses_before(graph.memory.head, poses)
    copy.fill(graph.rows()._replace(poses=poses))
    copy.apply(graph.leaving())
    if optimizer.optimize_from_linear_start(copy, _CONFIG, _STARTS).status is Status.FAILED:
        return False
    copy.set_poses(copy.poses)
    return True
