# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The hidden nodes by stamp: those in the graph, and those that have left it for good."""

from typing import Annotated, NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Pose, Poses
from pose_graph_ros.core.graph.constraints import full, upper
from pose_graph_ros.core.odometry.motion import Attachment, OdometryErrors, Span
from pose_graph_ros.core.odometry.stream import SavedStream
from pose_graph_ros.core.quantities import StampsNs
from pose_graph_ros.core.saved_columns import Column, Integers, Rows3

# Nodes that have left although older ones stay: their numbers, ascending, those of nodes beside
# them, their poses in these, and the upper triangles of the covariances of these poses, in the
# frames of the nodes.
PLACES = np.dtype(
    [('numbers', 'i8'), ('anchors', 'i8'), ('relative', 'f8', 3), ('noise', 'f8', 6)])
THINNED = np.dtype([('anchors', 'i4'), ('relative', 'f4', 3), ('noise', 'f4', 6)])
IN_GRAPH = np.array((-1, np.zeros(3), np.zeros(6)), THINNED)


class SavedNodes(NamedTuple):
    """Saved hidden nodes, and the state of the odometry sources."""

    stamps_ns: Integers
    ids: Integers  # ascending
    odometry: Rows3  # poses by odometry alone of the nodes after the frozen ones
    # stamps after which a source is the primary one, and its name, in order
    leads: tuple[tuple[int, str], ...]
    lead_ns: int  # stamp up to which everything is settled
    base_ns: int  # stamp from which the motion to the next node is measured
    base: Pose  # pose of the primary source at `base_ns`
    # motion from the newest node to `base_ns`; None if that is the stamp of the node
    bridge: Span | None
    streams: dict[str, SavedStream]  # by the name of the source
    # poses of the first nodes, which have left the graph
    frozen: Rows3
    travelled: float  # path length up to the first node in the graph [m]
    thinned: Annotated[GrowingArray, Column(PLACES)]
    errors: OdometryErrors  # that the edges know of
    relocated: Integers  # numbers of the nodes at which the robot was put by hand

    def poses(self, node_ids: IntArray, poses: Poses) -> Poses:
        """Return the poses of all nodes."""
        table = NodeTable()
        table.fill(self)
        at = np.searchsorted(node_ids, self.ids[table.n_frozen:])
        return np.concatenate((self.frozen, table.placed(poses[np.minimum(at, len(poses) - 1)])))


class NodeTable:
    """
    Stamps and ids of all hidden nodes, in the order of time.

    The first `n_frozen` of them have left the graph: their poses do not change any more, but for
    motions of the whole map, and a node takes 40 bytes. The number of a node, such as 42 of x42,
    is its index among all of them, and never changes. Of the others, too, some may have left:
    their poses move with those of other nodes in the graph, their anchors, and what concerns them
    later is attached to these. If an anchor leaves as well, the nodes that were attached to it are
    passed on to its own anchor. All arrays are read-only views.
    """

    def __init__(self) -> None:
        self._stamps, self._ids = GrowingArray((), np.int64), GrowingArray((), np.int64)
        self._frozen, self._odometry = GrowingArray((3,), float), GrowingArray((3,), float)
        self._travelled = 0.0  # path length up to the first node that is not frozen [m]
        # of each node after the frozen ones, where it is if it has left; else the anchor is -1
        self._places, self.n_thinned = GrowingArray((), THINNED), 0

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> StampsNs:
        """Stamps of all nodes."""
        return self._stamps.read_only

    @property
    def ids(self) -> IntArray:
        """Ids of all nodes in the graph."""
        return self._ids.read_only

    @property
    def n_frozen(self) -> int:
        """Number of nodes that have left the graph: the first ones."""
        return len(self._frozen)

    @property
    def last_frozen_ns(self) -> int:
        """Stamp of the newest of these [ns]; -1 if there is none."""
        return int(self.stamps_ns[self.n_frozen - 1]) if self.n_frozen > 0 else -1

    @property
    def frozen(self) -> Poses:
        """Poses of the nodes that have left, in the map."""
        return self._frozen.read_only

    @property
    def odometry(self) -> Poses:
        """Poses of the nodes after the frozen ones by odometry alone."""
        return self._odometry.read_only

    @property
    def travelled(self) -> FloatArray:
        """Path lengths up to the nodes after the frozen ones [m]."""
        steps = np.diff(self.odometry[:, :2], axis=0)
        return np.cumsum(np.append(self._travelled, np.hypot(steps[:, 0], steps[:, 1])))

    def append(self, stamp_ns: int, node: int, odometry: se2.PoseVector) -> None:
        """Append a node."""
        self._stamps.append_one(stamp_ns)
        self._ids.append_one(node)
        self._odometry.append_one(odometry)
        self._places.append_one(IN_GRAPH)

    def freeze(self, poses: Poses) -> None:
        """Freeze the oldest nodes in the graph at the given poses."""
        self._travelled = float(self.travelled[len(poses)])
        self._frozen.append(poses)
        self.n_thinned -= int(np.count_nonzero(self._places['anchors'][:len(poses)] >= 0))
        self._odometry.drop_first(len(poses))
        self._places.drop_first(len(poses))

    def places(self) -> GrowingArray:
        """Return where the nodes are that have left but are not frozen, records of `PLACES`."""
        rows = np.flatnonzero(self._places['anchors'] >= 0)
        places = np.empty(len(rows), PLACES)
        places['numbers'] = rows + self.n_frozen
        places[['anchors', 'relative', 'noise']] = self._places.values[rows]
        return GrowingArray.of(places)

    def placed(self, present: Poses) -> Poses:
        """Return poses of the nodes that are not frozen, overwritten where one was thinned out."""
        if self.n_thinned > 0:
            thinned, first = self.places(), self.n_frozen
            present[thinned['numbers'] - first] = se2.compose(
                present[thinned['anchors'] - first], thinned['relative'])
        return present

    def attachment(self, number: int, mean: se2.PoseVector, noise: se2.Covariance) -> Attachment:
        """Return the attachment of a motion from a node, or from the one that stands for it."""
        anchor, there, spread = self._places.values[number - self.n_frozen]
        if anchor >= 0:
            there, spread = there.astype(float), full(spread[None].astype(float))[0]
            number, (mean, noise) = int(anchor), Span(there, spread).continued(mean, noise)
        return Attachment(int(self.ids[number]), mean, noise)

    def has_left(self, number: int) -> bool:
        """Return whether a node has left the graph, by its number."""
        row = number - self.n_frozen
        return row < 0 or bool(self._places['anchors'][row] >= 0)

    def thin(self, ids: IntArray, anchors: IntArray, relative: Poses,
             noise: se2.Covariances) -> None:
        """Let nodes leave, each with its place, and its noise, relative to a node that stays."""
        numbers, anchors = np.searchsorted(self.ids, (ids, anchors))
        rows, table = numbers - self.n_frozen, self._places.values
        table['anchors'][rows], table['relative'][rows] = anchors, relative
        table['noise'][rows] = upper(noise)
        self.n_thinned += len(rows)
        passed = np.flatnonzero(np.isin(table['anchors'], numbers))
        own, before = table[passed], table[table['anchors'][passed] - self.n_frozen]
        first, then = (Span(each['relative'].astype(float), full(each['noise'].astype(float)))
                       for each in (before, own))
        both = first.continued(*then)
        table['relative'][passed], table['noise'][passed] = both.mean, upper(both.covariance)
        table['anchors'][passed] = before['anchors']

    def move_frozen(self, T: se2.PoseVector) -> None:
        """Move the frozen poses by a rigid motion of the map."""
        if self.n_frozen > 0:
            self._frozen.values[:] = se2.compose(T, self._frozen.values)

    def fill(self, saved: SavedNodes) -> None:
        """Fill this empty table."""
        self._stamps, self._ids, self._odometry, self._frozen = map(
            GrowingArray.of, (saved.stamps_ns, saved.ids, saved.odometry, saved.frozen))
        self._travelled, self.n_thinned = saved.travelled, len(saved.thinned)
        self._places.append(np.full(len(saved.odometry), IN_GRAPH))
        self._places.values[saved.thinned['numbers'] - self.n_frozen] = saved.thinned.values[
            ['anchors', 'relative', 'noise']]
