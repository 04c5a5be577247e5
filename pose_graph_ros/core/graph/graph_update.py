# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What goes into a `Graph`, and what comes out of it as a whole."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges, NodeKind, ObservedNodes
from pose_graph_ros.core.graph.priors import Prior

# Empty parts of updates.
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_POINTS: Final[FloatArray] = np.empty((0, 2))
NO_EDGES: Final = Edges()
NOTHING_OBSERVED: Final = ObservedNodes()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})


class Measured(NamedTuple):
    """Other measurements of edges that there are; raises GraphUpdateError where invalid."""

    ids: IntArray
    """Shape (M,)."""
    mean: FloatArray
    """Shape (M, 3)."""
    information: FloatArray
    """Shape (M, 3, 3)."""


class GraphUpdate(NamedTuple):
    """
    An edit of a graph; all nodes and constraints in it are given by their ids.

    New hidden nodes, edges and observed nodes get the next ids (`Graph.next_ids`), in order.
    """

    hidden: FloatArray = NO_POSES
    """Initial poses of new hidden nodes in the map, shape (N, 3) [m, m, rad]."""
    edges: Edges = NO_EDGES
    """New edges, possibly to the new hidden nodes."""
    observed: ObservedNodes = NOTHING_OBSERVED
    """New observed nodes, possibly on the new hidden nodes."""
    biases: FloatArray = NO_POSES
    """
    Initial values of new biases, shape (S, 3) [sigma, sigma, rad]: hidden nodes that are numbered
    after those of `hidden`.
    """
    dimensions: Sequence[int] = ()
    """Numbers of coordinates of the new biases, 3 if not given; the others are and stay 0."""
    landmarks: FloatArray = NO_POINTS
    """Initial positions of new landmarks in the map, shape (L, 2) [m], numbered after biases."""
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that are no longer fixed."""
    remove_edges: Sequence[int] = ()
    """
    Edges whose weight becomes 0: they keep row and id, and `weigh_edges` brings them back.
    `drop_edges` is for good.
    """
    remove_observed: Sequence[int] = ()
    """Observed nodes whose weight becomes 0, as `remove_edges`."""
    weigh_edges: Mapping[int, float] = NO_WEIGHTS
    """New weights (factors on the information) of edges, by id; removed edges may get one."""
    weigh_observed: Mapping[int, float] = NO_WEIGHTS
    """New weights of observed nodes, by id."""
    remove_nodes: Sequence[int] = ()
    """
    Hidden nodes that leave the graph for good, with all constraints on them, those with weight 0
    included. What they told about the others is lost; see `marginalization`.
    """
    drop_edges: Sequence[int] = ()
    """Edges that leave the graph for good."""
    drop_observed: Sequence[int] = ()
    """Observed nodes that leave the graph for good."""
    priors: Sequence[Prior] = ()
    """New dense priors, possibly on the new nodes."""
    measure_edges: Sequence[Measured] = ()
    """Edges that get another mean and information; they keep their weights."""


class Left(NamedTuple):
    """Ids of what has left a graph, ascending."""

    nodes: IntArray
    edges: IntArray
    """With those that were on these nodes, whatever their weight."""
    observed: IntArray


NOTHING_LEFT: Final = Left(*(np.empty(0, dtype=np.int64) for _ in range(3)))

# Index of the first part of an update that edits what there is.
FIRST_EDIT: Final = GraphUpdate._fields.index('fix')


class Energies(NamedTuple):
    """Energies of all constraints: weighted squared errors [sigma^2]."""

    edges: FloatArray
    """Shape (M,)."""
    observed: FloatArray
    """Shape (K,)."""
    priors: FloatArray
    """Of the dense priors."""

    @property
    def chi2(self) -> float:
        """Sum of the energies, without a factor 1/2."""
        return float(np.sum(self.edges) + np.sum(self.observed) + np.sum(self.priors))


class NextIds(NamedTuple):
    """Ids of the next new hidden node (or bias), edge and observed node."""

    node: int
    edge: int
    observed: int


class GraphRows(NamedTuple):
    """Copies of all rows of a graph."""

    poses: FloatArray
    """Estimates of all hidden nodes, biases included, shape (N, 3) [m, m, rad]."""
    node_kind: npt.NDArray[Any]
    """`NodeKind` of the hidden nodes, shape (N,)."""
    fixed: BoolArray
    edges: Edges
    """Their ends are ids."""
    observed: ObservedNodes
    """Their nodes are ids."""
    node_ids: IntArray
    """Ids of the nodes, ascending, shape (N,)."""
    edge_ids: IntArray
    observed_ids: IntArray
    next_ids: NextIds
    """Ids of the next new rows; at least 1 more than the last."""
    dimension: IntArray | None = None
    """Numbers of coordinates of the hidden nodes; by default those usual for their kinds."""
    priors: Sequence[Prior] = ()
    """All dense priors, by ids."""

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases, shape (N,)."""
        return np.asarray(self.node_kind == NodeKind.BIAS)

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses, shape (N,)."""
        return np.asarray(self.node_kind == NodeKind.POSE)

    def rows_of(self, ids: IntArray) -> IntArray:
        """Return the rows of nodes that are in the graph, given their ids."""
        return np.asarray(np.searchsorted(self.node_ids, ids), dtype=np.int64)

    def since(self, first: NextIds) -> 'GraphRows':
        """
        Return the rows that are new since the next ids were these.

        Priors have no ids, so none of them is among these rows.
        """
        nodes, edges, observed = (
            slice(int(np.searchsorted(ids, begin)), None) for ids, begin in zip(
                (self.node_ids, self.edge_ids, self.observed_ids), first, strict=True))
        return GraphRows(
            self.poses[nodes], self.node_kind[nodes], self.fixed[nodes], self.edges.rows(edges),
            self.observed.rows(observed), self.node_ids[nodes], self.edge_ids[edges],
            self.observed_ids[observed], self.next_ids,
            None if self.dimension is None else self.dimension[nodes])

    def with_edges(self, edges: Edges) -> Self:
        """Return the same rows with other edges, which get the ids 0, 1 and so on."""
        return self._replace(edges=edges, edge_ids=np.arange(len(edges)),
                             next_ids=self.next_ids._replace(edge=len(edges)))
