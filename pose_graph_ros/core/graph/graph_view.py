# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A view of a graph for display: positions of nodes, and constraints with the size of their errors.

The error of a constraint is given in sigmas, as the root of its energy per degree of freedom. The
energy is unweighted, so that a wrong measurement shows its large error even if a robust loss gives
it a small weight.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.core.graph.graph import Graph

# Columns of the tables: diagonal of the information, offset or arm with the measured position.
DIAGONAL = [tb.INFO, tb.INFO + 3, tb.INFO + 5]
_OFFSET_AND_MEAN = [tb.OBS_OFFSET, tb.OBS_OFFSET + 1, tb.MEAN, tb.MEAN + 1]
_ARM_AND_MEAN = [tb.BIAS_OFFSET, tb.BIAS_OFFSET + 1, tb.MEAN, tb.MEAN + 1]


@dataclass(frozen=True, slots=True)
class Lines:
    """Constraints as straight lines; the arrays are read-only copies."""

    ends: FloatArray
    """Both ends of each line in the map, shape (M, 2, 2) [m]."""
    sigmas: FloatArray
    """Errors: roots of the unweighted energies per degree of freedom, shape (M,) [sigma]."""

    def __post_init__(self) -> None:
        self.ends.flags.writeable = self.sigmas.flags.writeable = False


@dataclass(frozen=True, slots=True)
class GraphView:
    """Immutable view of a graph for display."""

    nodes: FloatArray
    """Hidden nodes in the map without biases, shape (N, 2) [m], read-only."""
    odometry: Lines
    """Edges of odometry, from node to node."""
    loop_closures: Lines
    """Loop closures, from node to node."""
    observed: Lines
    """Measured positions (of an antenna, or the robot), from the predicted to the measured one."""

    def __post_init__(self) -> None:
        self.nodes.flags.writeable = False


def view(graph: Graph) -> GraphView | None:
    """Return the view of a graph; None if the graph is empty."""
    if graph.n_nodes == 0:
        return None
    positions, is_bias = graph.poses[:, :2].copy(), graph.is_bias
    (edges, edge_sigmas), (observed, observed_sigmas) = (
        (table, np.sqrt(np.maximum(table.energies, 0.0) / np.maximum(table.freedom, 1)))
        for table in constraint_tables(graph))
    lines = []
    for kind in (EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE):
        rows = np.flatnonzero(
            (edges.integers[:, tb.EDGE_KIND] == kind) & (edges.weights > 0.0))
        ends = edges.integers[rows, tb.END_I:tb.END_J + 1]
        # `take` is several times as fast as an index
        lines.append(Lines(positions.take(ends, axis=0), edge_sigmas[rows]))
    # a measurement with a time-correlated error is an edge to a bias
    biased = np.flatnonzero(
        (edges.integers[:, tb.EDGE_KIND] == EdgeKind.BIAS) & edges.tells_position
        & ~is_bias[edges.integers[:, tb.END_I]])
    seen = np.flatnonzero(
        observed.tells_position & ~is_bias[observed.integers[:, tb.OBS_NODE]])
    nodes = np.concatenate((
        observed.integers[seen, tb.OBS_NODE], edges.integers[biased, tb.END_I]))
    offsets, measured = np.concatenate((
        observed.numbers[seen][:, _OFFSET_AND_MEAN], edges.numbers[biased][:, _ARM_AND_MEAN],
    )).reshape(-1, 2, 2).swapaxes(0, 1)
    predicted = se2.transform(graph.poses[nodes], offsets)
    return GraphView(
        positions.take(np.flatnonzero(~is_bias), axis=0), lines[0], lines[1],
        Lines(np.stack((predicted, measured), axis=1),
              np.concatenate((observed_sigmas[seen], edge_sigmas[biased]))))


class ConstraintTable(NamedTuple):
    """All edges, or all observed nodes: views of the graph's tables, with energies."""

    numbers: FloatArray
    """Rows of edge_f or observed_f."""
    integers: IntArray
    """Rows of edge_i or observed_i."""
    energies: FloatArray
    """Unweighted energies, shape (M,) [sigma^2]."""

    @property
    def weights(self) -> FloatArray:
        """Factors on the information, shape (M,)."""
        return self.numbers[:, tb.WEIGHT]

    @property
    def tells_position(self) -> BoolArray:
        """Whether constraints measure a position and are not removed, shape (M,)."""
        return (self.numbers[:, tb.INFO] > 0.0) & (self.weights > 0.0)

    @property
    def freedom(self) -> IntArray:
        """Degrees of freedom: how many coordinates each constraint measures, shape (M,)."""
        return np.asarray(np.count_nonzero(self.numbers[:, DIAGONAL] > 0.0, axis=1))


def constraint_tables(graph: Graph) -> tuple[ConstraintTable, ConstraintTable]:
    """Return the edges and the observed nodes of a graph."""
    edges, observed = np.empty(graph.n_edges), np.empty(graph.n_observed)
    factors.energies(graph.memory.head, edges, observed)
    return tuple(  # type: ignore[return-value]
        ConstraintTable(graph.memory[f'{name}_f'][:len(energies)],
                        graph.memory[f'{name}_i'][:len(energies)], energies)
        for name, energies in (('edge', edges), ('observed', observed)))
