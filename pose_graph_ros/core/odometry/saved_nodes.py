# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hidden nodes as columns of saved graphs."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pose_graph_ros.core.geometry.scalar_se2 import Pose
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.odometry.node_table import NodeTable
from pose_graph_ros.core.odometry.saved_stream import SavedStream
from pose_graph_ros.core.odometry.thinned_nodes import SavedThinned
from pose_graph_ros.core.saved_columns import Integers, Matrix, Numbers, Rows3


@dataclass(frozen=True, slots=True)
class SavedSpan:
    """Saved motion from the newest node to the first stamp of a new primary source."""

    mean: Pose
    covariance: Matrix
    """In the frame at its end."""


@dataclass(frozen=True, slots=True)
class SavedNodes:
    """Saved hidden nodes, and the state of the odometry sources."""

    stamps_ns: Integers
    """Shape (H,) [ns]."""
    ids: Integers
    """Ids of the nodes, ascending, shape (H,)."""
    odometry: Rows3
    """Poses by odometry alone of the nodes after the frozen ones, shape (H - F, 3)."""
    leads: tuple[str, ...]
    """Primary sources one after the other, P of them."""
    leads_after_ns: Integers
    """Stamps after which each of them is the primary source, shape (P,) [ns]."""
    lead_ns: int
    """Stamp up to which everything is settled [ns]."""
    base_ns: int
    """Stamp from which the motion to the next node is measured [ns]."""
    base: Pose
    """Pose of the primary source at `base_ns`."""
    bridge: SavedSpan | None
    """Motion from the newest node to `base_ns`; None if that is the stamp of the node."""
    streams: Mapping[str, SavedStream]
    """By the name of the source."""
    frozen: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    """Poses of the first nodes, which have left the graph, shape (F, 3) [m, m, rad]."""
    travelled: float = 0.0
    """Path length up to the first node in the graph [m]."""
    thinned: SavedThinned = field(default_factory=SavedThinned)
    """Nodes that have left although older ones stay."""

    errors: Numbers = field(default_factory=lambda: np.empty(0))
    """
    `OdometryErrors` that the edges know of. Empty in files of older versions, in which weights of
    the edges stand for them.
    """

    relocated: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Numbers of the nodes at which the robot was put by hand; empty in older files."""

    def poses(self, node_ids: IntArray, poses: FloatArray) -> FloatArray:
        """
        Return the poses of all nodes, shape (H, 3) [m, m, rad].

        Parameters
        ----------
        node_ids : ndarray of int, shape (N,), ids of the nodes in the graph, ascending
        poses : ndarray, shape (N, 3), their poses

        """
        table = NodeTable()
        self.fill(table)
        at = np.searchsorted(node_ids, self.ids[table.n_frozen:])
        return table.poses(poses[np.minimum(at, len(poses) - 1)])

    def fill(self, table: NodeTable) -> None:
        """Fill an empty table."""
        table.restore(self.stamps_ns, self.ids, self.odometry, self.frozen, self.travelled)
        table.thinned.restore(self.thinned, table.n_frozen)
