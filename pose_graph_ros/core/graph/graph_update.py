# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What goes into a `Graph`, and what comes out of it as a whole."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import Factors, NodeKind, RECORD
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.saved_columns import Column, Flags, Integers, Rows3

# Empty parts of updates.
NO_POSES: Final[FloatArray] = np.empty((0, 3))
NO_POINTS: Final[FloatArray] = np.empty((0, 2))
NO_FACTORS: Final = Factors()
NO_WEIGHTS: Final[Mapping[int, float]] = MappingProxyType({})


class Measured(NamedTuple):
    """Other measurements of factors that there are."""

    ids: IntArray
    mean: Poses
    information: FloatArray     # shape (M, 3, 3)


class GraphUpdate(NamedTuple):
    """
    An edit of a graph; all nodes and factors in it are given by their ids.

    New hidden nodes and factors get the next ids (`Graph.next_ids`), in order: first `hidden`,
    then `biases`, then `landmarks`. New factors and edits may be on new nodes.
    """

    hidden: Poses = NO_POSES    # initial poses of new hidden nodes in the map
    factors: Factors = NO_FACTORS
    biases: FloatArray = NO_POSES   # initial values of new ones, shape (S, 3) [sigma, sigma, rad]
    dimensions: Sequence[int] = ()  # of the new biases, by default 3; other coordinates stay 0
    landmarks: FloatArray = NO_POINTS   # initial positions of new ones, shape (L, 2) [m]
    fix: Sequence[int] = ()     # hidden nodes that keep their pose from now on (the gauge)
    free: Sequence[int] = ()    # hidden nodes that are no longer fixed
    # factors whose weight becomes 0: they keep row and id, and may get a new weight
    remove: Sequence[int] = ()
    # new weights (what the information is multiplied by) of factors, removed ones included, by id
    weigh: Mapping[int, float] = NO_WEIGHTS
    # hidden nodes that leave the graph for good, with all factors on them, those with weight 0
    # included; what they told about the others is lost, see `marginalization`
    remove_nodes: Sequence[int] = ()
    drop: Sequence[int] = ()    # factors that leave the graph for good
    priors: Sequence[Prior] = ()    # new dense ones
    measure: Sequence[Measured] = ()    # new mean and information; factors keep their weights

    @property
    def edits(self) -> bool:
        """Whether it edits what there is, by any part from `fix` on."""
        return any(map(len, self[5:]))


class Gone(NamedTuple):
    """Ids of what has left a graph, ascending."""

    nodes: IntArray
    factors: IntArray   # with those that were on these nodes, whatever their weight

class Energies(NamedTuple):
    """Energies of all factors: weighted squared errors [sigma^2]."""

    factors: FloatArray
    priors: FloatArray

    @property
    def chi2(self) -> float:
        """Sum of the energies, without a factor 1/2."""
        return float(np.sum(self.factors) + np.sum(self.priors))


class NextIds(NamedTuple):
    """Ids of the next new hidden node (or bias) and factor."""

    node: int
    factor: int


class GraphRows(NamedTuple):
    """Copies of all rows of a graph; nodes of factors are ids."""

    poses: Rows3        # estimates of all hidden nodes, biases included
    # `NodeKind` of the hidden nodes
    node_kind: Annotated[npt.NDArray[Any], Column(np.uint8)]
    fixed: Flags
    factors: Annotated[Factors, Column(RECORD)]
    node_ids: Integers      # ascending
    factor_ids: Integers
    next_ids: NextIds       # at least 1 more than the last ones
    dimension: Integers     # numbers of coordinates of the hidden nodes
    priors: tuple[Prior, ...] = ()  # all dense ones, by ids

    @property
    def is_bias(self) -> BoolArray:
        """Whether hidden nodes are biases."""
        return np.asarray(self.node_kind == NodeKind.BIAS)

    @property
    def is_pose(self) -> BoolArray:
        """Whether hidden nodes are poses."""
        return np.asarray(self.node_kind == NodeKind.POSE)

    def rows_of(self, ids: IntArray) -> IntArray:
        """Return the rows of nodes that are in the graph, given their ids."""
        return np.asarray(np.searchsorted(self.node_ids, ids), dtype=np.int64)

    def since(self, first: NextIds) -> 'GraphRows':
        """Return the rows that are new since the next ids were these; priors have no ids."""
        nodes, factors = (
            slice(int(np.searchsorted(ids, begin)), None) for ids, begin in zip(
                (self.node_ids, self.factor_ids), first, strict=True))
        return GraphRows(
            self.poses[nodes], self.node_kind[nodes], self.fixed[nodes],
            self.factors.rows(factors), self.node_ids[nodes], self.factor_ids[factors],
            self.next_ids, self.dimension[nodes])
