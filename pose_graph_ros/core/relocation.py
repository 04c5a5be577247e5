# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A robot that was moved without odometry: a new hidden node, with a loose edge to the last."""

from dataclasses import replace

import numpy as np

from pose_graph_ros.core.config import CovariancePolicy
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.measurements import Answer, GlobalPose, rejected
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.measurement_constraints import attach
from pose_graph_ros.core.sources.validation import validate

# Sigmas of the edge to the new node [m, m, rad]: the motion is unknown.
RELOCATION_SIGMA = (1000.0, 1000.0, 3.0)


def relocate(
    pose: GlobalPose, policy: CovariancePolicy, graph: Graph, nodes: HiddenNodes,
) -> GlobalPose | Answer:
    """
    Return the pose of a new hidden node after the newest odometry; or why there is none.

    Parameters
    ----------
    pose : GlobalPose, of the robot at a stamp that odometry covers
    policy : CovariancePolicy
    graph, nodes : Graph and HiddenNodes, to which the node is added

    """
    validated = validate(pose, policy)
    if isinstance(validated, Answer):
        return validated
    measurement, last_ns = validated.measurement, nodes.covered_ns
    begin, end = attach(nodes, pose.stamp_ns), attach(nodes, last_ns)
    if isinstance(begin, Answer) or isinstance(end, Answer) or not isinstance(
            measurement, GlobalPose):
        return rejected('no_odometry', 'none at that time')
    first, last, newest = graph.poses_of([begin.node, end.node, int(nodes.ids[-1])])
    moved = se2.between(se2.compose(first, begin.motion), se2.compose(last, end.motion))
    now = se2.compose(measurement.pose, moved)
    node = nodes.relocate(se2.between(newest, now), np.diag(RELOCATION_SIGMA) ** 2)
    if node < 0:
        return rejected('failed', 'the solver failed')
    return replace(measurement, stamp_ns=last_ns + 1, pose=now)
