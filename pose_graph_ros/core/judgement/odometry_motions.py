# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The motions that odometry has measured, from node to node, and where a jump is among them."""

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.odometry_chain import integrated, OdometryChain
from pose_graph_ros.core.solver_config import CLOSURE_FLOORS

# Sigmas of the motion over a jump, which the closures over it determine [m, m, rad].
SIGMAS = 2.0 * np.array(CLOSURE_FLOORS)


class Odometry:
    """The chain of odometry of a graph, with its edges; nodes and edges are given by row."""

    def __init__(self, graph: Graph) -> None:
        self.chain = OdometryChain(by_row=True)
        self.chain.extend(graph)
        self.nodes = self.chain.nodes
        ends, n = graph.memory['edge_i'][:graph.n_edges], max(len(self.nodes) - 1, 0)
        rows = np.flatnonzero(ends[:, tb.EDGE_KIND] == EdgeKind.ODOMETRY)
        at = self.places(ends[rows, tb.END_J])
        is_chained = (at > 0) & (self.nodes[np.maximum(at, 1) - 1] == ends[rows, tb.END_I])
        self.rows = np.full(n, -1)
        self.rows[at[is_chained][::-1] - 1] = rows[is_chained][::-1]
        if np.any(self.rows < 0):   # an edge was removed: a chain with a gap is none
            self.nodes, self.rows = self.nodes[:1], self.rows[:0]
        self.motions = graph.memory['edge_f'][self.rows, tb.MEAN:tb.MEAN + 3]
        self.poses = integrated(self.motions)

    def places(self, nodes: IntArray) -> IntArray:
        """Return the places of nodes in the chain, -1 for those that are not in it."""
        at = np.minimum(np.searchsorted(self.nodes, nodes), max(len(self.nodes) - 1, 0))
        return np.where(self.nodes[at] == nodes, at, -1) if len(self.nodes) > 0 else at - 1

    def motion_at(self, at: IntArray, first: int, last: int, total: FloatArray) -> FloatArray:
        """
        Return the motions along edges of which one must be wrong, shape (K, 3).

        Parameters
        ----------
        at : ndarray of int, shape (K,), places that the edges begin at
        first, last : int, places between which they are
        total : ndarray, shape (3,), pose of the last place in the first one

        """
        before = se2.between(self.poses[[first]], self.poses[at])
        after = se2.between(self.poses[at + 1], self.poses[[last]])
        return se2.compose(se2.inverse(before), se2.compose(total[None], se2.inverse(after)))

    def smallest_jump(
        self, begin: int, end: int, first: int, last: int, total: FloatArray,
    ) -> tuple[int, FloatArray]:
        """
        Return where between two places the jump is the smallest, and the motion there.

        Parameters
        ----------
        begin, end : int
        first, last, total : as in `motion_at`

        """
        at = np.arange(begin, end)
        motions = self.motion_at(at, first, last, total)
        sizes = np.sum((se2.between(self.motions[at], motions) / SIGMAS)**2, axis=1)
        k = int(np.argmin(np.round(sizes, 6)))
        return begin + k, motions[k]
