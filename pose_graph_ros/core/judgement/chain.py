# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The chain of odometry edges of a graph, with the noise of the motion between any two nodes."""

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph

# Sigma of the motion to a node that no odometry edge leads to from the one before [m], [rad].
UNKNOWN_MOTION = (1e4, 1e4, 10.0)
# Added to informations, which may be singular: a sigma of 30 km.
LEAST_INFORMATION = 1e-9


class OdometryChain:
    """
    Poses of the hidden nodes by odometry alone, and prefix sums of its noise.

    The edge of a node is the first odometry edge from the node before it: those of further sources
    come later.
    """

    def __init__(self) -> None:
        self._poses = GrowingArray((3,), np.float64)
        self._sums = GrowingArray((3, 3), np.float64)
        self._travel = GrowingArray((), np.float64)
        self._rows = GrowingArray((), np.int64)
        self._position = GrowingArray((), np.int64)
        """Of each row of the node table, -1 for biases."""
        self._n_edges = 0

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> FloatArray:
        """Poses by odometry alone, from the first node, shape (N, 3); headings are not wrapped."""
        return self._poses.values

    @property
    def sums(self) -> FloatArray:
        """Prefix sums of the noise in the frame of the first node, shape (N, 3, 3)."""
        return self._sums.values

    @property
    def travel(self) -> FloatArray:
        """Length of the path up to each node, shape (N,) [m]."""
        return self._travel.values

    def positions(self, rows: IntArray) -> IntArray:
        """Return the places in the chain of hidden nodes, by their rows in the graph."""
        return self._position.values[rows]

    def extend(self, graph: Graph) -> None:
        """Add the nodes and edges that the graph has got since the last call."""
        n_before, n_nodes, n_edges = len(self._position), graph.n_nodes, graph.n_edges
        if n_before == n_nodes:
            # edges between nodes that are known are no part of the chain
            self._n_edges = n_edges
            return
        is_pose = graph.memory['node_i'][n_before:n_nodes, tb.IS_BIAS] == 0
        new = n_before + np.flatnonzero(is_pose)
        places = np.full(n_nodes - n_before, -1, dtype=np.int64)
        places[is_pose] = len(self._rows) + np.arange(len(new))
        self._position.append(places)
        first = len(self._rows)
        self._rows.append(new)
        if len(new) > 0:
            self._append(graph, first, *self._edges_to(graph, first, len(new)))
        self._n_edges = n_edges

    def _edges_to(self, graph: Graph, first: int, n: int) -> tuple[FloatArray, FloatArray]:
        """Return motion and covariance from the node before to each of n new nodes."""
        means, covariances = np.zeros((n, 3)), np.zeros((n, 3, 3))
        covariances[:] = np.diag(np.square(UNKNOWN_MOTION))
        edges = graph.edges_at(slice(self._n_edges, graph.n_edges))
        odometry = np.flatnonzero(edges.kind == EdgeKind.ODOMETRY)
        ends = self._position.values[edges.j[odometry]]
        chosen = (ends >= max(first, 1)) & (
            self._position.values[edges.i[odometry]] == ends - 1)
        # the first one of those to a node
        ends, which = np.unique(ends[chosen], return_index=True)
        chosen = odometry[chosen][which]
        means[ends - first] = edges.mean[chosen]
        covariances[ends - first] = np.linalg.inv(
            edges.information[chosen] + LEAST_INFORMATION * np.eye(3))
        return means, covariances

    def _append(self, graph: Graph, first: int, means: FloatArray, noise: FloatArray) -> None:
        start, total, travelled = np.zeros(3), np.zeros((3, 3)), 0.0
        if first > 0:
            start, total, travelled = (
                self.poses[-1], self.sums[-1], float(self.travel[-1]))
        else:
            means, noise = means.copy(), noise.copy()
            means[0], noise[0] = 0.0, 0.0
        poses = np.empty_like(means)
        poses[:, 2] = start[2] + np.cumsum(means[:, 2])
        before = np.concatenate(([start[2]], poses[:-1, 2]))
        c, s = np.cos(before), np.sin(before)
        poses[:, 0] = start[0] + np.cumsum(c * means[:, 0] - s * means[:, 1])
        poses[:, 1] = start[1] + np.cumsum(s * means[:, 0] + c * means[:, 1])
        turn = se2.adjoint(poses)
        self._poses.append(poses)
        self._sums.append(total + np.cumsum(turn @ noise @ turn.transpose(0, 2, 1), axis=0))
        self._travel.append(travelled + np.cumsum(np.hypot(means[:, 0], means[:, 1])))
