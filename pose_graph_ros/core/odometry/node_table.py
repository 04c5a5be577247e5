# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The hidden nodes by stamp: those in the graph, and those that have left it for good."""

from typing import Annotated, NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Pose, Poses
from pose_graph_ros.core.graph.constraints import full, upper
from pose_graph_ros.core.odometry.motion import Attachment, Span
from pose_graph_ros.core.odometry.stream import SavedStream
from pose_graph_ros.core.quantities import StampsNs
from pose_graph_ros.core.saved_columns import Integers, Numbers, Records, Rows3

# Nodes that have left although older ones stay: their numbers, ascending, those of nodes beside
# them, their poses in these, and the upper triangles of the covariances of these poses, in the
# frames of the nodes.
PLACES = np.dtype(
    [('numbers', 'i8'), ('anchors', 'i8'), ('relative', 'f8', 3), ('noise', 'f8', 6)])
THINNED = np.dtype([('anchors', 'i4'), ('relative', 'f4', 3), ('noise', 'f4', 6)])


class ThinnedNodes:
    """
    Nodes by number, each with its place relative to another one in the graph, its anchor.

    The poses of these nodes move with the graph, and what concerns them later is attached to their
    anchors. If an anchor leaves as well, the nodes that were attached to it are passed on to its
    own anchor. A node takes 40 bytes, and a group of nodes a time that hardly grows with them.
    """

    def __init__(self, first: int = 0) -> None:
        # by number, from the first node that is not frozen on; -1 for nodes that are in the graph
        self._first, self._size = first, 0
        self._rows = GrowingArray((), THINNED)

    def __len__(self) -> int:
        return self._size

    def add(self, numbers: IntArray, anchors: IntArray, relative: Poses,
            noise: se2.Covariances) -> None:
        """Add nodes; none of the anchors is among these, or has left before."""
        if len(numbers) == 0:
            return
        rows = numbers - self._first
        more = int(np.max(rows)) + 1 - len(self._rows)
        if more > 0:
            self._rows.append(np.zeros(more, THINNED))
            self._rows['anchors'][-more:] = -1
        table = self._rows.values
        table['anchors'][rows], table['relative'][rows] = anchors, relative
        table['noise'][rows] = upper(noise)
        self._size += len(rows)
        passed = np.flatnonzero(np.isin(table['anchors'], numbers))
        own, before = table[passed], table[table['anchors'][passed] - self._first]
        first, then = (Span(each['relative'].astype(float), full(each['noise'].astype(float)))
                       for each in (before, own))
        both = first.continued(*then)
        table['relative'][passed], table['noise'][passed] = both.mean, upper(both.covariance)
        table['anchors'][passed] = before['anchors']

    def place(self, number: int) -> tuple[int, Span] | None:
        """Return the anchor of a node, by number, and the motion from there; None without."""
        row = number - self._first
        if not 0 <= row < len(self._rows) or self._rows['anchors'][row] < 0:
            return None
        anchor, mean, noise = self._rows.values[row]
        return int(anchor), Span(mean.astype(float), full(noise[None].astype(float))[0])

    def places(self) -> GrowingArray:
        """Return the places of all nodes, records of `PLACES`."""
        rows = np.flatnonzero(self._rows['anchors'] >= 0)
        places = np.empty(len(rows), PLACES)
        places['numbers'] = rows + self._first
        places[['anchors', 'relative', 'noise']] = self._rows.values[rows]
        return GrowingArray.of(places)

    def drop_before(self, number: int) -> None:
        """
        Drop the nodes before a number, whose poses are frozen with those of the oldest nodes.

        The anchors of the others must not be before it.
        """
        n = min(number - self._first, len(self._rows))
        self._size -= int(np.count_nonzero(self._rows['anchors'][:n] >= 0))
        self._rows.drop_first(n)
        self._first = number


class SavedNodes(NamedTuple):
    """Saved hidden nodes, and the state of the odometry sources."""

    stamps_ns: Integers
    ids: Integers  # ascending
    odometry: Rows3  # poses by odometry alone of the nodes after the frozen ones
    leads: tuple[str, ...]  # primary sources one after the other
    leads_after_ns: Integers  # stamps after which each of them is the primary source
    lead_ns: int  # stamp up to which everything is settled
    base_ns: int  # stamp from which the motion to the next node is measured
    base: Pose  # pose of the primary source at `base_ns`
    # motion from the newest node to `base_ns`; None if that is the stamp of the node
    bridge: Span | None
    streams: dict[str, SavedStream]  # by the name of the source
    # poses of the first nodes, which have left the graph
    frozen: Rows3 = np.empty((0, 3))
    travelled: float = 0.0  # path length up to the first node in the graph [m]
    thinned: Annotated[GrowingArray, Records(PLACES)] = GrowingArray((), PLACES)
    # `OdometryErrors` that the edges know of; empty in files of older versions, in which weights
    # of the edges stand for them
    errors: Numbers = np.empty(0)
    # numbers of the nodes at which the robot was put by hand; empty in older files
    relocated: Integers = np.empty(0, np.int64)

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
    is its index among all of them, and never changes. Of the others, too, some may have left
    (`thinned`); their poses move with those of other nodes. All arrays are read-only views.
    """

    def __init__(self) -> None:
        self._stamps, self._ids = GrowingArray((), np.int64), GrowingArray((), np.int64)
        self._frozen, self._odometry = GrowingArray((3,), float), GrowingArray((3,), float)
        self._travelled = 0.0  # path length up to the first node that is not frozen [m]
        self.thinned = ThinnedNodes()

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

    def freeze(self, poses: Poses) -> None:
        """Freeze the oldest nodes in the graph at the given poses."""
        self._travelled = float(self.travelled[len(poses)])
        self._frozen.append(poses)
        self._odometry.drop_first(len(poses))
        self.thinned.drop_before(self.n_frozen)

    def placed(self, present: Poses) -> Poses:
        """Return poses of the nodes that are not frozen, overwritten where one was thinned out."""
        if len(self.thinned) > 0:
            thinned, first = self.thinned.places(), self.n_frozen
            present[thinned['numbers'] - first] = se2.compose(
                present[thinned['anchors'] - first], thinned['relative'])
        return present

    def attachment(self, number: int, mean: se2.PoseVector, noise: se2.Covariance) -> Attachment:
        """Return the attachment of a motion from a node, or from the one that stands for it."""
        if (place := self.thinned.place(number)) is not None:
            number, (mean, noise) = place[0], place[1].continued(mean, noise)
        return Attachment(int(self.ids[number]), mean, noise)

    def has_left(self, number: int) -> bool:
        """Return whether a node has left the graph, by its number."""
        return number < self.n_frozen or self.thinned.place(number) is not None

    def thin(self, ids: IntArray, anchors: IntArray, *places: FloatArray) -> None:
        """Let nodes leave, each with its place, and its noise, relative to a node that stays."""
        self.thinned.add(*np.searchsorted(self.ids, (ids, anchors)), *places)

    def move_frozen(self, T: se2.PoseVector) -> None:
        """Move the frozen poses by a rigid motion of the map."""
        if self.n_frozen > 0:
            self._frozen.values[:] = se2.compose(T, self._frozen.values)

    def fill(self, saved: SavedNodes) -> None:
        """Fill this empty table."""
        self._stamps, self._ids, self._odometry, self._frozen = map(
            GrowingArray.of, (saved.stamps_ns, saved.ids, saved.odometry, saved.frozen))
        self._travelled, thinned = saved.travelled, saved.thinned
        self.thinned = ThinnedNodes(self.n_frozen)
        self.thinned.add(thinned['numbers'], thinned['anchors'], thinned['relative'],
                         full(thinned['noise']))
