# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What goes into a `Graph`, and what comes out of it as a whole."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes

# Empty parts of updates.
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_EDGES: Final = Edges()
NOTHING_OBSERVED: Final = ObservedNodes()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})


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
    fix: Sequence[int] = ()
    """Hidden nodes that keep their pose from now on (the gauge)."""
    free: Sequence[int] = ()
    """Hidden nodes that are no longer fixed."""
    remove_edges: Sequence[int] = ()
    """Edges whose weight becomes 0; they keep their ids, and `weigh_edges` brings them back."""
    remove_observed: Sequence[int] = ()
    """Observed nodes whose weight becomes 0; they keep their ids."""
    weigh_edges: Mapping[int, float] = NO_WEIGHTS
    """New weights (factors on the information) of edges, by id; removed edges may get one."""
    weigh_observed: Mapping[int, float] = NO_WEIGHTS
    """New weights of observed nodes, by id."""
    biases: FloatArray = NO_POSES
    """
    Initial values of new biases, shape (S, 3) [sigma, sigma, rad]: hidden nodes that are numbered
    after those of `hidden`.
    """


class Energies(NamedTuple):
    """Energies of all constraints: weighted squared errors [sigma^2]."""

    edges: FloatArray
    """Shape (M,)."""
    observed: FloatArray
    """Shape (K,)."""

    @property
    def chi2(self) -> float:
        """Sum of the energies, without a factor 1/2."""
        return float(np.sum(self.edges) + np.sum(self.observed))


class NextIds(NamedTuple):
    """Ids of the next new hidden node (or bias), edge and observed node."""

    node: int
    edge: int
    observed: int


class GraphRows(NamedTuple):
    """Copies of all rows of a graph."""

    poses: FloatArray
    """Estimates of all hidden nodes, biases included, shape (N, 3) [m, m, rad]."""
    is_bias: BoolArray
    fixed: BoolArray
    edges: Edges
    observed: ObservedNodes
