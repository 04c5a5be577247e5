# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A graph of poses and edges alone as arrays, for tools that run once; `plain_optimizer` solves it.

It reads like a `Graph` as far as such a tool asks, and nothing in it is compiled.
"""

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import are_definite, Edges, ObservedNodes
from pose_graph_ros.core.graph.graph_update import Energies, GraphRows
from pose_graph_ros.core.graph.kinds import EdgeKind, NodeKind
from pose_graph_ros.core.sparse.components import components


class PlainGraph:
    """
    A graph of poses and edges between them.

    Parameters
    ----------
    rows : GraphRows, for which `is_covered`

    """

    def __init__(self, rows: GraphRows) -> None:
        self._rows = rows
        self.poses = rows.poses.copy()
        """Of the hidden nodes in the map, shape (N, 3) [m, m, rad]."""
        self.fixed: BoolArray = rows.fixed.copy()
        """Whether hidden nodes keep their pose, shape (N,)."""
        self.edges = self.edges_by_row = rows.edges
        """All edges; ids are rows."""
        self.observed = self.observed_by_row = ObservedNodes()
        """There are none."""
        self.n_nodes, self.n_priors = len(rows.poses), 0
        self.node_kind: npt.NDArray[np.uint8] = np.zeros(self.n_nodes, dtype=np.uint8)

    @classmethod
    def is_covered(cls, rows: GraphRows) -> bool:
        """
        Tell whether a graph has nothing but poses and edges between them, all with weight 1.

        Each edge has to measure all coordinates. Otherwise a pose may not be determined, and the
        factors of H, without pivoting, need not show that it is singular.
        """
        return (len(rows.observed) == len(rows.priors) == 0
                and bool(np.all(rows.node_kind == NodeKind.POSE))
                and bool(np.all(rows.edges.kind <= EdgeKind.LOOP_CLOSURE))
                and bool(np.all(rows.edges.weight == 1.0))
                and bool(np.all(are_definite(rows.edges.information)))
                and np.array_equal(rows.node_ids, np.arange(len(rows.poses))))

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses, shape (N,)."""
        return np.ones(self.n_nodes, dtype=bool)

    def set_poses(self, poses: FloatArray) -> None:
        """Set the poses of all hidden nodes, shape (N, 3) [m, m, rad]."""
        self.poses = se2.wrapped(poses)

    def hold_parts(self) -> list[int]:
        """Fix the first node of each part without a fixed one; return these nodes."""
        part = components(self.edges.i, self.edges.j, self.n_nodes)
        is_held = np.zeros(self.n_nodes, dtype=bool)
        is_held[part[self.fixed]] = True
        held = np.flatnonzero((part == np.arange(self.n_nodes)) & ~is_held)
        self.fixed[held] = True
        return [*map(int, held)]

    def edges_at(self, rows: IntArray) -> Edges:
        """Return some of the edges."""
        return self.edges.rows(rows)

    def energies(self) -> Energies:
        """Return the energies of all edges."""
        # what overflows is infinite
        with np.errstate(over='ignore', invalid='ignore'):
            error = errors(self.poses, self.edges)
            return self._energies(error)

    def _energies(self, error: FloatArray) -> Energies:
        return Energies(np.einsum('mi,mij,mj->m', error, self.edges.information, error),
                        np.empty(0), np.empty(0))

    def rows(self) -> GraphRows:
        """Return the graph with the present poses."""
        return self._rows._replace(poses=self.poses.copy(), fixed=self.fixed.copy())


def errors(poses: FloatArray, edges: Edges) -> FloatArray:
    """
    Return the errors (3.48) of edges, shape (M, 3) [m, m, rad].

    Parameters
    ----------
    poses : ndarray, shape (N, 3), by row [m, m, rad]
    edges : Edges

    """
    return linearized(poses, edges)[0]


def linearized(poses: FloatArray, edges: Edges) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return the errors (3.48) of edges, shape (M, 3), and their Jacobians by both ends, (M, 3, 3).

    With R the rotation by th_i + th_z and d = t_j - t_i, e_t = R^T d - R_z^T t_z. Its derivative
    by t_j is R^T, by t_i -R^T, and by th_i that of R^T d, (y, -x) if that is (x, y).

    Parameters
    ----------
    poses : ndarray, shape (N, 3), by row [m, m, rad]
    edges : Edges

    """
    start, mean = poses[edges.i], edges.mean
    difference = poses[edges.j] - start
    heading = start[:, 2] + mean[:, 2]
    c, s = np.cos(heading), np.sin(heading)
    own_c, own_s = np.cos(mean[:, 2]), np.sin(mean[:, 2])
    x = c * difference[:, 0] + s * difference[:, 1]
    y = c * difference[:, 1] - s * difference[:, 0]
    error = np.stack((
        x - (own_c * mean[:, 0] + own_s * mean[:, 1]),
        y - (own_c * mean[:, 1] - own_s * mean[:, 0]),
        se2.wrap(difference[:, 2] - mean[:, 2])), axis=1)
    by_j = np.zeros((len(c), 3, 3))
    by_j[:, 0, 0], by_j[:, 0, 1], by_j[:, 1, 0], by_j[:, 1, 1] = c, s, -s, c
    by_j[:, 2, 2] = 1.0
    by_i = -by_j
    by_i[:, 0, 2], by_i[:, 1, 2] = y, -x
    return error, by_i, by_j
