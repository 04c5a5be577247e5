# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The constraints as springs: where the graph is strained, for pictures and for reading.

How far a spring is stretched is told in sigmas, the root of its energy by degree of freedom, and
without the weight that a robust loss gives it: a wrong measurement does not look like a good one
because the loss has given it up.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import factors, se2, tables as tb
from pose_graph_ros.core.constraints import EdgeKind
from pose_graph_ros.core.graph import BoolArray, Graph
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.joining import Joining, Origin
from pose_graph_ros.core.se2 import FloatArray, IntArray

# Columns of the tables.
_DIAGONAL = [tb.INFO, tb.INFO + 3, tb.INFO + 5]
_OFFSET_AND_MEAN = [tb.OBS_OFFSET, tb.OBS_OFFSET + 1, tb.MEAN, tb.MEAN + 1]
_ARM_AND_MEAN = [tb.BIAS_OFFSET, tb.BIAS_OFFSET + 1, tb.MEAN, tb.MEAN + 1]


@dataclass(frozen=True, slots=True)
class Lines:
    """Springs as straight lines; arrays of their own, read-only."""

    ends: FloatArray
    """Both ends of each in the map, shape (M, 2, 2) [m]."""
    sigmas: FloatArray
    """How far each is stretched, shape (M,)."""

    def __post_init__(self) -> None:
        self.ends.flags.writeable = self.sigmas.flags.writeable = False


@dataclass(frozen=True, slots=True)
class GraphView:
    """What there is to see of a graph; nothing of it changes any more."""

    nodes: FloatArray
    """Hidden nodes in the map without biases, shape (N, 2) [m], read-only."""
    odometry: Lines
    loop_closures: Lines
    observed: Lines
    """From where the estimate puts what was measured (an antenna, the robot) to where it was."""

    def __post_init__(self) -> None:
        self.nodes.flags.writeable = False


@dataclass(frozen=True, slots=True)
class Spring:
    """One constraint and its energy."""

    energy: float
    """With its weight: its part of chi2."""
    unweighted: float
    """Without the weight, as its covariance has it."""
    freedom: int
    """Degrees of freedom: what is expected of the latter."""
    source: str
    """Of the measurement; empty if it is not known."""
    kind: str
    """`odometry`, `loop_closure`, `global_pose`, `position`, `heading`, or `bias`."""
    name: str
    """For people: `odom x12 - x13`, `fix at 1695.250 s near x812`."""


def view(graph: Graph) -> GraphView | None:
    """Return what there is to see of a graph; None if it is empty."""
    if graph.n_nodes == 0:
        return None
    positions, is_bias = graph.poses[:, :2].copy(), graph.is_bias
    (edges, edge_sigmas), (observed, observed_sigmas) = (
        (table, np.sqrt(np.maximum(table.energies, 0.0) / np.maximum(table.freedom, 1)))
        for table in _tables(graph))
    lines = []
    for kind in (EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE):
        rows = np.flatnonzero(
            (edges.integers[:, tb.EDGE_KIND] == kind) & (edges.weights > 0.0))
        ends = edges.integers[rows, tb.END_I:tb.END_J + 1]
        # `take` is several times as fast as an index
        lines.append(Lines(positions.take(ends, axis=0), edge_sigmas[rows]))
    # a measurement whose error lives on is an edge to a state of the error
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


def largest(graph: Graph, nodes: HiddenNodes, joins: Joining, n: int) -> list[Spring]:
    """Return the n constraints with the largest energies in chi2, the largest one first."""
    tables = _tables(graph)
    energies = np.concatenate([table.weights * table.energies for table in tables])
    n = min(n, int(np.count_nonzero(energies > 0.0)))
    if n <= 0:
        return []
    rows = np.flatnonzero(energies >= np.partition(energies, len(energies) - n)[-n])
    rows = rows[np.argsort(-energies[rows], kind='stable')][:n]
    named = []
    for row in rows.tolist():
        is_edge = row < graph.n_edges
        number, table = (row, tables[0]) if is_edge else (row - graph.n_edges, tables[1])
        called = (_edge_name if is_edge else _observed_name)(number, table, nodes, joins)
        named.append(Spring(float(energies[row]), float(table.energies[number]),
                            int(table.freedom[number]), *called))
    return named


class _Table(NamedTuple):
    """The edges, or the observed nodes: views of the graph's tables, and energies."""

    numbers: FloatArray
    integers: IntArray
    energies: FloatArray
    """Without weights, shape (M,)."""

    @property
    def weights(self) -> FloatArray:
        return self.numbers[:, tb.WEIGHT]

    @property
    def tells_position(self) -> BoolArray:
        """Whether it counts, and tells of a position."""
        return (self.numbers[:, tb.INFO] > 0.0) & (self.weights > 0.0)

    @property
    def freedom(self) -> IntArray:
        """How many coordinates each constraint tells, shape (M,)."""
        return np.asarray(np.count_nonzero(self.numbers[:, _DIAGONAL] > 0.0, axis=1))


def _tables(graph: Graph) -> tuple[_Table, _Table]:
    edges, observed = np.empty(graph.n_edges), np.empty(graph.n_observed)
    factors.energies(graph.memory.head, edges, observed)
    return tuple(  # type: ignore[return-value]
        _Table(graph.memory[f'{name}_f'][:len(energies)],
               graph.memory[f'{name}_i'][:len(energies)], energies)
        for name, energies in (('edge', edges), ('observed', observed)))


def _edge_name(
    row: int, edges: _Table, nodes: HiddenNodes, joins: Joining,
) -> tuple[str, str, str]:
    """Return source, kind and name of an edge, given its row in the graph."""
    integers, origin = edges.integers[row], joins.origin(row, edge=True)
    start, end, kind = (
        int(integers[column]) for column in (tb.END_I, tb.END_J, tb.EDGE_KIND))
    if kind == EdgeKind.BIAS:
        return _measurement_name(origin, start, edges.numbers[row], nodes, joins)
    i, j = np.searchsorted(nodes.rows, (start, end)).tolist()
    source = '' if origin is None else origin.source
    if origin is None and kind == EdgeKind.ODOMETRY:
        source = nodes.lead_at(int(nodes.stamps_ns[j]))
    word = EdgeKind(kind).name.lower()
    return source, word, f'{source or word} x{i} - x{j}'


def _observed_name(
    row: int, observed: _Table, nodes: HiddenNodes, joins: Joining,
) -> tuple[str, str, str]:
    """Return the same of an observed node."""
    return _measurement_name(
        joins.origin(row, edge=False), int(observed.integers[row, tb.OBS_NODE]),
        observed.numbers[row], nodes, joins)


def _measurement_name(
    origin: Origin | None, node: int, numbers: FloatArray, nodes: HiddenNodes, joins: Joining,
) -> tuple[str, str, str]:
    """
    Return the same of a measurement in the map, given its node and its row in the table.

    On a node that is a state of an error it is no measurement, but what is known of that state
    beforehand.
    """
    number = int(np.searchsorted(nodes.rows, node))
    if number == len(nodes) or nodes.rows[number] != node:
        origin, kind, where = joins.bias_origin(node), 'bias', ''
    else:
        position, _, heading = numbers[_DIAGONAL] > 0.0
        kind = 'heading' if not position else 'global_pose' if heading else 'position'
        where = f' near x{number}'
    if origin is None:
        return '', kind, f'{kind}{where}'
    what = f'error of {origin.source}' if kind == 'bias' else origin.source
    return origin.source, kind, f'{what} at {origin.stamp_ns * 1e-9:.3f} s{where}'
