# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A view of a graph for display: positions of nodes, and factors with the size of their errors.

The error of a factor is given in sigmas, as the root of its energy per degree of freedom. The
energy is unweighted, so that a wrong measurement shows its large error even if a robust loss gives
it a small weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Points
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph

# Columns of the tables: diagonal of the information, offset with the measured position.
DIAGONAL = [tb.INFO, tb.INFO + 3, tb.INFO + 5]
_OFFSET_AND_MEAN = [tb.OFFSET, tb.OFFSET + 1, tb.MEAN, tb.MEAN + 1]


@dataclass(frozen=True, slots=True)
class Lines:
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


@dataclass(frozen=True, slots=True)
class GraphView:
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
    sigmas = table.sigmas

    def lines(rows: IntArray) -> Lines:
        # `take` is several times as fast as an index
        return Lines(positions.take(table.integers[rows, tb.END_I:tb.END_J + 1], axis=0),
                     sigmas[rows])

    in_graph, kinds = table.weights > 0.0, table.integers[:, tb.FACTOR_KIND]
    weak, waiting, doubted, unused = (
        rows[rows >= 0] for part in drawn
        for rows in (graph.factor_rows(np.array(part, dtype=np.int64)),))
    in_graph[weak] = in_graph[doubted] = False
    # a measurement with a time-correlated error is an edge to a bias
    in_map = np.flatnonzero(
        ((kinds == FactorKind.BIAS) | (table.integers[:, tb.END_J] < 0)) & table.tells_position
        & ~is_bias[table.integers[:, tb.END_I]])
    return GraphView(
        nodes=positions.take(np.flatnonzero(~is_bias), axis=0),
        odometry=lines(np.flatnonzero(in_graph & (kinds == FactorKind.ODOMETRY))),
        loop_closures=lines(np.flatnonzero(in_graph & (kinds == FactorKind.LOOP_CLOSURE))),
        observed=_measured(graph, table, in_map), weak=lines(weak),
        waiting=lines(waiting), doubted=lines(doubted),
        unused=_measured(graph, table, unused[table.numbers[unused, tb.INFO] > 0.0]))


def _measured(graph: Graph, table: 'FactorTable', rows: IntArray) -> Lines:
    """Return measured positions, given the rows of their factors."""
    offsets, measured = table.numbers[rows][:, _OFFSET_AND_MEAN].reshape(-1, 2, 2).swapaxes(0, 1)
    predicted = se2.transform(graph.poses[table.integers[rows, tb.END_I]], offsets)
    return Lines(np.stack((predicted, measured), axis=1), table.sigmas[rows])


class FactorTable(NamedTuple):
    """All factors: views of the graph's tables, with energies."""

    numbers: FloatArray     # rows of factor_f
    integers: IntArray      # rows of factor_i
    energies: FloatArray    # unweighted [sigma^2]

    @property
    def weights(self) -> FloatArray:
        """What the information is multiplied by."""
        return self.numbers[:, tb.WEIGHT]

    @property
    def tells_position(self) -> BoolArray:
        """Whether factors measure a position and are not removed."""
        return (self.numbers[:, tb.INFO] > 0.0) & (self.weights > 0.0)

    @property
    def sigmas(self) -> FloatArray:
        """Roots of the unweighted energies per degree of freedom [sigma]."""
        return np.asarray(np.sqrt(np.maximum(self.energies, 0.0) / np.maximum(self.freedom, 1)))

    @property
    def freedom(self) -> IntArray:
        """Degrees of freedom: how many coordinates each factor measures."""
        return np.asarray(np.count_nonzero(self.numbers[:, DIAGONAL] > 0.0, axis=1))


def factor_table(graph: Graph) -> FactorTable:
    """Return the factors of a graph."""
    energies = np.empty(graph.n_factors)
    factors.energies(graph.memory.head, energies)
    return FactorTable(graph.memory['factor_f'][:len(energies)],
                       graph.memory['factor_i'][:len(energies)], energies)
