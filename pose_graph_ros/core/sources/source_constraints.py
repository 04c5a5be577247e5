# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints that are attached to hidden nodes: on their way into the graph, and in it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from typing import Final, NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.growing_array import GrowingArray
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, FactorKinds, Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.measurements import Absolute, LoopClosure, PoseMeasurement
from pose_graph_ros.core.odometry.gyro import Turn
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, Attachment, OdometryErrors
from pose_graph_ros.core.saved_columns import Integers, Numbers, Pairs, Rows2, Rows3, Rows4, Rows6
from pose_graph_ros.core.sources.error_likelihood import PastPath
from pose_graph_ros.core.sources.gauss_markov import CorrelatedErrors, SavedBins
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_report import SourceReport

NO_NOISE: Final[FloatArray] = np.zeros(2)


@dataclass(frozen=True, slots=True)
class SavedEdges:
    sources: tuple[str, ...]
    i: Integers
    j: Integers
    mean: Rows3
    information: Rows6
    kind: FactorKinds
    stamps_ns: Pairs  # of a loop closure and of its other end [ns]; -1 for odometry
    # columns of `Factors`; empty in files of older versions, which have no ranges
    constants: Rows4 = field(default_factory=lambda: np.empty((0, 4)))


class QueuedEdge(NamedTuple):
    source: str
    edge: Factors
    stamp_ns: int = -1  # of the loop closure [ns]; -1 for an edge of odometry
    reference_ns: int = -1  # stamp of its other end [ns]
    kind: type[PoseMeasurement] = LoopClosure  # also of odometry

    @property
    def ends(self) -> tuple[int, ...]:
        """Ids of the nodes that it is on."""
        return int(self.edge.i[0]), int(self.edge.j[0])


class AttachedMeasurement(NamedTuple):
    source: str
    observed: Factors  # its constraint if its error is treated as white
    measurement: Absolute
    attachment: Attachment
    # what the motion since the node adds to the variances of position and heading
    noise: FloatArray = NO_NOISE

    @property
    def is_placed(self) -> bool:
        """Whether it contains a position: not if it is a heading."""
        return bool(self.observed.kind[0] != FactorKind.HEADING)

    @property
    def ends(self) -> tuple[int, ...]:
        """Id of the node that it is on."""
        return (self.attachment.node,)


@dataclass(slots=True)
class Queue:
    """Constraints for the next update, with their sources."""

    edges: list[QueuedEdge] = field(default_factory=list)
    observed: list[AttachedMeasurement] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.edges) + len(self.observed) + len(self.turns)

    def extend(self, other: 'Queue') -> None:
        self.replace_by(self.joined(other))

    def joined(self, other: 'Queue') -> 'Queue':
        return Queue(self.edges + other.edges, self.observed + other.observed,
                     self.turns + other.turns)

    def newest(self, n: int) -> 'Queue':
        return Queue(self.edges[-n:], self.observed[-n:], self.turns[-n:])

    def replace_by(self, other: 'Queue') -> None:
        self.edges, self.observed, self.turns = other.edges, other.observed, other.turns

    def drop(self, nodes: set[int]) -> list[str]:
        """Return the sources of the constraints on nodes that have left, after removing them."""
        every: Iterator[QueuedEdge | AttachedMeasurement | Turn] = chain(
            self.edges, self.observed, self.turns)
        gone = [each.source for each in every if not nodes.isdisjoint(each.ends)]
        self.edges = [each for each in self.edges if nodes.isdisjoint(each.ends)]
        self.observed = [each for each in self.observed if nodes.isdisjoint(each.ends)]
        self.turns = [each for each in self.turns if nodes.isdisjoint(each.ends)]
        return gone

    def halves(self) -> 'tuple[Queue, Queue]':
        half = len(self) // 2
        n_edges = min(half, len(self.edges))
        n_observed = min(half - n_edges, len(self.observed))
        n_turns = half - n_edges - n_observed
        return (Queue(self.edges[:n_edges], self.observed[:n_observed], self.turns[:n_turns]),
                Queue(self.edges[n_edges:], self.observed[n_observed:], self.turns[n_turns:]))


class ConstraintOrigin(NamedTuple):
    """The measurement that a constraint was made from."""

    source: str
    stamp_ns: int  # [ns]; -1 for an edge between poses


class NewConstraint(NamedTuple):
    """A constraint in the update that was built last."""

    number: int  # its id
    source: str
    stamp_ns: int  # of the measurement [ns]; -1 for an edge of odometry
    kind: type[PoseMeasurement]  # `LoopClosure` for all edges between poses
    reference_ns: int = -1  # stamp of the other end of a loop closure [ns]; else -1
    # what the motion since the node adds to its variances, as `AttachedMeasurement.noise`
    noise: FloatArray = NO_NOISE
    held_by: int = -1  # id of the edge that holds it instead of the observed node `number`, or -1

    @property
    def held(self) -> int:
        """Id of the factor that holds it."""
        return self.held_by if self.held_by >= 0 else self.number


@dataclass(frozen=True, slots=True)
class SavedSource:
    seen_ns: Integers  # stamps of all measurements that were received [ns], sorted
    # for each stamp the reference of the loop closure, 0 for others; see `waiting`
    seen_references: Integers
    # Stamp [ns] and id of each constraint, shape (K, 2): of an edge if a bias with a given
    # correlation time was estimated, else of an observed node.
    rows: Pairs
    n_otherwise: int  # number of constraints that were added under other settings
    ties: Integers  # ids of its edges between hidden nodes, except those of the primary odometry
    bins: SavedBins | None  # states of its bias, if it has one
    # estimated statistics of its errors that are in use; None for white or given ones
    errors: CorrelatedErrors | None = None
    # what the motion since the node adds to the variances, or empty
    noise: Rows2 = field(default_factory=lambda: np.empty((0, 2)))
    # with estimated statistics, ids of the edges that hold the measurements, or empty
    edges: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    # number of measurements at which its errors are estimated next
    next_estimate: int = SOURCES.least_positions
    odometry_scale: float = 1.0  # in files of older versions, factor on the sigmas of odometry
    n_gone: int = 0  # number of its measurements that have left the graph
    past: PastPath | None = None  # their positions, where its errors are estimated
    # `OdometryErrors` that its measurements show; empty in files of older versions
    odometry: Numbers = field(default_factory=lambda: np.empty(0))


class SourceConstraints:
    """
    The constraints of one source.

    A measurement whose error was found to be correlated keeps its observed node, with weight 0;
    an edge to the bias holds it instead. So it can become white again, or get another bias.
    """

    def __init__(self) -> None:
        # stamp [ns] of each measurement, and the id of what it was first added as
        self.rows = GrowingArray((2,), np.int64)
        # what the motion since the node adds to its variances, as `AttachedMeasurement.noise`
        self.noise = GrowingArray((2,), np.float64)
        self.edges = GrowingArray((), np.int64)  # id of the edge that holds it instead, or -1
        self.report: SourceReport | None = None  # the newest report
        self.n_reported = 0  # number of measurements when it was made; 0 if none of them was used
        self.n_gone = 0  # number of measurements that have left the graph
        self.past: PastPath | None = None  # their positions, where the errors are estimated
        self.n_otherwise = 0  # constraints of a loaded graph that were added under other settings
        # number of measurements at which the errors are estimated next
        self.next_estimate = SOURCES.least_positions
        self.odometry = AS_CLAIMED  # errors of odometry that the measurements show

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def n_ever(self) -> int:
        """Number of measurements, with those that have left the graph."""
        return len(self) + self.n_gone

    def leaving(self, factors: IntArray) -> BoolArray:
        return np.isin(self.rows.values[:, 1], factors)

    def forget(self, gone: BoolArray) -> IntArray:
        """Return the numbers of the measurements that are left, after forgetting the others."""
        kept = np.flatnonzero(~gone)
        if len(kept) < len(self):
            self.n_gone += len(self) - len(kept)
            for column in (self.rows, self.noise, self.edges):
                column.select(kept)
        return kept

    def append(self, stamp_ns: int, number: int, noise: FloatArray, edge: int) -> None:
        """
        Append a measurement: the id of what it was added as, and of the edge that holds it, or -1.
        """
        self.rows.append_one((stamp_ns, number))
        self.noise.append_one(noise)
        self.edges.append_one(edge)

    def held(self, which: IntArray | slice = slice(None)) -> IntArray:
        """Return the ids of the factors that hold some measurements."""
        edges = self.edges.values[which]
        return np.where(edges >= 0, edges, self.rows.values[which, 1])

    def are_used(self, graph: Graph, weights: FloatArray | None = None) -> BoolArray:
        """Tell which measurements have a weight, in the graph or given by row."""
        weights = graph.weights if weights is None else weights
        return np.asarray(weights[graph.factor_rows(self.held())] > 0.0)

    def stamp_ns(self, number: int) -> int | None:
        """Return the stamp of the measurement that a factor holds [ns], or None."""
        # ids are appended in increasing order
        at = int(np.searchsorted(self.rows.values[:, 1], number))
        if at < len(self.rows) and self.rows.values[at, 1] == number:
            return int(self.rows.values[at, 0])
        found_at = np.flatnonzero(self.edges.values == number)
        return int(self.rows.values[found_at[0], 0]) if len(found_at) > 0 else None

    def restore(self, saved: SavedSource) -> None:
        n = len(saved.rows)
        self.rows.append(saved.rows)
        self.noise.append(saved.noise if len(saved.noise) == n else np.zeros((n, 2)))
        self.edges.append(saved.edges if len(saved.edges) == n else np.full(n, -1))
        self.n_gone, self.past = saved.n_gone, saved.past
        if self.past is not None and len(self.past.lever) == 0:
            self.past = None    # of an older version, which knew less of odometry
        self.next_estimate = saved.next_estimate
        self.odometry = (OdometryErrors(*saved.odometry.tolist()) if len(saved.odometry) > 0
                         else OdometryErrors.scaled(saved.odometry_scale))
