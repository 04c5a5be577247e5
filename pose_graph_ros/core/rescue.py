# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The way out when the iterations of a step lead nowhere: optimise a copy of the whole graph.

Gauss-Newton converges from a good estimate. A closure that contradicts it by radians, over a part
with little stiffness, can throw it off. That is rare and shows at once, so a step need not be
damped for it: what the batch optimiser finds, from the poses before the step and from none, is
better than any damped step, and costs as much as a few of them.
"""

import numpy as np

from pose_graph_ros.core import batch, undo
from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.graph import Graph

_CONFIG = SolverConfig(max_iterations=50, step_tolerance=1e-6)


def optimize_copy(graph: Graph, copy: Graph) -> bool:
    """
    Copy a graph whose iterations lead nowhere into an empty one, and optimise that.

    Parameters
    ----------
    graph : Graph
        In the middle of an update; stays as it is.
    copy : Graph
        Everything in it will be eliminated anew at the next step.

    Returns
    -------
    bool
        Whether there is a solution.

    """
    poses = np.empty((graph.n_nodes, 3))
    # where to start if the linear start leads to something worse
    undo.poses_before(graph.memory.head, poses)
    copy.take_over(graph, poses)
    if batch.optimize_from_nothing(copy, _CONFIG).status is Status.FAILED:
        return False
    copy.set_poses(copy.poses)
    return True
