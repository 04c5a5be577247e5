# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A view of a graph for display: positions of nodes, and constraints with the size of their errors.

The error of a constraint is given in sigmas, as the root of its energy per degree of freedom. The
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
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph

# Columns of the tables: diagonal of the information, offset with the measured position.
DIAGONAL = [tb.INFO, tb.INFO + 3, tb.INFO + 5]
_OFFSET_AND_MEAN = [tb.OFFSET, tb.OFFSET + 1, tb.MEAN, tb.MEAN + 1]


@dataclass(frozen=True, slots=True)
class Lines:
    """Constraints as straight lines; the arrays are copies."""

    ends: FloatArray    # both ends of each line in the map, shape (M, 2, 2) [m]
    sigmas: FloatArray  # errors [sigma]


NO_LINES = Lines(np.empty((0, 2, 2)), np.empty(0))


class DrawnRows(NamedTuple):
    """Ids of constraints that are drawn in another way, as they are not simply believed."""

    # edges between poses
    weak: Sequence[int] = ()        # in the estimate, but little speaks for them
    waiting: Sequence[int] = ()     # not in the estimate yet
    doubted: Sequence[int] = ()     # left out
    # measurements in the map that are not in the estimate: edges to biases, observed nodes
    unused_edges: Sequence[int] = ()
    unused_observed: Sequence[int] = ()


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
    tables = constraint_tables(graph)
    edges, observed = tables
    sigmas = edges.sigmas

    def lines(rows: IntArray) -> Lines:
        # `take` is several times as fast as an index
        return Lines(positions.take(edges.integers[rows, tb.END_I:tb.END_J + 1], axis=0),
                     sigmas[rows])

    in_graph, kinds = edges.weights > 0.0, edges.integers[:, tb.EDGE_KIND]
    weak, waiting, doubted, unused_edges, unused_observed = (
        rows[rows >= 0] for part, rows_of in zip(
            drawn, (graph.edge_rows,) * 4 + (graph.observed_rows,), strict=True)
        for rows in (rows_of(np.array(part, dtype=np.int64)),))
    in_graph[weak] = in_graph[doubted] = False
    # a measurement with a time-correlated error is an edge to a bias
    biased, seen = (np.flatnonzero(
        of_kind & table.tells_position & ~is_bias[table.integers[:, tb.END_I]])
        for of_kind, table in ((kinds == EdgeKind.BIAS, edges), (True, observed)))
    return GraphView(
        nodes=positions.take(np.flatnonzero(~is_bias), axis=0),
        odometry=lines(np.flatnonzero(in_graph & (kinds == EdgeKind.ODOMETRY))),
        loop_closures=lines(np.flatnonzero(in_graph & (kinds == EdgeKind.LOOP_CLOSURE))),
        observed=_measured(graph, tables, biased, seen), weak=lines(weak),
        waiting=lines(waiting), doubted=lines(doubted),
        unused=_measured(graph, tables, *(
            rows[table.numbers[rows, tb.INFO] > 0.0]
            for table, rows in zip(tables, (unused_edges, unused_observed), strict=True))))


def _measured(
    graph: Graph, tables: 'tuple[ConstraintTable, ConstraintTable]', biased: IntArray,
    seen: IntArray,
) -> Lines:
    """Return measured positions, given the rows of edges to biases and of observed nodes."""
    nodes, numbers, sigmas = map(np.concatenate, zip(*(
        (table.integers[rows, tb.END_I], table.numbers[rows], table.sigmas[rows])
        for table, rows in zip(tables[::-1], (seen, biased), strict=True)), strict=True))
    offsets, measured = numbers[:, _OFFSET_AND_MEAN].reshape(-1, 2, 2).swapaxes(0, 1)
    predicted = se2.transform(graph.poses[nodes], offsets)
    return Lines(np.stack((predicted, measured), axis=1), sigmas)


class ConstraintTable(NamedTuple):
    """All edges, or all observed nodes: views of the graph's tables, with energies."""

    numbers: FloatArray     # rows of edge_f or observed_f
    integers: IntArray      # rows of edge_i or observed_i
    energies: FloatArray    # unweighted [sigma^2]

    @property
    def weights(self) -> FloatArray:
        """Factors on the information."""
        return self.numbers[:, tb.WEIGHT]

    @property
    def tells_position(self) -> BoolArray:
        """Whether constraints measure a position and are not removed."""
        return (self.numbers[:, tb.INFO] > 0.0) & (self.weights > 0.0)

    @property
    def sigmas(self) -> FloatArray:
        """Roots of the unweighted energies per degree of freedom [sigma]."""
        return np.asarray(np.sqrt(np.maximum(self.energies, 0.0) / np.maximum(self.freedom, 1)))

    @property
    def freedom(self) -> IntArray:
        """Degrees of freedom: how many coordinates each constraint measures."""
        return np.asarray(np.count_nonzero(self.numbers[:, DIAGONAL] > 0.0, axis=1))


def constraint_tables(graph: Graph) -> tuple[ConstraintTable, ConstraintTable]:
    """Return the edges and the observed nodes of a graph."""
    edges, observed = np.empty(graph.n_edges), np.empty(graph.n_observed)
    factors.energies(graph.memory.head, edges, observed)
    return tuple(  # type: ignore[return-value]
        ConstraintTable(graph.memory[f'{name}_f'][:len(energies)],
                        graph.memory[f'{name}_i'][:len(energies)], energies)
        for name, energies in (('edge', edges), ('observed', observed)))
