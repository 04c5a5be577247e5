# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The hidden nodes by stamp: those in the graph, and those that have left it for good."""

import math

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.odometry.thinned_nodes import ThinnedNodes


class NodeTable:
    """
    Stamps and ids of all hidden nodes, in the order of time.

    The first `n_frozen` of them have left the graph: their poses do not change any more, but for
    motions of the whole map, and a node takes 40 bytes. The number of a node, such as 42 of x42,
    is its index among all of them, and never changes. Of the others, too, some may have left
    (`thinned`); their poses move with those of other nodes.
    """

    def __init__(self) -> None:
        self._stamps = GrowingArray((), np.int64)
        self._ids = GrowingArray((), np.int64)
        self._frozen = GrowingArray((3,), np.float64)
        self._odometry = GrowingArray((3,), np.float64)
        self._travelled = GrowingArray((), np.float64)
        self.thinned = ThinnedNodes()
        """Nodes that have left although older ones stay; by number."""

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> IntArray:
        """Stamps of all nodes [ns], shape (N,), a read-only view."""
        return self._stamps.read_only

    @property
    def ids(self) -> IntArray:
        """Ids of all nodes in the graph, shape (N,), a read-only view."""
        return self._ids.read_only

    @property
    def n_frozen(self) -> int:
        """Number of nodes that have left the graph."""
        return len(self._frozen)

    @property
    def frozen(self) -> FloatArray:
        """Poses of the nodes that have left, in the map, shape (F, 3), a read-only view."""
        return self._frozen.read_only

    @property
    def odometry(self) -> FloatArray:
        """Poses of the nodes in the graph by odometry alone, shape (N - F, 3), read-only."""
        return self._odometry.read_only

    @property
    def travelled(self) -> FloatArray:
        """Path lengths up to the nodes in the graph, shape (N - F,) [m], read-only."""
        return self._travelled.read_only

    def append(self, stamp_ns: int, node: int, odometry: FloatArray) -> None:
        """
        Append a node.

        Parameters
        ----------
        node : int, its id in the graph
        odometry : ndarray, shape (3,), its pose by odometry alone [m, m, rad]

        """
        travelled = 0.0
        if len(self._odometry) > 0:
            step = odometry - self._odometry.values[-1]
            travelled = float(self._travelled.values[-1]) + math.hypot(step[0], step[1])
        self._stamps.append_one(stamp_ns)
        self._ids.append_one(node)
        self._odometry.append_one(odometry)
        self._travelled.append_one(travelled)

    def freeze(self, poses: FloatArray) -> None:
        """Freeze the oldest nodes in the graph at the given poses, shape (M, 3)."""
        self._frozen.append(poses)
        self._odometry.drop_first(len(poses))
        self._travelled.drop_first(len(poses))
        self.thinned.drop_before(self.n_frozen)

    def poses(self, present: FloatArray) -> FloatArray:
        """Return the poses of all nodes, shape (N, 3); `present` as for `recent_poses`."""
        recent = self.recent_poses(present)
        return recent if self.n_frozen == 0 else np.concatenate((self.frozen, recent))

    def recent_poses(self, present: FloatArray) -> FloatArray:
        """
        Return the poses of the nodes that are not frozen, shape (N - F, 3) [m, m, rad].

        They are given, but overwritten where a node was thinned out.
        """
        if len(self.thinned) > 0:
            thinned, first = self.thinned.places(), self.n_frozen
            present[thinned.numbers - first] = se2.compose(
                present[thinned.anchors - first], thinned.relative.astype(np.float64))
        return present

    def attachment(self, number: int, mean: FloatArray, noise: FloatArray) -> Attachment:
        """
        Return the attachment of a motion from a node, or from the one that stands for it.

        Parameters
        ----------
        number : int, of the node
        mean : ndarray, shape (3,), the motion [m, m, rad]
        noise : ndarray, shape (3, 3), its covariance, in the frame at its end

        """
        place = self.thinned.place(number)
        if place is None:
            return Attachment(int(self.ids[number]), mean, noise)
        adjoint = se2.adjoint(se2.inverse(mean))
        return Attachment(int(self.ids[place.anchor]), se2.compose(place.mean, mean),
                          adjoint @ place.noise @ adjoint.T + noise)

    def has_left(self, number: int) -> bool:
        """Return whether a node has left the graph, by its number."""
        return number < self.n_frozen or self.thinned.place(number) is not None

    def thin(
        self, ids: IntArray, anchors: IntArray, relative: FloatArray, noise: FloatArray,
    ) -> None:
        """
        Let nodes leave, each with its place relative to a node that stays.

        Parameters
        ----------
        ids, anchors : ndarray of int, shape (L,), of nodes that leave and of those that stay
        relative : ndarray, shape (L, 3), poses in the anchors [m, m, rad]
        noise : ndarray, shape (L, 3, 3), covariances of these, in the frames of the nodes

        """
        self.thinned.add(
            np.searchsorted(self.ids, ids), np.searchsorted(self.ids, anchors), relative, noise)

    def move_frozen(self, T: FloatArray) -> None:
        """Move the frozen poses by a rigid motion of the map, shape (3,) [m, m, rad]."""
        if self.n_frozen > 0:
            self._frozen.values[:] = se2.compose(T, self._frozen.values)

    def set_frozen(self, poses: FloatArray) -> None:
        """Set the frozen poses, shape (F, 3), to what they were before a motion."""
        self._frozen.values[:] = poses

    def restore(
        self, stamps_ns: IntArray, ids: IntArray, odometry: FloatArray, frozen: FloatArray,
        travelled: float,
    ) -> None:
        """
        Fill this empty table.

        Parameters
        ----------
        stamps_ns, ids : ndarray of int64, shape (N,)
        odometry : ndarray, shape (N - F, 3), of the nodes in the graph
        frozen : ndarray, shape (F, 3), poses of the others
        travelled : float, path length up to the first node in the graph [m]

        """
        self._stamps.append(stamps_ns)
        self._ids.append(ids)
        self._odometry.append(odometry)
        self._frozen.append(frozen)
        steps = np.diff(odometry[:, :2], axis=0)
        lengths = [math.hypot(x, y) for x, y in steps.tolist()]
        self._travelled.append(np.cumsum([travelled, *lengths]))
