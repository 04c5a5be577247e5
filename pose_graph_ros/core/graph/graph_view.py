# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A view of a graph for display: positions of nodes, and factors with the size of their errors.

The error of a factor is given in sigmas, as the root of its energy per degree of freedom. The
energy is unweighted, so that a wrong measurement shows its large error even if a robust loss gives
it a small weight.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Points
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph

# Where the diagonal is in the upper triangle of an information matrix.
DIAGONAL = [0, 3, 5]


class Lines(NamedTuple):
    """Factors as straight lines; the arrays are copies."""

    ends: FloatArray    # both ends of each line in the map, shape (M, 2, 2) [m]
    sigmas: FloatArray  # errors [sigma]


NO_LINES = Lines(np.empty((0, 2, 2)), np.empty(0))


class DrawnRows(NamedTuple):
    """Ids of factors that are drawn in another way, as they are not simply believed."""

    # edges between poses
    weak: Sequence[int] = ()        # in the estimate, but little speaks for them
    waiting: Sequence[int] = ()     # not in the estimate yet
    doubted: Sequence[int] = ()     # left out
    unused: Sequence[int] = ()      # measurements in the map that are not in the estimate


ALL_BELIEVED = DrawnRows()


class GraphView(NamedTuple):
    """View of a graph for display, which does not change with it."""

    nodes: Points   # hidden nodes in the map without biases
    odometry: Lines         # from node to node, as the loop closures
    loop_closures: Lines
    # measured positions (of an antenna, or the robot), from the predicted to the measured one
    observed: Lines
    # loop closures and, of the last ones, odometry, as in `DrawnRows`
    weak: Lines = NO_LINES
    waiting: Lines = NO_LINES
    doubted: Lines = NO_LINES
    unused: Lines = NO_LINES    # measured positions that are not in the estimate


def view(graph: Graph, drawn: DrawnRows = ALL_BELIEVED) -> GraphView | None:
    """Return the view of a graph; None if the graph is empty."""
    if graph.n_nodes == 0:
        return None
    positions, is_bias = graph.poses[:, :2].copy(), ~graph.is_pose
    table = factor_table(graph)
    sigmas, ends, kinds = table.sigmas, table.records['ends'], table.records['kind']

    def lines(rows: IntArray) -> Lines:
        # `take` is several times as fast as an index
        return Lines(positions.take(ends[rows, :2], axis=0), sigmas[rows])

    in_graph, tells_position = table.weights > 0.0, table.records['information'][:, 0] > 0.0
    used = in_graph & tells_position
    weak, waiting, doubted, unused = (
        rows[rows >= 0] for part in drawn
        for rows in (graph.factor_rows(np.array(part, dtype=np.int64)),))
    in_graph[weak] = in_graph[doubted] = False
    # a measurement with a time-correlated error is an edge to a bias
    in_map = np.flatnonzero(
        ((kinds == FactorKind.BIAS) | (ends[:, 1] < 0)) & used & ~is_bias[ends[:, 0]])
    return GraphView(
        nodes=positions.take(np.flatnonzero(~is_bias), axis=0),
        odometry=lines(np.flatnonzero(in_graph & (kinds == FactorKind.ODOMETRY))),
        loop_closures=lines(np.flatnonzero(in_graph & (kinds == FactorKind.LOOP_CLOSURE))),
        observed=_measured(graph, table, in_map), weak=lines(weak),
        waiting=lines(waiting), doubted=lines(doubted),
        unused=_measured(graph, table, unused[tells_position[unused]]))


def _measured(graph: Graph, table: 'FactorTable', rows: IntArray) -> Lines:
    """Return measured positions, given the rows of their factors."""
    nodes, offsets, measured = (
        table.records[field][rows] for field in ('ends', 'constants', 'mean'))
    predicted = se2.transform(graph.poses[nodes[:, 0]], offsets[:, :2])
    return Lines(np.stack((predicted, measured[:, :2]), axis=1), table.sigmas[rows])


class FactorTable(NamedTuple):
    """All factors, a view of the graph's table, with energies."""

    records: npt.NDArray[Any]   # of `tables.FACTOR`
    energies: FloatArray    # unweighted [sigma^2]

    @property
    def weights(self) -> FloatArray:
        """What the information is multiplied by."""
        return np.asarray(self.records['weight'])

    @property
    def sigmas(self) -> FloatArray:
        """Roots of the unweighted energies per degree of freedom [sigma]."""
        return np.asarray(np.sqrt(np.maximum(self.energies, 0.0) / np.maximum(self.freedom, 1)))

    @property
    def freedom(self) -> IntArray:
        """Degrees of freedom: how many coordinates each factor measures."""
        diagonal = self.records['information'][:, DIAGONAL]
        return np.asarray(np.count_nonzero(diagonal > 0.0, axis=1))


def factor_table(graph: Graph) -> FactorTable:
    """Return the factors of a graph."""
    return FactorTable(
        graph.factor_records, graph.unweighted_energies(np.arange(graph.n_factors)))
