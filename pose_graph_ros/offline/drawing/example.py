# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A pose graph that grows in five steps, as in Figure 3.10 of the thesis."""

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate

_MOTION = np.array((2.0, 0.0, 0.0))
_START = np.zeros(3)


def five_states() -> list[tuple[str, GraphRows]]:
    """Return the graph after each of five updates, with what is new in it."""
    poses = [_START]
    for _ in range(4):
        poses.append(se2.compose(poses[-1], _MOTION))
    return _after_each(
        ('a) a hidden node x0 and an observed node z0', _step(poses[:1], [0])),
        ('b) another observed node on x0: same pattern, other values', _step([], [0])),
        ('c) a node x1 and an edge: two by two blocks', _step(poses[1:2], [], [0])),
        ('d) an observed node on x1: same pattern', _step([], [1])),
        ('e) a chain: block-tridiagonal', _step(poses[2:], [3], [1, 2, 3])))


def _step(poses: list[np.ndarray], observed: list[int], edges: list[int] | None = None,
          ) -> GraphUpdate:
    """Return an update with hidden nodes, observed ones on nodes, and edges from nodes."""
    i = edges or []
    return GraphUpdate(
        hidden=np.array(poses).reshape(-1, 3),
        edges=Edges(i, [each + 1 for each in i], np.tile(_MOTION, (len(i), 1)),
                    np.tile(np.eye(3), (len(i), 1, 1)), [EdgeKind.ODOMETRY] * len(i)),
        observed=ObservedNodes(
            observed, mean=np.zeros((len(observed), 3)),
            information=np.tile(np.eye(3), (len(observed), 1, 1)),
            kind=[ObservedKind.GLOBAL_POSE] * len(observed)))


def _after_each(*steps: tuple[str, GraphUpdate]) -> list[tuple[str, GraphRows]]:
    graph, states = Graph(), []
    for title, update in steps:
        graph.apply(update)
        states.append((title, graph.rows()))
    return states
