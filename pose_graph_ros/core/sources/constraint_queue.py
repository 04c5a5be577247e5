# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints that are attached to hidden nodes, on their way into the graph."""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKinds, Edges, ObservedNodes
from pose_graph_ros.core.measurements import Absolute, Measurement
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.odometry.turns import Turn
from pose_graph_ros.core.saved_columns import Integers, Pairs, Rows3, Rows6

NO_NOISE: Final[FloatArray] = np.zeros(2)


@dataclass(frozen=True, slots=True)
class SavedEdges:
    """Edges that are not in the graph yet."""

    sources: tuple[str, ...]
    i: Integers
    j: Integers
    mean: Rows3
    information: Rows6
    kind: EdgeKinds
    stamps_ns: Pairs
    """Of a loop closure and of its other end [ns]; -1 for odometry."""


class QueuedEdge(NamedTuple):
    """An edge between hidden nodes for the next update."""

    source: str
    edge: Edges
    stamp_ns: int = -1
    """Of the loop closure [ns]; -1 for an edge of odometry."""
    reference_ns: int = -1
    """Stamp of its other end [ns]."""

    def is_on(self, nodes: Collection[int]) -> bool:
        """Return whether one of its ends is one of some nodes, given by their ids."""
        return int(self.edge.i[0]) in nodes or int(self.edge.j[0]) in nodes


class AttachedMeasurement(NamedTuple):
    """A measurement that is attached to a hidden node."""

    source: str
    observed: ObservedNodes
    """Its constraint if its error is treated as white."""
    measurement: Absolute
    attachment: Attachment


@dataclass(slots=True)
class Queue:
    """Constraints for the next update, with their sources."""

    edges: list[QueuedEdge] = field(default_factory=list)
    observed: list[AttachedMeasurement] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.edges) + len(self.observed) + len(self.turns)

    def extend(self, other: 'Queue') -> None:
        """Append all constraints of another queue."""
        self.edges += other.edges
        self.observed += other.observed
        self.turns += other.turns

    def joined(self, other: 'Queue') -> 'Queue':
        """Return a new queue with the constraints of this one, then those of another one."""
        return Queue([*self.edges, *other.edges], [*self.observed, *other.observed],
                     [*self.turns, *other.turns])

    def newest(self, n: int) -> 'Queue':
        """Return a new queue with the newest n constraints of each type."""
        return Queue(self.edges[-n:], self.observed[-n:], self.turns[-n:])

    def replace_by(self, other: 'Queue') -> None:
        """Replace all constraints by those of another queue."""
        self.edges, self.observed, self.turns = other.edges, other.observed, other.turns

    def drop(self, nodes: Collection[int]) -> list[str]:
        """Return the sources of the constraints on nodes that have left, after removing them."""
        gone = [each.source for each in self.edges if each.is_on(nodes)]
        gone += [each.source for each in self.observed if each.attachment.node in nodes]
        gone += [turn.source for turn in self.turns if turn.i in nodes or turn.j in nodes]
        if len(gone) > 0:
            self.turns = [
                turn for turn in self.turns if turn.i not in nodes and turn.j not in nodes]
            self.edges = [each for each in self.edges if not each.is_on(nodes)]
            self.observed = [
                each for each in self.observed if each.attachment.node not in nodes]
        return gone

    def halves(self) -> 'tuple[Queue, Queue]':
        """Return the first half of the constraints and the rest, as new queues."""
        half = len(self) // 2
        n_edges = min(half, len(self.edges))
        n_observed = min(half - n_edges, len(self.observed))
        n_turns = half - n_edges - n_observed
        return (Queue(self.edges[:n_edges], self.observed[:n_observed], self.turns[:n_turns]),
                Queue(self.edges[n_edges:], self.observed[n_observed:], self.turns[n_turns:]))


class ConstraintOrigin(NamedTuple):
    """The measurement that a constraint was made from."""

    source: str
    stamp_ns: int
    """[ns]; -1 for an edge between poses."""


class NewConstraint(NamedTuple):
    """A constraint in the update that was built last."""

    is_edge: bool
    number: int
    """Its id."""
    source: str
    stamp_ns: int
    """Of the measurement [ns]; -1 for an edge of odometry."""
    kind: type[Measurement]
    """`LoopClosure` for all edges between poses."""
    reference_ns: int = -1
    """Stamp of the other end of a loop closure [ns]; else -1."""
    noise: FloatArray = NO_NOISE
    """What the motion since the node adds to its variances; see `motion_noise`."""
    held_by: int = -1
    """Id of the edge that holds it instead of the observed node `number`, or -1."""
